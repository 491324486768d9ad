"""The lights of a scene: emissive triangles first, then punctual lights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warp_gi.color import LUMINANCE
from warp_gi.errors import SceneError
from warp_gi.kernels import types
from warp_gi.scene.geometry import FlatGeometry, placed_points, triangle_areas
from warp_gi.scene.model import Material, Node, PunctualLight
from warp_gi.scene.poses import deforms, poses
from warp_gi.scene.textures import box_means, linear_shades, texture_coordinates

LIGHT_KINDS = {
    "point": types.EMITTER_POINT,
    "spot": types.EMITTER_SPOT,
    "directional": types.EMITTER_DIRECTIONAL,
}

SMALLEST_AREA = 1e-18
"""Area in square metres below which a triangle cannot be sampled in float32, and is no emitter."""


LEAST_AREA = 0.01
"""Least area of a triangle of a lamp that changes its size or shape, over the mean of the lamp's triangles."""

UNKNOWN_AREA = 0.01
"""Area in square metres that stands for the mean of a lamp's triangles where that is zero at all sampled times."""


@dataclass(frozen=True, eq=False)
class PlacedEmitters:
    """The emitters of a scene, where they are in the pose of one device; see ``Scene.placed_emitters``."""

    table: np.ndarray
    """Emitters, types.Emitter [emitter]: emissive triangles first, then punctual lights."""
    corners: np.ndarray
    """Corners in world space of the table's emissive triangles, or of smaller ones that hold all that shines of them;
    metres, float64 [emissive triangle, 3, 3]."""
    two_sided: np.ndarray
    """Whether both sides shine, bool [emissive triangle]."""


LARGEST_INTENSITY, LARGEST_POSITION = 1e30, 1e30
"""Past these, squares and products of what kernels compute with leave float32."""


def check_light(light: PunctualLight, nodes: Sequence[Node]) -> None:
    """Raise SceneError where a field of ``light`` is unknown, out of range or not finite."""
    name = f"light {light.name!r}"
    if light.kind not in LIGHT_KINDS:
        raise SceneError(f"{name}: unknown kind {light.kind!r} (known: {', '.join(LIGHT_KINDS)})")
    for label in ("intensity", "position", "direction"):
        values = np.asarray(getattr(light, label), np.float64)
        if values.shape != (3,) or not np.isfinite(values).all():
            raise SceneError(f"{name}: {label} must be 3 finite numbers, got {getattr(light, label)!r}")
    if max(light.intensity) > LARGEST_INTENSITY:
        raise SceneError(f"{name}: intensity must be at most {LARGEST_INTENSITY:g}, got {max(light.intensity):g}")
    if np.abs(light.position).max() > LARGEST_POSITION:
        raise SceneError(f"{name}: position must be within {LARGEST_POSITION:g} m, got {light.position!r}")
    if min(light.intensity) < 0.0:
        raise SceneError(f"{name}: intensity must not be negative, got {light.intensity}")
    if light.kind != "point" and not np.linalg.norm(light.direction) > 1e-12:
        raise SceneError(f"{name}: direction must not be zero")
    if light.kind == "spot" and not 0.0 <= light.inner_cone < light.outer_cone <= np.pi / 2 + 1e-6:
        raise SceneError(
            f"{name}: needs 0 <= inner_cone < outer_cone <= pi/2 radians, got {light.inner_cone} and {light.outer_cone}"
        )
    if light.range is not None and not light.range > 0.0:
        raise SceneError(f"{name}: range must be above 0 m, or None for no limit, got {light.range}")
    if light.node is not None and not 0 <= light.node < len(nodes):
        raise SceneError(f"{name}: node must be from 0 to {len(nodes) - 1}, got {light.node}")


def emitting_areas(flat: FlatGeometry, triangles: np.ndarray) -> np.ndarray:
    """Return areas in square metres of triangles (int64 [count]), one side of each; means over time if they change."""
    if flat.mean_areas is not None:
        return flat.mean_areas[triangles]
    corners = flat.points[flat.indices[triangles]]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * np.linalg.norm(cross.astype(np.float64), axis=1)


