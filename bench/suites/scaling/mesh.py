"""What the suite ``scaling`` grows: the same shapes in ever more triangles, the same hall under ever more lamps."""

from __future__ import annotations

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness import scenes
from warp_gi.scene.builtin import shapes
from warp_gi.scene.camera import CameraKey

SIDE, HEIGHT = 12.0, 5.0
"""Side and height of the crowd's room in metres."""
BLOBS = 5
"""Number of blobs along each side of the room; there is none where the camera is."""
WALL_SHARE = 1 / 8
"""Share of the triangles that the walls have."""
OCTAVES = ((2.0, 0.22), (4.0, 0.12), (7.0, 0.07))
"""Frequency and amplitude of a blob's waves; even the coarsest mesh has about two vertices for each."""
CROWD_VIEW = CameraKey(0.0, (-5.2, 2.4, 5.2), (1.5, 1.2, -1.5), hfov=75.0)

HALL = (40.0, 6.0, 30.0)
LAMP_AREA = 6.0
"""Area of all lamps together, m^2."""
STRENGTHS = (4.0, 8.0, 16.0, 32.0)
HALL_VIEW = gi.Camera.look_at((-18.0, 1.7, 13.0), (4.0, 1.5, -3.0), hfov=65.0)


def crowd(triangles: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return float32 [vertex, 3] points and int32 [triangle, 3] indices: lumpy balls in a room of uneven walls.

    Shape, area and depth complexity are the same for any number of ``triangles``, which is met roughly; only their
    sizes differ.
    """
    rng = np.random.default_rng(seed)
    count = BLOBS**2 - 1
    rows = max(round(0.5 + (0.25 + (1 - WALL_SHARE) * triangles / count / 4) ** 0.5), 3)
    ball = scenes.sphere((0.0, 0.0, 0.0), 1.0, gi.Material(), rows)
    parts = [_room(max(round((WALL_SHARE * triangles / 12) ** 0.5), 1), rng)]
    for place in range(1, count + 1):  # place 0 is the camera's
        spacing = SIDE / BLOBS
        center = np.array([place // BLOBS + 0.5, 0.0, BLOBS - place % BLOBS - 0.5]) * spacing - (SIDE / 2, 0, SIDE / 2)
        center += (*rng.uniform(-0.3, 0.3, 2), 0.0)
        center[1] = rng.uniform(0.6, 3.2)
        waves = np.zeros(len(ball.points))
        for frequency, height in OCTAVES:
            waves += height * _wave(ball.points, frequency, rng)
        points = center + rng.uniform(0.7, 1.1) * (1.0 + waves)[:, None] * ball.points
        parts.append((points.astype(np.float32), ball.indices))
    starts = np.cumsum([0, *(len(points) for points, _ in parts[:-1])])
    indices = [indices + np.int32(start) for (_, indices), start in zip(parts, starts, strict=True)]
    return np.concatenate([points for points, _ in parts]), np.concatenate(indices)


def _wave(points: np.ndarray, frequency: float, rng: np.random.Generator) -> np.ndarray:
    """Return waves from -1 to 1 over points [vertex, 3] in float32, along three directions at random."""
    directions = rng.normal(size=(3, 3)).astype(np.float32)
    directions *= np.float32(frequency) / np.linalg.norm(directions, axis=0)
    phases = rng.uniform(0, 2 * np.pi, 3).astype(np.float32)
    return np.sin(points @ directions + phases).mean(axis=1)


def _room(cells: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the room's six walls of 2 ``cells``^2 triangles each, fronts inward, that bulge inward by up to 0.2 m."""
    line = np.linspace(-1.0, 1.0, cells + 1)
    u, v = (grid.ravel() for grid in np.meshgrid(line, line, indexing="ij"))
    row, column = (grid.ravel() for grid in np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij"))
    a = row * (cells + 1) + column
    b = a + cells + 1
    one = np.concatenate([np.stack([a, b, b + 1], axis=1), np.stack([a, b + 1, a + 1], axis=1)])
    points, half = [], np.array([SIDE / 2, HEIGHT / 2, SIDE / 2])
    for axis in range(3):
        for side in (-1.0, 1.0):
            wall = np.empty((len(u), 3))
            wall[:, (axis + 1) % 3], wall[:, (axis + 2) % 3] = (u, v) if side < 0 else (v, u)
            wall[:, axis] = side
            wall *= half
            edge = (1 - u**2) * (1 - v**2)  # walls meet at their edges
            wall[:, axis] -= side * edge * (0.1 + 0.1 * _wave(wall.astype(np.float32), 3.0, rng))
            points.append(wall + np.array([0.0, HEIGHT / 2, 0.0]))
    indices = np.concatenate([one + k * len(u) for k in range(6)])
    return np.concatenate(points).astype(np.float32), indices.astype(np.int32)


def lamp_hall(lights: int, seed: int = 0) -> gi.Scene:
    """Return a hall of pillars and shelves under small square lamps of ``lights`` triangles, facing down.

    Their area and mean radiance together are the same for any number of them.
    """
    rng = np.random.default_rng(seed)
    x, y, z = HALL
    count = max(lights // 2, 1)
    side = (LAMP_AREA / count) ** 0.5
    columns = int(np.ceil((count * x / z) ** 0.5))
    rows = -(-count // columns)
    place = rng.choice(columns * rows, count, replace=False)
    cell = np.stack([place % columns, place // columns], axis=1) + rng.uniform(0.2, 0.8, (count, 2))
    low = np.stack([(cell[:, 0] / columns - 0.5) * (x - 2), rng.uniform(0.6, 0.95, count) * y], axis=1)
    low = np.insert(low, 2, (cell[:, 1] / rows - 0.5) * (z - 2), axis=1)
    corners = low[:, None] + side * np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]])
    which = np.arange(count) % len(STRENGTHS)
    lamps = []
    for k, strength in enumerate(STRENGTHS[: which.max() + 1]):
        points = corners[which == k].reshape(-1, 3).astype(np.float32)
        starts = 4 * np.arange(len(points) // 4)[:, None, None]
        indices = (starts + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3).astype(np.int32)
        lamps.append(gi.Mesh(points, indices, scenes.light((strength, strength, strength)), name=f"lamps {k}"))
    grey = gi.Material("grey", (0.6, 0.6, 0.6), specular=0.0)
    solid = [shapes.box((-x / 2, 0, -z / 2), (x / 2, y, z / 2)).flipped()]
    solid += [shapes.box((i - 0.3, 0, k - 0.3), (i + 0.3, y, k + 0.3)) for i in range(-15, 16, 6) for k in (-8, 0, 8)]
    solid += [
        shapes.box((i - 1.5, h, k - 0.4), (i + 1.5, h + 0.1, k + 0.4))
        for i in (-9, 3, 12)
        for k in (-4, 4)
        for h in (0.8, 1.6)
    ]
    hall = shapes.merge(solid).mesh(grey, "hall")
    return gi.Scene([gi.Node("hall", [hall]), gi.Node("lamps", lamps)], name=f"hall of {lights} lights")
