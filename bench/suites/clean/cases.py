"""Sequences that the suite renders: scene, camera path, size, frames that are judged, and what is wanted of each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import warp_gi as gi
from warp_gi.bench.harness import scenes
from warp_gi.bench.harness.places import PLACES, Point
from warp_gi.bench.suites.cache.moving import sliding_crate, turning_atrium

FRAMES = 48
"""Frames of a sequence; a second of film is 24."""
SIZE, LARGE = (320, 180), (640, 360)


@dataclass(frozen=True)
class Judged:
    """Numbers of the frames that are compared with references."""

    first: int = 0
    """A frame without a frame before."""
    middle: int = 23
    """A frame with a long history; flicker is from the frame before to this one."""
    last: int = 47

    @property
    def before(self) -> int:
        """The frame before the middle one."""
        return self.middle - 1

    @property
    def all(self) -> tuple[int, ...]:
        """All of them, and the one before the middle one."""
        return (self.first, self.before, self.middle, self.last)

    @property
    def count(self) -> int:
        """Number of frames of the sequence."""
        return self.last + 1


@dataclass(frozen=True)
class SequenceCase:
    """A sequence, and what is wanted of the preset ``clean`` in it."""

    place: str
    """Key in `PLACES` of the scene and the camera's first position."""
    name: str = ""
    """Name in rows; the place's title if not given."""
    move: Point | None = None
    """Way of the camera in metres over the whole sequence, target and all; None is the place's own path."""
    build: Callable[[], gi.Scene] | None = None
    """Builds the scene, if it is not as the place has it."""
    size: tuple[int, int] = SIZE
    judged: Judged = Judged()
    reference_spp: int = 256
    """Samples a pixel of the reference, half of them in each half."""
    most_flip: float | None = None
    """Largest FLIP of the middle frame; None where it is compared with that of other pipelines alone."""
    within: float = 0.03
    """Largest relative error of the mean, of the whole sequence and of the first frame."""
    most_seconds: float | None = None
    """Largest number of wall seconds of a frame on two idle cores."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", self.name or PLACES[self.place].title)

    @property
    def missing(self) -> str:
        """Message about the place's files that are missing; empty if none are."""
        return PLACES[self.place].missing

    def scene(self) -> gi.Scene:
        """Return a scene of its own."""
        return PLACES[self.place].scene() if self.build is None else self.build()

    def path(self) -> gi.CameraPath:
        """Return the camera path at the case's size."""
        path = PLACES[self.place].path()
        if self.move is not None:
            begin = path.keys[0]
            eye, target = (_sum(point, self.move) for point in (begin.eye, begin.target))
            end = replace(begin, time=self.judged.last / path.fps, eye=eye, target=target)
            path = replace(path, keys=(begin, end))
        return path.at_resolution(*self.size)

    def small(self, size: tuple[int, int], last: int, reference_spp: int) -> SequenceCase:
        """Return the case with fewer pixels, frames and samples of the reference, and nothing wanted."""
        judged = Judged(0, min(last - 1, Judged().middle), last)
        small = replace(self, size=size, judged=judged, reference_spp=reference_spp)
        return replace(small, most_flip=None, most_seconds=None, within=1.0)


def _sum(one: Point, other: Point) -> Point:
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


def sunny_sponza() -> gi.Scene:
    """Sponza under a clear sky, whose sun shines into the nave from the side."""
    scene = PLACES["sponza"].scene()
    scene.environment = gi.SunSky(elevation=68.0, azimuth=200.0)
    return scene


INTO_ROOM = (0.45, 0.1, -0.45)
BUILT_IN = (
    SequenceCase("atrium", most_flip=0.18, within=0.02),
    SequenceCase("street"),
    SequenceCase("warehouse"),
    SequenceCase("two_rooms", within=0.02),
    SequenceCase("cornell_box", within=0.02),
)
FROM_FILES = (
    SequenceCase("living_room", move=INTO_ROOM, most_flip=0.06, within=0.02),
    SequenceCase("modern_hall", move=(-0.6, 0.0, -0.35), most_flip=0.07, within=0.02),
    SequenceCase("sponza_courtyard", move=(2.0, 0.0, 0.0), reference_spp=512),
    SequenceCase("sponza", "Sponza, sun", (2.0, 0.0, 0.0), sunny_sponza, reference_spp=512),
    SequenceCase("bistro", move=(2.0, 0.0, 1.6), within=0.05, reference_spp=512),
)
MOVING = (
    SequenceCase("atrium", "atrium, sky turns", build=turning_atrium),
    SequenceCase("strobe", "crate slides", (-0.4, 0.0, -0.3), sliding_crate),
)
IN_LARGE = (
    SequenceCase("atrium", "atrium, 640x360", size=LARGE, most_flip=0.165, within=0.02, most_seconds=0.85),
    SequenceCase("living_room", "living room, 640x360", INTO_ROOM, None, LARGE, within=0.02, most_seconds=0.45),
)
QUICK = (SequenceCase("cornell_box"),)

ON, OFF = scenes.STROBE_PERIODS["jump"], scenes.STROBE_PERIODS["jump"] // 2
"""Frames in which the lamp of the room `scenes.strobe` comes out of its box, and goes into it."""
SWITCHED = SequenceCase("strobe", "light switched", (-0.4, 0.0, -0.3), reference_spp=64)
