"""The command line, as a user meets it."""

import ctypes
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import trimesh
from deforming_tools import animate, bar, skinned_bar
from scene_tools import GlbBuilder

from warp_gi.cli import main as cli
from warp_gi.cli.interrupts import stoppable
from warp_gi.cli.options import value_given
from warp_gi.cli.render import Render, parse
from warp_gi.cli.report import LOG_WIDTH, Reporter, print_table
from warp_gi.sequence import frames as sequence
from warp_gi.sequence.preview import write_png

SMALL = ["cornell_box", "--resolution", "24x16", "--spp", "4", "--pipeline", "path"]
COMMAND = [sys.executable, "-m", "warp_gi.cli"]


def run(*arguments, **options):
    """Run warp-gi in a process of its own."""
    return subprocess.run([*COMMAND, *map(str, arguments)], capture_output=True, text=True, timeout=300, **options)


def same_frame(a, b):
    """Whether two files are equal in pixels and all metadata but the stage times."""
    a, b = sequence.read_frame(a), sequence.read_frame(b)
    keep = [{k: v for k, v in f.attributes.items() if not k.startswith(sequence.TIMES)} for f in (a, b)]
    return (
        a.names == b.names
        and all(np.array_equal(a.numpy(name), b.numpy(name), equal_nan=True) for name in a.names)
        and keep[0].keys() == keep[1].keys()
        and all(np.array_equal(keep[0][key], keep[1][key]) for key in keep[0])
    )


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    """Four small frames with previews, rendered in one go."""
    folder = tmp_path_factory.mktemp("unbroken")
    result = run("render", *SMALL, "--frames", "0-3", "--preview", "-o", folder / "a.####.exr")
    assert result.returncode == 0, result
    assert result.stderr == ""
    lines = result.stdout.splitlines()
    assert any(line.startswith("[4/4] ") for line in lines) and any("left" in line for line in lines)
    return folder


def test_render_writes_frames_and_previews(unbroken):
    assert sorted(path.name for path in unbroken.iterdir()) == sorted(
        f"a.{i:04d}.{kind}" for i in range(4) for kind in ("exr", "png")
    )
    frame = sequence.read_frame(unbroken / "a.0002.exr")
    assert frame.index == 2 and frame.time == pytest.approx(2 / 24)
    assert frame.metadata["seed"] == 1 and frame.metadata["pipeline.spp"] == 4
    assert {"paths", "compile", "bake"} <= set(frame.timings)
    terms = [frame.numpy(name) for name in ("emission", "environment", "emitters", "indirect")]
    np.testing.assert_allclose(sum(terms), frame.numpy("beauty"), rtol=4e-3, atol=1e-3)
    assert frame.numpy("beauty").max() > 0.1


def test_resume_keeps_whole_frames_and_redoes_the_others(unbroken, tmp_path, capsys):
    folder = tmp_path / "resumed"
    shutil.copytree(unbroken, folder)
    torn = folder / "a.0001.exr"
    torn.write_bytes(torn.read_bytes()[:-1])
    (folder / "a.0002.exr").unlink()
    (folder / "a.0003.png").unlink()
    kept = (folder / "a.0000.exr").stat().st_mtime_ns
    assert cli.main(["render", *SMALL, "--frames=0-3", "--preview", "--resume", "-o", f"{folder}/a.####.exr"]) == 0
    printed = capsys.readouterr().out
    assert "a.0001.exr is rendered again: not whole" in printed and "2 of 4 frames are there already" in printed
    assert (folder / "a.0000.exr").stat().st_mtime_ns == kept
    for path in unbroken.iterdir():
        if path.suffix == ".png":
            assert path.read_bytes() == (folder / path.name).read_bytes(), path.name
        else:
            assert same_frame(path, folder / path.name), path.name


