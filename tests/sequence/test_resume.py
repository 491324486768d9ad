"""Sequences that are written and resumed from Python: stopped, torn, of other settings, and dependent on the past."""

from __future__ import annotations

import logging
import shutil
from dataclasses import replace

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.cli import main as cli
from warp_gi.errors import OptionError
from warp_gi.sequence import frames as sequence

COUNT = 5
STATE = "a.state.safetensors"
FIELD = gi.VisibilityField(cell_size=0.25, samples=5000, rays=64, resolution=16, budget=0.4)
LEARNS = {"octree": gi.SampleOctree(split=64, collapse=32), "spp": 2}
PIPELINES = {
    "path": gi.Pipeline.preset("path", spp=2),
    "reuse": gi.Pipeline.preset("reuse", **LEARNS),
    "growing": gi.Pipeline.preset("dvf", environment=FIELD, indirect=None, spp=2),
    "denoised": gi.Pipeline.preset("path", spp=2, denoise="spatiotemporal"),
    "sunny": gi.Pipeline.preset("clean", denoise=gi.SpatioTemporal(blend=0.5)),  # a sun, whose light is apart
}
SAVED = ("reuse", "growing", "denoised", "sunny")


class Case:
    """A pipeline, its scene and its bakes; ``render`` and ``plan`` take what changes."""

    def __init__(self, name):
        self.scene = gi.builtin_scene("cornell_box")
        self.scene.environment = gi.SunSky(elevation=30.0) if name == "sunny" else 1.0
        self.arguments = {"pipeline": PIPELINES[name], "frames": range(COUNT), "seed": 3}
        if name == "growing":  # a bake of little of what is seen grows by a few cells a frame
            narrow = gi.Camera.look_at((0, 1, 3.4), (0, 0.3, 0), hfov=12.0, resolution=(24, 16))
            self.arguments["bakes"] = [gi.bake(self.scene, FIELD, seed=3, camera=narrow)]

    @property
    def path(self):
        return gi.builtin_camera_path("cornell_box").at_resolution(24, 16)

    def render(self, folder, **changes):
        return gi.render(self.scene, self.path, output=folder / "a.####.exr", **self.arguments | changes)

    def plan(self, folder, **changes):
        return gi.plan_sequence(self.scene, self.path, output=folder / "a.####.exr", **self.arguments | changes)

    def resumed(self, folder, **changes):
        """Return the numbers of the frames that are rendered."""
        return [frame.index for frame in self.render(folder, resume=True, **changes)]


@pytest.fixture(scope="module")
def cases(tmp_path_factory):
    """Return a function that gives a case, and a folder with all its frames, rendered in one go."""
    known = {}

    def case(name):
        if name not in known:
            folder, one = tmp_path_factory.mktemp(name), Case(name)
            known[name] = one, folder, [frame.index for frame in one.render(folder)]
        one, folder, indices = known[name]
        assert indices == list(range(COUNT))
        return one, folder

    return case


def copy(folder, target, frames=range(COUNT), state=True):
    target.mkdir(exist_ok=True)
    for index in frames:
        shutil.copy(folder / f"a.{index:04d}.exr", target)
    if state and (folder / STATE).exists():
        shutil.copy(folder / STATE, target)


def assert_same_files(found, wanted):
    """Pixels and all metadata but the stage times are equal, and so is what the last frame left."""
    assert sorted(p.name for p in found.iterdir()) == sorted(p.name for p in wanted.iterdir())
    for index in range(COUNT):
        a, b = (sequence.read_frame(folder / f"a.{index:04d}.exr") for folder in (found, wanted))
        assert a.names == b.names
        assert not [name for name in a.names if a.numpy(name).tobytes() != b.numpy(name).tobytes()], index
        assert a.metadata == b.metadata and a.time == b.time
    if (wanted / STATE).exists():
        assert (found / STATE).read_bytes() == (wanted / STATE).read_bytes()


def test_frames_are_written_before_they_are_yielded_and_as_they_are_without_files(tmp_path):
    case = Case("path")
    plain = [frame.numpy("beauty").copy() for frame in gi.render(case.scene, case.path, **case.arguments)]
    for frame, wanted in zip(case.render(tmp_path, precision="float"), plain, strict=True):
        file = sequence.read_frame(tmp_path / f"a.{frame.index:04d}.exr")
        np.testing.assert_array_equal(frame.numpy("beauty"), wanted)
        np.testing.assert_array_equal(file.numpy("beauty"), wanted)
        assert frame.timings["write"] > 0 and "lineage" not in file.metadata
    assert len(list(tmp_path.iterdir())) == COUNT


@pytest.mark.parametrize("name", PIPELINES)
def test_a_stopped_sequence_goes_on_to_the_same_files(name, cases, tmp_path):
    """Not from its first frame: what it learnt is saved."""
    case, whole = cases(name)
    for frame in case.render(tmp_path):
        if frame.index == 1:
            break
    assert case.plan(tmp_path).frames == (2, 3, 4)
    assert case.resumed(tmp_path) == [2, 3, 4]
    assert_same_files(tmp_path, whole)
    assert case.resumed(tmp_path) == []


