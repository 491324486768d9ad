"""The protocol of everything that keeps a state over frames: plain settings, and calls that return the next state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from warp_gi.baking import Bake, Setting
    from warp_gi.frame import Frame
    from warp_gi.scene.baked import BakedScene
    from warp_gi.scene.camera import Camera, CameraPath
    from warp_gi.scene.scene import Scene


@dataclass(frozen=True)
class Ahead:
    """Knowledge of a sequence before its first frame."""

    state: Any
    """State before the first frame, of the part that the question is about."""
    views: Sequence[tuple[int, Camera]]
    """Number and camera of each frame that will be rendered."""
    sky_changes: bool = False
    """Whether the scene gets another sky from frame to frame."""


@dataclass(frozen=True)
class Stateful:
    """Base of estimators, services, radiance caches, primaries and denoisers; a frozen dataclass of plain settings.

    The scheduler calls ``bake`` and ``start`` before the first frame, with the scene at time 0, whoever moved it
    before. For each frame it calls ``preprocess`` before rays are traced and ``after`` when the frame's sums are
    complete. Each returns a state and leaves the one that it was given as it is, arrays included: a frame that is
    interrupted is rendered again from there. Nothing is kept anywhere but in the state.
    """

    def __post_init__(self) -> None:
        self.validate()

    def validate(self) -> None:
        """Raise OptionError for settings out of range."""

    # ---- before the first frame ----

    def bake_key(self, scene: Scene | BakedScene) -> str:
        """Return a hash of all in the scene that ``bake`` and ``start`` depend on; "" stands for everything.

        While the hash stays the same, a changed sky or light leaves bake and state as they are.
        """
        return ""

    def bake_settings(self, scene: Scene | BakedScene) -> dict[str, Setting]:
        """Return the settings that a bake depends on."""
        return {}

    def bake(
        self,
        scene: Scene,
        device: str,
        seed: int = 0,
        progress: Callable[[float], None] | None = None,
        camera: Camera | CameraPath | None = None,
    ) -> Bake | None:
        """Return what can be known before the first frame, or None if there is nothing.

        ``camera`` tells from where the scene will be seen, for bakes of what the camera sees alone. ``progress`` is
        called with the share done in [0, 1].
        """
        return None

    def check_view(self, bake: Bake, camera: Camera | CameraPath) -> None:
        """Warn if a bake of this scene and these settings was made for another camera than will look at it."""

    def start(self, scene: Scene | BakedScene, device: str, bake: Bake | None = None, seed: int = 0) -> Any:
        """Return the state before the first frame, from a bake if there is one."""
        return None

    # ---- each frame ----

    def preprocess(self, frame: Frame, state: Any) -> Any:
        """Return the state for this frame, from the scene's changes and the state that the last frame left."""
        return state

    def after(self, frame: Frame, state: Any) -> Any:
        """Return the state that this frame leaves, for example after learning from its samples."""
        return state

    def depends_on_past(self, scene: Scene | BakedScene, ahead: Ahead | None = None) -> bool:
        """Return whether a frame depends on those before it: by default, whether it has ``preprocess`` or ``after``.

        An override may say no. That is a promise: a frame rendered alone, after a break, or after any others is the
        same to the last bit. ``ahead`` None asks for every camera, sky and state that there may be.
        """
        kind = type(self)
        return kind.preprocess is not Stateful.preprocess or kind.after is not Stateful.after

    @property
    def saves_state(self) -> bool:
        """Whether a saved state holds all that frames before left, so that a sequence goes on from it bit for bit.

        If not, a sequence whose frames depend on the past is rendered from its first frame again.
        """
        return False

    @property
    def learns(self) -> bool:
        """Whether ``after`` does anything."""
        return type(self).after is not Stateful.after
