"""The protocol of an estimator of one term of the light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from warp_gi.stateful import Ahead, Stateful

if TYPE_CHECKING:
    from warp_gi.baking import Bake
    from warp_gi.frame import Frame
    from warp_gi.primary import Primary
    from warp_gi.radiance_cache import RadianceCache

__all__ = ["Ahead", "Estimator"]


@dataclass(frozen=True)
class Estimator(Stateful):
    """Base of every estimator of one term of the light; a frozen dataclass of plain settings.

    ``trace`` is called once for each camera sample: it adds to the term's buffer, or asks the path tracer for the
    term (``Frame.paths``).
    """

    term: ClassVar[str]
    """Term of the light that the estimator stands for: "environment", "emitters" or "indirect"."""

    def trace(self, frame: Frame, state: Any) -> None:
        """Add this term's samples of the current camera sample to the frame's buffers."""
        raise NotImplementedError

    @property
    def radiance_cache(self) -> RadianceCache | None:
        """The radiance cache in which the estimator's paths end, or None. Its state and bake are its own."""
        return None

    @property
    def own_primary(self) -> Primary | None:
        """The primary that finds the frame's hits in place of camera rays, or None. Its state is the estimator's."""
        return None

    def fitting(self, bake: Bake) -> Estimator:
        """Return these settings with those that a bake depends on replaced by its own, to render it without a scene.

        Asked of an estimator whose ``own_primary`` is whole. Raises BakeError for another technique's bake.
        """
        raise NotImplementedError
