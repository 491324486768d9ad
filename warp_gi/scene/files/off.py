"""OFF files in text: polygons of any number of corners, with colours, normals and texture coordinates of vertices."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from warp_gi.color import decode_srgb
from warp_gi.errors import SceneError
from warp_gi.scene.files.parts import SceneParts
from warp_gi.scene.files.polygons import triangulate
from warp_gi.scene.files.support import Findings
from warp_gi.scene.files.text import decode, read_bytes
from warp_gi.scene.model import Material, Mesh, Node

KEYWORD = re.compile(r"(ST)?(C)?(N)?(4)?(n)?OFF\b\s*(BINARY\b)?")
"""First word of a file, as Geomview writes it; what stands before OFF is what a vertex has."""


def read_off(path: Path) -> SceneParts:
    """Read an OFF file: one mesh; raises SceneError."""
    findings = Findings()
    numbers, lines = _lines(decode(read_bytes(path)))
    match = KEYWORD.match(lines[0]) if lines else None
    if match is None:
        raise SceneError(f"{str(path)!r} is no OFF file: it does not begin with OFF")
    if match[4] or match[5] or match[6]:
        raise SceneError(
            f"{str(path)!r} is OFF with {match[0].strip()!r}, which is not supported; export it as OFF in text,"
            " with three numbers a point"
        )
    lines[0] = lines[0][match.end() :].strip()
    if not lines[0]:
        del numbers[0], lines[0]
    counts = _values(path, numbers[0], lines[0]) if lines else []
    if len(counts) < 2 or any(count < 0 or count % 1 for count in counts):
        raise SceneError(f"{str(path)!r}: its numbers of vertices, faces and edges are missing; export it again")
    vertices, faces = int(counts[0]), int(counts[1])
    if len(lines) - 1 < vertices + faces:
        raise SceneError(
            f"{str(path)!r} is truncated: it should have {vertices:,} vertices and {faces:,} faces, and has"
            f" {len(lines) - 1:,} lines of them; copy it again"
        )
    rows = [_values(path, n, line) for n, line in zip(numbers[1:], lines[1 : 1 + vertices], strict=False)]
    fields = _fields(path, rows, has_normals=bool(match[3]), has_uvs=bool(match[1]))
    corners, sizes = _faces(
        path, numbers[1 + vertices :], lines[1 + vertices : 1 + vertices + faces], vertices, findings
    )
    mesh = _mesh(path, fields, corners, sizes)
    return SceneParts([Node(path.stem, [mesh])], findings=findings)


def _lines(text: str) -> tuple[list[int], list[str]]:
    """Return the lines that say something, without comments, and their numbers from 1."""
    bare = [line.partition("#")[0].strip() for line in text.splitlines()]
    return [n for n, line in enumerate(bare, 1) if line], [line for line in bare if line]


def _values(path: Path, number: int, line: str) -> list[float]:
    try:
        return [float(word) for word in line.split()]
    except ValueError:
        raise SceneError(f"{str(path)!r}: line {number}: expected numbers, got {line[:60]!r}") from None


def _fields(path: Path, rows: list[list[float]], has_normals: bool, has_uvs: bool) -> dict[str, np.ndarray]:
    """Return points, and normals, colors and uvs if there are any, float64 [vertex, width] each."""
    widths = {len(row) for row in rows}
    if len(widths) > 1 or (rows and min(widths) < 3):
        raise SceneError(f"{str(path)!r}: its vertices have {min(widths)} to {max(widths)} numbers; export it again")
    values = np.array(rows, np.float64).reshape(len(rows), -1)
    fields, at = {"points": values[:, :3]}, 3
    if has_normals:
        fields["normals"], at = values[:, at : at + 3], at + 3
    if has_uvs:
        fields["uvs"], values = values[:, -2:], values[:, :-2]
    if values.shape[1] - at in (3, 4):  # with and without a C before OFF
        fields["colors"] = values[:, at:]
    return fields


def _faces(
    path: Path, numbers: list[int], lines: list[str], vertices: int, findings: Findings
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of all faces, one after another, and the number of each face's."""
    corners: list[int] = []
    sizes: list[int] = []
    for number, line in zip(numbers, lines, strict=False):
        words = line.split()
        try:
            size = int(words[0])
            face = [int(word) for word in words[1 : 1 + size]]
        except ValueError:
            raise SceneError(f"{str(path)!r}: line {number}: expected a face, got {line[:60]!r}") from None
        if len(face) < size or size < 1:
            raise SceneError(f"{str(path)!r}: line {number}: a face of {size} corners names {len(face)}")
        if not (min(face) >= 0 and max(face) < vertices):
            wrong = next(index for index in face if not 0 <= index < vertices)
            raise SceneError(
                f"{str(path)!r}: line {number}: index {wrong} is out of range, there are {vertices} vertices"
            )
        if len(words) > 1 + size:
            findings.add("colours of faces")
        if size < 3:
            findings.add("faces of fewer than three corners", f"line {number}")
            continue
        corners += face
        sizes.append(size)
    return np.array(corners, np.int64), np.array(sizes, np.int64)


def _mesh(path: Path, fields: dict[str, np.ndarray], corners: np.ndarray, sizes: np.ndarray) -> Mesh:
    points, normals, uvs = fields["points"], fields.get("normals"), fields.get("uvs")
    colors = _linear(fields["colors"]) if "colors" in fields else None
    grey = (0.8, 0.8, 0.8) if colors is None else (1.0, 1.0, 1.0)
    return Mesh(
        points,
        corners[triangulate(points, corners, sizes)[0]].astype(np.int32),
        Material(path.stem, grey, specular=0.0, alpha_blend=colors is not None and bool((colors[:, 3:] < 1.0).any())),
        None if normals is None else normals.astype(np.float32),
        None if uvs is None else uvs.astype(np.float32),
        path.stem,
        colors=colors,
    )


def _linear(colors: np.ndarray) -> np.ndarray:
    """Return colours as float32, linear, with coverage where there are four numbers; above 1 they are of 255."""
    values = np.clip(np.nan_to_num(colors) / (255.0 if np.nanmax(colors, initial=0.0) > 1.0 else 1.0), 0.0, 1.0)
    values[:, :3] = decode_srgb(values[:, :3])
    return values.astype(np.float32)
