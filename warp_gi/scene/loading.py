"""Scenes from files."""

from __future__ import annotations

import os
import struct
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from warp_gi.errors import OptionError, SceneError, one_line, unknown_name
from warp_gi.files import user_path
from warp_gi.scene.environment import Sky
from warp_gi.scene.files.from_trimesh import is_trimesh, trimesh_parts
from warp_gi.scene.files.images import missing_file, restricted_to
from warp_gi.scene.files.parts import SceneParts
from warp_gi.scene.pinhole import offset_text
from warp_gi.scene.scene import Scene

if TYPE_CHECKING:
    import trimesh

EXTENSIONS = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off")

UPRIGHT = {
    "x": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
}
"""Rotation that makes an axis of a file y."""
LARGEST_STEP = 0.001
"""Distance in metres between neighbouring float32 coordinates from which a scene is recentred."""
DAMAGE = (ArithmeticError, AttributeError, EOFError, LookupError, NameError, OSError, TypeError, ValueError)
"""Exceptions that readers, trimesh's among them, raise on damaged files."""


def load_scene(
    path: str | os.PathLike[str] | trimesh.Trimesh | trimesh.Scene,
    environment: Sky = None,
    smooth: float | None = None,
    scale: float = 1.0,
    recentre: bool | None = None,
    up: Literal["x", "y", "z"] = "y",
    restrict_paths: bool = False,
) -> Scene:
    """Load a scene from a GLB, glTF, OBJ (with MTL), PLY, STL or OFF file, or from an object of trimesh.

    Args:
        path: The file; textures and buffers it names are looked up beside it. Or a ``trimesh.Trimesh`` or
            ``trimesh.Scene``, whose materials, colours and transforms are taken.
        environment: A path to a sky map, an RGB radiance, an Environment, a SunSky, or None for black.
        smooth: Crease angle in degrees. Meshes without normals get smooth ones except across
            edges that bend more than this; None leaves them flat, as glTF asks.
        scale: Metres in one unit of the file. Radiance and intensities are left as they are. Where a file has points
            alone, as OBJ and PLY, these are scaled and turned (``up``): keyframes for ``Scene.animate`` move them in
            metres. Nodes of glTF have it in their placement, which keyframes replace.
        recentre: Whether to take the middle of the scene, in whole units, from all positions in double precision.
            ``Scene.offset`` is what was taken: nodes, bounds and the buffer "position" are without it. Cameras, and
            keyframes for ``Scene.animate``, are still given in the file's coordinates. None does so, with a warning,
            where float32 has steps of more than a millimetre.
        up: Axis of the file that points up, and becomes y. Where it is z, as in surveys and CAD, (x, y, z) of the file
            is (x, z, -y) of the scene. All else, cameras too, is then given in the turned coordinates.
        restrict_paths: Whether buffers, textures and libraries that the file names may only lie in its folder or below,
            links and ".." followed: for files of strangers. Others are an error before they are opened.

    Gives an UnsupportedWarning for each feature that the file uses and this library does not read in full.
    Raises SceneError if the file or anything it names is missing, damaged or unusable: one line.
    """
    if smooth is not None and not 0.0 <= smooth <= 180.0:
        raise OptionError(f"smooth must be an angle from 0 to 180 degrees, got {smooth}")
    if not (np.isfinite(scale) and scale > 0.0):
        raise OptionError(f"scale must be a finite number above 0, got {scale}")
    if up not in UPRIGHT:
        raise unknown_name("axis that points up", up, UPRIGHT)
    if isinstance(path, str | os.PathLike):
        if not str(path):
            raise SceneError("the name of the scene file is empty; give a GLB, glTF, OBJ or PLY file")
        path = user_path(path)
        with restricted_to(path.parent if restrict_paths else None):
            name, told, parts = path.stem, str(path), _file_parts(path)
    elif is_trimesh(path):
        name, told, parts = "trimesh", "the trimesh object", trimesh_parts(path)
    else:
        raise OptionError(f"expected the path of a scene file or an object of trimesh, got a {type(path).__name__}")
    parts.findings.warn(told, stacklevel=2)
    parts = _recentred(parts, told, scale, recentre).single()
    if smooth is not None:
        parts = parts.smoothed(smooth)
    if scale != 1.0:
        parts = parts.scaled(scale)
    if up != "y":
        parts = parts.turned(np.array(UPRIGHT[up], np.float64))
    if not any(len(mesh.indices) for node in parts.nodes for mesh in node.meshes):
        raise SceneError(f"{told!r} holds no triangles; export it with faces")
    scene = Scene(parts.nodes, parts.lights, environment, parts.cameras, name, parts.camera_nodes)
    scene.offset = parts.offset
    return scene


def _recentred(parts: SceneParts, told: str, scale: float, recentre: bool | None) -> SceneParts:
    """Return the parts around the origin, if that is asked for, or is needed and not refused."""
    if recentre is False:
        return parts
    offset = np.round(parts.middle())
    farthest = float(np.abs(offset).max()) * scale
    step = float(np.spacing(np.float32(farthest)))
    if recentre is None and not step > LARGEST_STEP:
        _warn_of_extent(parts, told, scale)
        return parts
    if recentre is None:
        warnings.warn(
            f"{told!r} lies {farthest:,.0f} m from its origin, where float32 has steps of {1000 * step:.3g} mm:"
            f" recentred by {offset_text(scale * offset)} m; cameras are still in the file's coordinates",
            stacklevel=3,
        )
    moved = parts.recentred(offset)
    _warn_of_extent(moved, told, scale)
    return moved


def _warn_of_extent(parts: SceneParts, told: str, scale: float) -> None:
    """Warn of parts that reach so far from their origin that no offset gives them fine coordinates."""
    low, high = parts.bounds() * scale
    farthest = float(max(np.abs(low).max(), np.abs(high).max()))
    step = float(np.spacing(np.float32(farthest)))
    if step > LARGEST_STEP:
        extent = " x ".join(f"{side:,.0f}" for side in high - low)
        warnings.warn(
            f"{told!r} is {extent} m large and reaches {farthest:,.0f} m from the origin, where float32 has steps of"
            f" {1000 * step:.3g} mm; leave out what is far away, or load it in parts",
            stacklevel=4,
        )


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
    if suffix == ".stl":
        from warp_gi.scene.files.stl import read_stl

        return read_stl(path)
    from warp_gi.scene.files.off import read_off

    return read_off(path)
