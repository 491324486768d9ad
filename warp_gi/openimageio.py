"""Files that OpenImageIO opens: names of any bytes, and what it says is wrong as text, whatever bytes that holds."""

from __future__ import annotations

import functools
import hashlib
import os
import tempfile
from pathlib import Path
from typing import Any

from warp_gi.errors import one_line


def open_image(path: str | Path) -> Any:
    """Return an ``OpenImageIO.ImageInput``, or None: ``reason`` then says why."""
    import OpenImageIO as oiio

    return oiio.ImageInput.open(native_name(path))


def native_name(path: str | Path) -> str:
    """Return a file's name for libraries that take UTF-8 alone: of another, that of a link to it, there or not yet."""
    text = str(path)
    try:
        text.encode()
    except UnicodeEncodeError:
        whole = os.path.abspath(text)
        name = (
            hashlib.sha256(os.fsencode(whole)).hexdigest()[:16] + Path(text).suffix.encode("ascii", "ignore").decode()
        )
        link = os.path.join(_links().name, name)
        if not os.path.islink(link):
            os.symlink(whole, link)
        return link
    return text


@functools.cache
def _links() -> tempfile.TemporaryDirectory[str]:
    """Return a folder of links that goes when the program ends."""
    return tempfile.TemporaryDirectory(prefix="warp_gi-")


def reason(source: Any = None, otherwise: str = "no reason given") -> str:
    """Return the error of an ``ImageInput``, or the last one of all, as one line, and forget it.

    It quotes damaged files, so that it may hold bytes that are no text: they are shown as U+FFFD.
    """
    import OpenImageIO as oiio

    try:
        text = oiio.geterror() if source is None else source.geterror()
    except UnicodeDecodeError as error:
        text = error.object.decode("utf-8", "replace")
    return one_line("".join(c if c.isprintable() or c.isspace() else "?" for c in text), otherwise)