@pytest.mark.parametrize(
    "change, reason",
    [
        (["--seed", "2"], "seed is 1 instead of 2"),
        (["--indirect.max-depth", "3"], "pipeline.indirect.max_depth is 64 instead of 3"),
        (["--pipeline", "direct"], "pipeline.indirect is 'BsdfPaths' instead of 'None'"),
        (["--environment", "1,1,1"], "scene_hash"),
        (["--resolution", "12x8"], "24x16 instead of 12x8"),
        (["--precision", "float"], "precision is 'half' instead of 'float'"),
    ],
)
def test_resume_redoes_frames_of_other_settings(unbroken, tmp_path, capsys, change, reason):
    shutil.copy(unbroken / "a.0000.exr", tmp_path)
    command = ["render", *SMALL, "--frames=0", "--resume", *change, "-o", str(tmp_path / "a.####.exr")]
    assert cli.main(command) == 0
    assert f"rendered again: {reason}" in capsys.readouterr().out


def _start(folder, *extra):
    frames = ["render", "cornell_box", "--resolution=48x32", "--spp=64", "--frames=0-7"]
    command = [*COMMAND, *frames, "--quiet", "-o", folder / "a.####.exr", *extra]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def _wait_for(folder, count):
    deadline = time.monotonic() + 200
    while len(list(folder.glob("a.*.exr"))) < count:
        assert time.monotonic() < deadline
        time.sleep(0.002)


PATH, CLEAN = ["--pipeline=path"], ["--spp=16"]
LEARNT = ["--pipeline=reuse", "--octree.split=1500", "--octree.collapse=700", "--spp=16", "--octree.most-samples=50000"]


@pytest.mark.parametrize("extra", [PATH, LEARNT, CLEAN], ids=["path", "learnt", "clean"])
def test_killed_runs_resume_to_the_same_files(unbroken, tmp_path, extra):
    """And where frames depend on those before, as by default, the state between them is kept as well."""
    broken, whole = tmp_path / "broken", tmp_path / "whole"
    for count in (1, 3, 4):
        process = _start(broken, "--resume", "--preview", *extra)
        _wait_for(broken, count)
        process.kill()
        assert process.wait() == -signal.SIGKILL
        for path in broken.glob("a.*.exr"):
            assert sequence.why_not_whole(path) is None, path
    for folder in (broken, whole):
        process = _start(folder, "--resume", "--preview", *extra)
        assert process.communicate(timeout=200) == ("", "") and process.returncode == 0
    names = sorted(path.name for path in whole.iterdir())
    assert len(names) == 16 + (extra is not PATH)
    leftovers = [path for path in broken.iterdir() if path.name not in names]
    assert leftovers == []
    for name in names:
        a, b = broken / name, whole / name
        assert same_frame(a, b) if name.endswith(".exr") else a.read_bytes() == b.read_bytes(), name


def test_learnt_frames_go_on_from_the_saved_state(tmp_path, capsys):
    """Frames after those that are there need no others again; a hole among them, or a damaged state, does."""
    command = [
        "render",
        "cornell_box",
        "--resolution=24x16",
        "--spp=4",
        "--pipeline=reuse",
        "-o",
        f"{tmp_path}/a.####.exr",
    ]
    assert cli.main([*command, "--frames=0-1", "--quiet"]) == 0
    assert cli.main([*command, "--frames=0-3", "--resume"]) == 0
    printed = capsys.readouterr().out
    assert "2 of 4 frames are there already" in printed and "again" not in printed
    assert cli.main([*command, "--frames=2-3", "--resume"]) == 0  # which learnt from others
    assert "a.0002.exr is rendered again: lineage is" in capsys.readouterr().out
    assert cli.main([*command, "--frames=0-3", "--resume"]) == 0
    capsys.readouterr()
    (tmp_path / "a.0002.exr").unlink()
    assert cli.main([*command, "--frames=0-3", "--resume"]) == 0
    assert "every frame is rendered again: no saved state fits" in capsys.readouterr().out
    state = tmp_path / "a.state.safetensors"
    state.write_bytes(state.read_bytes()[:-5])
    assert cli.main([*command, "--frames=0-4", "--resume"]) == 0
    assert "every frame is rendered again: no saved state fits" in capsys.readouterr().out
    assert cli.main([*command, "--frames=0-4", "--resume"]) == 0
    assert "5 of 5 frames are there already" in capsys.readouterr().out


