"""8-bit images from files, and errors about files that are not there."""

from __future__ import annotations

import contextlib
import contextvars
import difflib
import io
import os
import re
import struct
import warnings
import zlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warp_gi.color import bands
from warp_gi.errors import SceneError, one_line
from warp_gi.memory import check_memory

if TYPE_CHECKING:
    from PIL import Image

MOST_TEXELS = 178_956_970
"""Largest number of pixels of a texture's file: Pillow's own limit."""
_LIMIT = f"at most {MOST_TEXELS:,} are supported; scale it down"


class OutsideError(SceneError):
    """A scene names a file outside of its own folder, and may not."""


_root: contextvars.ContextVar[str | None] = contextvars.ContextVar("root", default=None)


@contextlib.contextmanager
def restricted_to(folder: Path | None) -> Iterator[None]:
    """Let scenes that are read in the block name files in a folder alone; None lets them name any."""
    token = _root.set(None if folder is None else os.path.realpath(folder))
    try:
        yield
    finally:
        _root.reset(token)


def check_inside(path: Path, what: str) -> None:
    """Raise OutsideError for a file that a scene may not name: links and ".." are followed, nothing is opened."""
    root = _root.get()
    if root is None:
        return
    real = os.path.realpath(path)
    if os.path.commonpath([root, real]) != root:
        raise OutsideError(
            f"{what} lies outside of the scene's folder {root!r}, and paths are restricted to it; copy the file there,"
            " or allow the path"
        )


def missing_file(path: Path, what: str) -> SceneError:
    """Return an error that says ``what`` is a folder, or is missing, and names the nearest file in the folder."""
    if os.path.isdir(path):
        return SceneError(f"{what} {str(path)!r} is a folder; name a file in it")
    if not os.path.isdir(path.parent):
        return SceneError(f"{what} {str(path)!r} is missing: there is no folder {str(path.parent)!r}")
    near = difflib.get_close_matches(path.name, sorted(p.name for p in path.parent.iterdir()), n=1, cutoff=0.4)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return SceneError(f"{what} {str(path)!r} is missing{hint}")


def find_file(folder: Path, name: str, what: str) -> Path:
    """Return the path of file ``name`` under ``folder``, upper and lower case aside; raises SceneError if missing.

    It is an OutsideError where ``restricted_to`` forbids the file.
    """
    if re.match("[a-z][a-z0-9+.-]+://", name, re.IGNORECASE):
        raise SceneError(f"{what} {name!r} is an address, and only files are read; fetch it, and name the file")
    path = folder / name.replace("\\", "/")
    check_inside(path, f"{what} {name!r}" if name not in what else what)
    if os.path.isfile(path):  # False, not an error, for names that are too long
        return path
    found = folder
    for part in Path(name.replace("\\", "/")).parts:
        alike = [p for p in found.iterdir() if p.name.lower() == part.lower()] if os.path.isdir(found) else []
        found = found / (part if part == ".." or not alike else alike[0].name)
    check_inside(found, f"{what} {name!r}" if name not in what else what)
    if os.path.isfile(found):
        return found
    raise missing_file(path, what)


def read_image(source: Path | bytes | memoryview, what: str) -> np.ndarray:
    """Return the pixels of an image file or of its bytes, uint8 [height, width, 4], row 0 at the top.

    16-bit images lose their low byte. Raises SceneError naming ``what`` if it is damaged, cut short or empty, and
    before its pixels are read if it has more than ``MOST_TEXELS`` or does not fit into memory.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the limit here is another one
            opened = Image.open(source if isinstance(source, Path) else io.BytesIO(source), formats=_formats())
        with opened as image:
            width, height = image.size
            if 0 in image.size:
                raise SceneError(f"{what} has no pixels ({width}x{height}); replace it")
            if width * height > MOST_TEXELS:
                raise SceneError(f"{what} has {width}x{height} pixels, {_LIMIT}")
            is_deep = image.mode.startswith("I")
            check_memory(f"{what}: {width}x{height} pixels", (18 if is_deep else 9) * width * height)
            if is_deep:
                grey = (np.asarray(image, np.int64) >> 8).clip(0, 255).astype(np.uint8)
                return np.stack([grey, grey, grey, np.full_like(grey, 255)], axis=-1)
            return _rgba(image)
    except Image.DecompressionBombError as error:
        raise SceneError(f"{what} is too large: {_LIMIT}") from error
    except SceneError:
        raise
    except (
        OSError,
        ValueError,
        SyntaxError,
        ArithmeticError,
        LookupError,
        TypeError,
        struct.error,
        zlib.error,
    ) as error:
        reason = one_line(error, type(error).__name__)  # readers of damaged files raise what they stumble over
        if isinstance(error, UnidentifiedImageError):
            reason = "it is in no format of images that is known"
        raise SceneError(f"{what} cannot be read as an image ({reason}); replace or repair it") from error


@cache
def _formats() -> tuple[str, ...]:
    """Return the formats that are read: all of Pillow's but those whose reader starts another program."""
    from PIL import Image

    Image.init()
    return tuple(name for name in Image.OPEN if name not in ("EPS", "WMF"))


def _rgba(image: Image.Image) -> np.ndarray:
    """Return the pixels of an image, uint8 [height, width, 4]; converted some rows at a time to save memory."""
    width, height = image.size
    if image.mode not in ("RGB", "RGBA", "L") or "transparency" in image.info:
        return np.array(image.convert("RGBA"))
    image.load()
    pixels = np.empty((height, width, 4), np.uint8)
    for rows in bands(height, width):
        pixels[rows] = np.asarray(image.crop((0, rows.start, width, rows.stop)).convert("RGBA"))
    return pixels
