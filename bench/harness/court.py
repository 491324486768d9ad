"""A court open to the sky, in which radiance transfer is measured, and skies of few numbers."""

from __future__ import annotations

import math

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness.scenes import quad, sphere
from warp_gi.scene import harmonics
from warp_gi.scene.environment import Sky

GREY = 0.6
"""Albedo of the floor, the boxes and the ball of the court."""


def court(environment: Sky = None, floor: int = 1, specular: float = 0.0, roughness: float = 1.0) -> gi.Scene:
    """Return a court of 4 x 4 x 2 m: red, green and grey walls, two boxes and a ball on a grey floor.

    Args:
        environment: Its sky.
        floor: Cells along a side of the floor and of the walls, of two triangles each.
        specular: Of all materials; 0 makes them Lambert.
        roughness: Of all materials.
    """

    def material(name: str, color: tuple[float, float, float]) -> gi.Material:
        return gi.Material(name, color, specular=specular, roughness=roughness)

    grey = material("grey", (GREY, GREY, GREY))
    red, green = material("red", (0.65, 0.1, 0.08)), material("green", (0.12, 0.5, 0.12))
    meshes = [
        grid((-2, 0, 2), (4, 0, 0), (0, 0, -4), grey, floor, "floor"),
        grid((-2, 0, -2), (4, 0, 0), (0, 2, 0), grey, floor, "back"),
        grid((2, 0, 2), (-4, 0, 0), (0, 2, 0), grey, floor, "front"),
        grid((-2, 0, 2), (0, 0, -4), (0, 2, 0), red, floor, "left"),
        grid((2, 0, -2), (0, 0, 4), (0, 2, 0), green, floor, "right"),
        *block((-1.1, 0, -0.9), (0.9, 1.4, 0.9), 0.3, grey),
        *block((0.9, 0, -0.3), (0.8, 0.7, 0.8), -0.35, grey),
        sphere((-0.3, 0.45, 0.7), 0.45, grey, rows=18),
    ]
    nodes = [gi.Node(mesh.name or f"part {k}", [mesh]) for k, mesh in enumerate(meshes)]
    return gi.Scene(nodes, environment=environment, name="court")


def court_camera(resolution: tuple[int, int] = (480, 320)) -> gi.Camera:
    """Return a camera that looks down into the court."""
    return gi.Camera.look_at((1.85, 2.7, 1.85), (-0.35, 0.25, -0.35), hfov=64, resolution=resolution)


def grid(corner: object, edge_u: object, edge_v: object, material: gi.Material, cells: int, name: str) -> gi.Mesh:
    """Return a parallelogram of ``cells`` x ``cells`` cells, with vertices that neighbours share."""
    corner, u, v = (np.asarray(value, np.float64) for value in (corner, edge_u, edge_v))
    steps = np.arange(cells + 1) / cells
    across, along = np.meshgrid(steps, steps)
    points = corner + across.reshape(-1, 1) * u + along.reshape(-1, 1) * v
    rows = np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)
    a = rows.ravel()
    b, c, d = a + 1, a + cells + 2, a + cells + 1
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    uvs = np.stack([across.ravel(), along.ravel()], axis=1).astype(np.float32)
    return gi.Mesh(points.astype(np.float32), faces.astype(np.int32), material, uvs=uvs, name=name)


def block(
    base: tuple[float, float, float], size: tuple[float, float, float], turn: float, material: gi.Material
) -> list[gi.Mesh]:
    """Return the five faces above ground of a box about ``base``, turned by ``turn`` radians about +y."""
    c, s = math.cos(turn), math.sin(turn)
    x, z = np.array([c, 0, -s]) * size[0], np.array([s, 0, c]) * size[2]
    y = np.array([0.0, size[1], 0.0])
    low = np.asarray(base, np.float64) - (x + z) / 2
    sides = [(low + z, x, y), (low + x, -x, y), (low, z, y), (low + x + z, -z, y), (low + y + z, x, -z)]
    return [quad(corner, u, v, material, "block") for corner, u, v in sides]


def band_limited(sky: gi.Environment, height: int = 128, strength: float = 0.02) -> gi.Environment:
    """Return the sky of 25 numbers nearest to ``sky``, as a map; a window keeps it from falling below 0.

    What little is below 0 all the same is set to 0, so the map's own harmonics are those to go by.
    """
    light = sky.harmonics_of(5)
    bands = np.repeat(np.arange(5), 2 * np.arange(5) + 1)
    light = light / (1 + strength * (bands * (bands + 1.0)) ** 2)
    theta = np.pi * np.arange(height)[:, None] / (height - 1)
    phi = 2 * np.pi * (np.arange(2 * height)[None] + 0.5) / (2 * height)
    ring = np.sin(theta)
    directions = np.stack([ring * np.sin(phi), np.cos(theta) + 0 * phi, -ring * np.cos(phi)], axis=-1)
    pixels = harmonics.basis(directions, 5) @ light.T
    return gi.Environment(pixels=np.maximum(pixels, 0).astype(np.float32), name="low frequencies")