@pytest.mark.parametrize("name", PIPELINES)
def test_a_torn_and_a_missing_frame(name, cases, tmp_path):
    case, whole = cases(name)
    copy(whole, tmp_path)
    torn = tmp_path / "a.0001.exr"
    torn.write_bytes(torn.read_bytes()[:-1])
    (tmp_path / "a.0003.exr").unlink()
    plan = case.plan(tmp_path)
    assert plan.problems == {1: "not whole", 3: "missing"} and plan.missing == (3,)
    assert plan.dependence.kind == "independent" if name == "path" else "saved"
    if name == "path":
        assert plan.frames == (1, 3) and not plan.restart and [shot.index for shot in plan.done] == [0, 2, 4]
        assert plan.reason(0) == "" and plan.reason(1) == "not whole"
    else:
        told = {
            "reuse": "no saved state fits, and the emitters light and the indirect light depend on the frames before",
            "growing": "no saved state fits, and the environment light depends on the frames before",
            "sunny": "no saved state fits, and the denoiser depends on the frames before",
            "denoised": "no saved state fits, and the denoiser depends on the frames before",
        }[name]
        assert plan.frames == tuple(range(COUNT)) and plan.restart == plan.reason(0) == plan.reason(4) == told
    assert case.resumed(tmp_path) == list(plan.frames)
    assert_same_files(tmp_path, whole)


@pytest.mark.parametrize("name", SAVED)
def test_a_state_that_lags_behind_the_frames(name, cases, tmp_path):
    """As after a kill between a frame and its state: frames after the state's own are rendered again."""
    case, whole = cases(name)
    frames = case.render(tmp_path)
    next(frames), next(frames)
    frames.close()
    copy(whole, tmp_path, range(4), state=False)
    plan = case.plan(tmp_path)
    assert plan.frames == (2, 3, 4) and not plan.restart
    assert plan.reason(2) == "the saved state is of a frame before it" and plan.reason(4) == "missing"
    assert case.resumed(tmp_path) == [2, 3, 4]
    assert_same_files(tmp_path, whole)


@pytest.mark.parametrize("name", SAVED)
@pytest.mark.parametrize("damage", ["gone", "torn", "of another seed"])
def test_without_its_state_a_sequence_starts_over(name, damage, cases, tmp_path):
    case, whole = cases(name)
    copy(whole, tmp_path, range(4))
    state = tmp_path / STATE
    if damage == "gone":
        state.unlink()
    elif damage == "torn":
        state.write_bytes(state.read_bytes()[:-5])
    else:
        list(case.render(tmp_path / "other", seed=4, frames=range(2)))
        shutil.copy(tmp_path / "other" / STATE, state)
        shutil.rmtree(tmp_path / "other")
    assert case.plan(tmp_path).restart.startswith("no saved state fits")
    assert case.resumed(tmp_path) == list(range(COUNT))
    assert_same_files(tmp_path, whole)


@pytest.mark.parametrize(
    "change, reason",
    [
        ({"seed": 4}, "seed is 3 instead of 4"),
        ({"pipeline": replace(PIPELINES["path"], filter="tent")}, "pipeline.filter is 'box' instead of 'tent'"),
        ({"pipeline": gi.Pipeline.preset("direct", spp=2)}, "pipeline.indirect is 'BsdfPaths' instead of 'None'"),
        ({"precision": "float"}, "precision is 'half' instead of 'float'"),
    ],
)
def test_another_setting_renders_every_frame_again(change, reason, cases, tmp_path):
    case, whole = cases("path")
    copy(whole, tmp_path)
    plan = case.plan(tmp_path, **change)
    assert plan.frames == tuple(range(COUNT)) and plan.reason(4) == reason and plan.missing == ()
    assert case.resumed(tmp_path, **change, frames=[2]) == [2]
    assert case.plan(tmp_path, **change).frames == (0, 1, 3, 4)


def test_another_camera_and_another_frame_before(cases, tmp_path):
    case, whole = cases("path")
    copy(whole, tmp_path)
    other = gi.plan_sequence(
        case.scene, case.path.at_resolution(12, 8), output=tmp_path / "a.####.exr", **case.arguments
    )
    assert other.reason(0) == "24x16 instead of 12x8"
    assert case.plan(tmp_path, frames=[0, 2, 3]).frames == (2,)  # its motion is towards frame 0
    assert case.plan(tmp_path, frames=[0, 2, 3]).reason(2) == "another frame before it"


@pytest.mark.parametrize("name", SAVED)
def test_frames_made_apart_are_no_part_of_a_sequence(name, cases, tmp_path):
    case, whole = cases(name)
    copy(whole, tmp_path)
    assert [frame.index for frame in case.render(tmp_path, frames=[3, 4])] == [3, 4]
    plan = case.plan(tmp_path)
    assert plan.reason(3).startswith("lineage is ") and plan.frames == tuple(range(COUNT))
    assert case.resumed(tmp_path) == list(range(COUNT))
    assert_same_files(tmp_path, whole)


