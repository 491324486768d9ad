"""Columns, balusters, coffers, fountains, lanterns and plants for built-in scenes. Metres; standing on y = 0."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from warp_gi.scene.builtin.shapes import Shape, box, icosphere, lathe, loft, merge, placement, quad, tube


def half_round(radius: float, centre: float, y: float, count: int = 6) -> list[tuple[float, float]]:
    """Return profile points of a torus bulging from radius ``centre``, ``2 * radius`` high, from height ``y``."""
    angle = np.linspace(-math.pi / 2, math.pi / 2, count + 1)
    return [(centre + radius * math.cos(a), y + radius + radius * math.sin(a)) for a in angle]


def base(radius: float, segments: int, fine: bool = True) -> Shape:
    """Return an Attic base for a shaft of ``radius``: plinth, torus, hollow, torus; 0.9 radii high."""
    r = radius
    if not fine:
        profile = [(0, 0), (1.38 * r, 0), (1.38 * r, 0.3 * r), (1.2 * r, 0.58 * r), (1.08 * r, 0.64 * r)]
        return lathe([*profile, (1.12 * r, 0.78 * r), (r, 0.9 * r), (0, 0.9 * r)], segments)
    plinth = box((-1.38 * r, 0, -1.38 * r), (1.38 * r, 0.28 * r, 1.38 * r), 0.03 * r)
    profile = [(0, 0.28 * r), *half_round(0.15 * r, 1.2 * r, 0.28 * r, 3)]
    profile += [(1.08 * r, 0.65 * r)]
    profile += [*half_round(0.08 * r, 1.06 * r, 0.70 * r, 2), (1.0 * r, 0.90 * r), (0, 0.90 * r)]
    return merge([plinth, lathe(profile, segments)])


def shaft(radius: float, height: float, segments: int, taper: float = 0.86) -> Shape:
    """Return a shaft with entasis that narrows to ``taper`` of its radius, closed."""
    t = np.linspace(0, 1, 5)
    swell = 1 - (1 - taper) * t**2
    sides = [(radius * s, height * x) for s, x in zip(swell, t, strict=True)]
    return lathe([(0, 0), *sides, (0, height)], segments)


def leaf(width: float, height: float, curl: float) -> Shape:
    """Return a capital's leaf: open, rising along y from the origin, its tip curling towards +z."""
    rise = height * np.array([0.0, 0.45, 0.82, 0.98, 0.88])
    out = curl * np.array([0.0, 0.06, 0.30, 0.75, 1.0])
    half = width / 2 * np.array([0.85, 1.0, 0.8, 0.5, 0.12])
    rows = [[(-w, y, z - 0.25 * w), (0, y, z), (w, y, z - 0.25 * w)] for w, y, z in zip(half, rise, out, strict=True)]
    return loft(np.array(rows)[:, ::-1], crease=70.0).flipped()


def capital(radius: float, width: float, height: float, segments: int, leaves: int = 8, fine: bool = True) -> Shape:
    """Return a Corinthian capital on a shaft of ``radius``: bell, two rows of leaves, corner scrolls, abacus."""
    r, abacus = radius, 0.16 * height
    ring = half_round(0.06 * height, r, 0, 4 if fine else 2)
    bell = [(0, 0), *ring, (r * 1.02, 0.5 * height), (r * 1.12, 0.72 * height), (r * 1.32, height - abacus)]
    parts = [lathe([*bell, (0, height - abacus)], segments)]
    for row, (y, tall, curl) in enumerate(((0.12, 0.40, 0.30), (0.16, 0.66, 0.42))):
        size = 2.0 * math.pi * r / leaves, tall * height, curl * r
        one = leaf(*size).moved(y=y * height, z=r * (1.02 - 0.02 * row))
        turns = (np.arange(leaves) + 0.5 * row) * 360 / leaves
        parts.append(one.repeated(np.stack([placement(turn=t) for t in turns])))
    if fine:
        reach, y = 0.5 * width - 0.09 * height, height - abacus - 0.06 * height
        scroll = icosphere(0.085 * height, 1).scaled(1, 1.15, 1)
        parts.append(scroll.at([(x * reach, y, z * reach) for x in (-1, 1) for z in (-1, 1)]))
    top = box((-width / 2, height - abacus, -width / 2), (width / 2, height, width / 2), 0.2 * abacus)
    parts.append(top)
    return merge(parts)