def test_ctrl_c_keeps_what_is_done(unbroken, tmp_path):
    process = _start(tmp_path, "--spp=1024")
    _wait_for(tmp_path, 1)
    process.send_signal(signal.SIGINT)
    err = process.stderr.readline()
    process.send_signal(signal.SIGINT)  # an impatient second one, while Python leaves
    out, rest = process.communicate(timeout=60)
    assert (process.returncode, out, rest) == (130, "", "")
    assert err == "warp-gi: interrupted: finished frames are kept, --resume renders the others\n"
    files = list(tmp_path.glob("*.exr"))
    assert 1 <= len(files) < 8
    assert all(sequence.why_not_whole(path) is None for path in files)
    assert {path.name for path in tmp_path.iterdir() if path not in files} <= {"a.state.safetensors"}


def test_a_swallowed_ctrl_c_is_remembered(capfd):
    class Freed:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    before = signal.getsignal(signal.SIGINT), sys.unraisablehook
    with stoppable() as stop:
        freed = Freed()
        assert not stop.is_set()
        del freed  # Python drops what a finaliser raises
        assert stop.is_set()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert (signal.getsignal(signal.SIGINT), sys.unraisablehook) == before
    assert capfd.readouterr().err == ""


def test_time_left():
    report = Reporter(terminal=False)
    with report.bar(5):
        assert report.time_left() is None
        report.frame("a", 2.0)
        report.frame("b", 4.0)
        assert report.time_left() == pytest.approx(9.0, abs=0.5)


def test_full_disk_is_one_line(unbroken, tmp_path):
    pytest.importorskip("resource")
    script = f"""
import resource, sys
from warp_gi.cli.main import main
resource.setrlimit(resource.RLIMIT_FSIZE, (8000, 8000))
sys.exit(main(["render", *{SMALL!r}, "--frames=0-3", "--quiet", "-o", "a.####.exr"]))
"""
    result = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 1, result
    assert result.stderr.startswith("warp-gi: error: cannot write a.0000.exr: ") and result.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name != "posix", reason="needs a pseudo-terminal")
def test_progress_bar_on_a_terminal(unbroken, tmp_path):
    import pty

    ours, theirs = pty.openpty()
    command = [*COMMAND, "render", *SMALL, "--spp=2048", "--frames=0-2", "-o", tmp_path / "a.####.exr"]
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "120"}
    with subprocess.Popen(command, stdout=theirs, stderr=subprocess.PIPE, env=environment) as process:
        os.close(theirs)
        shown = b""
        while True:
            try:
                chunk = os.read(ours, 65536)
            except OSError:
                break
            if not chunk:
                break
            shown += chunk
        assert process.wait() == 0
    os.close(ours)
    assert b"3/3" in shown and b"left" in shown and b"[1/3]" not in shown
    assert b"trace 25%" in shown or b"trace 50%" in shown or b"trace 75%" in shown


def test_verbose_prints_stage_times(unbroken, tmp_path, capsys):
    assert cli.main(["render", *SMALL, "--frames=0", "--verbose", "-o", str(tmp_path / "a.exr")]) == 0
    printed = capsys.readouterr().out
    assert "seconds by stage" in printed and "primary" in printed and "write" in printed


