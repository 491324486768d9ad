"""Pictures that are larger than the memory that they may take: rendered in bands of rows, each a frame of its own.

Kernels see the whole picture: pixels have the numbers, and so the random numbers, that they have in a frame at once,
and every bit is the same. What is smaller are the buffers: an array of a band begins in memory where its rows do, and
kernels run over the items of these rows alone. That is for pipelines whose pixels know nothing of each other
(``Stateful.is_per_pixel``); a denoiser needs the whole picture.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_gi.errors import OptionError
from warp_gi.frame import Frame
from warp_gi.kernels.gbuffer import TILE
from warp_gi.memory import PLAIN_BYTES, gigabytes, left_on, picture_bytes, too_large

if TYPE_CHECKING:
    from warp_gi.pipeline import Pipeline
    from warp_gi.scene.baked import BakedScene
    from warp_gi.scene.scene import Scene

SHARE = 0.5
"""Share of the free memory that a band takes, where nobody says how much it may."""


class BandFrame(Frame):
    """Some rows of a picture: buffers are as large as these are, and addressed as if they were of all rows."""

    def __init__(self, *arguments: Any, rows: range) -> None:
        self.rows = rows
        """Rows of the picture, from the top; the first is a multiple of the height of tiles."""
        super().__init__(*arguments)

    def _zeros(self, dtype: type) -> wp.array:
        width, height = self.camera.resolution
        memory = wp.zeros(len(self.rows) * width, dtype=dtype, device=self.device)
        begin = memory.ptr - self.rows.start * width * wp.types.type_size_in_bytes(dtype)
        buffer: Any = wp.array(ptr=begin, dtype=dtype, shape=width * height, device=self.device)
        buffer.band = memory  # lives as long; the rest of what the buffer seems to hold is never touched
        return buffer

    def numpy(self, name: str) -> np.ndarray:
        """Return the rows of a buffer, [rows, width] or [rows, width, channels]."""
        buffer: Any = self[name]
        values = buffer.band.numpy()
        return values.reshape(len(self.rows), -1, *values.shape[1:])

    def _rows(self) -> range:
        return self.rows


def band_rows(
    pipeline: Pipeline,
    scene: Scene | BakedScene,
    resolution: tuple[int, int],
    device: wp.Device,
    memory: float | None = None,
) -> int:
    """Return the number of rows that are rendered at once: all of them, if the picture fits into the memory.

    ``memory`` is how many bytes a picture may take; None is what the device has left. Raises OptionError for a picture
    that does not fit, if the pipeline cannot render it in bands or 8 rows are too large as well.
    """
    if memory is not None and not (memory > 0 and math.isfinite(memory)):
        raise OptionError(f"memory must be a number of bytes above 0, got {memory:g}")
    (width, height), is_denoised = resolution, pipeline.denoise is not None
    free = left_on(device)
    most = min((limit for limit in (free, memory) if limit is not None), default=None)
    if most is None or picture_bytes(resolution, is_denoised) <= most:
        return height
    room = f"{gigabytes(int(most))} are free on {device.alias}" if most == free else f"{gigabytes(int(most))} may be"
    problem = f"{too_large(resolution, is_denoised)}, and {room}"
    if is_denoised:
        raise OptionError(f"{problem}; render fewer pixels, or without a denoiser")
    why = why_whole(pipeline, scene)
    if why:
        raise OptionError(f"{problem}; render fewer pixels, or by the preset path, in bands ({why})")
    share = most if most == memory else SHARE * most
    rows = int(share // (width * PLAIN_BYTES * int(TILE))) * int(TILE)
    if not rows:
        raise OptionError(f"{problem}; a band of {int(TILE)} rows takes more, too: render fewer pixels")
    return rows


def why_whole(pipeline: Pipeline, scene: Scene | BakedScene) -> str:
    """Return why a pipeline cannot render pictures in bands; "" if it can."""
    owner = pipeline.primary()[0]
    if owner:
        return f"{owner} finds primary hits, all at once"
    for place, part in pipeline.parts().items():
        if not part.is_per_pixel:
            return f"{type(part).__name__} of {place} needs the whole picture"
    past = pipeline.dependence(scene).on_past
    return f"{past[0]} depends on the frames before" if past else ""


def whole(
    rows: int,
    pipeline: Pipeline,
    scene: Scene | BakedScene,
    resolution: tuple[int, int],
    device: wp.Device,
    memory: float | None,
) -> int:
    """Return the number of rows that are rendered at once, ``rows`` where those are enough for the whole picture.

    Raises OptionError where they are not, and what ``band_rows`` says of the picture are not, either.
    """
    if rows < resolution[1]:  # the camera may be another one
        rows = band_rows(pipeline, scene, resolution, device, memory)
    if rows < resolution[1]:
        raise OptionError(
            f"{too_large(resolution, False)}, more than it may; give an output: files are written in bands of {rows}"
            " rows"
        )
    return rows
