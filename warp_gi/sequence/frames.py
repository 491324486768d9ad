"""Frames on disk: file names, EXR with metadata, reading back, and what a resumed run may skip.

A frame's file appears by rename once it is complete, so a killed process leaves whole
files and at most one temporary file beside them. Everything that decides the pixels is
in the metadata: a file counts as done only if it says what the run would write. Equal runs
write equal files, except for the stage times.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from warp_gi.errors import GiError, OptionError, SceneError, one_line
from warp_gi.files import frame_path, replacing, user_path
from warp_gi.scene.camera import LAST_FRAME, Camera
from warp_gi.scene.pinhole import offset_text
from warp_gi.sequence.exr import Attribute, plain, read_exr, stored_values, write_exr
from warp_gi.sequence.preview import picture_bytes, tone_map, write_png

MOST_FRAMES = 1_000_000
PREFIX = "warp_gi/"
TIMES = "warp_gi/seconds/"
MEASURED = "warp_gi/measured/"


class FrameLike(Protocol):
    """The part of a ``Frame`` that is written to files."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the buffers to write."""
        ...

    @property
    def index(self) -> int:
        """Number of the frame."""
        ...

    @property
    def time(self) -> float:
        """Time of the frame in seconds from the first one."""
        ...

    @property
    def camera(self) -> Camera:
        """Camera of the frame."""
        ...

    @property
    def timings(self) -> Mapping[str, float]:
        """Wall seconds by stage."""
        ...

    @property
    def metadata(self) -> Mapping[str, str | int | float]:
        """Values by name that decide the pixels, beside camera and time."""
        ...

    def numpy(self, name: str) -> np.ndarray:
        """Return a buffer, [height, width] or [height, width, channels]."""
        ...


