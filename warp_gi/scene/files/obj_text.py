"""The statements of an OBJ file as arrays.

Lines of numbers are taken apart together, in NumPy: a file of millions of faces takes seconds. Only the few other
lines, which name materials and libraries, are read one by one.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass, field

import numpy as np

from warp_gi.errors import SceneError
from warp_gi.scene.files.support import Findings
from warp_gi.scene.files.text import decode, joined

NEWLINE, SLASH, SPACE, HASH = 10, 47, 32, 35  # all up to the space is blank
VERTEX, COORDINATE, NORMAL, FACE = range(4)
KEYWORDS = {b"v": VERTEX, b"vt": COORDINATE, b"vn": NORMAL, b"f": FACE, b"fo": FACE}
CORNER = re.compile(r"[-+]?\d+(/([-+]?\d+)?){0,2}")
NOT_ROUNDING = 1.001  # colours above this are no rounded ones
UNSEEN = {"o", "g", "mg", "lod", "bevel", "c_interp", "d_interp", "shadow_obj", "trace_obj", "ctech", "stech", "s"}
"""Statements without a warning: names, and what changes no polygon."""
CURVES = {"vp", "cstype", "deg", "bmat", "step", "curv", "curv2", "surf", "parm", "trim", "hole", "scrv", "sp", "end"}


@dataclass(eq=False)
class ObjStatements:
    """What an OBJ file says, before it is made a scene."""

    points: np.ndarray
    """Positions, float64 [vertex, 3]."""
    colors: np.ndarray | None
    """Colours, float64 [vertex, 3], 1 where a vertex has none; None if no vertex has one."""
    uvs: np.ndarray
    """Texture coordinates, float64 [coordinate, 2]."""
    normals: np.ndarray
    """Normals, float64 [normal, 3]."""
    corners: np.ndarray
    """Vertex, coordinate and normal of each corner of each face, int64 [corner, 3]; -1 is none."""
    sizes: np.ndarray
    """Number of corners of each face, int64 [face]."""
    face_materials: np.ndarray
    """Index in ``materials`` of each face's material, int64 [face]; -1 is none."""
    face_smooth: np.ndarray
    """Whether a face is in a smoothing group, bool [face]."""
    materials: list[str] = field(default_factory=list)
    """Names after ``usemtl``, in the order of their first use."""
    libraries: list[str] = field(default_factory=list)
    """What stands behind each ``mtllib``."""