def baluster(height: float, radius: float, segments: int = 7) -> Shape:
    """Return a turned baluster, closed."""
    outline = [(0.95, 0.0), (0.55, 0.10), (0.66, 0.20), (1.0, 0.34), (0.82, 0.50), (0.42, 0.72), (0.44, 0.84)]
    outline += [(0.95, 0.93), (0.95, 1.0)]
    return lathe([(0, 0), *((radius * r, height * y) for r, y in outline), (0, height)], segments, crease=50.0)


def coffer(width: float, depth: float, rise: float) -> Shape:
    """Return one coffer of a ceiling seen from below, centred, its rim at y = 0, the panel ``rise`` above; open."""
    steps = [(1.0, 0.0), (0.80, 0.0), (0.74, 0.6), (0.56, 1.0)]
    corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1], [1, 1]]) * [width / 2, depth / 2]
    rings = [np.column_stack([c[:, 0], np.full(5, h * rise), c[:, 1]]) for s, h in steps for c in [corners * s]]
    sides = loft(np.stack(rings), crease=20.0)
    w, d = 0.56 * width, 0.56 * depth
    return merge([sides, quad((-w / 2, rise, -d / 2), (w, 0, 0), (0, 0, d))]).box_mapped()


def archivolt(radius: float, width: float, depth: float, segments: int, fine: bool = True) -> Shape:
    """Return the moulded band around an arch, standing out of both faces of a wall of ``depth``; open at its feet."""
    angle = np.linspace(0, math.pi, segments + 1)
    z = depth / 2 + 0.04
    half = (
        [(-0.02, z), (width * 0.45, z), (width * 0.55, z + 0.03), (width, z + 0.03)]
        if fine
        else [(-0.02, z), (width, z)]
    )
    profile = np.array([*half, *((x, -y) for x, y in half[::-1]), half[0]])
    r, around = radius + profile[:, 0], angle[:, None]
    grid = np.broadcast_arrays(r * np.cos(around), r * np.sin(around), profile[:, 1])
    return loft(np.stack(grid, axis=-1), crease=35.0)


def fountain(radius: float) -> dict[str, Shape]:
    """Return a round fountain of two bowls: "stone" and "water"."""
    wall = [(radius * 1.12, 0), (radius * 1.12, 0.10), (radius * 1.02, 0.14), (radius * 0.98, 0.40)]
    wall += [(radius * 1.02, 0.44), *half_round(0.05, radius * 1.04, 0.44, 5), (radius * 0.90, 0.54)]
    wall += [(radius * 0.88, 0.20), (0, 0.20)]
    stem = [(0, 0.1), (0.34, 0.1), (0.34, 0.3), (0.22, 0.36), (0.16, 0.55), (0.20, 0.72), (0.13, 0.85), (0.15, 0.98)]
    bowl = [(0.15, 0.98), (0.30, 1.02), (0.55, 1.12), (0.72, 1.26), (0.76, 1.30), (0.72, 1.31), (0.66, 1.27)]
    bowl += [
        (0.50, 1.17),
        (0.12, 1.13),
        (0.10, 1.30),
        (0.15, 1.38),
        (0.12, 1.47),
        (0.05, 1.53),
        (0.08, 1.60),
        (0, 1.68),
    ]
    scale = radius / 1.6
    upper = lathe([*stem, *bowl[1:]], 28).scaled(scale, 1.0, scale)
    pools = [lathe([(radius * 0.9, 0.42), (0, 0.42)], 40), lathe([(0.70 * scale, 1.27), (0.1 * scale, 1.27)], 28)]
    water = merge(pools)
    flat = water.points[:, [0, 2]]
    return {
        "stone": merge([lathe([(0, 0), *wall], 48), upper]),
        "water": Shape(water.points, water.indices, flat, water.normals),
    }


def lantern(drop: float) -> dict[str, Shape]:
    """Return a lantern that hangs ``drop`` below the origin: "metal" and "glow" (a closed ball)."""
    y = -drop
    chain = tube(np.array([[0, 0, 0], [0, y + 0.34, 0]]), 0.008, 4)
    roof = lathe([(0, 0.22), (0.15, 0.22), (0.15, 0.235), (0.06, 0.31), (0.03, 0.35), (0, 0.36)], 8).moved(y=y)
    foot = lathe([(0, -0.06), (0.05, -0.05), (0.11, -0.01), (0.11, 0.0), (0, 0.0)], 8).moved(y=y)
    bar = box((-0.006, 0, -0.006), (0.006, 0.22, 0.006))
    bars = bar.at([(0.115 * math.cos(a), y, 0.115 * math.sin(a)) for a in np.arange(4) * math.pi / 2])
    return {"metal": merge([chain, roof, foot, bars]), "glow": icosphere(0.06, 1).moved(y=y + 0.11)}


