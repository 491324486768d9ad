"""EXR files with named layers and metadata: written by OpenEXR itself, read through OpenImageIO.

OpenImageIO writes the same files in twice the time: where some channels are half and others float, it converts them one
by one, pixel by pixel. One part, scan lines, ZIP. Layers follow the usual names: ``R G B`` for the picture, ``A`` for
its coverage,
``N.X``, ``P.X``, ``Z``, ``motion.u``, ``albedo.R`` and so on. Colours and normals are
half unless a value is past half's range; positions, depth, motion, identifiers and
variance are float. No capture date is written, so equal frames are equal files.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from warp_gi import launch
from warp_gi.errors import OptionError, SceneError, one_line
from warp_gi.memory import check_memory
from warp_gi.openimageio import native_name, open_image, reason

HALF_MAX = 65504.0
SEEN = 1 << 24
"""Values that are read at once from a file that is looked through."""

_writing = threading.Lock()  # OpenEXR's number of threads is one for all files; taken across a fork

Attribute = str | int | float | np.ndarray

# buffer -> its channels in the file; other buffers are named after themselves
_CHANNELS = {
    "beauty": ("R", "G", "B"),
    "alpha": ("A",),
    "normal": ("N.X", "N.Y", "N.Z"),
    "position": ("P.X", "P.Y", "P.Z"),
    "depth": ("Z",),
    "motion": ("motion.u", "motion.v"),
    "object_id": ("objectId",),
    "material_id": ("materialId",),
}
_BUFFER_OF_CHANNEL = {channel: name for name, channels in _CHANNELS.items() for channel in channels}
_ALWAYS_FLOAT = {"position", "depth", "motion", "object_id", "material_id", "variance"}
_OIIO_NAMES = {"PixelAspectRatio": "pixelAspectRatio"}  # attributes that OpenImageIO calls otherwise than OpenEXR
_SHAPES = {"matrix": (4, 4), "matrix33": (3, 3), "float2": (2,), "float[2]": (2,)}
_INTEGER = {"object_id", "material_id"}


def channel_names(buffer: str, count: int) -> tuple[str, ...]:
    """Return the EXR channels that hold a buffer of ``count`` values a pixel."""
    known = _CHANNELS.get(buffer)
    if known is not None and len(known) == count:
        return known
    if count == 1:
        return (buffer,)
    if count > 4:
        raise OptionError(f"buffer {buffer!r} has {count} values a pixel; an EXR layer here takes 1 to 4")
    return tuple(f"{buffer}.{letter}" for letter in ("uv" if count == 2 else "RGBA"[:count]))


def stored_format(buffer: str, values: np.ndarray, precision: str = "half") -> str:
    """Return "half" or "float", the format ``buffer`` is stored in."""
    if precision == "float" or buffer in _ALWAYS_FLOAT:
        return "float"
    if values.size and values.max() <= HALF_MAX and values.min() >= -HALF_MAX:  # nothing is NaN or infinite
        return "half"
    finite = values[np.isfinite(values)]
    return "float" if finite.size and np.abs(finite).max() > HALF_MAX else "half"


def stored_values(buffer: str, values: np.ndarray, precision: str = "half") -> np.ndarray:
    """Return the values of ``buffer`` as reading the file gives them back (float32)."""
    values = np.asarray(values, dtype=np.float32)
    if stored_format(buffer, values, precision) == "half":
        return values.astype(np.float16).astype(np.float32)
    return values


def plain(value: object) -> str | int | float:
    """Return a metadata value in the form that a file gives back: int32, float32 or text."""
    if isinstance(value, bool | np.bool_):
        return int(value)
    if isinstance(value, int | np.integer):
        return int(value) if -(2**31) <= int(value) < 2**31 else str(int(value))
    if isinstance(value, float | np.floating):
        return float(np.float32(value))
    return str(value).encode("utf-8", "backslashreplace").decode()  # names of files may hold what is not UTF-8


def write_exr(
    path: str | Path,
    buffers: Mapping[str, np.ndarray],
    attributes: Mapping[str, Attribute],
    precision: str = "half",
) -> None:
    """Write ``buffers`` (each [height, width] or [height, width, 1 to 4]) and ``attributes`` to ``path``.

    Attributes are text, numbers, 4x4 and 3x3 matrices (stored row after row as they are) or pairs of numbers.
    ``precision`` is "half" or "float" for the buffers that may be either.
    Raises OSError when the file cannot be written, OptionError for buffers of unequal size.
    """
    if precision not in ("half", "float"):
        raise OptionError(f"EXR precision must be 'half' or 'float', got {precision!r}")
    channels: dict[str, np.ndarray] = {}
    size: tuple[int, ...] = ()
    for buffer, values in buffers.items():
        values = np.asarray(values)
        if buffer in _INTEGER and values.size and np.abs(values).max() > 2**24:
            raise OptionError(f"buffer {buffer!r} has identifiers above 2^24, which an EXR float cannot hold")
        values = np.asarray(values, dtype=np.float32)
        values = values.reshape(*values.shape[:2], -1)
        size = size or values.shape[:2]
        if values.shape[:2] != size:
            raise OptionError(f"buffer {buffer!r} is {values.shape[:2]}, the others are {size}")
        dtype = np.float16 if stored_format(buffer, values, precision) == "half" else np.float32
        planes = np.ascontiguousarray(np.moveaxis(values, 2, 0), dtype=dtype)
        channels |= dict(zip(channel_names(buffer, len(planes)), planes, strict=True))
    if not channels:
        raise OptionError("an EXR file needs at least one buffer")
    write_channels(path, channels, attributes)


def write_channels(path: str | Path, channels: Mapping[str, np.ndarray], attributes: Mapping[str, Attribute]) -> None:
    """Write channels, float16 or float32 [height, width] by name, and ``attributes`` to ``path``; see ``write_exr``."""
    import OpenEXR

    header: dict[str, Any] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for name, value in attributes.items():
        is_matrix = isinstance(value, np.ndarray)
        header[name] = np.ascontiguousarray(value, np.float32) if is_matrix else plain(value)  # OpenEXR ignores strides
    threads = launch.thread_count()
    with _writing:
        try:
            OpenEXR.set_global_thread_count(threads if threads > 1 else 0)
            with OpenEXR.File(header, dict(channels)) as file:
                file.write(native_name(path))
        except RuntimeError as error:
            raise OSError(f"cannot write {path}: {one_line(str(error), 'unknown failure')}") from error
        finally:
            OpenEXR.set_global_thread_count(0)  # a forked process would wait for threads that only its parent has


def read_exr(path: str | Path, keep: bool = True) -> tuple[dict[str, np.ndarray], dict[str, Attribute], dict[str, str]]:
    """Read an EXR file (or HDR): its buffers by name, its attributes, and the format ("half", "float") of each buffer.

    Buffers are float32 [height, width] or [height, width, channels], identifiers int32; a
    file by another program gives its layers by the same rules. Matrices come back as float32
    [4, 4] or [3, 3], pairs as [2]. Without ``keep`` all pixels are read some rows at a time, to see that they are
    there, and buffers are zeros that take no memory. Raises SceneError when the file is missing, torn or not an EXR.
    """
    if not Path(path).is_file():
        raise SceneError(f"{path}: no such file")
    try:
        return _read(Path(path), keep)
    except UnicodeDecodeError as error:  # names or texts of its header
        raise SceneError(f"{path}: not a whole EXR file (its header holds text that is not UTF-8)") from error


def _read(path: Path, keep: bool) -> tuple[dict[str, np.ndarray], dict[str, Attribute], dict[str, str]]:
    kind, source = path.suffix[1:].upper() or "EXR", open_image(path)
    if source is None:
        raise SceneError(f"{path}: not a whole {kind} file ({reason()})")
    try:
        spec = source.spec()
        if spec.deep:  # what OpenImageIO would return are no pixels, but what lay in memory
            raise SceneError(f"{path}: deep EXR, which has no one value a pixel; flatten it first")
        if keep or spec.tile_width:
            check_memory(f"{path}: {spec.width}x{spec.height} pixels", 8 * spec.image_pixels() * spec.nchannels)
            pixels = source.read_image("float")
        else:
            pixels = _seen(source, spec)
        problem = reason(source, "")  # missing scan lines are reported here, with zeros in the pixels
    finally:
        source.close()
    if pixels is None or problem:
        raise SceneError(f"{path}: not a whole {kind} file ({problem or 'no pixels'})")
    formats = [str(format) for format in spec.channelformats] or [str(spec.format)] * spec.nchannels
    groups: dict[str, list[int]] = {}
    for index, channel in enumerate(spec.channelnames):
        groups.setdefault(_buffer_of(channel), []).append(index)
    buffers = {}
    for buffer, indices in groups.items():
        order = (
            {name: rank for rank, name in enumerate(channel_names(buffer, len(indices)))} if len(indices) < 5 else {}
        )
        indices.sort(key=lambda i: order.get(spec.channelnames[i], i))
        values = pixels[:, :, indices[0]]
        if not keep:
            shape = values.shape + (len(indices),) * (len(indices) > 1)
            buffers[buffer] = np.broadcast_to(np.float32(0), shape)
            continue
        values = np.ascontiguousarray(pixels[:, :, indices] if len(indices) > 1 else values)
        buffers[buffer] = values.astype(np.int32) if buffer in _INTEGER else values
    attributes: dict[str, Attribute] = {}
    for item in spec.extra_attribs:
        value: Any = item.value
        shape = _SHAPES.get(str(item.type))
        value = value if shape is None else np.array(value, np.float32).reshape(shape)
        attributes[_OIIO_NAMES.get(item.name, item.name)] = value
    return buffers, attributes, {buffer: formats[indices[0]] for buffer, indices in groups.items()}


def _seen(source: Any, spec: Any) -> np.ndarray | None:
    """Read all rows of a file, some at a time; return zeros in place of its pixels, or None if some are missing."""
    step = max(SEEN // max(spec.width * spec.nchannels, 1), 1)
    for start in range(spec.y, spec.y + spec.height, step):
        stop = min(start + step, spec.y + spec.height)
        if source.read_scanlines(start, stop, 0, 0, spec.nchannels, "float") is None:
            return None
    return np.broadcast_to(np.float32(0), (spec.height, spec.width, spec.nchannels))


def _buffer_of(channel: str) -> str:
    if channel in _BUFFER_OF_CHANNEL:
        return _BUFFER_OF_CHANNEL[channel]
    return channel.rpartition(".")[0] or channel


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_writing.acquire, after_in_parent=_writing.release, after_in_child=_writing.release)
