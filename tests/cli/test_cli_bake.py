"""``warp-gi bake``, what is made of its files, and skies that turn, as a user meets them."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from PIL import Image

import warp_gi as gi
from warp_gi import launch
from warp_gi.cli import bake as bake_command
from warp_gi.cli import main as cli
from warp_gi.cli.bake import BAKEABLE, default_output, tool_of
from warp_gi.cli.bake import parse as parse_bake
from warp_gi.cli.render import parse
from warp_gi.kernels import visibility_field as field_kernels
from warp_gi.kernels.octahedral import octahedral_decode, octahedral_wrap
from warp_gi.sequence import frames as sequence
from warp_gi.techniques.light_field.estimator import LightFieldProbes
from warp_gi.techniques.light_field.state import ProbeState
from warp_gi.techniques.visibility_field import export
from warp_gi.techniques.visibility_field import pictures as dvf_pictures
from warp_gi.techniques.visibility_field.estimator import VisibilityField
from warp_gi.techniques.visibility_field.state import FieldState

FIELD = {"cell-size": "0.5", "resolution": "18", "rays": "64"}
SETTINGS = [f"--{name}={value}" for name, value in FIELD.items()]
OF_RENDER = [f"--environment.{name}={value}" for name, value in FIELD.items()]
SMALL = ["cornell_box", "--environment=1,1,1", "--resolution=48x32", "--spp=8", "--pipeline=dvf,indirect=none"]
RENDER = ["render", *SMALL, *OF_RENDER, "--quiet"]


@pytest.fixture(scope="module")
def baked(tmp_path_factory):
    """A bake of what the camera sees, its textures and its pictures."""
    folder = tmp_path_factory.mktemp("baked")
    command = [sys.executable, "-m", "warp_gi.cli", "bake", "cornell_box", *SETTINGS, "--picture=48x32"]
    more = ["--show", "pictures", "--export", "textures/field.png", "-o", "box.dvf.safetensors"]
    result = subprocess.run([*command, *more], cwd=folder, capture_output=True, text=True, timeout=300)
    assert (result.returncode, result.stderr) == (0, ""), result
    for words in ("cells", "rays traced", "seconds", "million rays a second", "file [MB]", "bake: box.dvf.safetensors"):
        assert words in result.stdout
    return folder


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A bake of all cells, as a file and as read back."""
    path = tmp_path_factory.mktemp("whole") / "all.dvf.safetensors"
    assert cli.main(["bake", "cornell_box", *SETTINGS, "--everywhere", "--quiet", "-o", str(path)]) == 0
    return path, gi.load_bake(path)


def pictures(paths):
    """Return the environment light of frames."""
    return np.stack([sequence.read_frame(path).numpy("environment") for path in paths])


def test_rendering_with_a_bake_is_the_same_as_without(baked, whole, tmp_path):
    made, given, wide = (tmp_path / f"{name}.exr" for name in ("made", "given", "wide"))
    assert cli.main([*RENDER, "--frames=0", "-o", str(made)]) == 0
    assert cli.main([*RENDER, "--frames=0", "--bake", f"{baked}/box.dvf.safetensors", "-o", str(given)]) == 0
    assert cli.main([*RENDER, "--frames=0", "--bake", str(whole[0]), "-o", str(wide)]) == 0
    a, b, c = pictures([made, given, wide])
    assert a.max() > 0.1
    np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(a, c)
    assert len(whole[1].arrays["cells"]) > len(gi.load_bake(baked / "box.dvf.safetensors").arrays["cells"])


def test_equal_bakes_but_for_their_seconds(whole, tmp_path):
    path = tmp_path / "again.safetensors"
    assert cli.main(["bake", "cornell_box", *SETTINGS, "--everywhere", "--quiet", "--threads=1", "-o", str(path)]) == 0
    again = gi.load_bake(path)
    for name, array in whole[1].arrays.items():
        np.testing.assert_array_equal(array, again.arrays[name])
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