def test_skipped_frames_are_not_in_the_lineage(cases, tmp_path):
    """What was rendered without those before is not taken for what follows them."""
    case, whole = cases("reuse")
    assert [frame.index for frame in case.render(tmp_path, skip=(0, 1))] == [2, 3, 4]
    copy(whole, tmp_path, (0, 1), state=False)
    assert case.plan(tmp_path).frames == tuple(range(COUNT))


def test_a_plan_writes_nothing(cases, tmp_path):
    case, _ = cases("path")
    assert case.plan(tmp_path / "new").missing == tuple(range(COUNT))
    assert not (tmp_path / "new").exists()
    assert case.plan(tmp_path, frames=[]).frames == ()


def test_what_is_kept_is_logged(cases, tmp_path, caplog):
    case, whole = cases("path")
    copy(whole, tmp_path)
    (tmp_path / "a.0002.exr").write_bytes(b"")
    caplog.set_level(logging.INFO, "warp_gi")
    assert case.resumed(tmp_path) == [2]
    assert [record.getMessage() for record in caplog.records] == [
        f"{tmp_path / 'a.0002.exr'} is rendered again: not whole",
        "4 of 5 frames are there already",
    ]


def test_previews_of_kept_frames_are_made(cases, tmp_path):
    case, whole = cases("path")
    copy(whole, tmp_path, range(2))
    assert case.resumed(tmp_path, frames=range(3), preview=True, exposure=1.0) == [2]
    before = {path.name: path.read_bytes() for path in tmp_path.glob("*.png")}
    assert sorted(before) == [f"a.{index:04d}.png" for index in range(3)]
    list(case.render(tmp_path, frames=range(3), preview=True, exposure=1.0))
    assert before == {path.name: path.read_bytes() for path in tmp_path.glob("*.png")}
    (tmp_path / "png").mkdir()
    arguments = case.arguments | {"frames": [1], "exposure": 1.0}
    list(gi.render(case.scene, case.path, output=tmp_path / "png" / "b.####.png", **arguments))
    assert (tmp_path / "png" / "b.0001.png").read_bytes() == before["a.0001.png"]


def test_the_command_and_python_go_on_with_each_other(tmp_path):
    """A file says nothing of who rendered it."""
    command = ["render", "cornell_box", "--environment=1", "--resolution=24x16", "--spp=2", "--pipeline=reuse"]
    command += ["--octree.split=64", "--octree.collapse=32", "--seed=3", "--frames=0-4", "--resume", "--quiet"]
    case = Case("reuse")
    frames = case.render(tmp_path)
    next(frames), next(frames)
    frames.close()
    assert cli.main([*command, "-o", str(tmp_path / "a.####.exr")]) == 0
    assert case.plan(tmp_path).frames == ()
    (tmp_path / "a.0000.exr").unlink()
    list(case.render(tmp_path, resume=True))
    assert cli.main([*command, "-o", str(tmp_path / "a.####.exr")]) == 0
    assert case.plan(tmp_path).frames == ()


@pytest.mark.parametrize(
    "arguments, words",
    [
        ({"resume": True}, 'give output="out/shot.####.exr" too'),
        ({"preview": True}, "resume, precision, preview, exposure, chunk and cluster are of files"),
        ({"output": "a.exr"}, "2 frames cannot all go to a.exr; put #### in the name"),
        ({"output": "a.#.tif"}, "cannot write a.#.tif: frames are .exr or .png files"),
        ({"output": "a.#.png", "resume": True}, "resume needs .exr files"),
        ({"output": "a.#.exr", "precision": "quarter"}, "unknown precision 'quarter'"),
        ({"output": "a.#.exr", "frames": [-1]}, "frame numbers must be 0 or above, got -1"),
    ],
)
def test_mistakes_are_one_line(arguments, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene, camera = gi.builtin_scene("cornell_box"), gi.builtin_camera_path("cornell_box").at_resolution(4, 4)
    with pytest.raises(OptionError) as error:
        list(gi.render(scene, camera, **{"frames": range(2), **arguments}))
    assert words in str(error.value) and "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_a_bake_takes_its_camera_by_both_names():
    scene, camera = gi.builtin_scene("cornell_box"), gi.builtin_camera_path("cornell_box").camera(0)
    settings = gi.VisibilityField(cell_size=0.5, resolution=16, samples=500, rays=8)
    narrow = replace(camera, hfov=10.0, resolution=(8, 8))
    digests = [
        gi.bake(scene, settings, camera=narrow).digest,
        gi.bake(scene, settings, camera_path=narrow).digest,
        gi.bake(scene, settings, "cpu", 0, narrow).digest,
    ]
    assert len(set(digests)) == 1 and digests[0] != gi.bake(scene, settings).digest
    with pytest.raises(OptionError, match="camera and camera_path are two names of one argument; give camera"):
        gi.bake(scene, settings, camera=narrow, camera_path=narrow)
