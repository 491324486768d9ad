"""Surface caches in scenes that move: cells go with objects and follow the light, and a resume changes no bit."""

from dataclasses import replace

import numpy as np
import pytest
import statistics_tools as st
from scene_tools import quad
from statistics_tools import every_device  # noqa: F401
from truth_tools import camera_in_box, closed_box

import warp_gi as gi
from warp_gi import launch
from warp_gi.errors import SceneError
from warp_gi.scene.builtin.shapes import box
from warp_gi.techniques.surface_cache.bake_tool import TOOL
from warp_gi.techniques.surface_cache.cells import Sums
from warp_gi.techniques.surface_cache.state import still_valid

FPS = 24
CACHE = gi.SurfaceCache(paths=20_000, refresh=4_000)
PIPELINE = gi.Pipeline(environment=None, emitters=None, indirect=gi.BsdfPaths(ends_in=CACHE), camera_samples=1, spp=4)
TRACED = replace(PIPELINE, indirect=gi.BsdfPaths(max_depth=24))


def box_with_a_crate(emission: float = 1.0, turn: float = 0.0) -> gi.Scene:
    """A closed box of albedo 0.5, and a crate of it that slides by 0.2 m and turns by ``turn`` in each frame."""
    sides = closed_box(0.5, emission)
    crate = box((-0.3, -0.3, -0.3), (0.3, 0.3, 0.3)).mesh(sides[0].material, "crate")
    keys = []
    for frame in range(5):
        half = 0.5 * turn * frame
        rotation = (0.0, float(np.sin(half)), 0.0, float(np.cos(half)))
        keys.append(gi.Keyframe(frame / FPS, (-0.6 + 0.2 * frame, -0.65, -0.6), rotation))
    return gi.Scene([gi.Node("room", sides), gi.Node("crate", [crate], keyframes=keys)], name="crate")


def lamp_that_goes(frame: int = 6) -> gi.Scene:
    """A dim box whose bright lamp is in a lidded niche from a frame on: its own dim light is left."""
    sides = closed_box(0.6, 0.02)
    lamp = gi.Material("lamp", (0, 0, 0), emission=(40.0, 40.0, 40.0))
    panel = quad((-0.3, 0, -0.3), (0.6, 0, 0), (0, 0, 0.6), lamp, "lamp")
    keys = [gi.Keyframe((frame - 0.75) / FPS, (0.0, 0.9, 0.0)), gi.Keyframe((frame - 0.5) / FPS, (0.0, 9.0, 0.0))]
    niche = box((-1.0, 8.0, -1.0), (1.0, 10.0, 1.0)).flipped().mesh(gi.Material("niche", (0.5, 0.5, 0.5)), "niche")
    return gi.Scene([gi.Node("room", [*sides, niche]), gi.Node("lamp", [panel], keyframes=keys)], name="lamp")


def scheduler_of(scene: gi.Scene, pipeline: gi.Pipeline = PIPELINE, seed: int = 3, camera=None) -> gi.FrameScheduler:
    return gi.FrameScheduler(scene, camera or camera_in_box((24, 24)), pipeline, st.device().alias, seed)


def cells_of(scheduler: gi.FrameScheduler):
    """Return the grid numbers, keys, irradiance and weights of the smallest cells."""
    state = scheduler.state("indirect.ends_in")
    return state.keys >> np.uint64(55), state.keys, state.light[:, :3] / state.weights[:, None], state.weights


# ---- objects ----


def test_a_furnace_stays_white_while_a_crate_moves_in_it():
    """Every cell has the irradiance pi / (1 - albedo) = 2 pi, in each frame: those of the crate, too."""
    scheduler = scheduler_of(box_with_a_crate(turn=0.3))
    for index in range(5):
        scheduler.frame(index)
        number, _, light, weights = cells_of(scheduler)
        assert set(number) == {0, 2}
        for which in (0, 2):
            mine = number == which
            mean = (light[mine] * weights[mine, None]).sum(axis=0) / weights[mine].sum()
            np.testing.assert_allclose(mean, 2 * np.pi, rtol=0.015)


def test_a_crate_takes_its_cells_along():
    """As many as at rest: with cells in the world each frame would add others. What is left behind fades."""
    moving = scheduler_of(box_with_a_crate(turn=0.3))
    before: set[int] = set()
    for index in range(5):
        moving.frame(index)
        number, keys, _, weights = cells_of(moving)
        crate = set(keys[number == 2][weights[number == 2] > 4].tolist())
        if index:
            assert len(crate & before) > 0.7 * len(crate) > 50
        before = before | crate


def test_pictures_of_what_moves_have_the_mean_of_paths():
    """A lit crate slides and turns: the mean of its frames' indirect light is that of paths within 3 %."""
    scene, light = box_with_a_crate(0.0, turn=0.2), gi.Material("lamp", (0, 0, 0), emission=(5.0, 4.0, 3.0))
    scene.nodes[0].meshes.append(quad((-0.3, 0.99, -0.3), (0.6, 0, 0), (0, 0, 0.6), light, "lamp"))
    scene = gi.Scene(scene.nodes, name="lit crate")
    frames = {}
    for name, pipeline in (("cache", replace(PIPELINE, spp=32)), ("paths", replace(TRACED, spp=128))):
        scheduler = scheduler_of(scene, pipeline)
        frames[name] = np.stack([scheduler.frame(index).numpy("indirect") for index in range(5)]).astype(np.float64)
    ratio = frames["cache"].mean(axis=(1, 2)) / frames["paths"].mean(axis=(1, 2))
    np.testing.assert_allclose(ratio, 1.0, atol=0.04)
    np.testing.assert_allclose(ratio.mean(), 1.0, atol=0.02)


