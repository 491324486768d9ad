"""What renders the sequences: the preset ``clean``, and the path tracer with and without denoisers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

import warp_gi as gi
from warp_gi import launch
from warp_gi.bench.harness.measure import Row, Times, clocked
from warp_gi.bench.suites.clean.cases import Judged
from warp_gi.denoise import Denoiser
from warp_gi.errors import OptionError

CLEAN, UNBLENDED = "clean", "clean, blend 1"
PATH, FILTERED, OIDN = "path", "path, spatiotemporal", "path, OIDN"
BLEND = 1.0
HISTORY = {4: 16, 16: 2, 64: 2}
"""Frames before the middle one that paths of so many samples render, for the filter over frames; of one sample all."""
FEW = 4
"""Most samples a pixel of paths that render the first frame, too."""


@dataclass
class Side:
    """What one of the denoisers of ``Several`` made of the last frame, and its seconds."""

    state: Any
    picture: np.ndarray | None = None
    times: Times = (0.0, 0.0)


@dataclass(frozen=True)
class Several(Denoiser):
    """Gives each noisy frame to several denoisers, so that paths are traced once for all of them.

    The state is a ``Side`` of each that is installed. The beauty is the last one's. ``first_samples`` of a filter
    over frames are not taken: all get what the pipeline says. Parting light by lobes, which the filter needs, is in the
    time of all of them: 2 % of that of paths.
    """

    wants_lobes = True
    sides: Mapping[str, Denoiser] = field(default_factory=dict)
    judged: tuple[int, ...] = ()
    """Numbers of the frames that denoisers without a history are given."""

    def start(self, scene: Any, device: str, bake: Any = None, seed: int = 0) -> dict[str, Side]:
        """Return the state of each denoiser; those that are not installed are left out."""
        found = {}
        for name, side in self.sides.items():
            try:
                found[name] = Side(side.start(scene, device, bake, seed))
            except OptionError:
                continue
        return found

    def apply(self, frame: gi.Frame, state: dict[str, Side]) -> dict[str, Side]:
        """Give the frame to each, and return their new states with what they made."""
        after = {}
        for name, side in state.items():
            denoiser = self.sides[name]
            if frame.index not in self.judged and not denoiser.depends_on_past(frame.scene):
                after[name] = replace(side, picture=None)
                continue
            made, times, _ = clocked(partial(denoiser.apply, frame, side.state), str(frame.device))
            after[name] = Side(made, frame.numpy("beauty").copy(), times)
        return after


@dataclass
class Shots:
    """What a renderer made of a sequence."""

    renderer: str
    spp: int
    family: str = ""
    """Renderer whose settings are other points of the same line in plots; ``renderer`` if not given."""
    pictures: dict[int, np.ndarray] = field(default_factory=dict)
    """Frames that are judged, by number."""
    times: dict[int, Times] = field(default_factory=dict)
    """Wall and CPU seconds of all frames, by number, without compilation."""

    @property
    def row(self) -> Row:
        """Return what tells its rows apart."""
        return {"renderer": self.renderer, "spp": self.spp, "family": self.family or self.renderer}

    def add(self, index: int, picture: np.ndarray, times: Times, judged: Iterable[int]) -> None:
        """Take over a frame."""
        self.times[index] = times
        if index in judged:
            self.pictures[index] = picture


@dataclass
class Contender:
    """A pipeline that renders frames of a sequence, in the order of their numbers, in turns with others."""

    name: str
    pipeline: gi.Pipeline
    frames: tuple[int, ...]
    shots: dict[str, Shots] = field(default_factory=dict)
    bake: Times = (0.0, 0.0)
    """Seconds before the first frame, compilation apart: fills of caches."""
    compile_seconds: float = 0.0
    """Seconds of compilation so far; 0 if the kernels were there."""
    scheduler: gi.FrameScheduler | None = None

    def has(self, index: int) -> bool:
        """Return whether a frame is rendered."""
        return any(index in shots.times for shots in self.shots.values())

    def step(self, scene: gi.Scene, path: gi.CameraPath, index: int, judged: Iterable[int], device: str) -> None:
        """Render a frame, the first time with all that comes before."""
        compiled = launch.compile_seconds
        if self.scheduler is None:
            self.scheduler = gi.FrameScheduler(scene, path, self.pipeline, device)
            scheduler = self.scheduler
            _, self.bake, _ = clocked(lambda: scheduler.bake(index / path.fps), device)
        scheduler = self.scheduler
        frame, times, _ = clocked(lambda: scheduler.frame(index), device)
        self.compile_seconds += launch.compile_seconds - compiled
        sides = scheduler.state("denoise") if isinstance(self.pipeline.denoise, Several) else None
        if sides is None:
            self._shots(self.name).add(index, frame.numpy("beauty").copy(), times, judged)
            return
        own = times[0] - sum(side.times[0] for side in sides.values() if side.picture is not None)
        cpu = times[1] - sum(side.times[1] for side in sides.values() if side.picture is not None)
        self._shots(PATH).add(index, frame.numpy("noisy").copy(), (own, cpu), judged)
        for name, side in sides.items():
            if side.picture is not None:
                more = (own + side.times[0], cpu + side.times[1])
                self._shots(name).add(index, side.picture, more, judged)

    def _shots(self, name: str) -> Shots:
        family = CLEAN if name == UNBLENDED else name
        return self.shots.setdefault(name, Shots(name, self.pipeline.spp, family))

    @property
    def row(self) -> Row:
        """Return the seconds before the first frame."""
        return {"fill s": self.bake[0], "fill cpu s": self.bake[1], "compile s": self.compile_seconds}


def cleans(count: int) -> list[Contender]:
    """Return the preset ``clean``, and without its average of pictures, for so many frames."""
    clean = gi.Pipeline.preset("clean")
    assert isinstance(clean.denoise, gi.SpatioTemporal)
    unblended = replace(clean, denoise=replace(clean.denoise, blend=BLEND))
    frames = tuple(range(count))
    return [Contender(CLEAN, clean, frames), Contender(UNBLENDED, unblended, frames)]


def paths(judged: Judged, samples: Iterable[int] = (1, *HISTORY)) -> list[Contender]:
    """Return the path tracer at each number of samples a pixel, for all denoisers.

    One sample renders every frame; more of them the middle one with some before it, and few of them the first.
    """
    sides = {FILTERED: gi.SpatioTemporal(first_samples=1), OIDN: gi.Oidn(quality="high", accumulate=False)}
    found = []
    for spp in samples:
        begin = max(judged.middle - HISTORY.get(spp, judged.middle), 0)
        frames = range(judged.count if spp == 1 else judged.middle + 1)
        chosen = tuple(index for index in frames if index >= begin or (index == judged.first and spp <= FEW))
        pipeline = gi.Pipeline.preset("path", spp=spp, denoise=Several(sides, judged.all))
        found.append(Contender(PATH, pipeline, chosen))
    return found


def filtered(count: int) -> Contender:
    """Return paths of one sample with the filter over frames, and without, for so many frames."""
    pipeline = gi.Pipeline.preset("path", spp=1, denoise=Several({FILTERED: gi.SpatioTemporal(first_samples=1)}))
    return Contender(PATH, pipeline, tuple(range(count)))


def take_turns(
    contenders: Sequence[Contender], scene: gi.Scene, path: gi.CameraPath, judged: Iterable[int], device: str
) -> list[Shots]:
    """Let contenders render their frames, those of one number one after the other; return what all have made.

    Pictures of the frames ``judged`` are kept. A frame that was rendered before is not rendered again.
    """
    judged = tuple(judged)
    for index in sorted({frame for contender in contenders for frame in contender.frames}):
        for contender in contenders:
            if index in contender.frames and not contender.has(index):
                contender.step(scene, path, index, judged, device)
    return [shots for contender in contenders for shots in contender.shots.values()]