@dataclass(frozen=True, eq=False)
class FrameFile:
    """A frame read back from its file."""

    buffers: dict[str, np.ndarray]
    """Buffers by name, float32 [height, width] or [height, width, channels]; identifiers are int32."""
    formats: dict[str, str]
    """Storage format by buffer, "half" or "float"."""
    index: int
    """Number of the frame."""
    time: float
    """Time of the frame in seconds from the first one."""
    camera: Camera | None
    """Camera of the frame; None in files by other programs."""
    metadata: dict[str, str | int | float]
    """Values by name that decide the pixels, beside camera and time."""
    timings: dict[str, float] = field(default_factory=dict)
    """Wall seconds by stage."""
    attributes: dict[str, Attribute] = field(default_factory=dict)
    """Every attribute of the file, under its own name."""

    @property
    def offset(self) -> np.ndarray:
        """What to add to the buffer "position" for the coordinates of the scene's file, float64 [3] in metres."""
        return np.array(self.camera.offset if self.camera else (0.0, 0.0, 0.0))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the buffers."""
        return tuple(self.buffers)

    def __repr__(self) -> str:
        height, width = next(iter(self.buffers.values())).shape[:2]
        return f"<FrameFile {self.index}: {width}x{height}, {', '.join(self.names)}>"

    def _repr_png_(self) -> bytes | None:
        """Return the picture as a notebook shows it; None in files without a beauty."""
        return picture_bytes(self.buffers["beauty"]) if "beauty" in self.buffers else None

    def numpy(self, name: str) -> np.ndarray:
        """Return a buffer by name; raises OptionError if the file has none of that name."""
        if name not in self.buffers:
            raise OptionError(f"the file has no layer {name!r} (it has: {', '.join(self.buffers)})")
        return self.buffers[name]


def parse_frames(text: str) -> list[int]:
    """Return the frame numbers of "5", "0-47", "0-47:2" or a comma-separated list of these, in order, each once."""
    frames: dict[int, None] = {}
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,18})(?:-(\d{1,18})(?::(\d{1,18}))?)?\s*", part)
        first, last, step = match.groups() if match else ("1", "0", None)
        span = range(int(first), int(last or first) + 1, max(int(step or 1), 1))
        if not span or (step is not None and int(step) == 0):
            raise OptionError(f"frames {text[:80]!r} not understood; write for example 5, 0-47, 0-47:2 or 1,4,9-12")
        if span[-1] > LAST_FRAME:
            raise OptionError(f"frames {text[:80]!r}: numbers must be at most {LAST_FRAME:,}")
        if len(span) + len(frames) > MOST_FRAMES:
            raise OptionError(f"frames {text!r} are more than {MOST_FRAMES:,}; render them in parts")
        frames.update(dict.fromkeys(span))
    return list(frames)


def frame_attributes(
    index: int,
    time: float,
    camera: Camera,
    metadata: Mapping[str, str | int | float],
    previous_camera: Camera | None = None,
    precision: str = "half",
) -> dict[str, Attribute]:
    """Return the EXR attributes of a frame, all but its stage times.

    ``screenWindowCenter``, ``screenWindowWidth`` and ``pixelAspectRatio`` are OpenEXR's, at 1 m before the camera, and
    the picture's size in metres where ``warp_gi/projection`` says "orthographic", whose ``hfov`` has no meaning;
    ``K`` is that of ``Camera.from_intrinsics``, row after row. ``worldToCamera`` and ``worldToNDC`` follow the OpenEXR
    standard: row vectors, a left-handed camera space with x right, y up and z forward; NDC from (0, 0) at the upper
    left to (1, 1) at the lower right corner of the picture. ``warp_gi/offset`` is what a recentred scene's positions,
    and these matrices, are without: "x y z" in metres of the file's coordinates.
    """
    world_to_camera, world_to_ndc = camera_matrices(camera)
    half_width, half_height = camera.half_size
    attributes: dict[str, Attribute] = {
        "frame": int(index),
        "time": float(time),
        "hfov": float(camera.hfov),
        "worldToCamera": world_to_camera,
        "worldToNDC": world_to_ndc,
        "K": camera.intrinsics,
        "pixelAspectRatio": float(camera.pixel_aspect),
        "screenWindowWidth": float(2 * half_width),
        "screenWindowCenter": 2 * np.multiply(camera.lens_shift, (half_width, half_height)),
        PREFIX + "precision": precision,
    }
    if camera.is_orthographic:
        attributes |= {PREFIX + "projection": "orthographic"}
    if any(camera.offset):
        attributes[PREFIX + "offset"] = offset_text(camera.offset)
    if previous_camera is not None:  # motion is towards it
        attributes["previousWorldToCamera"] = camera_matrices(previous_camera)[0]
    for key, value in metadata.items():
        if plain(value) != "":  # OpenEXR drops empty text
            attributes[PREFIX + key] = plain(value)
    return attributes


def camera_matrices(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return ``worldToCamera`` and ``worldToNDC`` as OpenEXR defines them, float32 [4, 4], for row vectors."""
    forward_z = np.diag([1.0, 1.0, -1.0, 1.0])
    camera_from_world = forward_z @ np.linalg.inv(camera.world_from_camera)
    # x / z and y / z on the picture (x and y of an orthographic camera); the third row keeps the matrix invertible
    (x, _, right), (_, y, down), _ = camera.intrinsics / np.array([*camera.resolution, 1])[:, None]
    if camera.is_orthographic:
        rows = [[x, 0, 0, right], [0, -y, 0, down], [0, 0, 1, 0], [0, 0, 0, 1]]
    else:
        rows = [[x, 0, right, 0], [0, -y, down, 0], [0, 0, 1, -1], [0, 0, 1, 0]]
    ndc_from_camera = np.array(rows, np.float64)
    return camera_from_world.T.astype(np.float32), (ndc_from_camera @ camera_from_world).T.astype(np.float32)


def write_frame(frame: FrameLike, pattern: str | Path, precision: str = "half") -> Path:
    """Write a frame to ``pattern`` with ``####`` replaced by its number, and return the path.

    EXR: every buffer as a named layer, metadata and stage times; ``precision`` "float" stores
    all of it in full. PNG: the tone-mapped picture. The file appears whole or not at all.
    Raises OSError when it cannot be written, OptionError for another kind of file.
    """
    path = frame_path(pattern, frame.index)
    if path.suffix.lower() == ".png":
        return write_preview(frame, path)
    if path.suffix.lower() != ".exr":
        raise OptionError(f"cannot write {path.name}: frames are .exr or .png files")
    attributes = written_attributes(frame, precision)
    buffers = {name: frame.numpy(name) for name in frame.names}
    with replacing(path) as part:
        try:
            write_exr(part, buffers, attributes, precision)
        except OSError as error:
            raise OSError(str(error).replace(str(part), str(path))) from error
    return path


def written_attributes(frame: FrameLike, precision: str) -> dict[str, Attribute]:
    """Return all EXR attributes of a frame, its stage times and what it measured among them."""
    previous = getattr(frame, "previous_camera", None)
    attributes = frame_attributes(frame.index, frame.time, frame.camera, frame.metadata, previous, precision)
    attributes |= {TIMES + stage: float(seconds) for stage, seconds in frame.timings.items()}
    return attributes | {MEASURED + name: float(value) for name, value in getattr(frame, "measured", {}).items()}


