"""8-bit images from files, and errors about files that are not there."""

from __future__ import annotations

import difflib
import io
import os
from pathlib import Path

import numpy as np

from warp_gi.errors import SceneError, one_line


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
    """Return the path of file ``name`` under ``folder``, upper and lower case aside; raises SceneError if missing."""
    path = folder / name.replace("\\", "/")
    if os.path.isfile(path):  # False, not an error, for names that are too long
        return path
    found = folder
    for part in Path(name.replace("\\", "/")).parts:
        alike = [p for p in found.iterdir() if p.name.lower() == part.lower()] if os.path.isdir(found) else []
        found = found / (part if part == ".." or not alike else alike[0].name)
    if os.path.isfile(found):
        return found
    raise missing_file(path, what)


def read_image(source: Path | bytes | memoryview, what: str) -> np.ndarray:
    """Return the pixels of an image file or of its bytes, uint8 [height, width, 4], row 0 at the top.

    16-bit images lose their low byte. Raises SceneError naming ``what`` if it is damaged, cut short or empty.
    """
    from PIL import Image

    try:
        with Image.open(source if isinstance(source, Path) else io.BytesIO(source)) as image:
            if image.mode.startswith("I"):
                grey = (np.asarray(image, np.int64) >> 8).clip(0, 255).astype(np.uint8)
                return np.stack([grey, grey, grey, np.full_like(grey, 255)], axis=-1)
            pixels = np.array(image.convert("RGBA"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        reason = one_line(error)
        raise SceneError(f"{what} cannot be read as an image ({reason}); replace or repair it") from error
    if pixels.size == 0:
        raise SceneError(f"{what} has no pixels ({pixels.shape[1]}x{pixels.shape[0]}); replace it")
    return pixels
