"""What pipelines say of the frames before: alone, after a break, after an interrupt or whole, equal to the last bit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import OpenImageIO as oiio
import pytest
import statistics_tools as st
from scene_tools import quad

import warp_gi as gi
from warp_gi import launch
from warp_gi.cli import main as cli
from warp_gi.errors import BakeError
from warp_gi.sequence import frames as sequence
from warp_gi.sequence.state import state_arrays

SIZE = (24, 16)
FRAMES = 5
FIELD = gi.VisibilityField(cell_size=0.5, resolution=16, samples=2000, rays=64)
PROBES = gi.LightFieldProbes(counts=(2, 1, 2), resolution=16, irradiance_resolution=8, rays=1, bounces=2, update=2)


def yard(moving):
    """A floor, a wall, a canopy and two lamps; a plate and one of the lamps move, if at all, until frame 2.

    A cloth hangs between the floor and the plate, and bends as that moves.
    """
    grey = gi.Material("grey", (0.7, 0.6, 0.5), roughness=0.4)
    lamp = gi.Material("lamp", emission=(6.0, 5.0, 4.0), double_sided=True)
    rests = [
        quad((-2, 0, 2), (4, 0, 0), (0, 0, -4), grey),
        quad((-2, 0, -2), (4, 0, 0), (0, 2, 0), grey),
        quad((-2, 1.5, -2), (2.5, 0, 0), (0, 0, 2), grey),
        quad((1.2, 0.6, -1.2), (0.3, 0, 0), (0, 0.3, 0), lamp),
    ]
    plate = [quad((-0.5, 0, 0.5), (1, 0, 0), (0, 0, -1), grey), quad((-0.1, -0.2, 0.1), (0.2, 0, 0), (0, 0.2, 0), lamp)]
    nodes = [gi.Node("yard", rests), gi.Node("plate", plate)]
    nodes[1].parent_from_node[:3, 3] = (0.4, 1.0, 0.6)
    if moving:
        cloth = quad((-0.5, 0.1, 0.3), (0.8, 0, 0), (0, 0.6, 0), grey)
        cloth.joints, cloth.joint_weights = np.int32([[0, 1]] * 4), np.float32([[1, 0], [1, 0], [0.5, 0.5], [0.2, 0.8]])
        cloth.targets = [gi.MorphTarget(np.float32([[0, 0, 0], [0, 0, 0], [0, 0, 0.4], [0, 0.2, 0]]))]
        morphs = [gi.MorphKeyframe(0.0, (0.0,)), gi.MorphKeyframe(0.5, (1.0,))]
        nodes.append(gi.Node("cloth", [cloth], skin=gi.Skin([0, 1], np.stack([np.eye(4)] * 2)), morphs=morphs))
    scene = gi.Scene(nodes, environment=sky())
    if moving:
        scene.animate("plate", [gi.Keyframe(0.0, (0.9, 1.4, 0.9)), gi.Keyframe(0.5, (-0.6, 0.7, 0.8))])
    return scene


def sky():
    pixels = np.full((16, 32, 3), 0.3, np.float32)
    pixels[3:5, 10:13] = (12.0, 10.0, 8.0)
    return gi.Environment(pixels=pixels)


def view(at=0.0, hfov=55.0):
    return gi.Camera.look_at((1.5 - at, 2.2, 4.0), (-0.2, 0.5, 0), hfov=hfov, resolution=SIZE)


def preset(name, **settings):
    """Return a preset at a small size: fields and probes have the settings of this file."""
    pipeline = gi.Pipeline.preset(name, spp=2, camera_samples=2)
    if isinstance(pipeline.environment, gi.VisibilityField):
        pipeline = replace(pipeline, environment=FIELD)
    if isinstance(pipeline.environment, gi.VisibilityPolygons):
        pipeline = replace(pipeline, environment=gi.VisibilityPolygons(resolution=16))
    if isinstance(pipeline.indirect, gi.LightFieldProbes):
        pipeline = replace(pipeline, indirect=replace(PROBES, primary=pipeline.indirect.primary))
    if pipeline.indirect is not None and pipeline.indirect.radiance_cache is not None:
        ends_in = replace(pipeline.indirect.radiance_cache, paths=2000)
        if isinstance(ends_in, gi.SurfaceCache):
            ends_in = replace(ends_in, refresh=1000)
        pipeline = replace(pipeline, indirect=replace(pipeline.indirect, ends_in=ends_in))
    for term in ("environment", "indirect"):
        if isinstance(getattr(pipeline, term), gi.RadianceTransfer):
            pipeline = replace(pipeline, **{term: replace(getattr(pipeline, term), resolution=64, rays=128)})
    octree = gi.SampleOctree(split=64, collapse=32)
    return replace(pipeline, octree=octree, **settings)


@dataclass(frozen=True)
class Case:
    """A pipeline, what changes while it renders, and what it is to say of the frames before: "", "saved", "unsaved"."""

    says: str
    pipeline: gi.Pipeline
    moving: bool = False
    turning: bool = False
    travels: bool = True
    """Whether the camera moves."""
    narrow_bake: bool = False
    """Whether there is a bake of little of what is seen."""
    alone: bool = False
    """Whether there is nothing of the scene but its bake."""

    def path(self):
        return gi.CameraPath.from_cameras([view(0.25 * i * self.travels) for i in range(FRAMES)], fps=4.0)

    def bakes(self):
        field = self.pipeline.environment
        return [gi.bake(yard(self.moving), field, st.device().alias, camera_path=view(hfov=9.0))]

    def begin(self, progress=None):
        """Return a run that has rendered nothing yet, as another process would begin it."""
        scene = yard(self.moving)
        if self.alone:
            scene = gi.bake(scene, self.pipeline.indirect, st.device().alias, seed=3)
        bakes = self.bakes() if self.narrow_bake else []
        return Run(self, gi.FrameScheduler(scene, self.path(), self.pipeline, st.device().alias, 3, progress, bakes))


@dataclass
class Run:
    """A scheduler, whose scene gets its sky before every frame."""

    case: Case
    scheduler: gi.FrameScheduler

    def frame(self, index):
        if self.case.turning:
            self.scheduler.scene.environment = sky().rotated(25.0 * index)
        frame = self.scheduler.frame(index)
        return {name: frame.numpy(name).copy() for name in frame.names}

    def state(self):
        return state_arrays(self.scheduler._to_save())

    @property
    def says(self):
        found = self.scheduler.dependence(sky_changes=self.case.turning)
        return "saved" if found.is_saved else "unsaved" if found.on_past else ""


def assert_same(a, b, what):
    assert a.keys() == b.keys()
    different = [name for name in a if not np.array_equal(a[name], b[name], equal_nan=a[name].dtype.kind == "f")]
    assert not different, (what, different)


relight = replace(FIELD, sky="harmonics", relight=True)
small_budget = replace(FIELD, budget=0.2)
hierarchy = preset("path", emitters=gi.LightHierarchy())
CASES = {
    "path": Case("", preset("path"), moving=True, turning=True),
    "direct": Case("", preset("direct", emitters=gi.UniformLights()), moving=True, turning=True),
    "hierarchy": Case("", hierarchy, moving=True),
    "dvf": Case("", preset("dvf"), turning=True),
    "dvf moving": Case("saved", preset("dvf"), moving=True),
    "dvf budget": Case("saved", preset("dvf", environment=small_budget), narrow_bake=True),
    "dvf budget still": Case("saved", preset("dvf", environment=small_budget), narrow_bake=True, travels=False),
    "dvf budget moving": Case("saved", preset("dvf", environment=small_budget), moving=True, narrow_bake=True),
    "dvf no budget": Case("", preset("dvf", environment=replace(FIELD, budget=0.0)), moving=True, narrow_bake=True),
    "dvf all": Case("", preset("dvf", environment=replace(FIELD, lazy=False)), moving=True),
    "dvf traced": Case("", preset("dvf", environment=replace(FIELD, mode="traced")), moving=True),
    "dvf relight": Case("unsaved", preset("dvf", environment=relight), turning=True, travels=False),
    "reuse": Case("saved", preset("reuse")),
    "reuse moving": Case("saved", preset("reuse"), moving=True),
    "hybrid": Case("saved", preset("hybrid"), turning=True),
    "hybrid moving": Case("saved", preset("hybrid", environment=small_budget), moving=True, narrow_bake=True),
    "probes": Case("", preset("probes")),
    "probes moving": Case("unsaved", preset("probes"), moving=True),
    "probes turning": Case("unsaved", preset("probes"), turning=True),
    "probes fixed": Case("", preset("probes", indirect=replace(PROBES, update=0)), moving=True),
    "cache": Case("", preset("cache")),
    "cache turning": Case("", preset("cache"), turning=True),
    "cache moving": Case("saved", preset("cache"), moving=True),
    "clean": Case("saved", preset("clean"), moving=True),
    "clean blended": Case("saved", preset("clean", denoise=gi.SpatioTemporal(blend=0.25))),
    "transfer": Case("", preset("transfer")),
    "transfer turning": Case("", preset("transfer"), turning=True),
    "transfer moving": Case("", replace(preset("transfer"), indirect=None), moving=True),
    "polygons": Case("", preset("polygons")),
    "polygons turning": Case("", preset("polygons"), turning=True),
    "probe_view": Case("", preset("probe_view")),
    "probe_view moving": Case("unsaved", preset("probe_view"), moving=True),
    "probe_view alone": Case("", preset("probe_view"), alone=True),
    "denoised": Case("saved", preset("path", denoise="spatiotemporal"), moving=True),
    "reuse, probes": Case("unsaved", preset("reuse", indirect=PROBES), turning=True),
}


@pytest.fixture(scope="module")
def wholes(tmp_path_factory):
    """Return a function that gives frames, says and state files of a case rendered whole, on one thread, once each."""
    known = {}

    def whole(name):
        if name not in known:
            folder, case = tmp_path_factory.mktemp("states"), CASES[name]
            launch.set_threads(1)
            try:
                run = case.begin()
                says, frames, states = run.says, [], []
                for index in range(FRAMES):
                    frames.append(run.frame(index))
                    states.append((run.scheduler.save_state(folder / f"{index}.safetensors", "past"), run.state()))
            finally:
                launch.set_threads(None)
            known[name] = says, frames, states
        return known[name]

    return whole


def test_every_preset_is_here():
    assert set(gi.Pipeline.presets()) <= set(CASES)


def test_an_estimator_that_preprocesses_or_learns_depends_on_the_past_unless_it_says_not():
    class Own(gi.TracedEnvironment):
        def preprocess(self, frame, state):
            return frame.index

    class Promises(Own):
        def depends_on_past(self, scene, ahead=None):
            return False

    scene = yard(False)
    assert Own().depends_on_past(scene) and not Own().saves_state
    assert not gi.TracedEnvironment().depends_on_past(scene) and not Promises().depends_on_past(scene)
    assert gi.GuidedPaths().depends_on_past(scene) and gi.VisibilityLightCache().depends_on_past(scene)
    assert gi.VisibilityField().depends_on_past(scene) and gi.LightFieldProbes(update=0).depends_on_past(scene)
    scheduler = gi.FrameScheduler(scene, view(), preset("direct", environment=Own()), st.device().alias)
    assert scheduler.dependence().unsaved == ("environment",)


@pytest.mark.parametrize("name", CASES)
def test_frames_keep_what_their_pipeline_says(name, wholes):
    """Whole on two threads; if independent each frame alone and in reverse; if saved after a break at every frame."""
    case = CASES[name]
    says, frames, states = wholes(name)
    assert says == case.says
    launch.set_threads(2)
    try:
        again = case.begin()
        for index in range(FRAMES):
            assert_same(again.frame(index), frames[index], f"frame {index} on two threads")
            assert_same(again.state(), states[index][1], f"state {index} on two threads")
        if says == "":
            for index in reversed(range(FRAMES)):
                assert_same(again.frame(index), frames[index], f"frame {index} in reverse")
                alone = case.begin() if index == FRAMES - 1 else Run(case, other_scheduler(again))
                assert_same(alone.frame(index), frames[index], f"frame {index} alone")
        if says == "saved":
            for index in range(FRAMES - 1):
                resumed = case.begin() if index == FRAMES - 2 else Run(case, other_scheduler(again))
                resumed.scheduler.load_state(states[index][0], "past")
                assert_same(resumed.frame(index + 1), frames[index + 1], f"frame {index + 1} after a break")
                assert_same(resumed.state(), states[index + 1][1], f"state {index + 1} after a break")
    finally:
        launch.set_threads(None)


@pytest.mark.slow
@pytest.mark.parametrize("turning", [False, True], ids=["one sky", "turning"])
@pytest.mark.parametrize("moving", [False, True], ids=["still", "moving"])
@pytest.mark.parametrize("name", CASES)
def test_every_frame_alone_and_every_break(name, moving, turning, tmp_path):
    """In processes of their own, as far as that goes; after a break to the end; on 1, 2 and 3 threads by turns."""
    if moving and isinstance(CASES[name].pipeline.environment, gi.VisibilityPolygons):
        pytest.skip("visibility polygons refuse what moves")
    case = replace(CASES[name], moving=moving, turning=turning and not CASES[name].alone)
    if moving and isinstance(case.pipeline.indirect, gi.RadianceTransfer):  # the plate's lamp moves: it is refused
        case = replace(case, pipeline=replace(case.pipeline, indirect=None))
    whole = case.begin()
    says, frames = whole.says, []
    for index in range(FRAMES):
        frames.append(whole.frame(index))
        whole.scheduler.save_state(tmp_path / str(index), "past")
    try:
        for index in range(FRAMES):
            launch.set_threads(1 + index % 3)
            if says == "":
                assert_same(case.begin().frame(index), frames[index], f"frame {index} alone")
            run = case.begin()
            if says == "saved":
                run.scheduler.load_state(tmp_path / str(index), "past")
            for number in range(index + 1 if says == "saved" else 0, FRAMES):
                assert_same(run.frame(number), frames[number], f"frame {number} after a break at {index}")
    finally:
        launch.set_threads(None)


def other_scheduler(run):
    """Return a new scheduler of a scene that has been rendered already, which stands as the last frame left it."""
    old = run.scheduler
    scene = old.scene.bake if run.case.alone else old.scene
    bakes = [] if run.case.alone else [bake for given in old._bakes.values() for bake in given]
    return gi.FrameScheduler(scene, old.camera, old.pipeline, st.device().alias, 3, bakes=bakes)


def test_states_load_into_a_run_that_went_on(wholes):
    """What frames after it added is forgotten; and a state of a field with other cells is refused."""
    name = "dvf budget still"
    _, frames, states = wholes(name)
    run = CASES[name].begin()
    for index in (0, 1, 2):
        run.frame(index)
    run.scheduler.load_state(states[0][0], "past")
    assert_same(run.frame(1), frames[1], "frame 1")
    assert len(states[-1][1]["environment.cells"]) > len(states[0][1]["environment.cells"]) > 0  # it grew
    other = Run(CASES[name], gi.FrameScheduler(yard(False), CASES[name].path(), CASES[name].pipeline, seed=3))
    other.scheduler.bake()
    other.scheduler._bake_digests = run.scheduler._bake_digests
    with pytest.raises(BakeError, match="began with other cells"):
        other.scheduler.load_state(states[0][0], "past")


def test_what_a_cell_gets_does_not_depend_on_the_pose_in_which_baking_began():
    """Samples are as dense as the scene's area at time 0 says, though an object grows."""
    densities = []
    for time in (0.0, 0.5):
        scene = yard(True)
        scene.animate("plate", [gi.Keyframe(0.0, scale=(1.0, 1.0, 1.0)), gi.Keyframe(0.5, scale=(3.0, 3.0, 3.0))])
        scene.update(time, None, st.device())
        state = FIELD.start(scene, st.device().alias, None)
        densities.append([state.baker(layer).density for layer in ("static", "settled")])
    assert densities[0] == densities[1] and densities[0][0] == densities[0][1] > 0