class _Lines:
    """The lines of a text: where each begins and ends, what kind it is."""

    def __init__(self, data: bytes) -> None:
        data, places = joined(data)
        self.bytes = np.frombuffer(data + b"\n", np.uint8).copy()
        self.ends = np.flatnonzero(self.bytes == NEWLINE)
        self.starts = np.concatenate([[0], self.ends[:-1] + 1])
        self.numbers = np.arange(1, len(self.starts) + 1) + np.searchsorted(places, self.starts)
        """The number of each line in the file."""
        self._classify()

    def _classify(self) -> None:
        """Set the kind of each line, and make its keyword blank if it is one of numbers."""
        self.first = self.starts.copy()
        indented = np.flatnonzero((self.bytes[self.first] <= SPACE) & (self.first < self.ends))
        while len(indented):
            self.first[indented] += 1
            at = self.first[indented]
            indented = indented[(self.bytes[at] <= SPACE) & (at < self.ends[indented])]
        at, last = self.first, len(self.bytes) - 1
        letters = [self.bytes[np.minimum(at + i, last)] for i in range(3)]
        self.kinds = np.full(len(self.starts), -1, np.int8)
        for word, kind in KEYWORDS.items():
            match = letters[len(word)] <= SPACE
            for i, letter in enumerate(word):
                match &= letters[i] == letter
            self.kinds[match] = kind
            for i in range(len(word)):
                self.bytes[at[match] + i] = SPACE
        hashes = np.flatnonzero(self.bytes == HASH)
        lines = np.searchsorted(self.ends, hashes)
        numeric = self.kinds[lines] >= 0
        for position, line in zip(hashes[numeric].tolist(), lines[numeric].tolist(), strict=True):
            self.bytes[position : self.ends[line]] = SPACE  # a comment behind numbers

    def others(self) -> list[tuple[int, list[str]]]:
        """Return the index and the words of each line that is not of numbers and no comment."""
        chosen = np.flatnonzero((self.first < self.ends) & (self.kinds < 0) & (self.bytes[self.first] != HASH))
        found = []
        for line in chosen.tolist():
            text = decode(self.bytes[self.first[line] : self.ends[line]].tobytes())
            found.append((line, text.split()))
        return found

    def text(self, kind: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the bytes of all lines of a kind, each with its line end, and the indices of these lines."""
        lines = np.flatnonzero(self.kinds == kind)
        if not len(lines):
            return np.empty(0, np.uint8), lines
        breaks = np.flatnonzero(np.diff(lines) > 1)
        begin = self.starts[lines[np.concatenate([[0], breaks + 1])]]
        end = self.ends[lines[np.concatenate([breaks, [len(lines) - 1]])]] + 1
        return np.concatenate([self.bytes[a:b] for a, b in zip(begin.tolist(), end.tolist(), strict=True)]), lines


def parse(data: bytes, path: object, findings: Findings) -> ObjStatements:
    """Return the statements of an OBJ file; raises SceneError, which names the line that is wrong."""
    lines = _Lines(data)
    points, colors = _vertices(lines, path, findings)
    uvs = _rows(lines, COORDINATE, 2, path, "vt", least=1)
    normals = _rows(lines, NORMAL, 3, path, "vn")
    corners, sizes, face_lines = _faces(lines, path)
    given = (len(points), len(uvs), len(normals))
    _resolve(lines, corners, sizes, face_lines, given, path)
    small = sizes < 3
    if small.any():
        findings.add("faces of fewer than three corners", f"line {lines.numbers[face_lines[small][0]]}")
        corners, sizes, face_lines = corners[np.repeat(~small, sizes)], sizes[~small], face_lines[~small]
    result = ObjStatements(points, colors, uvs, normals, corners, sizes, *_assigned(face_lines))
    _others(lines, result, face_lines, findings)
    return result


def _assigned(face_lines: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.full(len(face_lines), -1, np.int64), np.zeros(len(face_lines), bool)


def _others(lines: _Lines, result: ObjStatements, face_lines: np.ndarray, findings: Findings) -> None:
    """Read the lines that are not of numbers into ``result``."""
    index_of: dict[str, int] = {}
    used, smooth = [(-1, -1)], [(-1, False)]
    for line, words in lines.others():
        keyword, where = words[0].lower(), f"line {lines.numbers[line]}"
        if keyword == "mtllib":
            result.libraries.append(" ".join(words[1:]))
        elif keyword == "usemtl":
            name = " ".join(words[1:])
            used.append((line, index_of.setdefault(name, len(index_of))))
        elif keyword == "s" and len(words) > 1:
            smooth.append((line, words[1].lower() not in ("0", "off")))
        elif keyword in ("l", "p"):
            findings.add("points and lines", where)
        elif keyword in CURVES:
            findings.add("free-form curves and surfaces", where)
        elif keyword not in UNSEEN:
            findings.add("other statements of OBJ, such as call and usemap", f"{words[0][:20]!r}, {where}")
    result.materials = list(index_of)
    for target, rows in ((result.face_materials, used), (result.face_smooth, smooth)):
        at, values = np.array(rows, np.int64).T
        target[:] = values[np.searchsorted(at, face_lines, side="right") - 1]


def _numbers(text: np.ndarray, lines: np.ndarray, path: object, keyword: str, dtype: type) -> np.ndarray:
    """Return all numbers of a text, whose lines have these numbers in the file."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromstring(text.tobytes(), dtype, sep=" ")
        except (DeprecationWarning, ValueError):
            raise SceneError(_wrong_line(text, lines, path, keyword, dtype)) from None


def _wrong_line(text: np.ndarray, lines: np.ndarray, path: object, keyword: str, dtype: type) -> str:
    """Return a message about the first line of a text that does not hold numbers alone."""
    for number, line in zip(lines.tolist(), text.tobytes().decode("latin-1").split("\n"), strict=False):
        for word in line.replace("/", " ").split():
            kind = "numbers"
            try:
                float(word)
                kind = "whole numbers"
                if dtype is np.int64:
                    int(word)
            except ValueError:
                what = f"{str(path)!r}: line {number}: {keyword} {line.strip()[:60]!r}"
                return f"{what} must hold {kind}, got {word[:40]!r}"
    return f"{str(path)!r}: a line of {keyword} must hold numbers"


def _counts(text: np.ndarray) -> np.ndarray:
    """Return the number of words on each line of a text."""
    ends = np.flatnonzero(text == NEWLINE)
    return np.diff(np.searchsorted(_word_starts(text), ends), prepend=0)


def _word_starts(text: np.ndarray) -> np.ndarray:
    """Return where the words of a text begin."""
    blank = text <= SPACE
    starts = ~blank
    starts[1:] &= blank[:-1]
    return np.flatnonzero(starts)


def _rows(lines: _Lines, kind: int, width: int, path: object, keyword: str, least: int | None = None) -> np.ndarray:
    """Return the first ``width`` numbers of each line of a kind, 0 where a line has fewer, float64 [line, width]."""
    text, numbers = lines.text(kind)
    if not len(numbers):
        return np.empty((0, width))
    counts, values = _counts(text), _numbers(text, lines.numbers[numbers], path, keyword, np.float64)
    least = width if least is None else least
    if counts.min() < least:
        line = lines.numbers[numbers[np.argmin(counts)]]
        raise SceneError(f"{str(path)!r}: line {line}: {keyword} needs {least} numbers, got {counts.min()}")
    if (counts == counts[0]).all() and counts[0] >= width:
        return values.reshape(len(numbers), -1)[:, :width]
    starts = np.cumsum(counts) - counts
    rows = np.zeros((len(numbers), width))
    for column in range(width):
        has = counts > column
        rows[has, column] = values[starts[has] + column]
    return rows


def _vertices(lines: _Lines, path: object, findings: Findings) -> tuple[np.ndarray, np.ndarray | None]:
    """Return positions and colours: ``v x y z``, with a weight that is not read, or ``v x y z r g b``."""
    text, numbers = lines.text(VERTEX)
    counts = _counts(text) if len(numbers) else np.zeros(1, np.int64)
    if counts.max() < 6:
        return _rows(lines, VERTEX, 3, path, "v"), None
    if counts.max() > 6:
        findings.add("more than six numbers of a vertex", f"line {lines.numbers[numbers[np.argmax(counts > 6)]]}")
    rows = _rows(lines, VERTEX, 6, path, "v", least=3)
    has = counts >= 6
    colors, scale = rows[:, 3:], 1.0
    most = float(np.nanmax(colors[has], initial=0.0))
    if most > NOT_ROUNDING:
        findings.add("colours of vertices above 1")
        if most > 2.0 or (np.mod(colors[has], 1.0) == 0.0).all():
            scale = 1.0 / 255.0
    return rows[:, :3], np.where(has[:, None], colors * scale, 1.0)


def _faces(lines: _Lines, path: object) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the numbers of each corner [corner, 3] (0 is none), each face's size, and each face's line."""
    text, numbers = lines.text(FACE)
    if not len(numbers):
        return np.empty((0, 3), np.int64), np.empty(0, np.int64), numbers
    words = _word_starts(text)
    sizes = np.diff(np.searchsorted(words, np.flatnonzero(text == NEWLINE)), prepend=0)
    text = np.concatenate([np.full(2, SPACE, np.uint8), text])
    slash = text == SLASH
    values = _numbers(np.where(slash, np.uint8(SPACE), text), lines.numbers[numbers], path, "f", np.int64)
    separated = (text <= SPACE) | slash
    number_starts = ~separated
    number_starts[1:] &= separated[:-1]
    at = np.flatnonzero(number_starts)
    # how many slashes stand before a number: 0 at the begin of a corner, 2 where a field is empty
    step = np.where(slash[at - 1], np.where(slash[at - 2], np.int8(2), np.int8(1)), np.int8(0))
    before = np.concatenate([np.zeros(1, np.int8), step[:-1]])
    fields = np.where(step > 0, step + before, np.int8(0))
    firsts = step == 0
    if len(values) != len(at) or np.count_nonzero(firsts) != len(words) or (len(fields) and fields.max() > 2):
        raise SceneError(_wrong_corner(text, lines.numbers[numbers], path))
    if len(values) == 3 * len(words) and (fields.reshape(-1, 3) == (0, 1, 2)).all():
        return values.reshape(-1, 3), sizes, numbers
    if (np.diff(np.flatnonzero(firsts), append=len(at)) > 3).any():
        raise SceneError(_wrong_corner(text, lines.numbers[numbers], path))
    corners = np.zeros((len(words), 3), np.int64)
    corners[np.cumsum(firsts) - 1, fields] = values
    return corners, sizes, numbers


def _wrong_corner(text: np.ndarray, lines: np.ndarray, path: object) -> str:
    """Return a message about the first corner of a text of faces that is not written like one."""
    like = "the corners of a face must be like 1, 1/2, 1//3 or 1/2/3"
    for number, line in zip(lines.tolist(), text.tobytes().decode("latin-1").split("\n"), strict=False):
        for word in line.split():
            if not CORNER.fullmatch(word):
                return f"{str(path)!r}: line {number}: {like}, got {word[:40]!r}"
    return f"{str(path)!r}: {like}"


def _resolve(
    lines: _Lines, corners: np.ndarray, sizes: np.ndarray, face_lines: np.ndarray, given: tuple[int, ...], path: object
) -> None:
    """Turn the numbers of corners into indices from 0, -1 for none; negative ones count back from their line."""
    for column, what in enumerate(("vertex", "texture coordinate", "normal")):
        values = corners[:, column]
        indices = values - 1
        if (values < 0).any():
            before = np.cumsum(lines.kinds == (VERTEX, COORDINATE, NORMAL)[column])[np.repeat(face_lines, sizes)]
            indices = np.where(values < 0, before + values, indices)
        wrong = (indices >= given[column]) | ((values < 0) & (indices < 0)) | ((values == 0) & (column == 0))
        if wrong.any():
            corner = int(np.argmax(wrong))
            line = lines.numbers[np.repeat(face_lines, sizes)[corner]]
            raise SceneError(
                f"{str(path)!r}: line {line}: a face names {what} {values[corner]}, which is out of range:"
                f" the file has {given[column]}"
            )
        corners[:, column] = indices