# ---- light ----


def test_light_that_goes_is_forgotten_at_once():
    """The room is far darker in the next frame. Without a look at the samples 0.8 of the light would be left."""
    pipeline, index = replace(PIPELINE, spp=16), 6
    traced = scheduler_of(lamp_that_goes(index), replace(TRACED, spp=64))
    bright, dark = (traced.frame(k).numpy("indirect").mean() for k in (index - 1, index))
    assert dark < 0.05 * bright
    scheduler = scheduler_of(lamp_that_goes(index), pipeline)
    light = [scheduler.frame(k).numpy("indirect").mean() for k in range(index + 3)]
    np.testing.assert_allclose(light[:index], bright, rtol=0.03)
    assert light[index] < dark + 0.02 * bright and light[index + 2] == pytest.approx(dark, rel=0.05)


def test_a_sky_that_turns_is_followed():
    sun = np.full((16, 32, 3), 0.2, np.float32)
    sun[3:5, 4:8] = 30.0
    court = gi.Scene(
        [
            gi.Node(
                "ground",
                [
                    quad((-4, 0, 4), (8, 0, 0), (0, 0, -8)),
                    box((-1, 0, -1), (1, 2, 1)).mesh(gi.Material("grey", (0.6, 0.6, 0.6)), "block"),
                ],
            )
        ]
    )
    court.environment = gi.TurningSky(gi.Environment(pixels=sun), 180.0)
    camera = gi.Camera.look_at((3, 2, 4), (0, 0.6, 0), hfov=50, resolution=(24, 24))
    cached = scheduler_of(court, replace(PIPELINE, spp=64), camera=camera)
    traced = scheduler_of(court, replace(TRACED, spp=128), camera=camera)
    for index in range(6):
        found, wanted = cached.frame(index).numpy("indirect"), traced.frame(index).numpy("indirect")
        assert found.mean() == pytest.approx(wanted.mean(), rel=0.08)


def test_only_light_that_changed_is_forgotten():
    """Of three large cells one is as it was, one has half of its light, and of one nobody knows more."""
    random = np.random.default_rng(3)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(12), np.arange(4), indexing="ij"))
    keys = (x.astype(np.uint64) << np.uint64(39)) | (y.astype(np.uint64) << np.uint64(23)) | np.uint64(1)
    region = x // 4

    def sums(mean: np.ndarray, count: int) -> Sums:
        samples = mean[:, None] * random.gamma(4.0, 0.25, (len(mean), count))
        light = np.zeros((len(mean), 7))
        light[:, :3], light[:, 6] = samples.sum(axis=1)[:, None], (samples**2).sum(axis=1)
        return Sums(keys, light, np.full(len(keys), float(count)))

    old, new = sums(np.full(len(keys), 2.0), 30), sums(np.where(region == 1, 1.0, 2.0), 3)
    new = Sums(new.keys[region < 2], new.light[region < 2], new.counts[region < 2])
    kept = still_valid(old, new)
    np.testing.assert_array_equal(kept.keys, keys[region != 1])
    np.testing.assert_array_equal(kept.light, old.light[region != 1])
    assert len(still_valid(old, Sums(old.keys[:0], old.light[:0], old.counts[:0])).keys) == len(keys)


# ---- sequences ----


def test_a_resumed_sequence_is_the_same_bit_by_bit(tmp_path):
    scene = box_with_a_crate(turn=0.3)
    whole = scheduler_of(scene)
    frames = [whole.frame(index).numpy("indirect") for index in range(3)]
    first = scheduler_of(scene)
    for index in range(2):
        first.frame(index)
    saved = first.save_state(tmp_path / "state.safetensors")
    second = scheduler_of(scene)
    second.load_state(saved)
    np.testing.assert_array_equal(second.frame(2).numpy("indirect"), frames[2])
    assert (frames[2] != frames[1]).any()


def test_nothing_depends_on_the_number_of_threads():
    found = []
    for threads in (1, 4):
        launch.set_threads(threads)
        try:
            scheduler = scheduler_of(box_with_a_crate(turn=0.3))
            found.append([scheduler.frame(index).numpy("indirect") for index in range(3)])
        finally:
            launch.set_threads(None)
    np.testing.assert_array_equal(*found)


def test_after_a_long_gap_all_is_filled_anew():
    scene = box_with_a_crate(turn=0.3)
    scheduler = scheduler_of(scene)
    scheduler.frame(0)
    np.testing.assert_array_equal(
        scheduler.frame(20).numpy("indirect"), scheduler_of(scene).frame(20).numpy("indirect")
    )


def test_what_a_sequence_depends_on():
    still = gi.builtin_scene("cornell_box")
    assert PIPELINE.dependence(still).kind == "independent"
    assert PIPELINE.dependence(box_with_a_crate()).kind == "saved"
    still.environment = gi.TurningSky(gi.Environment(color=(1.0, 1.0, 1.0)), 9.0)
    assert PIPELINE.dependence(still).kind == "saved"


def test_there_is_nothing_to_bake_where_something_moves():
    """The command says so; a bake by hand holds no cells, only where they lie."""
    scene = box_with_a_crate()
    with pytest.raises(SceneError, match="'crate' moves: there frames fill the cells as they are rendered"):
        TOOL.check_scene(CACHE, scene)
    bake = gi.bake(scene, CACHE, st.device().alias, camera=camera_in_box())
    assert bake.counts["cells"] == 0
    scene = gi.builtin_scene("cornell_box")
    scene.environment = gi.TurningSky(gi.Environment(color=(1.0, 1.0, 1.0)), 9.0)
    with pytest.raises(SceneError, match="the sky changes over time: there frames fill"):
        TOOL.check_scene(CACHE, scene)
