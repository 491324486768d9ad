"""Renders sequences, and bakes: the functions that a program calls first."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator

from warp_gi.baking import Bake
from warp_gi.errors import OptionError
from warp_gi.estimator import Estimator
from warp_gi.frame import Frame
from warp_gi.pipeline import Pipeline
from warp_gi.scene.camera import Camera, CameraPath
from warp_gi.scene.scene import Scene
from warp_gi.scheduler import FrameScheduler


def render(
    scene: Scene | Bake,
    camera: Camera | CameraPath,
    pipeline: Pipeline | None = None,
    frames: Iterable[int] | None = None,
    device: str = "cpu",
    seed: int = 0,
    skip: Container[int] = (),
    progress: Callable[[str, float], None] | None = None,
    bakes: Iterable[Bake] = (),
) -> Iterator[Frame]:
    """Yield the frames of a sequence.

    Args:
        scene: What is rendered; or a Bake that can be rendered without its scene, by the preset "probe_view".
        camera: A Camera (one frame) or a CameraPath.
        pipeline: The estimators; None is the preset "path".
        frames: Frame numbers in order; None is every frame of the path.
        device: "cpu", "cuda", "cuda:1".
        seed: Every random number follows from it, the frame, the pixel and the sample.
        skip: Frames that need not be rendered, because they exist already. What depends on frames before
            (``FrameScheduler.dependence``) does not see them.
        progress: Called with (stage, share done in [0, 1]).
        bakes: Bakes made before (``gi.bake``, ``gi.load_bake``), each for the estimator that it names.

    Raises OptionError for a device that is not there, a negative frame or seed, BakeError for a bake of another
    scene or other settings, SceneError for a scene that was edited so that pictures would not show it.
    """
    if frames is None:
        frames = range(camera.frame_count if isinstance(camera, CameraPath) else 1)
    frames = list(frames)
    if any(index < 0 for index in frames):
        raise OptionError(f"frame numbers must be 0 or above, got {min(frames)}")
    scheduler = FrameScheduler(scene, camera, pipeline or Pipeline(), device, seed, progress, bakes)
    for position, index in enumerate(frames):
        if index not in skip:
            yield scheduler.frame(index, frames[position - 1] if position else None)


def bake(
    scene: Scene,
    estimator: Estimator,
    device: str = "cpu",
    seed: int = 0,
    camera_path: Camera | CameraPath | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Bake:
    """Return what an estimator can know of a scene before the first frame, to be saved and used again.

    Args:
        scene: What will be rendered.
        estimator: For example ``gi.VisibilityField(cell_size=0.5)``.
        device: "cpu", "cuda", "cuda:1".
        seed: Every random number follows from it.
        camera_path: From where the scene will be seen, for estimators that bake no more than that; None is everywhere.
        progress: Called with (stage, share done in [0, 1]).

    Raises OptionError for a device that is not there, or an estimator that has nothing to bake, SceneError for a
    scene that was edited after it was built.
    """
    told = (lambda share: progress("bake", share)) if progress else None
    with scene.lock:
        scene.check_unchanged()
        scene.update(0.0, None, device)
        result = estimator.bake(scene, device, seed, told, camera_path)
    if result is None:
        raise OptionError(
            f"{type(estimator).__name__} with these settings has nothing to bake; render with it as it is"
        )
    return result
