"""EXR files of several parts: images of their own size and channels, by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from warp_gi.errors import BakeError
from warp_gi.openimageio import open_image, reason


class Part(NamedTuple):
    """An image in an EXR file."""

    name: str
    """Name of the part; "" is no name."""
    channels: Sequence[str]
    """Names of the channels. Readers may sort them: read them by name."""
    size: tuple[int, int]
    """Width and height."""
    pixels: Callable[[], np.ndarray]
    """Returns the image, float16 or float32 [height, width, channel]; called once, when it is written."""
    type: str = "half"
    """Type of the channels: "half" or "float"."""


def write_exr_parts(file: Path, path: Path, parts: Sequence[Part], attributes: dict[str, str] | None = None) -> None:
    """Write images as the parts of an EXR file, one after another; ``path`` is what errors name. Raises OSError.

    All parts have one display window, as OpenEXR asks: from (0, 0) to the largest width and height.
    """
    import OpenImageIO as oiio

    specs = []
    for part in parts:
        spec = oiio.ImageSpec(*part.size, len(part.channels), part.type)
        spec.full_width, spec.full_height = (max(other.size[axis] for other in parts) for axis in (0, 1))
        spec.channelnames = tuple(part.channels)
        spec.attribute("compression", "zip")
        spec.attribute("DateTime", "")  # else the time of day goes into every file
        for name, text in (attributes or {}).items():
            spec.attribute(name, text)
        if part.name:
            spec.attribute("oiio:subimagename", part.name)
        specs.append(spec)
    output = oiio.ImageOutput.create("exr")
    if output is None:
        raise OSError(f"cannot write {path}: this OpenImageIO writes no EXR files; install one that does")
    done = output.open(str(file), tuple(specs)) if len(specs) > 1 else output.open(str(file), specs[0])
    for index, (part, spec) in enumerate(zip(parts, specs, strict=True)):
        if index:
            done = done and output.open(str(file), spec, "AppendSubimage")
        done = done and output.write_image(np.ascontiguousarray(part.pixels()))
    done = output.close() and done
    problem = "" if done and not output.has_error else reason(output, "unknown failure")
    problem = problem or _end_missing(file)
    if problem:
        raise OSError(f"cannot write {path}: {problem.replace(str(file), str(path))}")


def _end_missing(file: Path) -> str:
    """Return what is wrong with the last row of a part that was just written, or "": a full disk may fail at the end.

    OpenImageIO does not tell when the last bytes, which it writes when it closes a file, find no room.
    """
    source = open_image(file)
    if source is None:
        return reason(None, "the disk may be full")
    try:
        part = 0
        while source.seek_subimage(part, 0):
            spec = source.spec()
            end = spec.y + spec.height
            if source.read_scanlines(part, 0, end - 1, end, 0, 0, spec.nchannels, "float") is None or source.has_error:
                reason(source)
                return "its last rows are not there; the disk may be full"
            part += 1
        reason(source)  # some readers keep that there was no further part
    finally:
        source.close()
    return ""


def read_exr_parts(path: str | Path) -> tuple[dict[str, dict[str, np.ndarray]], dict[str, str]]:
    """Return the images of an EXR file, float16 or float32 [height, width], by part and channel; and its texts by name.

    Raises BakeError when the file is missing, torn or no EXR file.
    """
    if not Path(path).is_file():
        raise BakeError(f"{path}: no such file; it belongs to the export, which has to be written again")
    source = open_image(path)
    if source is None or source.format_name() != "openexr":
        reason()  # taken, so that it is not printed when the program ends; pages of it for a few bytes missing
        raise BakeError(f"{path}: not a whole EXR file; export again")
    images: dict[str, dict[str, np.ndarray]] = {}
    texts: dict[str, str] = {}
    try:
        while source.seek_subimage(len(images), 0):
            spec = source.spec()
            kind = "half" if str(spec.format) == "half" else "float"
            pixels = source.read_image(len(images), 0, 0, spec.nchannels, kind)
            if pixels is None or source.has_error:
                break
            pixels = pixels.reshape(spec.height, spec.width, spec.nchannels)
            name = spec.get_string_attribute("oiio:subimagename") or str(len(images))
            images[name] = {channel: pixels[..., at] for at, channel in enumerate(spec.channelnames)}
            texts |= {item.name: item.value for item in spec.extra_attribs if isinstance(item.value, str)}
        problem = reason(source) if source.has_error else ""
    finally:
        source.close()
    if problem or not images:
        raise BakeError(f"{path}: not a whole EXR file ({problem or 'no pixels'}); export again")
    return images, texts
