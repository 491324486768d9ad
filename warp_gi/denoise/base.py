"""The protocol of denoisers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from warp_gi.stateful import Ahead, Stateful

if TYPE_CHECKING:
    from warp_gi.frame import Frame
    from warp_gi.scene.baked import BakedScene
    from warp_gi.scene.scene import Scene


@dataclass(frozen=True)
class Denoiser(Stateful):
    """Base of every denoiser; a frozen dataclass of plain settings.

    ``start`` makes the state before the first frame. ``apply`` fills a frame's ``beauty`` and returns the state for
    the next frame, leaving the last one as it is. A denoiser keeps nothing anywhere but in its state.
    """

    wants_lobes: ClassVar[bool] = False
    """Whether ``apply`` reads the guides and the separated light (``Frame.lobes``)."""

    @property
    def parts_lights(self) -> bool:
        """Whether it wants the diffuse light of suns and of lights without size apart (``Lobes.apart``)."""
        return False

    def depends_on_past(self, scene: Scene | BakedScene, ahead: Ahead | None = None) -> bool:
        """Return whether a frame depends on those before it; True, unless a denoiser promises that it does not."""
        return True

    def bake_key(self, scene: Scene | BakedScene) -> str:
        """Return the same for every scene: a denoiser learns of a change from the frames."""
        return "any scene"

    def samples(self, frame: Frame, state: Any) -> int:
        """Return the number of samples a pixel that a frame is to take, from the pipeline's own: ``frame.settings``."""
        return frame.settings.spp

    def apply(self, frame: Frame, state: Any) -> Any:
        """Fill ``frame["beauty"]`` from ``frame["noisy"]`` and the other buffers, and return the new state."""
        raise NotImplementedError
