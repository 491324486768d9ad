"""What a worker needs to render frames as the process does that asked for them. It travels once a worker."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from warp_gi.baking import Bake, load_bake
from warp_gi.cluster.identity import Identity
from warp_gi.errors import OptionError
from warp_gi.kept import BakeFolder
from warp_gi.pipeline import Pipeline
from warp_gi.scene.camera import Camera, CameraPath
from warp_gi.scene.scene import Scene
from warp_gi.scheduler import FrameScheduler
from warp_gi.sequence.resume import Output, SequenceRun, shots_of


class SceneSource(Protocol):
    """Where a worker gets the scene from."""

    def open(self) -> Scene | Bake:
        """Return the scene, with its sky."""
        ...


@dataclass(frozen=True)
class SceneAsItIs:
    """A scene that travels itself, with all its meshes and textures."""

    scene: Scene | Bake
    """The scene, or a bake that is rendered without one."""

    def open(self) -> Scene | Bake:
        """Return the scene."""
        return self.scene


@dataclass(frozen=True)
class Job:
    """A sequence, as workers render it. All paths are absolute, and on a disk that every worker sees."""

    name: str
    """A name that no other job has."""
    identity: Identity
    """Versions and processor of the process that asked."""
    scene: SceneSource
    """The scene, or where it is."""
    camera: Camera | CameraPath
    """Camera of the frames."""
    pipeline: Pipeline
    """The estimators."""
    frames: tuple[int, ...]
    """Numbers of all frames of the sequence, in order."""
    output: Output
    """Where files go."""
    device: str
    """Device on which frames are computed."""
    seed: int
    """The sequence's seed."""
    bakes: tuple[Bake | Path, ...]
    """Bakes made before, or their files."""
    cache: BakeFolder | str | Path | None
    """Folder of the worker's machine in which bakes are kept."""
    about: tuple[tuple[str, str | int | float], ...]
    """What decides the pixels of the first frame, as its metadata tell: a worker that has another is refused."""
    depends: bool
    """Whether frames depend on those before."""
    since: int
    """Time in ns, by the clock of the disk, from which on a file is one of this job; 0 takes older ones, too."""
    memory: float | None = None
    """Bytes that a picture may take on a worker; None is what it has free."""
    permit: Path | None = None
    """File of the claim of whoever asked, which is gone when that run has ended: then workers write nothing more."""

    def begin(self) -> SequenceRun:
        """Return what renders the sequence in this process.

        Raises OptionError unless the scene, the bakes and the settings are those of whoever asked.
        """
        bakes = [load_bake(one) if isinstance(one, Path) else one for one in self.bakes]
        scene = self.scene.open()
        of_scene = scene, self.camera, self.pipeline, self.device, self.seed
        scheduler = FrameScheduler(*of_scene, None, bakes, self.cache, self.memory)
        run = SequenceRun(scheduler, shots_of(scheduler.camera, self.frames, self.output.pattern), self.output)
        run.since, run.permit = self.since, self.permit
        run.bake()
        mine, wanted = scheduler.metadata(run.shots[0].time), dict(self.about)
        for name in sorted({*mine, *wanted}):
            if mine.get(name) != wanted.get(name):
                raise OptionError(f"{_WORDS.get(name, name)} is {mine.get(name)!r} here, expected {wanted.get(name)!r}")
        return run


_WORDS = {"scene_hash": "the scene is not the same: its hash"}
