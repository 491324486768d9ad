"""PLY files: polygons of any number of corners, ASCII and binary of both byte orders, with normals, uv and colours.

Elements are read as whole arrays. Only rows with lists of differing length, in which nothing says where the next one
begins, are walked one by one.
"""

from __future__ import annotations

import re
import struct
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warp_gi.color import decode_srgb
from warp_gi.errors import SceneError
from warp_gi.scene.files.parts import SceneParts
from warp_gi.scene.files.polygons import triangulate
from warp_gi.scene.files.support import Findings
from warp_gi.scene.files.text import read_bytes
from warp_gi.scene.model import Material, Mesh, Node

TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
BYTE_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
FORMATS = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}
UV_NAMES = (("u", "v"), ("s", "t"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
COLOR_NAMES = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
LINE_END = re.compile(rb"\r\n|\n|\r")
INDEX_NAMES = ("vertex_indices", "vertex_index")
READ = ("vertex", "face", "tristrips")
"""Elements that are read."""


@dataclass
class Property:
    """A property of an element; ``count`` is the type of a list's length."""

    name: str
    kind: str
    count: str | None = None


@dataclass
class Element:
    """An element of the header and, once it is read, its values."""

    name: str
    count: int
    properties: list[Property] = field(default_factory=list)
    values: dict[str, np.ndarray] = field(default_factory=dict)
    """Values of each property [row], of a list all values, row after row."""
    sizes: dict[str, np.ndarray] = field(default_factory=dict)
    """Number of values of each row of a list, int64 [row]."""

    def columns(self, names: Sequence[str]) -> np.ndarray | None:
        """Return properties side by side [row, name], or None unless all are there."""
        return np.stack([self.values[name] for name in names], axis=1) if set(names) <= self.values.keys() else None

    def kind(self, name: str) -> str:
        """Return the type of a property as in the header, such as "u1"."""
        return next(one.kind for one in self.properties if one.name == name)


def read_ply(path: Path) -> SceneParts:
    """Read a PLY file: one mesh; raises SceneError."""
    data, findings = read_bytes(path), Findings()
    elements, order, body = _header(data, path)
    _read_body(data, body, elements, order, path)
    by_name = {element.name: element for element in elements}
    vertices, faces = by_name.get("vertex"), by_name.get("face")
    points = vertices.columns("xyz") if vertices is not None else None
    if vertices is None or points is None:
        raise SceneError(f"{str(path)!r} has no vertices with x, y and z; export it again")
    _note(elements, data[:body], findings)
    corners, sizes = _lists(faces)
    strips = _strip_triangles(*_lists(by_name.get("tristrips")))
    corners, sizes = np.concatenate([corners, strips]), np.concatenate([sizes, np.full(len(strips) // 3, 3)])
    if not len(sizes):
        findings.warn(path, stacklevel=4)
        names = ", ".join(f"{element.count:,} of {element.name[:40]!r}" for element in elements)
        raise SceneError(f"{str(path)!r} holds no triangles (its elements: {names}); export it with faces")
    mesh = _mesh(vertices, points, corners, sizes, path, findings)
    return SceneParts([Node(path.stem, [mesh])], findings=findings)


def _lists(element: Element | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the lists of vertices of an element, one after the other, and the length of each."""
    name = next((one for one in INDEX_NAMES if element is not None and one in element.sizes), None)
    if element is None or name is None:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    return element.values[name], element.sizes[name]


def _strip_triangles(strips: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return the corners of all triangles of strips, three for each; every second one is turned around.

    A negative index ends a strip, as the end of its list does. Triangles that name a vertex twice are left out.
    """
    ends = np.cumsum(sizes)
    at = np.arange(len(strips))
    breaks = np.zeros(len(strips) + 1, bool)  # whether a strip begins here
    breaks[ends - sizes] = True
    breaks[1:] |= strips < 0
    begin = np.maximum.accumulate(np.where(breaks[:-1], at, 0))
    last = at - begin >= 2
    last[2:] &= (strips[2:] >= 0) & (strips[1:-1] >= 0) & (strips[:-2] >= 0)
    third = np.flatnonzero(last)
    is_odd = (third - begin[third]) % 2 == 1
    corners = np.stack([strips[third - 2 + is_odd], strips[third - 1 - is_odd], strips[third]], axis=1)
    distinct = (corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2]) & (corners[:, 0] != corners[:, 2])
    return corners[distinct].reshape(-1)


def _header(data: bytes, path: Path) -> tuple[list[Element], str, int]:
    """Return the elements, the format, and where the body begins."""
    elements: list[Element] = []
    order = ""
    lines, at = _header_lines(data, path)
    for line in lines:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        try:
            if words[0] == "format":
                order = words[1]
            elif words[0] == "element":
                elements.append(Element(words[1], int(words[2])))
                if elements[-1].count < 0:
                    raise ValueError
            elif words[0] == "property" and words[1] == "list":
                elements[-1].properties.append(Property(words[4], TYPES[words[3]], TYPES[words[2]]))
            elif words[0] == "property":
                elements[-1].properties.append(Property(words[2], TYPES[words[1]]))
            else:
                raise ValueError
        except (IndexError, KeyError, ValueError):
            raise SceneError(f"{str(path)!r} cannot be read as PLY: its header has {line.strip()[:60]!r}") from None
    if order not in BYTE_ORDERS:
        raise SceneError(
            f"{str(path)!r} cannot be read as PLY: its format must be {', '.join(BYTE_ORDERS)}, got {order!r}"
        )
    return elements, order, at


def _header_lines(data: bytes, path: Path) -> tuple[list[str], int]:
    """Return the lines between the first one and ``end_header``, and where the body begins."""
    lines: list[bytes] = []
    at, first = 0, LINE_END.search(data)
    if data.startswith(b"ply") and first is not None and b"end_header" in data:
        for match in LINE_END.finditer(data):
            line, at = data[at : match.start()], match.end()
            if line.strip() == b"end_header":
                # after a carriage return alone, a line feed is the first byte of the body
                at = match.start() + 1 if first[0] == b"\r" else at
                return [one.decode("latin-1") for one in lines[1:]], at
            lines.append(line)
        if data[at:].strip() == b"end_header":
            return [one.decode("latin-1") for one in lines[1:]], len(data)
    raise SceneError(f"{str(path)!r} cannot be read as PLY: it has no header from 'ply' to 'end_header'")


def _read_body(data: bytes, body: int, elements: list[Element], order: str, path: Path) -> None:
    """Read the values of all elements."""
    if order == "ascii":
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)
            try:
                data, body = np.fromstring(data[body:], np.float64, sep=" ").tobytes(), 0
            except (DeprecationWarning, ValueError):
                raise SceneError(f"{str(path)!r} cannot be read as PLY: its rows must hold numbers alone") from None
    for element in elements:
        body = _Rows(data, body, element, BYTE_ORDERS[order], order == "ascii", path).read()
    if order == "ascii" and body != len(data):
        more = (len(data) - body) // 8
        raise SceneError(
            f"{str(path)!r} cannot be read as PLY: its rows hold {more:,} numbers more than its header names;"
            " export it again"
        )


class _Rows:
    """Reads the rows of one element. Every number of an ASCII file is a float64 here."""

    def __init__(self, data: bytes, at: int, element: Element, order: str, is_ascii: bool, path: Path) -> None:
        self.data, self.at, self.element, self.order, self.path = data, at, element, order, path
        self.is_ascii = is_ascii

    def _type(self, kind: str) -> np.dtype:
        return np.dtype("<f8" if self.is_ascii else self.order + kind)

    def _short(self) -> SceneError:
        name, count = self.element.name, self.element.count
        return SceneError(
            f"{str(self.path)!r} is truncated: its {count} rows of {name!r} are not all there; copy it again"
        )

    def _left(self, at: int | None = None) -> int:
        """Return the number of bytes from a place, or from the begin of the element, to the end."""
        return len(self.data) - (self.at if at is None else at)

    def read(self) -> int:
        """Fill the element's values; return where the next one begins."""
        element = self.element
        if not element.count or not element.properties:
            for one in element.properties:
                element.values[one.name] = np.empty(0)
                if one.count is not None:
                    element.sizes[one.name] = np.empty(0, np.int64)
            return self.at
        lists = [one for one in element.properties if one.count is not None]
        if element.count * sum(self._type(one.count or one.kind).itemsize for one in element.properties) > self._left():
            raise self._short()  # before there is memory for its rows
        return self._uniform({one.name: self._first_size(one) for one in lists}) or self._walk()

    def _first_size(self, wanted: Property) -> int:
        """Return the length of a list in the first row."""
        at = self.at
        for one in self.element.properties:
            size = 1
            if one.count is not None:
                size = self._number(one.count, at)
                at += self._type(one.count).itemsize
            if size * self._type(one.kind).itemsize > self._left(at):
                raise self._short()
            if one is wanted:
                return size
            at += size * self._type(one.kind).itemsize
        return 0

    def _number(self, kind: str, at: int) -> int:
        """Return one whole number."""
        form = "<d" if self.is_ascii else self.order + FORMATS[kind]
        try:
            value = struct.unpack_from(form, self.data, at)[0]
        except struct.error:
            raise self._short() from None
        if value < 0 or value % 1 != 0:
            raise SceneError(f"{str(self.path)!r} cannot be read as PLY: a list has {value:g} values")
        return int(value)

    def _uniform(self, sizes: dict[str, int]) -> int | None:
        """Read rows whose lists are all as long as those of the first row; None if there are others."""
        element = self.element
        fields: list[Any] = []
        for index, one in enumerate(element.properties):
            if one.count is not None:
                fields.append((f"count {index}", self._type(one.count)))
                fields.append((f"value {index}", self._type(one.kind), (sizes[one.name],)))
            else:
                fields.append((f"value {index}", self._type(one.kind)))
        row = np.dtype(fields)
        end = self.at + row.itemsize * element.count
        if end > len(self.data):
            if sizes:
                return None
            raise self._short()
        rows = np.frombuffer(self.data, row, element.count, self.at)
        for index, one in enumerate(element.properties):
            if one.count is not None and (rows[f"count {index}"] != sizes[one.name]).any():
                return None
        for index, one in enumerate(element.properties):
            element.values[one.name] = rows[f"value {index}"].reshape(-1)
            if one.count is not None:
                element.sizes[one.name] = np.full(element.count, sizes[one.name], np.int64)
        return end

    def _walk(self) -> int:
        """Read rows with lists of any length."""
        element, at = self.element, self.at
        steps = [
            (one.count, one.count and self._type(one.count).itemsize, self._type(one.kind).itemsize)
            for one in element.properties
        ]
        starts = np.empty((len(steps), element.count), np.int64)
        sizes = np.ones((len(steps), element.count), np.int64)
        is_bytes = not self.is_ascii and all(count in (None, "u1") for count, _, _ in steps)
        for row in range(element.count):
            for index, (count, width, size) in enumerate(steps):
                if count is None:
                    starts[index, row] = at
                    at += size
                    continue
                if is_bytes and at < len(self.data):
                    length = self.data[at]
                else:
                    length = self._number(count, at)
                at += width or 0
                if length * size > self._left(at):
                    raise self._short()
                starts[index, row], sizes[index, row] = at, length
                at += length * size
        if at > len(self.data):
            raise self._short()
        raw = np.frombuffer(self.data, np.uint8)
        for index, one in enumerate(element.properties):
            kind, lengths = self._type(one.kind), sizes[index]
            within = np.arange(int(lengths.sum())) - np.repeat(np.cumsum(lengths) - lengths, lengths)
            places = np.repeat(starts[index], lengths) + within * kind.itemsize
            element.values[one.name] = raw[places[:, None] + np.arange(kind.itemsize)].reshape(-1).view(kind)
            if one.count is not None:
                element.sizes[one.name] = lengths
        return at


def _mesh(
    vertices: Element, points: np.ndarray, indices: np.ndarray, sizes: np.ndarray, path: Path, findings: Findings
) -> Mesh:
    if indices.dtype.kind == "f" and not (whole := np.isfinite(indices) & (np.trunc(indices) == indices)).all():
        raise SceneError(f"{str(path)!r}: vertices of faces must be whole numbers, got {indices[~whole][0]:g}")
    corners = indices.astype(np.int64)
    if len(corners) and not (corners.min() >= 0 and corners.max() < len(points)):
        wrong = corners[(corners < 0) | (corners >= len(points))][0]
        raise SceneError(f"{str(path)!r}: index {wrong} is out of range, there are {len(points)} vertices")
    small = sizes < 3
    if small.any():
        findings.add("faces of fewer than three corners")
        corners, sizes = corners[np.repeat(~small, sizes)], sizes[~small]
    normals = vertices.columns(("nx", "ny", "nz"))
    uvs = next((one for one in map(vertices.columns, UV_NAMES) if one is not None), None)
    colors = _colors(vertices)
    grey = (0.8, 0.8, 0.8) if colors is None else (1.0, 1.0, 1.0)
    return Mesh(
        points,
        corners[triangulate(points, corners, sizes)[0]].astype(np.int32),
        Material(path.stem, grey, specular=0.0, alpha_blend=colors is not None and bool((colors[:, 3:] < 1.0).any())),
        None if normals is None else np.ascontiguousarray(normals, np.float32),
        None if uvs is None else np.ascontiguousarray(uvs, np.float32),
        path.stem,
        colors=colors,
    )


def _colors(vertices: Element) -> np.ndarray | None:
    """Return colours of vertices, linear, with coverage where the file has alpha.

    Numbers in files are sRGB-coded, except for alpha, from 0 to the largest of their type.
    Signed and 32-bit integers, and floats above 1, count from 0 to 255 where none is larger.
    """
    for names in COLOR_NAMES:
        colors = vertices.columns(names)
        if colors is None or not len(colors):
            continue
        values = colors.astype(np.float64) / _largest(colors, vertices.kind(names[0]))
        linear = decode_srgb(np.clip(np.nan_to_num(values), 0.0, 1.0)).astype(np.float32)
        alpha = vertices.values.get("alpha")
        if alpha is None:
            return linear
        covered = np.clip(np.nan_to_num(alpha / _largest(alpha, vertices.kind("alpha")), nan=1.0), 0.0, 1.0)
        return np.column_stack([linear, covered.astype(np.float32)])
    return None


def _largest(values: np.ndarray, kind: str) -> float:
    """Return the number in a file that stands for 1."""
    most = float(np.nanmax(values))
    if most <= 255.0 and (kind in ("i2", "i4", "u4") or (kind[0] == "f" and most > 1.0)):
        return 255.0
    return 1.0 if kind[0] == "f" else float(np.iinfo(kind).max)


def _note(elements: list[Element], header: bytes, findings: Findings) -> None:
    """Note what the file holds and is not read."""
    for element in elements:
        if element.name == "edge" and element.count:
            findings.add("points and lines", "element 'edge'")
        elif element.name not in READ and element.count:
            findings.add("other elements of PLY, such as material", f"element {element.name[:40]!r}")
        elif element.name == "face" and any(set(names) <= element.values.keys() for names in COLOR_NAMES):
            findings.add("colours of faces")
    if b"TextureFile" in header or any("texcoord" in element.sizes for element in elements):
        findings.add("textures of PLY")
