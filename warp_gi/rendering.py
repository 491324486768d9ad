"""Renders sequences, and bakes: the functions that a program calls first."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast

from warp_gi import launch
from warp_gi.baking import Bake
from warp_gi.cluster.engine import frames_on, job_of
from warp_gi.cluster.job import SceneAsItIs
from warp_gi.errors import OptionError, whole_number
from warp_gi.estimator import Estimator
from warp_gi.foretold import kernels_of
from warp_gi.kept import BakeFolder, cached_bake
from warp_gi.pipeline import DEFAULT, Pipeline
from warp_gi.progress import Progress, shown
from warp_gi.scene.camera import Camera, CameraPath
from warp_gi.scene.sky_motion import sky_start
from warp_gi.scheduler import FrameScheduler
from warp_gi.sequence.chunks import chunk_of, run_of
from warp_gi.sequence.frame_time import check_seconds, samples_within, take_time
from warp_gi.sequence.resume import Output, Plan, SequenceRun, shots_of
from warp_gi.shards import bake_shard, check_shardable
from warp_gi.stateful import Stateful

if TYPE_CHECKING:
    from warp_gi.frame import Frame
    from warp_gi.scene.scene import Scene


def render(
    scene: Scene | Bake,
    camera: Camera | CameraPath,
    pipeline: Pipeline | None = None,
    frames: Iterable[int] | None = None,
    device: str = "cpu",
    seed: int = 0,
    skip: Container[int] = (),
    progress: Progress | bool | None = None,
    bakes: Iterable[Bake] = (),
    *,
    output: str | Path | None = None,
    resume: bool = False,
    precision: Literal["half", "float"] = "half",
    preview: bool = False,
    exposure: float = 0.0,
    frame_time: float | None = None,
    cache: BakeFolder | str | Path | None = None,
    chunk: str | tuple[int, int] | None = None,
    warm_up: int | None = None,
    cluster: object = None,
    memory: float | None = None,
) -> Iterator[Frame]:
    """Yield the frames of a sequence, and write them to files if there is an ``output``.

    Each frame is rendered when it is asked for, so iterate over all of them even if only the files matter. A file is
    there, whole, before its frame is yielded. Without ``resume`` all frames are rendered, whatever files
    there are. With it, frames whose files are whole and were made with just these settings are neither rendered nor
    yielded: ``gi.read_frame`` reads them, and ``gi.plan_sequence`` tells beforehand which they are. Where frames depend
    on those before, what is learnt is saved beside them after each frame (NAME.state.safetensors), and a resumed
    sequence goes on from there to the same bits; if it cannot, all its frames are rendered again.

    Args:
        scene: What is rendered; or a Bake that can be rendered without its scene, by the preset "probe_view".
        camera: A Camera (one frame) or a CameraPath.
        pipeline: The estimators; None is the preset "clean", and "probe_view" for a Bake. ``Pipeline()`` is the
            reference, "path".
        frames: Frame numbers in order; None is every frame of the path.
        device: "cpu", "cuda", "cuda:1".
        seed: Every random number follows from it, the frame, the pixel and the sample.
        skip: Frames that need not be rendered, because they exist already. What depends on frames before
            (``FrameScheduler.dependence``) does not see them.
        progress: Called with (stage, share done in [0, 1]); True shows a line on stderr, in a notebook too.
        bakes: Bakes made before (``gi.bake``, ``gi.load_bake``), each for the estimator that it names.
        output: Where frames go, as "out/shot.####.exr": #### becomes the frame's number. EXR files have every buffer
            as a named layer, and metadata; PNG files are tone-mapped pictures, and cannot be resumed. None writes none.
        resume: Keep the files that are there, and render what is missing, torn, or of other settings.
        precision: Storage of colours and normals in EXR files: "half" or "float".
        preview: Write a tone-mapped PNG beside each EXR file.
        exposure: Exposure of PNG files in stops.
        frame_time: Wall seconds that a frame may take here; the number of samples a pixel then follows from frames
            that are timed first. It is one for all frames, and in their metadata: a resumed sequence repeats it. The
            first frame may take more (``SpatioTemporal.first_samples``). None takes those of the pipeline.
        cache: Folder in which bakes that take long are kept, and found the next time, or a ``gi.BakeFolder``, which the
            command uses. The frames are the same to the last bit. None keeps none.
        chunk: A part of the frames, as "3/16" or (3, 16), for several processes with one ``output``: every sixteenth
            frame where frames are independent, else a run of frames. Each has the bits that one process would give it.
            What a run needs of the frames before it is read from another part's state file, or rendered anew.
        warm_up: Number of frames before a part that are rendered and thrown away in place of all of them, where frames
            depend on those before. That is not exact: files say so (``warm_up``, ``measured/warm_up_error``).
        cluster: A ``distributed.Client``, or the address of a Dask scheduler, whose workers render and write the files;
            all see the folder of ``output``. What is yielded then are ``FrameFile``s, in order, as read from the files.
            Frames are equal, bit for bit, to those of this process.

        memory: Bytes that a picture may take; None is what is free. A larger one is rendered in bands of its rows, to
            the same bits, if it goes to an ``output`` and the pipeline can ("path", "direct" and "cache", without a
            denoiser). What is yielded then reads the file when it is asked for a buffer.

    Raises OptionError for a device that is not there, a negative frame or seed, files that frames cannot be, several
    frames for one file, or files that another process is writing; BakeError for a bake of another scene or other
    settings; SceneError for a scene that was edited so that pictures would not show it; OSError for files that cannot
    be written.
    """
    if output is None and (resume or preview or exposure or precision != "half" or chunk or cluster):
        raise OptionError(
            'resume, precision, preview, exposure, chunk and cluster are of files; give output="out/shot.####.exr" too'
        )
    if cluster is not None and (chunk or frame_time is not None or skip):
        raise OptionError("a cluster hands out whole sequences; leave chunk, frame_time and skip out")
    if cluster is not None and not Output(Path(str(output))).is_exr:
        raise OptionError(f"a cluster writes .exr files, which say how they were made, got {str(output)!r}")
    bakes = tuple(bakes)
    part = chunk_of(chunk, warm_up, frame_time)
    if frame_time is not None:
        check_seconds(frame_time)
    wanted = _frame_numbers(camera, frames)
    with shown(progress, len(wanted)) as told:
        of_scene = scene, camera, _chosen(pipeline, scene), device, seed
        scheduler = FrameScheduler(*of_scene, told, bakes, cache, memory)
        camera = scheduler.camera
        launch.load_ahead(kernels_of(scheduler.pipeline, scheduler.scene), scheduler.device)
        if output is None:
            if frame_time is not None and wanted:
                scheduler.take_samples(
                    samples_within(scheduler, shots_of(camera, list(dict.fromkeys(wanted)), "#.exr"), frame_time),
                    frame_time,
                )
            for position, index in enumerate(wanted):
                if index not in skip:
                    yield scheduler.frame(index, wanted[position - 1] if position else None)
            return
        files = Output(Path(output), precision, preview, exposure)
        shots = [shot for shot in shots_of(camera, wanted, files.pattern) if shot.index not in skip]
        if not shots:
            return
        run = run_of(scheduler, shots, files, part)
        if frame_time is not None:
            take_time(run, frame_time, resume)
        plan = run.plan(resume)
        try:
            run.prepare(plan)
            if cluster is not None:
                yield from _on_cluster(cluster, run, plan, SceneAsItIs(scene), bakes, cache, resume)
                return
            run.lead()
            for shot in plan.todo:
                frame = run.render(shot)
                run.save_state(shot, frame)
                yield cast("Frame", frame)
                del frame  # before there is a next one
        finally:
            run.finish()


def _on_cluster(
    cluster: object,
    run: SequenceRun,
    plan: Plan,
    scene: SceneAsItIs,
    bakes: Sequence[Bake],
    cache: BakeFolder | str | Path | None,
    resume: bool,
) -> Iterator[Frame]:
    frames = frames_on(cluster, run, plan, job_of(run, plan, scene, bakes, cache, resume)) if plan.todo else ()
    yield from cast("Iterator[Frame]", frames)


def plan_sequence(
    scene: Scene | Bake,
    camera: Camera | CameraPath,
    pipeline: Pipeline | None = None,
    frames: Iterable[int] | None = None,
    device: str = "cpu",
    seed: int = 0,
    progress: Progress | bool | None = None,
    bakes: Iterable[Bake] = (),
    *,
    output: str | Path,
    precision: Literal["half", "float"] = "half",
    frame_time: float | None = None,
    cache: BakeFolder | str | Path | None = None,
    chunk: str | tuple[int, int] | None = None,
    warm_up: int | None = None,
) -> Plan:
    """Return what ``render`` with these arguments and ``resume=True`` would render, and why; nothing is written.

    ``plan.frames`` are the numbers of the frames to render, ``plan.missing`` of those without a file, and
    ``plan.reason(index)`` says in words why a frame is rendered. What estimators need is baked for that, as a file
    tells with which bake it was made: give ``bakes`` to do so once. Arguments and errors are those of ``render``;
    the scene is left under the sky of the last frame.
    """
    part = chunk_of(chunk, warm_up, frame_time)
    wanted = _frame_numbers(camera, frames)
    with shown(progress) as told:
        scheduler = FrameScheduler(scene, camera, _chosen(pipeline, scene), device, seed, told, bakes, cache)
        files = Output(Path(output), precision)
        shots = shots_of(scheduler.camera, wanted, files.pattern)
        if not shots:
            return Plan((), ())
        run = run_of(scheduler, shots, files, part)
        if frame_time is not None:
            take_time(run, frame_time, resume=True)
        return run.plan()


def bake(
    scene: Scene,
    estimator: Stateful,
    device: str = "cpu",
    seed: int = 0,
    camera: Camera | CameraPath | None = None,
    progress: Progress | bool | None = None,
    *,
    camera_path: Camera | CameraPath | None = None,
    cache: BakeFolder | str | Path | None = None,
    chunk: str | tuple[int, int] | None = None,
) -> Bake:
    """Return what an estimator can know of a scene before the first frame, to be saved and used again.

    Args:
        scene: What will be rendered. It is baked as it is at time 0, its sky too; or the first one that a
            sky of numbered files has.
        estimator: An estimator or a radiance cache, for example ``gi.VisibilityField(cell_size=0.5)``.
        device: "cpu", "cuda", "cuda:1".
        seed: Every random number follows from it.
        camera: Where the scene will be seen from, for estimators that bake no more than that; None is everywhere.
        progress: Called with (stage, share done in [0, 1]); True shows a line on stderr, in a notebook too.
        camera_path: Another name of ``camera``.
        cache: Folder in which bakes that take long are kept, and found the next time; None keeps none.
        chunk: A shard of the bake, as "3/16" or (3, 16), for several processes; ``gi.merge_bakes`` makes the whole of
            all. Shards are not kept in ``cache``. VisibilityField has shards, others have none yet.

    Raises OptionError for a device that is not there, an estimator that has nothing to bake, or no shards though one is
    asked for, or both ``camera`` and ``camera_path``; SceneError for a scene that was edited after it was built.
    """
    if camera is not None and camera_path is not None:
        raise OptionError("camera and camera_path are two names of one argument; give camera")
    camera = camera_path if camera is None else camera
    if camera is not None:
        camera = camera.relative_to(scene.offset)
    part = chunk_of(chunk)
    if part is not None:
        check_shardable(estimator)

    def make() -> Bake | None:
        tell = None if told is None else partial(told, "bake")
        if part is not None:
            return bake_shard(scene, estimator, part, device, seed, camera, tell)
        return estimator.bake(scene, device, seed, tell, camera)

    with shown(progress) as told, scene.lock:
        scene.check_unchanged()
        scene.update_sky(sky_start(scene.sky_at))
        scene.update(0.0, None, device)
        result = cached_bake(None if part else cache, estimator, scene, camera, launch.get_device(device), seed, make)
    if result is None and isinstance(estimator, Estimator) and estimator.radiance_cache is not None:
        raise OptionError(
            f"{type(estimator).__name__} has nothing to bake, but the cache has that its paths end in: bake its ends_in"
        )
    if result is None:
        raise OptionError(
            f"{type(estimator).__name__} with these settings has nothing to bake; render with it as it is"
        )
    return result


def _chosen(pipeline: Pipeline | None, scene: Scene | Bake) -> Pipeline:
    return Pipeline.preset("probe_view" if isinstance(scene, Bake) else DEFAULT) if pipeline is None else pipeline


def _frame_numbers(camera: Camera | CameraPath, frames: Iterable[int] | None) -> list[int]:
    """Return the frames to render, None being every one of the camera's; raises OptionError for negative ones."""
    if frames is None:
        frames = range(camera.frame_count if isinstance(camera, CameraPath) else 1)
    frames = [whole_number("frame numbers", index) for index in frames]
    if any(index < 0 for index in frames):
        raise OptionError(f"frame numbers must be 0 or above, got {min(frames)}")
    return frames
