"""Files of frames that are rendered in bands: rows wait on the disk until all are there, and go to one file.

A file a channel: OpenEXR reads them as memory that the system fetches from the disk (``numpy.memmap``).

The file is that of a frame at once. Whether a buffer is stored as half is known with its last row (``stored_format``).
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from warp_gi import bands
from warp_gi.errors import OptionError
from warp_gi.files import replacing
from warp_gi.scene.camera import Camera, frame_time
from warp_gi.sequence.exr import Attribute, channel_names, stored_format, stored_values, write_channels
from warp_gi.sequence.frames import read_frame, written_attributes
from warp_gi.sequence.preview import picture_bytes, tone_map, write_png

if TYPE_CHECKING:
    from warp_gi.bands import BandFrame
    from warp_gi.scheduler import FrameScheduler

BLOCK = 1 << 24
"""Values that are read from the disk and written at once."""


class Storage(Protocol):
    """How files are stored, as ``sequence.resume.Output`` says."""

    @property
    def is_exr(self) -> bool:
        """Whether files are EXR files, else PNG."""
        ...

    @property
    def precision(self) -> str:
        """Storage of colours and normals in EXR files."""
        ...

    @property
    def preview(self) -> bool:
        """Whether a tone-mapped PNG is written beside each EXR file."""
        ...

    @property
    def exposure(self) -> float:
        """Exposure of PNG files in stops."""
        ...


@dataclass
class BandedFrame:
    """A frame whose picture is in its file alone."""

    index: int
    """Number of the frame."""
    time: float
    """Time of the frame in seconds from the first one."""
    camera: Camera
    """Camera of the frame."""
    previous_camera: Camera
    """Camera of the frame that motion is towards."""
    path: Path
    """File of the frame."""
    names: tuple[str, ...]
    """Names of the buffers."""
    metadata: dict[str, str | int | float]
    """Values by name that decide the pixels, beside camera and time."""
    timings: dict[str, float] = field(default_factory=dict)
    """Wall seconds by stage, of all bands together."""
    measured: dict[str, float] = field(default_factory=dict)
    """Values by name that tell of the pixels and do not decide them."""

    def numpy(self, name: str) -> np.ndarray:
        """Return a buffer, read from the file, [height, width] or [height, width, channels]."""
        return read_frame(self.path).numpy(name)

    def __repr__(self) -> str:
        width, height = self.camera.resolution
        return f"<BandedFrame {self.index}: {width}x{height}, in {self.path}>"

    def _repr_png_(self) -> bytes:
        """Return the picture as a notebook shows it."""
        return picture_bytes(self.numpy("beauty"))


def frame_of(band: BandFrame, path: Path) -> BandedFrame:
    """Return what is known of a frame when its first band is there."""
    cameras = band.camera, band.previous_camera
    return BandedFrame(band.index, band.time, *cameras, path, band.names, dict(band.metadata))


class Rows:
    """Buffers of a frame on the disk, row after row, and its tone-mapped picture.

    Args:
        folder: Where files of rows go; None keeps the picture alone.
        output: How files are stored, and whether there is a preview.
    """

    def __init__(self, folder: Path | None, output: Storage) -> None:
        self.folder, self.output = folder, output
        self.formats: dict[str, str] = {}
        self.channels: dict[str, tuple[str, ...]] = {}
        self.picture: list[np.ndarray] = []

    def add(self, band: BandFrame) -> None:
        """Take the rows of a band, which follow those before. Raises OSError for a disk that is full."""
        if self.output.preview or not self.output.is_exr:
            shown = band.numpy("beauty")
            self.picture.append(tone_map(stored_values("beauty", shown), self.output.exposure))
        for name in band.names if self.folder is not None else ():
            values = np.asarray(band.numpy(name), np.float32).reshape(len(band.rows), band.camera.resolution[0], -1)
            self.channels[name] = channel_names(name, values.shape[2])
            stored = stored_format(name, values, self.output.precision)
            self.formats[name] = "float" if "float" in (stored, self.formats.get(name)) else "half"
            for index, channel in enumerate(self.channels[name]):
                with open(self._path(channel), "ab") as file:
                    file.write(np.ascontiguousarray(values[..., index]).data)

    def _path(self, channel: str, format: str = "float") -> Path:
        assert self.folder is not None
        return self.folder / f"{channel}.{format}"

    def _plane(self, channel: str, format: str, size: tuple[int, int]) -> np.ndarray:
        """Return a channel as it is stored, [height, width], in memory as far as it is read."""
        path = self._path(channel)
        if format == "half":
            with open(path, "rb") as source, open(self._path(channel, format), "wb") as target:
                while len(values := np.frombuffer(source.read(4 * BLOCK), np.float32)):
                    target.write(values.astype(np.float16).data)
            path.unlink()
        dtype = np.float16 if format == "half" else np.float32
        return np.memmap(self._path(channel, format), dtype, "r", shape=size[::-1])

    def write(self, path: Path, attributes: Mapping[str, Attribute], size: tuple[int, int]) -> None:
        """Write the EXR file; raises OSError if it cannot be."""
        planes = {
            channel: self._plane(channel, self.formats[name], size)
            for name, channels in self.channels.items()
            for channel in channels
        }
        write_channels(path, planes, attributes)


def bands_of(scheduler: FrameScheduler, index: int, previous_index: int) -> Iterator[BandFrame]:
    """Yield a frame in bands from the top, each rendered when it is asked for; see ``FrameScheduler.frame``."""
    height = scheduler.camera.resolution[1]
    with scheduler.scene.lock:
        scheduler.scene.check_unchanged()
        why = bands.why_whole(scheduler.pipeline, scheduler.scene)
        if why:  # since the scheduler was made, the scene has been edited
            raise OptionError(f"a picture that is larger than it may be cannot be rendered in bands any more ({why})")
        scheduler.bake(frame_time(scheduler.camera, index))
        for first in range(0, height, scheduler.rows):
            yield scheduler.band(index, previous_index, range(first, min(first + scheduler.rows, height)))


def render_in_bands(
    scheduler: FrameScheduler,
    index: int,
    previous_index: int,
    path: Path,
    output: Storage,
    origin: Mapping[str, str | int | float],
) -> BandedFrame:
    """Render a frame in bands, write its preview and its file ``path``, and return it.

    ``origin`` goes to the metadata. Raises OSError for files that cannot be written: then there is no EXR file.
    """
    frame: BandedFrame | None = None
    with contextlib.ExitStack() as stack:
        part = stack.enter_context(replacing(path, own_folder=True)) if output.is_exr else None
        rows = Rows(part and part.parent, output)
        for band in bands_of(scheduler, index, previous_index):
            frame = frame or frame_of(band, path)
            for stage, seconds in band.timings.items():
                frame.timings[stage] = frame.timings.get(stage, 0.0) + seconds
            started = time.perf_counter()
            rows.add(band)
            frame.timings["write"] = frame.timings.get("write", 0.0) + time.perf_counter() - started
        assert frame is not None
        started = time.perf_counter()
        frame.timings["bake"] = scheduler.bake_seconds
        frame.metadata |= origin
        if rows.picture:
            write_png(path.with_suffix(".png"), np.concatenate(rows.picture), output.exposure)
        if part is not None:
            try:
                rows.write(part, written_attributes(frame, output.precision), frame.camera.resolution)
            except OSError as error:
                raise OSError(str(error).replace(str(part), str(path))) from error
        frame.timings["write"] += time.perf_counter() - started
    return frame
