"""Radiance caches: they know the light at surfaces, so that paths may end there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from warp_gi.stateful import Stateful

if TYPE_CHECKING:
    from warp_gi.frame import Frame


@dataclass(frozen=True)
class RadianceCache(Stateful):
    """Base of every radiance cache: it knows the indirect light at surfaces, so that a path may end there.

    ``BsdfPaths(ends_in=...)`` holds one. Its bake and state are kept by the place where it stands,
    "indirect.ends_in", apart from those of an estimator of the same class.
    """

    def give(self, frame: Frame, state: Any) -> None:
        """Hand the cache to the frame's paths, by ``frame.paths.use_cache``; called once a camera sample."""
        raise NotImplementedError
