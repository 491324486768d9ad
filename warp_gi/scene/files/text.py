"""The text of OBJ and MTL files: encodings, lines that go on, and comments."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from warp_gi.errors import SceneError

UTF_8_MARK = b"\xef\xbb\xbf"
UTF_16_MARKS = (b"\xff\xfe", b"\xfe\xff")
GOES_ON = re.compile(rb"\\[ \t]*\n")
WHOLE = re.compile(rb"[ \t]*(mtllib|usemtl|newmtl|o|g)[ \t]", re.IGNORECASE)
"""Statements of names, which a backslash at the end belongs to."""


def read_bytes(path: Path) -> bytes:
    """Return the bytes of a file without the mark of UTF-8; raises SceneError for UTF-16."""
    data = path.read_bytes()
    if data.startswith(UTF_16_MARKS):
        raise SceneError(f"{str(path)!r} is text in UTF-16, expected ASCII or UTF-8; save it as UTF-8")
    return data.removeprefix(UTF_8_MARK)


def decode(data: bytes) -> str:
    """Return bytes as text in UTF-8 or, failing that, Latin-1."""
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data.decode("latin-1")


def joined(data: bytes) -> tuple[bytes, np.ndarray]:
    """Return a text whose lines end in a line feed, and where a line end was made blank to join two lines.

    A backslash at the end joins a line with the next one, unless it stands in a comment or in a name.
    """
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    places: list[int] = []
    blank = None
    start = -1
    for match in GOES_ON.finditer(data):
        line = data.rfind(b"\n", 0, match.start()) + 1
        if not places or places[-1] != line - 1:
            start = line
        if WHOLE.match(data, start) or data.find(b"#", start, match.start()) >= 0:
            continue
        blank = bytearray(data) if blank is None else blank
        blank[match.start() : match.end()] = b" " * len(match[0])
        places.append(match.end() - 1)
    return data if blank is None else bytes(blank), np.array(places, np.int64)


def uncommented(words: list[str]) -> list[str]:
    """Return the words before a comment."""
    for index, word in enumerate(words):
        if word.startswith("#"):
            return words[:index] or words
    return words


def without_comment(text: str) -> str:
    """Return a name without the comment behind it."""
    return " ".join(uncommented(text.split()))
