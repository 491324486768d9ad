"""STL files, binary and ASCII: one mesh of triangles that share no vertices, all solids together."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from warp_gi.errors import SceneError
from warp_gi.scene.files.parts import SceneParts
from warp_gi.scene.files.support import Findings
from warp_gi.scene.model import Material, Mesh, Node

HEAD = 84  # bytes of a binary file before its triangles: 80 of any text, and their number
FACET = np.dtype([("normal", "<f4", 3), ("points", "<f4", (3, 3)), ("color", "<u2")])
VERTEX = re.compile(rb"\bvertex\b([^\n\r]*)", re.IGNORECASE)
HAS_COLOR = 1 << 15
"""Flag of a facet's last two bytes, by which they are a colour."""


def read_stl(path: Path) -> SceneParts:
    """Read an STL file; raises SceneError. Normals of facets follow from their corners."""
    data, findings = path.read_bytes(), Findings()
    is_text = re.match(rb"\s*solid\b", data, re.IGNORECASE) and re.search(rb"\bfacet\b", data[:4096], re.IGNORECASE)
    if is_text and len(data) != HEAD + FACET.itemsize * _count(data):
        points = _text(data, path)
    else:
        points = _binary(data, path, findings)
    mesh = Mesh(points, np.arange(len(points), dtype=np.int32).reshape(-1, 3), Material(path.stem, specular=0.0))
    mesh.name = path.stem
    return SceneParts([Node(path.stem, [mesh])], findings=findings)


def _count(data: bytes) -> int:
    """Return the number of triangles that a binary file says it has."""
    return int.from_bytes(data[HEAD - 4 : HEAD], "little")


def _binary(data: bytes, path: Path, findings: Findings) -> np.ndarray:
    if len(data) < HEAD:
        raise SceneError(f"{str(path)!r} is no STL file: it has neither facets in text nor {HEAD} bytes before them")
    count = _count(data)
    needed = HEAD + FACET.itemsize * count
    if needed > len(data):
        raise SceneError(
            f"{str(path)!r} is truncated: its {count:,} triangles take {needed:,} bytes, it has {len(data):,};"
            " copy it again"
        )
    facets = np.frombuffer(data, FACET, count, HEAD)
    if b"COLOR=" in data[:80] or (facets["color"] & HAS_COLOR).any():
        findings.add("colours of faces")
    return facets["points"].reshape(-1, 3).astype(np.float32)


def _text(data: bytes, path: Path) -> np.ndarray:
    rows = [match[1].split() for match in VERTEX.finditer(data)]
    try:
        points = np.array(rows, np.float64).reshape(len(rows), 3)
    except ValueError:
        raise SceneError(_wrong_vertex(data, path)) from None
    if len(points) % 3:
        raise SceneError(f"{str(path)!r} is truncated: it has {len(points):,} vertices, not 3 a facet; copy it again")
    return points


def _wrong_vertex(data: bytes, path: Path) -> str:
    """Return a message about the first vertex that is not three numbers."""
    for match in VERTEX.finditer(data):
        try:
            wrong = len([float(word) for word in match[1].split()]) != 3
        except ValueError:
            wrong = True
        if wrong:
            line = len(re.findall(rb"\r\n|\n|\r", data[: match.start()])) + 1
            given = match[1].decode("latin-1").strip()[:60]
            return f"{str(path)!r}: line {line}: vertex must have 3 numbers, got {given!r}"
    return f"{str(path)!r}: its vertices must have 3 numbers each"
