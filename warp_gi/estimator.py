"""The protocol of an estimator: plain settings, and the calls bake, start, preprocess, trace."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from warp_gi.baking import Bake
    from warp_gi.scene.camera import Camera, CameraPath
    from warp_gi.scene.scene import Scene
    from warp_gi.scheduler import Frame
    from warp_gi.techniques.reuse.sample_octree import Lesson


class SamplerInUse(NamedTuple):
    """A sampler of ``kernels.path_samplers`` and the struct of data that it gets in this frame."""

    sampler: Any
    data: Any


@dataclass(frozen=True)
class Ahead:
    """What is known of a sequence before its first frame."""

    state: Any
    """The estimator's, before the first frame."""
    views: Sequence[tuple[int, Camera]]
    """The frames that will be rendered, by number, and from where."""
    sky_changes: bool = False
    """Whether the scene gets another sky from frame to frame."""


@dataclass(frozen=True)
class Estimator:
    """Base of every estimator of one term of the light; a frozen dataclass of plain settings.

    What can be known before the first frame is a ``Bake``, which can be saved; ``start`` makes
    the first state of it, ``preprocess`` the state of each frame, and ``trace`` is called once for
    each camera sample. For ``bake`` and ``start`` the scene is at time 0, whoever moved it before.
    An estimator keeps nothing anywhere but in its state, and leaves the previous state as it is,
    arrays included: a frame that is interrupted is rendered again from there.
    """

    term: ClassVar[str]
    """"environment", "emitters" or "indirect"."""

    @property
    def makes_primary(self) -> bool:
        """Whether the estimator finds out what the camera sees, too: then it is the only one of its pipeline."""
        return False

    def depends_on_past(self, scene: Scene, ahead: Ahead | None = None) -> bool:
        """Return whether a frame depends on those rendered before it: yes, if it has a ``preprocess`` or learns.

        An override may say no. That is a promise: a frame rendered alone, or after a break, or after any others is
        the same to the last bit. ``ahead`` None asks for every camera, sky and state that there may be.
        """
        kind = type(self)
        overrides = kind.preprocess is not Estimator.preprocess or kind.learn is not Estimator.learn
        return self.learns or overrides

    @property
    def saves_state(self) -> bool:
        """Whether a saved state holds all that frames before left, so that a sequence goes on from it bit for bit.

        If not, a sequence whose frames depend on the past is rendered from its first frame again.
        """
        return self.learns

    @property
    def learns(self) -> bool:
        """Whether it learns from the samples that the paths of a frame leave, region by region; see ``learn``."""
        return False

    def __post_init__(self) -> None:
        self.validate()

    def validate(self) -> None:
        """Raise OptionError for settings out of range."""

    def bake_key(self, scene: Scene) -> str:
        """Return a hash of all in the scene that ``bake`` and the state depend on; "" is everything.

        While it stays, a changed sky or light leaves bake and state as they are.
        """
        return ""

    def bake_settings(self, scene: Scene) -> dict[str, Any]:
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

        ``camera`` is where the scene will be seen from, for those that bake no more than that.
        """
        return None

    def check_view(self, bake: Bake, camera: Camera | CameraPath) -> None:
        """Warn if a bake, of this scene and with these settings, was made for another camera than will look at it."""

    def start(self, scene: Scene, device: str, bake: Bake | None, seed: int = 0) -> Any:
        """Return the state before the first frame."""
        return None

    def preprocess(self, frame: Frame, state: Any) -> Any:
        """Return the state for this frame, from the scene's changes and the previous state, which stays as it is."""
        return state

    def trace_primary(self, frame: Frame, state: Any) -> None:
        """Fill all buffers for the current camera sample; asked of an estimator that ``makes_primary``."""
        raise NotImplementedError

    def trace(self, frame: Frame, state: Any) -> None:
        """Add this term's samples of the current camera sample to the frame's buffers."""
        raise NotImplementedError

    def learn(self, lesson: Lesson, state: Any) -> Any:
        """Return the state after a frame, from the samples of its paths; asked of an estimator that ``learns``."""
        return state
