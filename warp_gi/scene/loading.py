"""Scenes from files."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warp_gi.errors import OptionError, SceneError, one_line
from warp_gi.scene.environment import Sky
from warp_gi.scene.files.from_trimesh import is_trimesh, trimesh_parts
from warp_gi.scene.files.images import missing_file
from warp_gi.scene.files.parts import SceneParts
from warp_gi.scene.geometry import triangulated
from warp_gi.scene.model import Material, Mesh, Node
from warp_gi.scene.scene import Scene

if TYPE_CHECKING:
    import trimesh

EXTENSIONS = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off")

DAMAGE = (ArithmeticError, AttributeError, EOFError, LookupError, NameError, OSError, TypeError, ValueError)
"""Exceptions that readers, trimesh's among them, raise on damaged files."""


def load_scene(
    path: str | os.PathLike[str] | trimesh.Trimesh | trimesh.Scene,
    environment: Sky = None,
    smooth: float | None = None,
    scale: float = 1.0,
) -> Scene:
    """Load a scene from a GLB, glTF, OBJ (with MTL), PLY, STL or OFF file, or from an object of trimesh.

    Args:
        path: The file; textures and buffers it names are looked up beside it. Or a ``trimesh.Trimesh`` or
            ``trimesh.Scene``, whose materials, colours and transforms are taken.
        environment: A path to a sky map, an RGB radiance, an Environment, a SunSky, or None for black.
        smooth: Crease angle in degrees. Meshes without normals get smooth ones except across
            edges that bend more than this; None leaves them flat, as glTF asks.
        scale: Metres in one unit of the file. Radiance and intensities are left as they are.

    Gives an UnsupportedWarning for each feature that the file uses and this library does not read in full.
    Raises SceneError if the file or anything it names is missing, damaged or unusable: one line.
    """
    if smooth is not None and not 0.0 <= smooth <= 180.0:
        raise OptionError(f"smooth must be an angle from 0 to 180 degrees, got {smooth}")
    if not (np.isfinite(scale) and scale > 0.0):
        raise OptionError(f"scale must be a finite number above 0, got {scale}")
    if isinstance(path, str | os.PathLike):
        path = Path(path)
        name, told, parts = path.stem, str(path), _file_parts(path)
    elif is_trimesh(path):
        name, told, parts = "trimesh", "the trimesh object", trimesh_parts(path)
    else:
        raise OptionError(f"expected the path of a scene file or an object of trimesh, got a {type(path).__name__}")
    parts.findings.warn(told, stacklevel=2)
    if smooth is not None:
        parts = parts.smoothed(smooth)
    if scale != 1.0:
        parts = parts.scaled(scale)
    if not any(len(mesh.indices) for node in parts.nodes for mesh in node.meshes):
        raise SceneError(f"{told!r} holds no triangles; export it with faces")
    return Scene(parts.nodes, parts.lights, environment, parts.cameras, name, parts.camera_nodes)


def _file_parts(path: Path) -> SceneParts:
    """Return the contents of a scene file."""
    suffix = path.suffix.lower()
    if not path.is_file():
        raise missing_file(path, "scene file")
    if suffix not in EXTENSIONS:
        raise SceneError(f"{str(path)!r}: unknown kind of file {suffix!r}; expected one of {', '.join(EXTENSIONS)}")
    try:
        return _read(path, suffix)
    except SceneError:
        raise
    except (*DAMAGE, struct.error) as error:
        reason = one_line(error)[:200]
        kind = suffix[1:].upper()
        raise SceneError(
            f"{str(path)!r} cannot be read as {kind} ({type(error).__name__}: {reason}); export or copy it again"
        ) from error


def _read(path: Path, suffix: str) -> SceneParts:
    if suffix in (".glb", ".gltf"):
        from warp_gi.scene.files.gltf import read_gltf

        return read_gltf(path)
    if suffix == ".obj":
        from warp_gi.scene.files.obj import read_obj

        return read_obj(path)
    if suffix == ".ply":
        from warp_gi.scene.files.ply import read_ply

        return read_ply(path)
    return _read_single_mesh(path, suffix)


def _read_single_mesh(path: Path, suffix: str) -> SceneParts:
    """Read a file that holds one mesh without materials: STL or OFF."""
    from trimesh.exchange.load import mesh_loaders

    with path.open("rb") as file:
        contents = mesh_loaders[suffix[1:]](file, file_type=suffix[1:])
    points, faces = contents.get("vertices"), contents.get("faces")
    if points is None or faces is None or not len(faces):
        raise SceneError(f"{str(path)!r} holds no triangles; export it with faces")
    normals = contents.get("vertex_normals")
    if normals is not None and np.shape(normals) != np.shape(points):
        normals = None
    mesh = Mesh(
        np.asarray(points, np.float32),
        triangulated(np.asarray(faces)),
        Material(path.stem, specular=0.0),
        None if normals is None else np.asarray(normals, np.float32),
        getattr(contents.get("visual"), "uv", None),
        path.stem,
    )
    return SceneParts([Node(path.stem, [mesh])])
