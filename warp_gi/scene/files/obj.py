"""OBJ files: one node a material; see ``mtl`` for materials."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np

from warp_gi.color import decode_srgb
from warp_gi.errors import SceneError
from warp_gi.scene.files.images import OutsideError, check_inside, find_file
from warp_gi.scene.files.mtl import ELSEWHERE, MtlMaterial, MtlReader, read_mtl, unquoted
from warp_gi.scene.files.obj_text import ObjStatements, parse
from warp_gi.scene.files.parts import SceneParts
from warp_gi.scene.files.polygons import triangulate
from warp_gi.scene.files.support import MOST_PLACES, Findings
from warp_gi.scene.files.text import read_bytes, without_comment
from warp_gi.scene.model import Mesh, Node
from warp_gi.scene.textures import TEXTURE_SLOTS


def read_obj(path: Path) -> SceneParts:
    """Read an .obj file and the .mtl files it names, one node a material; raises SceneError."""
    findings = Findings()
    obj = parse(read_bytes(path), path, findings)
    statements: dict[str, MtlMaterial] = {}
    for line in dict.fromkeys(obj.libraries):
        for file in _libraries(line, path, findings):
            statements = {**read_mtl(file), **statements}
    _name_materials(obj, statements)
    unknown = [name for name in obj.materials if name not in statements]
    if unknown and not obj.libraries:
        findings.lost.append(f"{str(path)!r} names {_list(unknown)} and no library (mtllib); plain grey")
    elif unknown and not any("is missing" in line for line in findings.lost):
        findings.lost.append(
            f"{str(path)!r}: {_list(unknown)} {'is' if len(unknown) == 1 else 'are'} not in its library; plain grey"
        )
    if (obj.face_smooth & (obj.corners[np.cumsum(obj.sizes) - obj.sizes, 2] < 0)).any():
        findings.add("smoothing groups")
    reader = MtlReader(path, statements, findings)
    triangles, faces = triangulate(obj.points, obj.corners[:, 0], obj.sizes)
    materials = obj.face_materials[faces]
    nodes = []
    for index in dict.fromkeys(obj.face_materials.tolist()):
        name = obj.materials[index] if index >= 0 else None
        mesh = _mesh(obj, triangles[materials == index], reader, name, path.stem)
        if (
            any(getattr(mesh.material, slot) is not None for slot in TEXTURE_SLOTS)
            and (obj.corners[triangles[materials == index].reshape(-1), 1] < 0).any()
        ):
            findings.add("textures without their coordinates", f"material {mesh.material.name!r}")
        nodes.append(Node(mesh.name, [mesh]))
    return SceneParts(nodes, findings=findings)


def _list(names: list[str]) -> str:
    """Return the first names of materials, and how many there are more."""
    few = ", ".join(map(repr, names[:MOST_PLACES]))
    more = f" and {len(names) - MOST_PLACES:,} more" if len(names) > MOST_PLACES else ""
    return f"{'material' if len(names) == 1 else 'materials'} {few}{more}"


def _name_materials(obj: ObjStatements, statements: dict[str, MtlMaterial]) -> None:
    """Give the materials of faces their names in the libraries: a name may hold "#", or a comment stand behind it."""
    commented: dict[str, list[str]] = {}
    for name in statements:
        if "#" in name.split()[1:]:
            commented.setdefault(without_comment(name), []).append(name)
    for short, names in commented.items():
        if len(names) == 1:
            statements.setdefault(short, statements[names[0]])
    named = [name if name in statements else without_comment(name) for name in obj.materials]
    named = [name if name in statements else whole for name, whole in zip(named, obj.materials, strict=True)]
    obj.materials = list(dict.fromkeys(named))
    index_of = np.array([*(obj.materials.index(name) for name in named), -1])
    obj.face_materials = index_of[obj.face_materials]


def _libraries(line: str, path: Path, findings: Findings) -> list[Path]:
    """Return the files that a ``mtllib`` names: one name, blanks and all, or several with blanks between."""
    short = without_comment(line)
    found: list[Path] = []
    missing: SceneError | None = None
    for names in ([unquoted(line)], line.split(), [unquoted(short)], short.split()):
        found, missing = [], None
        for name in names:
            bare, what = re.split(r"[\\/]", name)[-1], f"{str(path)!r}: material library"
            try:
                if os.path.isabs(name):
                    check_inside(Path(name), f"{what} {name!r}")
                place = bare if ELSEWHERE.match(name) and not os.path.isfile(name) else name
                found.append(find_file(path.parent, place, what))
            except OutsideError:
                raise
            except SceneError as error:
                missing = missing or error
        if missing is None:
            break
    if missing is not None:
        findings.lost.append(f"{missing}; its materials become plain grey")
    return found


def _mesh(obj: ObjStatements, triangles: np.ndarray, reader: MtlReader, name: str | None, otherwise: str) -> Mesh:
    """Return triangles [n, 3] of corners as a mesh, whose vertices are the distinct corners."""
    material, transform = reader.material(name, obj.colors is not None)
    corners = obj.corners[triangles.reshape(-1)]
    rows, indices = _distinct(corners, (len(obj.points), len(obj.uvs), len(obj.normals)))
    vertex, coordinate, normal = rows.T
    uvs = None
    if (coordinate >= 0).any():
        uvs = np.where(coordinate[:, None] >= 0, obj.uvs[coordinate], 0.0)
        if transform is not None:
            uvs = uvs @ transform[:, :2].T + transform[:, 2]
    normals = None
    if (normal >= 0).any():
        normals = np.where(normal[:, None] >= 0, obj.normals[normal], 0.0).astype(np.float32)
    return Mesh(
        obj.points[vertex],
        indices.reshape(-1, 3).astype(np.int32),
        material,
        normals,
        None if uvs is None else uvs.astype(np.float32),
        name or otherwise,
        colors=None if obj.colors is None else decode_srgb(np.clip(obj.colors[vertex], 0.0, 1.0)).astype(np.float32),
    )


def _distinct(corners: np.ndarray, given: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct rows of corners [n, 3] and the row of each corner [n]; -1 is none in a column."""
    vertex = corners[:, 0]
    if all((column < 0).all() or np.array_equal(column, vertex) for column in corners[:, 1:].T):
        used = np.zeros(given[0], bool)
        used[vertex] = True
        first = np.zeros(given[0], np.int64)
        first[vertex] = np.arange(len(vertex))
        return corners[first[used]], (np.cumsum(used) - 1)[vertex]
    key = (vertex * (given[1] + 1) + corners[:, 1] + 1) * (given[2] + 1) + corners[:, 2] + 1
    if given[0] * (given[1] + 1) * (given[2] + 1) >= 2**62:
        return np.unique(corners, axis=0, return_inverse=True)
    _, first, indices = np.unique(key, return_index=True, return_inverse=True)
    return corners[first], indices
