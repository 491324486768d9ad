"""The protocol of everything that keeps a state over frames: plain settings, and calls that return the next state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from warp_gi.plain import take_plain
from warp_gi.scene.camera import views_hash

if TYPE_CHECKING:
    import warp as wp

    from warp_gi.baking import Bake, Setting
    from warp_gi.frame import Frame
    from warp_gi.scene.baked import BakedScene
    from warp_gi.scene.camera import Camera, CameraPath
    from warp_gi.scene.scene import Scene


@dataclass(frozen=True)
class Ahead:
    """Knowledge of a sequence before its first frame."""

    state: Any
    """State before the first frame of whom the question is asked; None where it is not known."""
    views: Sequence[tuple[int, Camera]]
    """Number and camera of each frame that will be rendered."""
    sky_changes: bool = False
    """Whether the scene gets another sky from frame to frame."""


@dataclass(frozen=True)
class Forecast:
    """What a bake will cost, told before it starts."""

    bake_seconds: float
    """CPU seconds of the bake, about."""
    most_saved: float = 0.0
    """CPU seconds that it can save in a frame at most; 0 where nothing is known of that."""


_EARLIER = {
    "learn": "learn in after(frame, state), from frame.offered(Lesson) of the service SampleOctree",
    "makes_primary": "return a Primary as own_primary",
    "trace_primary": "return a Primary as own_primary, and trace there",
}
"""Methods of estimators before 0.1.0, and what takes their place."""


@dataclass(frozen=True)
class Stateful:
    """Base of estimators, services, radiance caches, primaries and denoisers; a frozen dataclass of plain settings.

    Numbers of NumPy's kinds become Python's own.

    The scheduler calls ``bake`` and ``start`` before the first frame, with the scene at time 0, whoever moved it
    before. For each frame it calls ``preprocess`` before rays are traced and ``after`` when the frame's sums are
    complete. Each returns a state and leaves the one that it was given as it is, arrays included: a frame that is
    interrupted is rendered again from there. Nothing is kept anywhere but in the state.
    """

    is_per_pixel: ClassVar[bool] = False
    """Whether a large picture may be rendered in bands of its rows (``bands``), each as a frame of its own: that a
    pixel's light depends on no other pixel, kernels run over pixels by ``Frame.launch`` and ``Frame.launch_tiled``, and
    ``preprocess`` of one frame may be called again."""

    def __init_subclass__(cls, **more: Any) -> None:
        """Refuse methods of an earlier protocol, which nobody would call."""
        super().__init_subclass__(**more)
        for name, instead in _EARLIER.items():
            is_called = name == "learn" and cls.after is not Stateful.after  # by its own ``after``
            if name in vars(cls) and not is_called:
                raise TypeError(f"{cls.__name__}.{name} is of an earlier version and never called: {instead}")

    def __post_init__(self) -> None:
        take_plain(self)
        self.validate()

    def validate(self) -> None:
        """Raise OptionError for settings out of range."""

    @property
    def services(self) -> tuple[Service, ...]:
        """Services that this needs in every frame.

        A field of the pipeline that holds a service of the same name replaces its settings.
        """
        return ()

    def kernels(self, scene: Scene | BakedScene | None = None) -> tuple[wp.Kernel, ...]:
        """Return a kernel of each module that this will launch: modules then compile before they are waited for.

        ``scene`` None is not known yet. A module left out compiles at its first launch; one too many costs its time.
        """
        return ()

    def samplers(self, scene: Scene | BakedScene | None = None) -> tuple[Any, ...] | None:
        """Return the samplers of ``kernels.path_samplers`` that this will give to paths, as they are compiled in.

        None says that they depend on the scene, where that is not known yet.
        """
        return ()

    # ---- before the first frame ----

    def bake_key(self, scene: Scene | BakedScene) -> str:
        """Return a hash of all in the scene that ``bake`` and ``start`` depend on; "" stands for ``scene.hash``.

        While the hash stays the same, a changed sky or light leaves bake and state as they are.
        """
        return ""

    def state_key(self, scene: Scene | BakedScene) -> str:
        """Return a hash of all in the scene that a state does not follow from frame to frame; "" is ``bake_key``.

        When an edit changes it, the state is made anew before the next frame.
        """
        return ""

    def bake_settings(self, scene: Scene | BakedScene) -> dict[str, Setting]:
        """Return the settings that a bake depends on."""
        return {}

    def bake_identity(self, scene: Scene | BakedScene, camera: Camera | CameraPath | None = None) -> str:
        """Return what decides a bake's bits beside class, settings, seed and device: a folder keeps bakes by it.

        By default the whole scene, where it is in its file, under its sky of now, and all views of ``camera``, for
        which None stands for the scene's own cameras. An override leaves out what the bake never reads.
        """
        views = [*getattr(scene, "cameras", {}).values()] if camera is None else [camera]
        return f"{scene.hash} {scene.offset.tolist()} {' '.join(views_hash(one) for one in views)}"

    def forecast(
        self, scene: Scene, device: wp.Device, seed: int, camera: Camera | CameraPath, samples: int
    ) -> Forecast | None:
        """Return what ``bake`` will cost for frames of ``samples`` samples a pixel, from a small share of it; or None.

        None is for a bake that takes seconds at most, or that says itself what it costs.
        """
        return None

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

    def bake_shard(
        self,
        scene: Scene,
        device: str,
        seed: int,
        shard: tuple[int, int],
        progress: Callable[[float], None] | None = None,
        camera: Camera | CameraPath | None = None,
    ) -> Bake | None:
        """Return a part of what ``bake`` returns, so that ``merge_shards`` of all parts is equal to it, bit for bit.

        ``shard`` is the number of the part, from 1, and the number of parts. Only those that override this and
        ``merge_shards`` can be baked in shards (``warp_gi.shards``).
        """
        raise NotImplementedError

    @classmethod
    def merge_shards(cls, shards: Sequence[Bake]) -> Bake:
        """Return the whole bake of all shards, in the order of their numbers, of one scene, seed and settings."""
        raise NotImplementedError

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


@dataclass(frozen=True)
class Service(Stateful):
    """Base of every service: several estimators share it, and it is built once a frame before they preprocess.

    An estimator names the services that it needs (``Stateful.services``). ``preprocess`` and ``after`` run before
    those of estimators, and hand over what they made by ``Frame.offer``; estimators take it by ``Frame.offered``.
    """

    name: ClassVar[str]
    """Key of the service's state. A field of ``Pipeline`` with this name holds its settings."""