# ---- interrupts ----


class Stop(Exception):
    pass


def interrupts(case, index, at, monkeypatch):
    """Return a run that has rendered the frames up to ``index``, and was stopped in the launch ``at`` of the next.

    ``at`` counts from the end if it is below 0. None if there are fewer launches.
    """
    run, counted = case.begin(), []
    launched = launch.launch

    def counts(*arguments, **named):
        counted.append(1)
        launched(*arguments, **named)

    def stops(*arguments, **named):
        counted.append(1)
        launched(*arguments, **named)
        if len(counted) == at:
            raise Stop

    if at < 0:
        for number in range(index + 1):
            if number == index:
                monkeypatch.setattr(launch, "launch", counts)
            run.frame(number)
        monkeypatch.undo()
        at, run = len(counted) + 1 + at, case.begin()
        counted.clear()
    for number in range(index):
        run.frame(number)
    monkeypatch.setattr(launch, "launch", stops)
    try:
        run.frame(index)
    except Stop:
        return run
    finally:
        monkeypatch.undo()
    return None


STOPPED = ("dvf moving", "dvf budget still", "dvf relight", "reuse moving", "probes moving", "denoised")


@pytest.mark.parametrize("name", STOPPED)
def test_an_interrupted_frame_leaves_nothing_behind(name, wholes, monkeypatch):
    """Stopped after its last launch, and after one while it traces: rendered again, and the next, as if it was not."""
    _, frames, states = wholes(name)
    for index, at in ((1, -1), (3, -3)):
        run = interrupts(CASES[name], index, at, monkeypatch)
        assert run is not None
        if name == "reuse moving":  # slices of a launch that was stopped may still write to its samples
            assert run.scheduler.state("octree").spare.records is None
        for number in (index, index + 1):
            assert_same(run.frame(number), frames[number], f"frame {number}, stopped in {index} at {at}")
            assert_same(run.state(), states[number][1], f"state {number}, stopped in {index} at {at}")
    run, other = interrupts(CASES[name], 1, -1, monkeypatch), CASES[name].begin()
    other.frame(0)
    assert_same(run.frame(0), other.frame(0), "frame 0 again, stopped in frame 1")


