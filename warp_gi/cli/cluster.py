"""``--cluster`` of ``warp-gi render``: the workers of a Dask scheduler render, this process plans and reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from warp_gi.baking import Bake, load_bake
from warp_gi.cli.inputs import BAKE_SUFFIX, SceneOptions, find_scene, move_sky
from warp_gi.cluster.engine import Cluster, connected, job_of
from warp_gi.kept import BakeFolder
from warp_gi.scene.camera import Camera, CameraPath
from warp_gi.scene.files.sky_images import split_layer
from warp_gi.scene.scene import Scene

if TYPE_CHECKING:
    from warp_gi.cli.report import Reporter
    from warp_gi.sequence.resume import Plan, SequenceRun


@dataclass(frozen=True)
class SceneByPath:
    """The scene of a command, which every worker reads from the same path; its hash is compared afterwards."""

    options: SceneOptions
    """Scene, sky and camera, with absolute paths."""
    turn: float
    """Angle in degrees by which the sky turns from frame to frame."""
    camera: Camera | CameraPath
    """Camera of the frames."""
    frames: tuple[int, ...]
    """Numbers of the frames."""

    def open(self) -> Scene | Bake:
        """Return the scene, with its sky."""
        if self.options.scene.endswith(BAKE_SUFFIX):
            return load_bake(self.options.scene)
        scene = find_scene(self.options)
        move_sky(scene, self.turn, self.camera, self.frames)
        return scene


def scene_by_path(options: SceneOptions, turn: float, sequence: SequenceRun) -> SceneByPath:
    """Return where workers find the scene of a command's options."""
    of_scene = {one.name: getattr(options, one.name) for one in fields(SceneOptions)}
    of_scene["scene"] = _absolute(options.scene)
    if options.environment:
        file, layer = split_layer(options.environment)
        path = _absolute(str(file), is_pattern=True)
        of_scene["environment"] = f"{path}:{layer}" if layer else path
    frames = tuple(shot.index for shot in sequence.shots)
    return SceneByPath(SceneOptions(**of_scene), turn, sequence.scheduler.camera, frames)


def render_on_cluster(
    address: str,
    scene: SceneByPath,
    bakes: Sequence[Path],
    cache: BakeFolder | None,
    resume: bool,
    plan: Plan,
    sequence: SequenceRun,
    report: Reporter,
) -> None:
    """Let the workers at ``address`` render what is to be rendered, and report their frames."""
    shots = sequence.shots
    todo = {shot.index for shot in plan.todo}
    places = [place for place, shot in enumerate(shots) if shot.index in todo]
    with connected(address) as client, report.bar(len(places)):
        cluster = Cluster(client, job_of(sequence, plan, scene, [path.absolute() for path in bakes], cache, resume))
        for done in cluster.render(places):
            shot = shots[done.place]
            report.at_once = 1 if cluster.job.depends else max(len(cluster.workers), 1)
            text = f"{shot.path} {done.seconds:.2f} s on {done.host}"
            report.frame(text, done.seconds, shot.index, shot.path, worker=done.worker)


def _absolute(name: str, is_pattern: bool = False) -> str:
    """Return the absolute path of a file, or of files with a number in their name; any other name as it is."""
    path = Path(name)
    return str(path.absolute()) if name and (path.is_file() or (is_pattern and "#" in path.name)) else name
