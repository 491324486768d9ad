"""What a bake says of its cost before it starts. Clocks are made up: seconds are cells baked, and rays traced."""

import logging
import math

import pytest
import warp as wp

import warp_gi as gi
from warp_gi.bvh import TriangleBvh
from warp_gi.sequence.resume import Output, SequenceRun, shots_of
from warp_gi.stateful import Forecast
from warp_gi.techniques.visibility_field import cost
from warp_gi.techniques.visibility_field.state import FieldState, cells_on_path

CPU = wp.get_device("cpu")


@pytest.fixture
def clock(monkeypatch):
    """A clock that goes on by 1 s a cell and a ray; reset it by ``clock[0] = 0``."""
    now, occluded = [0.0], TriangleBvh.occluded

    def bake(self, cells=None, progress=None, most_rays=math.inf):
        now[0] += len(cells)

    def traced(self, origins, directions, *more):
        now[0] += len(origins)
        return occluded(self, origins, directions, *more)

    for name, value in (("_cpu", lambda: now[0]), ("TRIED_CELLS", 8), ("FEW_CELLS", 80)):
        monkeypatch.setattr(cost, name, value)
    monkeypatch.setattr(FieldState, "bake", bake)
    monkeypatch.setattr(TriangleBvh, "occluded", traced)
    return now


def box():
    scene = gi.builtin_scene("cornell_box")
    scene.update(0.0, None, CPU)
    return scene, gi.Camera.look_at((0, 1, 0.5), (0, 1, -1), resolution=(16, 12))  # sees nothing but walls


def test_all_cells_cost_what_a_share_of_them_says(clock):
    scene, camera = box()
    settings = gi.VisibilityField(cell_size=0.05).mask_settings
    state = FieldState(scene, CPU, settings, 1)
    seen = len(cells_on_path(state, camera))
    assert cost.bake_seconds(scene, CPU, settings, 1, camera) == pytest.approx(seen) and seen > cost.FEW_CELLS
    assert clock[0] == cost.TRIED_CELLS
    assert cost.bake_seconds(scene, CPU, settings, 1, None) == pytest.approx(state.grid.cell_count) and seen < 200
    few = gi.VisibilityField(cell_size=1.0).mask_settings
    clock[0] = 0.0
    assert cost.bake_seconds(scene, CPU, few, 1, None) == clock[0] == 0.0


def test_a_frame_traces_its_rays_from_the_pixels_that_see_something(clock):
    scene, camera = box()
    assert cost.traced_seconds(scene, CPU, camera, 3.0, 1) == pytest.approx(3 * 16 * 12, rel=0.02)
    away = gi.Camera.look_at((0, 1, 50), (0, 1, 100), resolution=(16, 12))
    assert cost.traced_seconds(scene, CPU, away, 3.0, 1) == 0.0


def test_what_a_field_says(clock):
    scene, camera = box()
    field = gi.VisibilityField(cell_size=0.05)
    scene.environment = (0.5, 0.5, 0.5)
    constant = field.forecast(scene, CPU, 1, camera, 4)
    assert constant.bake_seconds > 80 and constant.most_saved == pytest.approx(4 * 16 * 12, rel=0.02)
    scene.environment = None
    assert field.forecast(scene, CPU, 1, camera, 4).most_saved == 0.0
    assert gi.VisibilityField(mode="traced").forecast(scene, CPU, 1, camera, 4) is None
    assert gi.VisibilityField(cell_size=1.0).forecast(scene, CPU, 1, camera, 4) is None
    assert gi.BsdfPaths().forecast(scene, CPU, 1, camera, 4) is None


@pytest.mark.parametrize(
    "saved, told",
    [
        (0.6, "; it saves at most 0.6 CPU s a frame, so it pays after 117 frames or more; this run has 3"),
        (0.0, ""),
    ],
)
def test_one_line_before_the_bake_and_none_for_one_that_is_there(monkeypatch, caplog, tmp_path, saved, told):
    scene, camera = box()
    field = gi.VisibilityField(cell_size=0.5, samples=200, rays=8)
    bake = gi.bake(scene, field, seed=1)
    monkeypatch.setattr(gi.VisibilityField, "forecast", lambda *_: Forecast(70.0, saved))
    monkeypatch.setattr(gi.VisibilityField, "bake", lambda *_, **__: logging.getLogger("warp_gi").info("bakes") or bake)
    for bakes, lines in (((), [f"bake of VisibilityField: about 70 CPU s{told}", "bakes"]), ([bake], [])):
        caplog.clear()
        with caplog.at_level(logging.INFO, "warp_gi"):
            scheduler = gi.FrameScheduler(scene, camera, gi.Pipeline(environment=field), seed=1, bakes=bakes)
            SequenceRun(scheduler, shots_of(camera, [0, 1, 2], "a.####.exr"), Output(tmp_path / "a.####.exr")).bake()
        assert caplog.messages == lines
