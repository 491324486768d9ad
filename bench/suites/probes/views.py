"""Views that light field probes are measured on: bakes by their settings, and the path tracer's pictures."""

from __future__ import annotations

from typing import Any

import warp_gi as gi
from warp_gi.bench.harness import path_views
from warp_gi.bench.harness.path_views import SEED, PathView
from warp_gi.bench.harness.stages import LAMBERT, PLAIN, Case, Stage

CORNELL = Case("cornell_box", materials=LAMBERT)
LIVING_ROOM = Case("living_room", target=50.0, materials=LAMBERT)
ROOM = Case("living_room_all", target=50.0, materials=LAMBERT)
"""View that looks the other way, into the living room; that of `LIVING_ROOM` is near its windows."""
GLOSSY_LIVING_ROOM = Case("living_room_all", "living room, its materials", materials=PLAIN)
SPONZA = Case("sponza", target=50.0, materials=LAMBERT)


class ProbeView(PathView):
    """A view of light field probes, with the path tracer's pictures to compare them with."""

    def stage(self, spp: int, **settings: Any) -> Stage:
        """Return the stage of probes at ``spp`` samples a pixel."""
        estimator = gi.LightFieldProbes(**settings)
        return Stage(self.scene, self.camera, estimator, spp, self.device, self.bake(estimator)[0], SEED)


def view_of(place: Case, size: tuple[int, int], device: str, reference_spp: int) -> ProbeView:
    """Return the view of a place at a size in pixels."""
    return path_views.view_of(ProbeView, place, size, device, reference_spp)


def room_views(size: tuple[int, int], device: str, reference_spp: int) -> dict[str, ProbeView]:
    """Return the views of the rooms "lit" and "dark" of two; what one bakes, for both cameras, the other has too."""
    return path_views.room_views(ProbeView, size, device, reference_spp)


def counts_of(stage: Stage) -> str:
    """Return a stage's probes along x, y and z in words."""
    return " x ".join(map(str, stage.state.grid.counts))