def emissive_triangles(flat: FlatGeometry, materials: Sequence[Material]) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles that emit (int64 [count], rising) and their powers (float64 [count]).

    Power is pi times area times the luminance of the mean emission under the
    triangle, twice that if both sides emit. A triangle is left out if its area is
    zero or its texture is black all over it. The area of one that changes its shape is the mean over time.
    """
    shining = np.array([max(m.emission) > 0.0 for m in materials])
    triangles = np.flatnonzero(shining[flat.materials])
    powers = np.pi * emitting_areas(flat, triangles)
    powers[powers < np.pi * SMALLEST_AREA] = 0.0
    shares = _texture_means(flat, materials, triangles)
    for index in np.flatnonzero(shining).tolist():
        mine = flat.materials[triangles] == index
        material = materials[index]
        radiance = np.asarray(material.emission, np.float64)
        if material.emission_texture is not None:
            radiance = radiance * shares[mine]
        if material.colors_emit and flat.colors is not None:
            radiance = radiance * flat.colors[flat.indices[triangles[mine]], :3].astype(np.float64).mean(axis=1)
        powers[mine] *= radiance @ LUMINANCE * (2.0 if material.double_sided else 1.0)
    kept = powers > 0.0
    return triangles[kept], powers[kept]


def _texture_means(flat: FlatGeometry, materials: Sequence[Material], triangles: np.ndarray) -> np.ndarray:
    """Return the mean of the emission's texture under each of these triangles, float64 [count, 3]; 1 without any.

    Sums over a texture are made once for all materials that share it.
    """
    means, low, high = np.ones((len(triangles), 3)), *np.zeros((2, len(triangles), 2))
    of_material, sharing = flat.materials[triangles], dict[tuple[object, ...], list[int]]()
    for index in np.unique(of_material).tolist():
        texture = materials[index].emission_texture
        if texture is None:
            continue
        mine = of_material == index
        ids = flat.indices[triangles[mine]]
        further = None if flat.further_uvs is None else flat.further_uvs[ids]
        uvs = texture_coordinates(texture, flat.uvs[ids], further)
        low[mine], high[mine] = uvs.min(axis=1), uvs.max(axis=1)
        sharing.setdefault((id(texture.pixels), texture.srgb, texture.wrap), []).append(index)
    for group in sharing.values():
        texture, mine = materials[group[0]].emission_texture, np.isin(of_material, group)
        assert texture is not None
        image, shades = texture.pixels[..., :3], linear_shades(texture)
        means[mine] = box_means(image, texture.wrap, low[mine], high[mine], shades)
    return means


def mean_areas(
    nodes: Sequence[Node], flat: FlatGeometry, moving: Sequence[bool], times: np.ndarray
) -> np.ndarray | None:
    """Return the area of each triangle, of lamps that change their size or shape as a mean over ``times`` [s].

    A triangle of such a lamp counts with at least LEAST_AREA of the mean over the lamp, whatever it is at these times:
    it may open between them, and what is never chosen never shines. ``moving`` says which nodes move. None if no such
    node emits: float64 [triangle] otherwise.
    """
    lamps = [
        index
        for index, node in enumerate(nodes)
        if moving[index] and any(max(mesh.material.emission) > 0.0 for mesh in node.meshes)
        if deforms(node) or _changes_size(nodes, index)
    ]
    if not lamps:
        return None
    areas, points = triangle_areas(flat.points, flat.indices), flat.points.copy()
    owners = np.searchsorted(flat.vertex_starts, flat.indices[:, 0], side="right") - 1
    mine = np.isin(owners, lamps)
    areas[mine] = 0.0
    for time in times.tolist():
        placed = poses(nodes, time)
        for index in lamps:
            start, stop = flat.vertex_starts[index : index + 2]
            points[start:stop] = placed_points(nodes[index], placed[index])
        areas[mine] += triangle_areas(points, flat.indices[mine]) / len(times)
    for index in lamps:
        own = owners == index
        mean = float(areas[own].mean()) if own.any() else 0.0
        areas[own] = np.maximum(areas[own], LEAST_AREA * (mean if mean > SMALLEST_AREA else UNKNOWN_AREA))
    return areas


def _changes_size(nodes: Sequence[Node], index: int) -> bool:
    """Return whether keyframes scale a node, or one above it, by factors that change."""
    above: int | None = index
    while above is not None:
        if len({tuple(key.scale) for key in nodes[above].keyframes or ()}) > 1:
            return True
        above = nodes[above].parent
    return False


def light_power(light: PunctualLight, radius: float) -> float:
    """Return the power of a punctual light [W, luminance]; a directional one lights a disc of ``radius`` [m]."""
    luminance = float(np.asarray(light.intensity, np.float64) @ LUMINANCE)
    if light.kind == "point":
        return 4.0 * np.pi * luminance
    if light.kind == "spot":
        return 2.0 * np.pi * (1.0 - 0.5 * (np.cos(light.inner_cone) + np.cos(light.outer_cone))) * luminance
    return np.pi * radius * radius * luminance


def emitter_table(triangles: np.ndarray, lights: Sequence[PunctualLight], world: Sequence[np.ndarray]) -> np.ndarray:
    """Return all emitters as an array with the dtype of types.Emitter; ``world`` is world_from_node of every node."""
    table = np.zeros(len(triangles) + len(lights), types.Emitter.numpy_dtype())
    table["triangle"] = -1
    table["kind"][: len(triangles)] = types.EMITTER_TRIANGLE
    table["triangle"][: len(triangles)] = triangles
    for row, light in zip(table[len(triangles) :], lights, strict=True):
        matrix = np.eye(4) if light.node is None else world[light.node]
        direction = matrix[:3, :3] @ np.asarray(light.direction, np.float64)
        row["kind"] = LIGHT_KINDS[light.kind]
        row["position"] = matrix[:3, :3] @ np.asarray(light.position, np.float64) + matrix[:3, 3]
        row["direction"] = direction / max(float(np.linalg.norm(direction)), 1e-30)
        row["intensity"] = light.intensity
        row["cos_inner"], row["cos_outer"] = np.cos(light.inner_cone), np.cos(light.outer_cone)
        row["range"] = light.range or 0.0
    return table
