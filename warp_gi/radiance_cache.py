"""Radiance caches: what is known of the light at surfaces, in which paths may end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from warp_gi.stateful import Stateful

if TYPE_CHECKING:
    from warp_gi.frame import Frame


@dataclass(frozen=True)
class RadianceCache(Stateful):
    """Base of what knows the indirect light at a surface, so that a path may end there.

    ``BsdfPaths(ends_in=...)`` holds one. Its bake and state are kept by the place where it stands,
    "indirect.ends_in", apart from those of an estimator of the same class.
    """

    def give(self, frame: Frame, state: Any) -> None:
        """Hand what is known in this frame to its paths, by ``frame.paths.use_cache``; called once a camera sample."""
        raise NotImplementedError
