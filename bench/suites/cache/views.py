"""Views that surface caches are measured on: places, targets, and pictures that end in cells."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import warp_gi as gi
from warp_gi import launch
from warp_gi.bench.harness.path_views import SEED, PathView
from warp_gi.bench.harness.stages import Case, Stage

SIZE, QUICK_SIZE = (160, 90), (40, 24)
SPP = 64
"""Samples a pixel at which errors and times are compared."""


@dataclass(frozen=True)
class CacheCase(Case):
    """A place with its own materials, its targets, and how many samples half of its reference takes."""

    within: float = 0.04
    """Largest relative error of the mean."""
    floor: float = 0.08
    """Largest error that more samples do not remove, over the mean."""
    flip: float = 0.5
    """Largest FLIP over that of paths of as many samples."""
    faster: float = 12.0
    """Least time of paths for equal error over that of the cache."""
    reference_spp: int = 512


CASES = (
    CacheCase("cornell_box", reference_spp=2048),
    CacheCase("two_rooms", reference_spp=1024),
    CacheCase("atrium", flip=2 / 3),
    CacheCase("living_room_white", floor=0.15, reference_spp=1024),
    CacheCase("modern_hall", reference_spp=1024),
    CacheCase("sponza_courtyard", within=0.05),
    CacheCase("sponza", "Sponza, white sky", within=0.05),
)
QUICK_CASES = CASES[:1]
ALL_FASTER = 20.0
"""Least geometric mean of ``CacheCase.faster`` over all places."""
MOST_FILL = 3.0
"""Largest number of CPU seconds of a fill."""


class CacheView(PathView):
    """A view of paths that end in a surface cache, with the path tracer's pictures to compare them with."""

    def cached(self, spp: int, seed: int = SEED, **settings: Any) -> Stage:
        """Return the stage of paths that end in a cache, which has one fill for all seeds."""
        cache = gi.SurfaceCache(**settings)
        return Stage(self.scene, self.camera, gi.BsdfPaths(ends_in=cache), spp, self.device, self.bake(cache)[0], seed)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let kernels have one thread for a while: several that wait for each other's memory take more CPU time."""
    before = launch.thread_count()
    launch.set_threads(1)
    try:
        yield
    finally:
        launch.set_threads(before)