class HasBuffers(Protocol):
    """The part of a frame that a preview is made of: of a ``Frame``, or of a ``FrameFile`` read back."""

    def numpy(self, name: str) -> np.ndarray:
        """Return a buffer, [height, width] or [height, width, channels]."""
        ...


def write_preview(frame: HasBuffers, path: str | Path, exposure: float = 0.0) -> Path:
    """Write the tone-mapped beauty as PNG, from the values that the EXR stores; ``exposure`` is in stops."""
    write_png(path, tone_map(stored_values("beauty", frame.numpy("beauty")), exposure), exposure)
    return Path(path)


def read_frame(path: str | Path) -> FrameFile:
    """Read a frame's buffers and metadata back; raises SceneError when the file is missing or not whole."""
    return _frame_in(path, True)


def _frame_in(path: str | Path, keep: bool) -> FrameFile:
    """Return a frame's file; without ``keep`` it is read to its end, and buffers are zeros."""
    try:
        return _frame_file(*read_exr(user_path(path), keep))
    except GiError:
        raise
    except (ValueError, TypeError, KeyError, IndexError, OverflowError, np.linalg.LinAlgError) as error:
        raise SceneError(f"{path}: what it says of its frame cannot be ({one_line(error)}); render it again") from error


def _frame_file(buffers: dict[str, np.ndarray], attributes: dict[str, Attribute], formats: dict[str, str]) -> FrameFile:
    """Return a frame of what its file holds."""
    numbers = {name: value for name, value in attributes.items() if not isinstance(value, np.ndarray)}
    apart = TIMES, MEASURED
    metadata = {k[len(PREFIX) :]: v for k, v in numbers.items() if k.startswith(PREFIX) and not k.startswith(apart)}
    timings = {k[len(TIMES) :]: float(v) for k, v in numbers.items() if k.startswith(TIMES)}
    camera, world_to_camera = None, attributes.get("worldToCamera")
    if isinstance(world_to_camera, np.ndarray) and "hfov" in attributes:
        height, width = next(iter(buffers.values())).shape[:2]
        world_from_camera = np.linalg.inv(world_to_camera.astype(np.float64).T) @ np.diag([1.0, 1, -1, 1])
        x, y, z = (float(value) for value in str(metadata.get("offset", "0 0 0")).split())
        camera = Camera(world_from_camera, float(attributes["hfov"]), (width, height), offset=(x, y, z))
        if isinstance(K := attributes.get("K"), np.ndarray):
            shift = (0.5 - float(K[0, 2]) / width, float(K[1, 2]) / height - 0.5)
            camera = replace(camera, lens_shift=shift, pixel_aspect=float(attributes["pixelAspectRatio"]))
        if metadata.get("projection") == "orthographic":
            camera = replace(camera, ortho_width=float(attributes["screenWindowWidth"]))
    return FrameFile(
        buffers,
        formats,
        int(attributes.get("frame", 0)),
        float(attributes.get("time", 0.0)),
        camera,
        metadata,
        timings,
        attributes,
    )


def why_not_whole(
    path: str | Path, expected: Mapping[str, Attribute] | None = None, camera: Camera | None = None
) -> str | None:
    """Return why ``path`` has to be rendered again, in a few words, or None if it need not be.

    ``expected`` are ``frame_attributes``: the file must have just these, stage times aside. ``camera``
    gives the resolution.
    """
    try:
        frame = _frame_in(path, False)
    except GiError:
        return "missing" if not Path(path).is_file() else "not whole"
    size = next(iter(frame.buffers.values())).shape[1::-1]
    if camera is not None and size != camera.resolution:
        return f"{size[0]}x{size[1]} instead of {camera.resolution[0]}x{camera.resolution[1]}"
    if expected is None:
        return None
    ours = {*expected, *(PREFIX + key for key in frame.metadata)}
    for name in sorted(ours):
        have, want = frame.attributes.get(name), expected.get(name)
        if isinstance(want, np.ndarray):
            if have is None or not np.array_equal(have, want.astype(np.float32)):
                return "another frame before it" if name.startswith("previous") else "another camera"
        elif want is None or have != plain(want):
            return f"{name.removeprefix(PREFIX)} is {have!r} instead of {None if want is None else plain(want)!r}"
    return None