def pot(radius: float, height: float, segments: int = 20) -> dict[str, Shape]:
    """Return a flower pot: "clay" and "soil"."""
    r, h = radius, height
    side = [(0.62 * r, 0), (0.66 * r, 0.05 * h), (0.90 * r, 0.80 * h), (1.0 * r, 0.84 * h), (1.0 * r, 0.97 * h)]
    side += [(0.96 * r, h), (0.88 * r, h), (0.84 * r, 0.88 * h), (0, 0.88 * h)]
    soil = lathe([(0.85 * r, 0.90 * h), (0, 0.93 * h)], 12)
    return {"clay": lathe([(0, 0), *side], segments), "soil": soil}


def foliage(
    centres: np.ndarray, radii: np.ndarray | float, count: int, size: float, seed: int, density: float = 0.6
) -> Shape:
    """Return ``count`` leaves of about ``size`` metres in balls around ``centres`` [k, 3], tips drooping outwards.

    A leaf is 4 triangles, folded along its rib. ``density`` 1 fills the balls, 0 lays all leaves on their surface.
    """
    rng = np.random.default_rng(seed)
    centres = np.asarray(centres, np.float64)
    radii = np.broadcast_to(radii, len(centres))
    which = rng.choice(len(centres), count, p=radii**2 / (radii**2).sum())
    out = rng.standard_normal((count, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    depth = 1 - density * (1 - rng.random(count) ** (1 / 3))
    origin = centres[which] + out * (radii[which] * depth)[:, None]
    along = out + 0.8 * rng.standard_normal((count, 3)) + [0, -0.25, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.cross(along, rng.standard_normal((count, 3)) * 0.5 + [0, 1, 0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, along)
    length = size * rng.uniform(0.7, 1.3, count)
    # (along, side, up) of a leaf of length 1: stalk, left, right, rib, tip
    outline = np.array([[0, 0, 0], [0.42, -0.24, 0.10], [0.42, 0.24, 0.10], [0.45, 0, 0.02], [1, 0, -0.16]])
    frame = np.stack([along, side, up], axis=1) * length[:, None, None]
    points = origin[:, None] + outline @ frame
    faces = np.array([[0, 2, 3], [3, 2, 4], [0, 3, 1], [1, 3, 4]])
    indices = (np.arange(count) * 5)[:, None, None] + faces
    a, b, c = (points[:, faces[:, k]] for k in range(3))
    flat = np.cross(b - a, c - a)
    normals = np.zeros((count, 5, 3))
    for k in range(3):
        for face, corner in enumerate(faces[:, k]):
            normals[:, corner] += flat[:, face]
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    uvs = np.broadcast_to(outline[:, :2] * [1, 1] + [0, 0.5], (count, 5, 2))
    return Shape(
        points.reshape(-1, 3), indices.reshape(-1, 3).astype(np.int32), uvs.reshape(-1, 2), normals.reshape(-1, 3)
    )


def branches(height: float, spread: float, count: int, radius: float, seed: int) -> tuple[Shape, np.ndarray]:
    """Return a trunk with ``count`` branches, and the points [count + 1, 3] where their leaves belong."""
    rng = np.random.default_rng(seed)
    fork = np.array([0.04, 0.55 * height, -0.03])
    bend = np.array(
        [[0, 0, 0], [0.05, 0.2 * height, 0.02], [0.0, 0.4 * height, -0.04], fork, [0.02, 0.8 * height, 0.0]]
    )
    parts = [tube(bend, radius * np.array([1.3, 1.0, 0.9, 0.75, 0.3]), 8)]
    tips = [[0.0, height, 0.0]]
    for k in range(count):
        angle = 2 * math.pi * (k + 0.3 * rng.random()) / count
        reach, rise = spread * rng.uniform(0.7, 1.0), height * rng.uniform(0.72, 0.98)
        tip = np.array([reach * math.cos(angle), rise, reach * math.sin(angle)])
        middle = (fork + tip) / 2 + [0, 0.06 * height, 0]
        parts.append(tube(np.stack([fork * [1, 0.92, 1], middle, tip]), radius * np.array([0.6, 0.4, 0.15]), 6))
        tips.append(tip.tolist())
    return merge(parts), np.array(tips)


def plants(placements: Sequence[np.ndarray], shapes: dict[str, Shape]) -> dict[str, Shape]:
    """Return every part of ``shapes`` repeated under all ``placements`` [4, 4]."""
    matrices = np.stack(list(placements))
    return {name: shape.repeated(matrices) for name, shape in shapes.items()}