def test_png_and_still_camera(unbroken, tmp_path):
    view = ["--eye", "0", "1", "3", "--target", "0", "1", "0", "--hfov", "50"]
    assert cli.main(["render", *SMALL, *view, "--quiet", "-o", str(tmp_path / "a.png")]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


BAD = [
    (["rendr"], "unknown command 'rendr'; did you mean 'render'?"),
    (["render", "cornel_box"], "unknown scene 'cornel_box'; did you mean 'cornell_box'?"),
    (["render", "none.glb"], "none.glb"),
    (["render", "cornell_box", "--pipeline", "pth"], "unknown pipeline 'pth'; did you mean 'path'?"),
    (["render", "cornell_box", "--pipeline", "path,indirect=BsdfPath"], "did you mean 'BsdfPaths'?"),
    (["render", "cornell_box", "--pipeline", "path,emitter=none"], "did you mean 'emitters'?"),
    (["render", "cornell_box", "--camera", "none.json"], "none.json"),
    (["render", "cornell_box", "--camera", "mainn"], "unknown camera 'mainn'; did you mean 'main'?"),
    (["render", "cornell_box", "--eye", "0", "0", "0"], "--eye and --target go together"),
    (["render", "cornell_box", "--hfov", "40"], "--hfov goes with a still camera"),
    (["render", "cornell_box", "--frames", "3-1"], "frames '3-1' not understood"),
    (["render", "cornell_box", "--resolution", "24"], "resolution '24' not understood"),
    (["render", "cornell_box", "--device", "tpu"], "device 'tpu' is not available"),
    (["render", "cornell_box", "--threads", "0"], "thread count must be"),
    (["render", "cornell_box", "--seed", "-1"], "seed must be 0 or above"),
    (["render", "cornell_box", "--frames", "0-1000000000000"], "numbers must be at most 2,147,483,647"),
    (["render", "cornell_box", "--frames", "0-2000000"], "more than 1,000,000"),
    (["render", "cornell_box", "--resolution", "1000000x1000000"], "resolution must be at most"),
    (["render", "cornell_box", "--spp", "5000000000"], "spp must be at most"),
    (["render", "cornell_box", "--scale", "0"], "go with a scene from a file"),
    (["render", "cornell_box", "--eye", "0", "1", "3", "--target", "0", "1", "0", "--hfov", "0"], "--hfov must be"),
    (["render", "cornell_box", "--device", "cuda:77"], "device 'cuda:77' is not available"),
    (["render", "cornell_box", "--frames", "0-1", "-o", "a.exr"], "put #### in the name"),
    (["render", "cornell_box", "--frames", "0", "-o", "a.tif"], ".exr or .png"),
    (["render", "cornell_box", "--frames", "0", "-o", "a.png", "--resume"], "--resume needs .exr"),
    (["render", "cornell_box", "--environment", "1,2"], "1 or 3 numbers"),
    (["render", "cornell_box", "--environment", "none.exr"], "none.exr"),
    (["render", "cornell_box", "--environment-scale", "2"], "go with --environment"),
    (["render", "cornell_box", "--frames", "0", "-o", "/dev/null/a.exr"], "/dev/null"),
    (["compare", "a.exr", "b.exr"], "a.exr: no such file"),
    (["info", "none.obj"], "none.obj"),
    (["render", "--resum"], "did you mean --resume?"),
    (["render", "--indirect.max-deph", "4"], "did you mean --indirect.max-depth?"),
    (["render", "--indirect.max-depth", "many"], "max-depth"),
    (["render", "--indirect.max-depth", "1"], "max_depth must be at least 2"),
    (["render", "--precision", "quarter"], "'half', 'float'"),
    (["compare"], "IMAGE"),
    (["bench", "pth"], "unknown benchmark suite 'pth'; did you mean 'path'?"),
]


@pytest.mark.parametrize("arguments, words", BAD, ids=[" ".join(a) for a, _ in BAD])
def test_mistakes_are_one_line(arguments, words, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(arguments) == 2
    error = capfd.readouterr().err
    assert error.startswith("warp-gi: error: ") and error.count("\n") == 1 and "Traceback" not in error
    assert words in error
    assert list(tmp_path.iterdir()) == []


def test_warnings_are_one_line(capfd, tmp_path):
    (tmp_path / "a.obj").write_text("mtllib gone.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n")
    assert cli.main(["info", str(tmp_path / "a.obj")]) == 0
    error = capfd.readouterr().err
    assert error.startswith("warp-gi: warning: ") and error.count("\n") == 1 and "gone.mtl" in error


def test_info_tells_copies_of_meshes(capfd, tmp_path):
    """A mesh that stands in three nodes has its triangles three times; nothing is said where none does."""
    glb = GlbBuilder()
    mesh = glb.mesh()
    nodes = [glb.add("nodes", {"mesh": mesh}) for _ in range(3)]
    glb.json["scenes"] = [{"nodes": nodes}]
    assert cli.main(["info", str(glb.write(tmp_path / "a.glb"))]) == 0
    assert re.search("copies of shared meshes +2, with 2 of the triangles", capfd.readouterr().out)
    assert cli.main(["info", "cornell_box"]) == 0
    assert "copies" not in capfd.readouterr().out


def test_no_memory_is_one_line(capfd, monkeypatch):
    def fails(arguments):
        raise RuntimeError("Failed to allocate 768000000000 bytes on device 'cpu'")

    monkeypatch.setattr(cli, "_dispatch", fails)
    assert cli.main(["info", "x"]) == 1
    assert capfd.readouterr().err.startswith("warp-gi: error: not enough memory: Failed to allocate 768")


def test_a_folder_in_the_way_is_named(capfd, tmp_path):
    (tmp_path / "a.exr").mkdir()
    small = ["--resolution", "4x4", "--spp", "1", "--frames", "0", "--quiet"]
    assert cli.main(["render", "cornell_box", *small, "-o", str(tmp_path / "a.exr")]) == 2
    assert f"{tmp_path / 'a.exr'}: is a folder; name a file in it" in capfd.readouterr().err


def test_traceback_on_demand(monkeypatch):
    monkeypatch.setenv("WARP_GI_DEBUG", "1")
    with pytest.raises(ValueError, match="unknown scene"):
        cli.main(["info", "cornel_box"])


@pytest.mark.parametrize("command", ["", "render", "compare", "info", "bench"])
def test_help(command, capsys):
    try:
        code = cli.main([command, "--help"] if command else ["--help"])
    except SystemExit as leaving:
        code = leaving.code or 0
    printed = capsys.readouterr().out
    assert code == 0 and "usage: warp-gi" in printed
    if command == "render":
        assert "--indirect.max-depth" in printed and "--spp" in printed and "warp-gi render hall.glb" in printed


def test_version_and_no_command(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("warp-gi 0.")
    assert cli.main([]) == 2


def test_render_without_arguments_is_the_default_sequence():
    assert parse([]) == Render(preview=True)
    assert parse(["--no-preview"]) == Render() and parse(["street"]) == Render(scene="street")


@pytest.mark.parametrize("command", ["info", "compare"])
def test_a_command_without_arguments_says_what_it_needs(command, capsys):
    assert cli.main([command]) == 2
    said = capsys.readouterr().err
    assert said.startswith("warp-gi: error: Missing from") and said.count("\n") == 1


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--ssp", "3"], "Unrecognized options: --ssp, 3; did you mean --spp? (see warp-gi render --help)"),
        (["--spp"], "Missing value for argument '--spp'. Expected 1 values (see warp-gi render --help)"),
        (["--nope"], "Unrecognized options: --nope (see warp-gi render --help)"),
    ],
)
def test_mistyped_options_are_one_line_in_every_encoding(encoding, arguments, message):
    result = run("render", *arguments, env=os.environ | {"PYTHONIOENCODING": encoding})
    assert (result.returncode, result.stdout, result.stderr) == (2, "", f"warp-gi: error: {message}\n")


@pytest.mark.parametrize(
    ("arguments", "value"),
    [
        ([], None),
        (["--spp", "4"], None),
        (["--bake", "a", "--spp", "4"], "a"),
        (["--bake=a", "b"], "a"),
        (["--bake", "a", "--bake=b"], "b"),
        (["x", "--bake"], None),
    ],
)
def test_the_value_of_a_flag_read_ahead(arguments, value):
    assert value_given(arguments, "--bake") == value


def test_compare(unbroken, tmp_path, capsys):
    a, b = unbroken / "a.0000.exr", unbroken / "a.0001.exr"
    picture = tmp_path / "d.png"
    assert cli.main(["compare", str(a), str(b), "-o", str(picture)]) == 0
    printed = capsys.readouterr().out
    assert all(word in printed for word in ("RMSE", "relMSE", "PSNR", "FLIP", "d.png"))
    from PIL import Image

    assert Image.open(picture).size == (72, 16)
    assert cli.main(["compare", str(a), str(b), "-o", str(tmp_path / "d.exr"), "--layer", "albedo"]) == 0
    difference = sequence.read_frame(tmp_path / "d.exr").numpy("beauty")
    albedos = [sequence.read_frame(path).numpy("albedo") for path in (a, b)]
    np.testing.assert_array_equal(difference, albedos[0] - albedos[1])
    assert cli.main(["compare", *[str(unbroken / f"a.000{i}.png") for i in (0, 1)], "-o", str(picture)]) == 0


def test_compare_refuses(unbroken, tmp_path, capsys):
    small = tmp_path / "small.png"
    write_png(small, np.zeros((4, 4, 3), np.uint8))
    (tmp_path / "text.png").write_text("not a picture")
    np.save(tmp_path / "objects.npy", np.array([{}]), allow_pickle=True)
    exr, png = unbroken / "a.0000.exr", unbroken / "a.0000.png"
    for a, b, extra, words in [
        (small, png, [], "image is 4x4 with 3 channels and reference 24x16"),
        (exr, png, [], "give two of a kind"),
        (tmp_path / "text.png", png, [], "text.png cannot be read as an image"),
        (tmp_path / "objects.npy", exr, [], "not a NumPy array"),
        (exr, exr, ["--layer", "shadow"], "no layer 'shadow'"),
        (exr, exr, ["-o", "d.gif"], ".png or an .exr"),
    ]:
        assert cli.main(["compare", str(a), str(b), *extra]) == 2
        error = capsys.readouterr().err
        assert words in error and error.count("\n") == 1


def test_info_names_skins_and_morph_targets(tmp_path, capsys):
    glb = skinned_bar()
    target = {"POSITION": glb.accessor(np.zeros((len(bar()[0]), 3)))}
    glb.json["meshes"][0]["primitives"][0]["targets"] = [target, target]
    animate(glb, 0, "weights", [0, 1], [[0, 0], [1, 0]])
    assert cli.main(["info", str(glb.write(tmp_path / "bar.glb"))]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "objects with a skin 1 (2 joints in 1 skins)" in told
    assert "objects that morph 1 (2 morph targets)" in told and "ignored" not in told


def test_info(capsys):
    assert cli.main(["info", "cornell_box"]) == 0
    printed = capsys.readouterr().out
    assert all(word in printed for word in ("triangles", "36", "lowest corner", "materials", "cameras", "memory"))


def test_bench_rows_as_json_lines(tmp_path):
    from warp_gi.bench.harness import runner

    rows = [{"case": "a", "seconds": 1.5}, {"case": "b", "seconds": np.float32(2)}, {"other": 1}]
    runner.write_json_lines(tmp_path / "r.jsonl", "suite", rows, True, "cpu")
    lines = [json.loads(line) for line in (tmp_path / "r.jsonl").read_text().splitlines()]
    assert [line.get("seconds") for line in lines] == [1.5, 2.0, None]
    assert all({"commit", "cpu", "warp-lang", "device", "quick", "suite"} <= set(line) for line in lines)


WIDE = {f"number {i}": 1234.5 + i for i in range(40)}


def test_a_table_wider_than_a_line_is_parted_and_no_number_broken(capsys):
    print_table("head", ["case", "spp", *WIDE], [["long_name", 4, *WIDE.values()], ["b", 16, *WIDE.values()]], [0, 1])
    lines = capsys.readouterr().out.splitlines()
    assert all(len(line) <= LOG_WIDTH for line in lines) and lines[1].startswith("head")
    heads = [line.split() for line in lines if "spp" in line]
    assert len(heads) == 2 and all(words[:2] == ["case", "spp"] for words in heads)
    bodies = [line.split() for line in lines if line.startswith(" long_name")]
    assert [word for words in bodies for word in words[2:]] == [f"{value:.4g}" for value in WIDE.values()]
    assert abs(len(bodies[0]) - len(bodies[1])) <= 1


def test_a_table_that_fits_is_left_whole(capsys):
    few = dict(list(WIDE.items())[:12])
    print_table("head", ["case", *few], [["a", *few.values()]])
    assert capsys.readouterr().out.count("case") == 1


def test_names_that_fill_a_line_are_columns_as_others(capsys):
    names = [f"name{i}" for i in range(12)]
    print_table("head", [*names, "x", "y"], [[*(letter * 20 for letter in "abcdefghijkl"), 1, 2]], range(12))
    words = capsys.readouterr().out.split()
    assert {*names, "x", "y", "1", "2", *(letter * 20 for letter in "abcdefghijkl")} <= set(words)
    assert words.count("name0") == 2 and words.count("name11") == 1


def test_output_that_cannot_be_encoded_is_replaced(tmp_path):
    scene = tmp_path / "é±.ply"
    trimesh.creation.box().export(scene)
    result = run("info", scene.name, cwd=tmp_path, env=os.environ | {"PYTHONIOENCODING": "ascii"})
    assert result.returncode == 0 and "??.ply" in result.stdout and "triangles" in result.stdout


HEAP = """
import ctypes
import warp as wp
from warp_gi.cli.report import start_warp

class Heap(ctypes.Structure):
    _fields_ = [(n, ctypes.c_size_t) for n in "arena count fast mapped mapped_bytes a b used free top".split()]

start_warp()
told = ctypes.CDLL(None).mallinfo2
told.restype = Heap
large = wp.zeros(30_000_000, dtype=wp.uint8, device="cpu")
del large  # after this the library would keep what is smaller
before = told()
arrays = [wp.zeros(size, dtype=wp.uint8, device="cpu") for size in (14_000_000, 9_000_000)]
print(told().mapped_bytes - before.mapped_bytes, told().arena - before.arena)
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="needs the heap of glibc 2.33 or newer")
@pytest.mark.parametrize("told", [False, True])
def test_large_arrays_do_not_live_in_the_heap(told):
    """Where they leave holes; unless whoever starts the process has set it otherwise."""
    environment = os.environ | ({"MALLOC_MMAP_THRESHOLD_": "33554432"} if told else {})
    found = subprocess.run([sys.executable, "-c", HEAP], capture_output=True, text=True, env=environment, check=True)
    mapped, heap = map(int, found.stdout.split())
    assert mapped < 1e5 if told else (mapped > 22e6 and heap < 1e5), found.stdout


@pytest.mark.parametrize(
    "given, wanted",
    [
        (["--environment.resolution", "512"], ("resolution", 512, 512)),
        (["--indirect.resolution=512"], ("resolution", 512, 512)),
        (["--indirect.first_rays=16"], ("first_rays", 16, 16)),
        (["--environment.no-soft-suns"], ("soft_suns", False, False)),
        (["--environment.resolution=512", "--indirect.resolution", "1024"], ("resolution", 512, 1024)),
        (["--indirect.resolution=256", "--environment.resolution", "512"], ("resolution", 512, 256)),
        (["--environment.order=6"], ("resolution", 1024, 1024)),
    ],
)
def test_terms_of_one_estimator_share_what_is_given_for_one(given, wanted):
    name, environment, indirect = wanted
    settings = parse(["--pipeline=transfer", *given]).settings
    assert (getattr(settings.environment, name), getattr(settings.indirect, name)) == (environment, indirect)
    assert (settings.environment.term, settings.indirect.term) == ("environment", "indirect")


def test_terms_of_other_estimators_share_nothing():
    default = parse(["--pipeline=reuse"]).settings
    settings = parse(["--pipeline=reuse", "--indirect.max-depth=3", "--emitters.exploration=0.25"]).settings
    assert settings.environment == default.environment and settings.indirect.max_depth == 3
    alone = parse(["--pipeline=transfer,environment=TracedEnvironment", "--indirect.resolution=128"]).settings
    assert alone.indirect.resolution == 128 and not hasattr(alone.environment, "resolution")


def test_unequal_settings_of_a_shared_bake_name_both_terms(capfd, tmp_path):
    arguments = ["render", "cornell_box", "--pipeline=transfer", "--environment.resolution=64", "--frames=0"]
    assert cli.main([*arguments, "--indirect.resolution=32", "-o", str(tmp_path / "a.exr")]) == 2
    error = capfd.readouterr().err
    assert error.count("\n") == 1 and "resolution 32 for indirect and 64 for environment: make them equal" in error
    assert list(tmp_path.iterdir()) == []


def test_a_shared_setting_that_does_not_fit_the_other_term_says_so(capfd, tmp_path):
    arguments = ["render", "cornell_box", "--pipeline=transfer", "--environment.bounces=0", "--frames=0"]
    assert cli.main([*arguments, "-o", str(tmp_path / "a.exr")]) == 2
    error = capfd.readouterr().err
    assert error.count("\n") == 1 and "given for one term hold for indirect, too" in error and "indirect=none" in error
    assert list(tmp_path.iterdir()) == []