@pytest.mark.slow
@pytest.mark.parametrize("name", STOPPED)
def test_a_frame_may_be_interrupted_anywhere(name, wholes, monkeypatch):
    _, frames, _ = wholes(name)
    for at in (1, 2, 3, 4, 6, 8, 11, 15, 20, 26):
        if (run := interrupts(CASES[name], 2, at, monkeypatch)) is not None:
            assert_same(run.frame(2), frames[2], f"frame 2, stopped at {at}")
            assert_same(run.frame(3), frames[3], f"frame 3, stopped at {at}")


@pytest.mark.parametrize("then", [0, 1])
@pytest.mark.parametrize("stopped", ["warp_gi.scene.geometry.place", "warp_gi.bvh.TriangleBvh.refit"])
def test_a_scene_interrupted_while_it_moves_is_placed_anew(stopped, then, wholes, monkeypatch):
    """For the pose that it was to have, and for that it had before."""
    case = CASES["hierarchy"]
    run = case.begin()
    run.frame(0)

    def stops(*arguments):
        raise Stop

    monkeypatch.setattr(stopped, stops)
    with pytest.raises(Stop):
        run.frame(1)
    monkeypatch.undo()
    assert_same(run.frame(then), wholes("hierarchy")[1][then], f"frame {then}")