BAKE = ["bake", "cornell_box", *SETTINGS]
LIGHT = {"resolution": "32", "irradiance-resolution": "8", "rays": "1", "bounces": "3"}
COUNTS = ["3", "2", "2"]
OF_PROBES = ["--technique=light-field-probes", *[f"--{name}={value}" for name, value in LIGHT.items()]]
PROBES = ["bake", "cornell_box", *OF_PROBES, "--counts", *COUNTS]
BAD = [
    (
        [*BAKE, "--technique", "visibility-feild"],
        "unknown technique 'visibility-feild'; did you mean 'visibility-field'",
    ),
    (
        [*BAKE, "--technique=field"],
        "(known: light-field-probes, radiance-transfer, surface-cache, visibility-field, visibility-polygons)",
    ),
    (["bake", "cornel_box"], "did you mean 'cornell_box'?"),
    ([*BAKE, "--cel-size", "1"], "did you mean --cell-size?"),
    ([*BAKE, "--rays", "0"], "rays must be a whole number"),
    ([*BAKE, "--cell-size", "0.0001"], "cell_size 0.0001 m makes a grid"),
    ([*BAKE, "--mode", "traced"], "uses no bake"),
    ([*BAKE, "--seed", "-1"], "seed must be 0 or above"),
    ([*BAKE, "-o", "a.txt"], "bakes are .safetensors files"),
    ([*BAKE, "-o", "/dev/null/a.safetensors"], "/dev/null"),
    ([*BAKE, "--export", "a.gif"], ".png files, one a layer, or one .exr"),
    (
        [*BAKE, "--no-relocate"],
        "--no-relocate is a setting of light-field-probes, but visibility-field is baked; leave it out, or give",
    ),
    (
        [*PROBES, "--cell-size=0.5"],
        "--cell-size is a setting of visibility-field, but light-field-probes is baked; leave it out, or give",
    ),
    ([*PROBES, "--everywhere"], "a bake of probes is always of the whole grid: omit it"),
    ([*PROBES, "--export", "a.png"], "atlases of probes are .exr files; give NAME.exr"),
    ([*PROBES, "--primary", "probes"], "is a way to render; bake without it"),
    ([*PROBES, "--irradiance-resolution", "3"], "irradiance_resolution must be a whole number from 4 to 128, got 3"),
    ([*PROBES, "--spacing", "0.5"], "spacing and counts along every axis contradict each other"),
    (["bake", "--technique=light-field-probes", "--counts", *["1000"] * 3], "1000 x 1000 x 1000 probes of 64 x 64"),
    (["bake", "--technique=light-field-probes", "--count", "2"], "did you mean --counts?"),
    ([*BAKE, "--picture", "12"], "resolution '12' not understood"),
    ([*BAKE, "--device", "cuda:77"], "device 'cuda:77' is not available"),
    (["render", "cornell_box", "--bake", "none.safetensors"], "none.safetensors: no such file"),
    (["render", "cornell_box", "--environment-turn", "2"], "needs a sky to turn"),
    (["render", "cornell_box", "--environment-turn", "nan"], "must be a finite number"),
]


