"""The protocol of an estimator: plain settings, and the three calls bake, preprocess, trace."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from collections.abc import Callable

    from warp_gi.scene.scene import Scene
    from warp_gi.scheduler import Frame


@dataclass(frozen=True)
class Estimator:
    """Base of every estimator of one term of the light; a frozen dataclass of plain settings.

    The scheduler calls ``bake`` once, ``preprocess`` once a frame and ``trace`` once for
    each camera sample. ``state`` is whatever ``preprocess`` returned last (at first what
    ``bake`` returned); an estimator keeps nothing anywhere else.
    """

    term: ClassVar[str]
    """"environment", "emitters" or "indirect"."""

    def __post_init__(self) -> None:
        self.validate()

    def validate(self) -> None:
        """Raise OptionError for settings out of range."""

    def bake(self, scene: Scene, device: str, seed: int = 0, progress: Callable[[float], None] | None = None) -> Any:
        """Return what can be known before the first frame, or None."""
        return None

    def preprocess(self, frame: Frame, state: Any) -> Any:
        """Return the state for this frame, from the scene's changes and the previous state."""
        return state

    def trace(self, frame: Frame, state: Any) -> None:
        """Add this term's samples of the current camera sample to the frame's buffers."""
        raise NotImplementedError