# ---- the command ----


def exr(pattern, index):
    frame = sequence.read_frame(sequence.frame_path(pattern, index))
    return {name: frame.numpy(name) for name in frame.names}


def test_a_growing_field_is_resumed_to_the_same_pictures(tmp_path, capsys):
    """The box with a bake of its middle, which grows by a few cells a frame: a hole, a break, frames made apart."""
    bake, pattern, broken = tmp_path / "box.dvf.safetensors", tmp_path / "a.####.exr", tmp_path / "b.####.exr"
    cells = {"cell-size": "0.25", "samples": "5000", "rays": "64"}
    place = ["cornell_box", "--environment=1"]
    narrow = ["--eye=0", "1", "3.4", "--target=0", "0.3", "0", "--hfov=12"]
    settings = [f"--{name}={value}" for name, value in cells.items()]
    assert cli.main(["bake", *place, *narrow, *settings, "--quiet", "-o", str(bake)]) == 0
    command = ["render", *place, "--pipeline=dvf,indirect=none", f"--bake={bake}", "--environment.budget=0.4"]
    command += [*(f"--environment.{name}={value}" for name, value in cells.items()), "--spp=4", "--resolution=32x18"]
    assert cli.main([*command, "--frames=0-4", "--quiet", "-o", str(pattern)]) == 0
    whole = [exr(pattern, index) for index in range(5)]
    assert cli.main([*command, "--frames=0-2", "--quiet", "-o", str(broken)]) == 0
    capsys.readouterr()
    assert cli.main([*command, "--frames=0-4", "--resume", "-o", str(broken)]) == 0
    assert "3 of 5 frames are there already" in capsys.readouterr().out
    for index in range(5):
        assert_same(exr(broken, index), whole[index], f"frame {index} after a break")
    sequence.frame_path(pattern, 3).unlink()
    assert cli.main([*command, "--frames=0-4", "--resume", "-o", str(pattern)]) == 0
    told = "no saved state fits, and the environment light depends on the frames before"
    assert told in capsys.readouterr().out
    assert_same(exr(pattern, 3), whole[3], "the frame that was missing")
    assert cli.main([*command, "--frames=3", "--quiet", "-o", str(pattern)]) == 0
    assert any(not np.array_equal(exr(pattern, 3)[name], whole[3][name]) for name in whole[3])  # alone it is another
    assert cli.main([*command, "--frames=0-4", "--resume", "-o", str(pattern)]) == 0
    for index in range(5):
        assert_same(exr(pattern, index), whole[index], f"frame {index} beside one made alone")