@pytest.mark.parametrize("arguments, words", BAD, ids=[" ".join(a[-2:]) for a, _ in BAD])
def test_mistakes_are_one_line_and_leave_nothing(arguments, words, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fails(arguments, words, capfd)
    assert list(tmp_path.iterdir()) == []


def fails(arguments, words, capfd):
    assert cli.main(list(map(str, arguments))) == 2
    error = capfd.readouterr().err
    assert error.startswith("warp-gi: error: ") and error.count("\n") == 1 and "Traceback" not in error
    assert words in error


def test_bakes_of_something_else_are_refused(whole, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path, _ = whole
    torn = tmp_path / "torn.safetensors"
    data = bytearray(path.read_bytes())
    data[-5] ^= 1
    torn.write_bytes(data)
    out = ["--frames=0", "-o", "new/a.exr", "--quiet"]
    dvf = ["--pipeline", "dvf", *OF_RENDER, *out]
    fails(["render", "atrium", *dvf, "--bake", path], "this bake is of scene 'cornell_box'", capfd)
    fails(["render", "cornell_box", *dvf, "--bake", torn], "torn.safetensors: is damaged", capfd)
    torn.write_bytes(data[:-9])
    fails(["render", "cornell_box", *dvf, "--bake", torn], "torn.safetensors: is truncated", capfd)
    wrong = ["--environment.rays", "128", "--bake", path]
    fails(["render", "cornell_box", *dvf, *wrong], "rays: bake has 64, asked for 128", capfd)
    fails(["render", "cornell_box", *out, "--bake", path], "a bake of VisibilityField was given, but", capfd)
    assert [p.name for p in tmp_path.iterdir()] == ["torn.safetensors"]


def test_a_failed_write_leaves_the_old_bake(whole, tmp_path):
    pytest.importorskip("resource")
    path = tmp_path / "old.safetensors"
    path.write_bytes(b"old")
    script = f"""
import resource, sys
from warp_gi.cli.main import main
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))
sys.exit(main([*{BAKE!r}, "--quiet", "-o", {str(path)!r}]))
"""
    result = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 1 and result.stderr.count("\n") == 1 and str(path) in result.stderr, result
    assert [p.name for p in tmp_path.iterdir()] == [path.name] and path.read_bytes() == b"old"


def test_show_writes_pictures(baked):
    folder = baked / "pictures"
    assert sorted(p.name for p in folder.iterdir()) == [
        f"{name}.png" for name in ("error", "labels", "maps", "render", "traced")
    ]
    render = np.asarray(Image.open(folder / "render.png"))
    assert render.shape == (32, 48, 3) and render.max() > 100
    shown = {tuple(color) for color in np.asarray(Image.open(folder / "maps.png")).reshape(-1, 3)}
    assert {dvf_pictures.VISIBLE_COLOR, dvf_pictures.OCCLUDED_COLOR, dvf_pictures.MIXED_COLOR} <= shown
    labels = {tuple(color) for color in np.asarray(Image.open(folder / "labels.png"))[:32, :48].reshape(-1, 3)}
    assert dvf_pictures.OCCLUDED_COLOR in labels
    assert dvf_pictures.UNKNOWN_COLOR not in labels  # all cells in view are baked
    traced = np.asarray(Image.open(folder / "traced.png"))[:32, :48]
    assert len(np.unique(traced.reshape(-1, 3), axis=0)) > 20


# Thread: a ray. What the field says of it: the eight bits of the texture.
@wp.kernel
def look_up_field(
    first: wp.int32,
    grid: field_kernels.VisibilityGrid,
    positions: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    found: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    slot = field_kernels.slot_at(grid, positions[i])
    state = field_kernels.texel_state(grid, slot, field_kernels.direction_texel(grid, directions[i]))
    value = 128 * (state & 1) + 64 * (state >> 1)
    if slot >= 0 and (slot & field_kernels.SLOT_LABEL) != 0:
        value = value + 32
    found[i] = value


# Thread: a texel of a map with a border; its source in the map.
@wp.kernel
def wrap_texels(first: wp.int32, size: wp.int32, source: wp.array(dtype=wp.int32)):
    i = first + wp.tid()
    source[i] = octahedral_wrap(i % (size + 2) - 1, i / (size + 2) - 1, size)


# Thread: a point of the map.
@wp.kernel
def decode(first: wp.int32, points: wp.array(dtype=wp.vec2), directions: wp.array(dtype=wp.vec3)):
    i = first + wp.tid()
    directions[i] = octahedral_decode(points[i])


def field_says(bake, positions, directions):
    """Return what the bake's own lookup says, as the eight bits of a texture."""
    settings = VisibilityField(cell_size=0.5, resolution=18, rays=64)
    device = wp.get_device("cpu")
    state = FieldState.from_bake(gi.builtin_scene("cornell_box"), device, settings.mask_settings, 1, bake)
    state.upload()
    found = wp.zeros(len(positions), dtype=wp.int32, device=device)
    arrays = [wp.array(values.astype(np.float32), dtype=wp.vec3, device=device) for values in (positions, directions)]
    launch.launch(look_up_field, len(positions), [state.data, *arrays, found], device)
    return found.numpy()


def test_export_reads_as_the_bake(baked, whole, tmp_path):
    rng = np.random.default_rng(5)
    sizes = 20_000
    positions = rng.uniform((-1.2, -0.2, -1.2), (1.2, 2.2, 1.2), (sizes, 3))  # some outside of the grid
    directions = rng.normal(size=(sizes, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = rng.uniform(size=(sizes // 2, 2)).astype(np.float32)  # near the map's borders and folds too
    points[:, 0] = np.where(rng.uniform(size=len(points)) < 0.5, 1e-4, 1 - 1e-4)
    near = wp.zeros(len(points), dtype=wp.vec3, device="cpu")
    launch.launch(decode, len(points), [wp.array(points, dtype=wp.vec2, device="cpu"), near], wp.get_device("cpu"))
    directions[: len(points)] = near.numpy()
    export.export_textures(whole[1], tmp_path / "all.####.png")
    for bake, description in (
        (gi.load_bake(baked / "box.dvf.safetensors"), baked / "textures" / "field.json"),
        (whole[1], tmp_path / "all.json"),
    ):
        layers, info = export.read_textures(description)
        ours = export.look_up(layers, info, positions.astype(np.float32), directions.astype(np.float32))
        theirs = field_says(bake, positions, directions)
        differing = np.flatnonzero(ours != theirs)  # by a rounding on the border of two texels
        assert len(differing) < 1e-3 * sizes, len(differing)
        assert {0, 64, 192} <= set((theirs & 192).tolist()) and (theirs & 32).any()


def test_padding_goes_across_the_borders(whole):
    maps = export.cell_maps(whole[1])
    size = maps.shape[1]
    source = wp.zeros((size + 2) ** 2, dtype=wp.int32, device="cpu")
    launch.launch(wrap_texels, len(source), [size, source], wp.get_device("cpu"))
    np.testing.assert_array_equal(
        export.padded(maps), maps.reshape(len(maps), -1)[:, source.numpy().reshape(size + 2, size + 2)]
    )


def test_exr_has_the_layers_of_the_png_files(whole, tmp_path):
    import OpenImageIO as oiio

    pngs = export.export_textures(whole[1], tmp_path / "a.png")
    exr, description = export.export_textures(whole[1], tmp_path / "b.exr")
    info = json.loads(Path(description).read_text())
    source = oiio.ImageInput.open(str(exr))
    for index, (part, png) in enumerate(zip(info["layers"]["parts"], pngs[:-1], strict=True)):
        assert source.seek_subimage(index, 0)
        assert source.spec().get_string_attribute("oiio:subimagename") == part
        np.testing.assert_array_equal(source.read_image("float")[:, :, 0], np.asarray(Image.open(png)))
    assert not source.seek_subimage(len(pngs) - 1, 0)
    assert info["resolution"] == 18 and info["cell_size"] == 0.5 and len(info["how_to_read"]) >= 4
    first = exr.read_bytes()
    export.export_textures(whole[1], tmp_path / "b.exr")
    assert exr.read_bytes() == first


@pytest.fixture
def sky(tmp_path):
    """A sky that is bright on one side."""
    import OpenImageIO as oiio

    pixels = np.full((8, 16, 3), 0.2, np.float32)
    pixels[2:4, 3:6] = (8.0, 4.0, 1.0)
    oiio.ImageBuf(pixels).write(str(tmp_path / "sky.exr"))
    return tmp_path / "sky.exr"


def test_a_turning_sky_resumes(whole, sky, tmp_path, capsys, monkeypatch):
    baked = []
    bake = FieldState.bake
    monkeypatch.setattr(FieldState, "bake", lambda *a, **k: baked.append(1) or bake(*a, **k))
    quiet = [argument for argument in RENDER if argument != "--quiet"]
    command = [*quiet, "--environment", str(sky), "--environment.budget=0", "--bake", str(whole[0])]
    turning = [*command, "--environment-turn", "30", "--frames=0-3"]
    unbroken, broken = tmp_path / "a.####.exr", tmp_path / "b.####.exr"
    assert cli.main([*turning, "-o", str(unbroken)]) == 0
    assert cli.main([*turning, "--frames=1", "-o", str(broken)]) == 0  # alone
    capsys.readouterr()
    assert cli.main([*turning, "--frames=0-3", "--resume", "-o", str(broken)]) == 0
    told = capsys.readouterr().out
    assert "1 of 4 frames are there already" in told
    assert cli.main([*turning, "--resume", "-o", str(unbroken)]) == 0
    assert "4 of 4 frames are there already" in capsys.readouterr().out
    a, b = (pictures([sequence.frame_path(pattern, i) for i in range(4)]) for pattern in (unbroken, broken))
    np.testing.assert_array_equal(a, b)
    assert all(not np.array_equal(a[0], a[i]) for i in range(1, 4))
    hashes = {sequence.read_frame(sequence.frame_path(unbroken, i)).metadata["scene_hash"] for i in range(4)}
    assert len(hashes) == 4 and not baked  # another sky a frame, and not one bake
    still = tmp_path / "c.exr"
    turned = [*command, "--environment-rotation=60", "--frames=2", "-o", str(still)]
    assert cli.main(turned) == 0
    np.testing.assert_array_equal(pictures([still])[0], a[2])
    capsys.readouterr()
    assert cli.main([*command, "--environment-turn=31", "--frames=0-3", "--resume", "-o", str(unbroken)]) == 0
    told = capsys.readouterr().out
    assert "1 of 4 frames are there already" in told and "rendered again: scene_hash" in told  # frame 0 is the same


@pytest.fixture(scope="module")
def probes(tmp_path_factory):
    """A bake of probes under a sky, its atlases and pictures; the folder, and what was printed."""
    folder = tmp_path_factory.mktemp("probes")
    command = [sys.executable, "-m", "warp_gi.cli", *PROBES, "--environment=0.2,0.3,0.4"]
    more = ["--picture=96x64", "--show", "pictures", "--export", "atlases/box.exr"]
    result = subprocess.run([*command, *more], cwd=folder, capture_output=True, text=True, timeout=300)
    assert (result.returncode, result.stderr) == (0, ""), result
    return folder, result.stdout


def test_probes_are_baked_exported_and_shown(probes):
    folder, _ = probes
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    atlases = {f"atlases/box.{name}.exr" for name in ("radiance", "normal", "distance", "irradiance", "moments")}
    names = ("radiance", "normal", "distance", "irradiance", "places", "seen", "ray")
    pictures = {f"pictures/{name}.png" for name in names}
    assert files == {"out/cornell_box.probes.safetensors", "atlases/box.json"} | atlases | pictures
    bake = gi.load_bake(folder / "out" / "cornell_box.probes.safetensors")
    assert bake.technique == "LightFieldProbes" and bake.settings["counts"] == "3x2x2"
    assert json.loads((folder / "atlases" / "box.json").read_text())["atlases"]["radiance"]["size"] == 32
    places = np.asarray(Image.open(folder / "pictures" / "places.png"))
    assert places.shape[0] > 64 and places[:64, :96].max() > 200


def test_the_closing_tables_say_what_was_baked(probes):
    folder, printed = probes
    path = folder / "out" / "cornell_box.probes.safetensors"
    bake = gi.load_bake(path)
    rows = {}
    for line in printed.splitlines():
        parts = [part.strip() for part in line.strip().split("  ") if part.strip()]
        if len(parts) == 2:
            rows[parts[0]] = parts[1]
    assert (rows["probes"], rows["probes usable"], rows["probes covered"]) == ("12", "12", "0")
    assert (rows["grid"], rows["map of a probe"], rows["map of irradiance"]) == ("3 x 2 x 2", "32 x 32", "8 x 8")
    assert rows["texels"] == rows["rays"] == f"{12 * 32 * 32:,}"
    assert float(rows["million rays a second"]) > 0 and float(rows["seconds"]) > 0
    assert float(rows["file [MB]"]) == pytest.approx(path.stat().st_size / 1e6, rel=1e-3)
    settings = LightFieldProbes(counts=(3, 2, 2), resolution=32, irradiance_resolution=8, rays=1, bounces=3)
    state = ProbeState(gi.builtin_scene("cornell_box"), wp.get_device("cpu"), settings.probe_settings, 1, bake)
    assert bake.counts["bytes"] == state.nbytes
    assert float(rows["maps in memory [MB]"]) == pytest.approx(state.nbytes / 1e6, rel=1e-3)
    assert rows["bounces"] == "3" and [float(rows[str(n)]) for n in (1, 2, 3)] == pytest.approx(state.changes, rel=1e-3)
    assert rows["change of the last"] == rows["3"]
    assert "more than the tolerance of 0.002: give more --bounces than 3" in printed
    assert "atlases: atlases/box.radiance.exr to box.moments.exr, described by atlases/box.json" in printed


@pytest.mark.parametrize("mode", ["irradiance", "hybrid", "traced"])
def test_rendering_takes_baked_probes(probes, tmp_path, mode):
    """With the bake pictures are the same as without; and it is the file that is read."""
    folder, _ = probes
    path = folder / "out" / "cornell_box.probes.safetensors"
    of_render = [f"--indirect.{name}={value}" for name, value in LIGHT.items()] + ["--indirect.counts", *COUNTS]
    small = ["cornell_box", "--environment=0.2,0.3,0.4", "--resolution=48x32", "--spp=2", "--pipeline=probes"]
    command = ["render", *small, f"--indirect.mode={mode}", *of_render, "--frames=0", "--quiet"]
    changed = gi.load_bake(path)
    changed.arrays["radiance"] //= 2
    changed.arrays["irradiance"] *= 2
    changed.save(tmp_path / "changed.safetensors")
    made = []
    for name, more in (("made", []), ("given", [path]), ("changed", [tmp_path / "changed.safetensors"])):
        given = [argument for bake in more for argument in ("--bake", str(bake))]
        assert cli.main([*command, *given, "-o", str(tmp_path / f"{name}.exr")]) == 0
        made.append(sequence.read_frame(tmp_path / f"{name}.exr").numpy("indirect"))
    np.testing.assert_array_equal(made[0], made[1])
    assert made[0].max() > 0.05 and np.abs(made[0] - made[2]).max() > 0.05


def test_a_bake_of_probes_is_rendered_alone_and_fits_only_its_settings(probes, tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = probes[0] / "out" / "cornell_box.probes.safetensors"
    assert cli.main(["render", str(path), "--resolution=48x32", "--spp=1", "--frames=0", "--quiet", "-o", "a.exr"]) == 0
    frame = sequence.read_frame(tmp_path / "a.exr")
    assert frame.numpy("indirect").max() > 0.05 and np.isfinite(frame.numpy("depth")).any()
    out = ["--frames=0", "-o", "new/a.exr", "--quiet"]
    fails(["render", "cornell_box", "--pipeline=probes", *out, "--bake", path], "counts: bake has '3x2x2'", capfd)
    fails(["render", "cornell_box", "--pipeline=dvf", *out, "--bake", path], "a bake of LightFieldProbes was", capfd)
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


def test_probes_that_follow_a_turning_sky_are_resumed_from_the_start(probes, sky, tmp_path, capsys):
    """A frame depends on those before it, so all are rendered again, to the same bits; a still sky resumes."""
    path = probes[0] / "out" / "cornell_box.probes.safetensors"
    of_render = [f"--indirect.{name}={value}" for name, value in LIGHT.items()] + ["--indirect.counts", *COUNTS]
    small = ["cornell_box", f"--environment={sky}", "--resolution=24x16", "--spp=1", "--pipeline=probes", *of_render]
    still = ["render", *small, "--indirect.mode=irradiance", "--frames=0-2", "--bake", str(path)]  # of another sky
    for command, told in (
        (
            [*still, "--environment-turn=30"],
            "again: the indirect light depends on the frames before",
        ),
        (still, "2 of 3 frames are there already"),
    ):
        pattern = tmp_path / str(len(command)) / "a.####.exr"
        assert cli.main([*command, "-o", str(pattern)]) == 0
        files = [sequence.frame_path(pattern, index) for index in range(3)]
        first = [sequence.read_frame(file).numpy("indirect") for file in files]
        files[1].unlink()
        capsys.readouterr()
        assert cli.main([*command, "--resume", "-o", str(pattern)]) == 0
        assert told in capsys.readouterr().out
        np.testing.assert_array_equal([sequence.read_frame(file).numpy("indirect") for file in files], first)
        assert first[0].max() > 0.01


def test_a_bake_is_found_wherever_it_stands_among_the_options():
    for before in (["--preview"], ["--quiet"], []):
        assert parse([*before, "a.probes.safetensors"]).settings.indirect.primary == "probes"
    assert parse(["cornell_box", "--bake", "a.probes.safetensors"]).settings.indirect != LightFieldProbes()


def test_probes_need_no_camera_and_settled_light_no_advice(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "floor.obj").write_text("v -1 0 -1\nv 1 0 -1\nv 1 0 1\nv -1 0 1\nf 4 3 2 1\n")
    command = ["bake", "floor.obj", *OF_PROBES, "--counts", "1", "1", "1", "--environment=1", "--tolerance=0.5"]
    assert cli.main(command) == 0
    printed = capsys.readouterr().out
    assert "no camera" not in printed and "give more" not in printed and "1 x 1 x 1" in printed
    assert cli.main([*command, "--show", "pictures"]) == 0
    assert "the scene has no camera: showing all of it" in capsys.readouterr().out
    assert (tmp_path / "pictures" / "places.png").exists() and (tmp_path / "out" / "floor.probes.safetensors").exists()


@pytest.mark.parametrize("name", BAKEABLE)
def test_a_technique_has_a_long_and_a_short_name(name, tmp_path, monkeypatch):
    one = BAKEABLE[name]
    for given in (name, one.short):
        options = parse_bake(["cornell_box", "--technique", given])
        assert (options.technique, type(options.settings)) == (name, tool_of(name).settings)
        assert default_output(options).name == f"cornell_box.{one.short}.safetensors"


def test_what_the_help_says_of_techniques_comes_from_their_tools():
    text = bake_command.DESCRIPTION + "".join(Path(bake_command.__file__).read_text().split("class BakeOptions")[1:])
    text = re.sub(r"cache: bool|options\.cache|cache=", "", text)  # the option --no-cache is of no technique
    words = {word for name, one in BAKEABLE.items() for word in (name, one.short, tool_of(name).settings.__name__)}
    assert not [word for word in {*words, "visibility field", "probes", "Probes"} if word in text]
    for name, one in BAKEABLE.items():
        tool = tool_of(name)
        lines = [*tool.summary, *tool.shows, *tool.exports, *(example.split(" ", 1)[1] for example in tool.examples)]
        told = bake_command.description()
        assert f"  {name}, {one.short} " in told and all(line in told for line in lines)


def test_help(capsys):
    with pytest.raises(SystemExit):
        cli.main(["bake", "--help"])
    printed = capsys.readouterr().out
    assert all(word in printed for word in ("usage: warp-gi bake", "--cell-size", "--everywhere", "--export"))
    assert "light-field-probes" in printed and "--counts INT" not in printed
    for arguments in (["--technique", "light-field-probes", "--help"], ["--help", "--technique=light-field-probes"]):
        with pytest.raises(SystemExit):
            cli.main(["bake", *arguments])
        printed = capsys.readouterr().out
        assert all(word in printed for word in ("visibility-field", "--counts INT", "--resolution", "--export"))
        assert "--cell-size FLOAT" not in printed