@pytest.mark.parametrize("kind", ["denoised", "probes"])
def test_frames_made_apart_are_not_taken_for_a_sequence(kind, tmp_path, capsys):
    """Where a frame depends on those before, its file says which: also if every file is there."""
    pattern, apart = tmp_path / "a.####.exr", tmp_path / "b.####.exr"
    command = ["render", "cornell_box", "--spp=2", "--resolution=24x16"]
    if kind == "denoised":
        command, what = [*command, "--pipeline=path", "--denoise=spatiotemporal"], "the denoiser"
    else:  # which are filled under the sky of the first frame, and stay so
        oiio.ImageBuf(sky().pixels).write(str(tmp_path / "sky.exr"))
        command += [f"--environment={tmp_path}/sky.exr", "--environment-turn=40", "--pipeline=probes"]
        command += ["--indirect.update=0", "--indirect.counts", "2", "2", "2", "--indirect.resolution=16"]
        what = "the indirect light"
    assert cli.main([*command, "--frames=0-2", "--quiet", "-o", str(pattern)]) == 0
    for frames in ("0-1", "2"):
        assert cli.main([*command, f"--frames={frames}", "--quiet", "-o", str(apart)]) == 0
    assert any(not np.array_equal(exr(apart, 2)[name], exr(pattern, 2)[name]) for name in ("beauty", "indirect"))
    capsys.readouterr()
    assert cli.main([*command, "--frames=0-2", "--resume", "-o", str(apart)]) == 0
    assert f"{what} depends on the frames before" in capsys.readouterr().out
    for index in range(3):
        assert_same(exr(apart, index), exr(pattern, index), f"frame {index}")
