"""A mine: a cavern and three timbered tunnels of rough rock, lit by the sun through one narrow shaft in the roof.

The sun draws a spot of about one square metre on the cavern's floor, and all other light comes from there: the sky is
seen from next to nowhere, and nothing glows. The rock is the surface of a distance field with noise.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from warp_gi.scene.builtin import materials
from warp_gi.scene.builtin import textures as tx
from warp_gi.scene.builtin.shapes import Shape, box, cylinder, icosphere, merge, placement, tube
from warp_gi.scene.camera import Camera, CameraKey, CameraPath
from warp_gi.scene.environment import SunSky, as_environment
from warp_gi.scene.model import Material, Node
from warp_gi.scene.scene import Scene

LOW, HIGH = np.array((-25.0, -1.0, -21.0)), np.array((11.0, 12.0, 13.0))  # corners of the rock in metres
CELL = 0.25
SKY = SunSky(elevation=60.0, azimuth=300.0, turbidity=2.6, intensity=1.0)
SPOT = np.array((4.3, 0.0, 2.4))
"""Point on the floor that the sun reaches, metres."""
SHAFT_RADIUS = 1.4
CAVERN = ((-0.5, 1.2, 0.0), (8.0, 5.2, 7.0))
"""Centre and radii of the cavern's ellipsoid, metres."""
TUNNEL_RADIUS = 1.75
TUNNELS = {
    "west": ((-6.0, 1.1, 1.0), (-11.0, 1.1, 2.5), (-16.0, 1.1, 1.2), (-22.0, 1.1, 4.5)),
    "north": ((2.5, 1.1, -5.0), (4.5, 1.1, -10.0), (2.0, 1.1, -14.0), (-1.0, 1.1, -18.0)),
    "gallery": ((-16.0, 1.1, 1.2), (-15.0, 1.1, -6.0), (-10.0, 1.1, -12.5), (-1.0, 1.1, -18.0)),
}
"""Corners of the tunnels' middle lines, metres, by name."""
OCTAVES = ((4.5, 0.85), (1.9, 0.45), (0.8, 0.20))
"""Wavelength and amplitude of the rock's relief, metres."""
PROP_STEP = 2.8


def to_sun() -> np.ndarray:
    """Return the unit vector that points to the sun."""
    elevation, azimuth = math.radians(SKY.elevation), math.radians(SKY.azimuth)
    flat = math.cos(elevation)
    return np.array((flat * math.sin(azimuth), math.sin(elevation), -flat * math.cos(azimuth)))


# ---- rock ----


def rock() -> Shape:
    """Return the walls, roofs and floors; the front is where one can be, and the shaft is open at the top."""
    axes = [np.arange(low, high + CELL / 2, CELL, dtype=np.float32) for low, high in zip(LOW, HIGH, strict=True)]
    points, faces = surface(field(axes), CELL)
    shape = Shape.of(points + LOW, faces, crease=38.0)
    return _mapped_by_face(shape)


def field(axes: list[np.ndarray]) -> np.ndarray:
    """Return about how far each point of a grid [x, y, z] is inside of rock; negative where there is air."""
    x, y, z = np.meshgrid(*axes, indexing="ij", sparse=True)
    middle, radii = CAVERN
    scaled = [(value - m) / r for value, m, r in zip((x, y, z), middle, radii, strict=True)]
    hollow = (np.sqrt(sum(value**2 for value in scaled)) - 1) * min(radii)
    for path in TUNNELS.values():
        for start, end in itertools.pairwise(path):
            hollow = np.minimum(hollow, _from_line(x, y, z, start, end) - TUNNEL_RADIUS)
    rng = np.random.default_rng(17)
    relief, ripples = np.zeros_like(hollow), np.zeros_like(hollow[:, :1])
    for wavelength, amplitude in OCTAVES:
        # ridges: what is left of the absolute value has creases, as broken rock has
        relief += amplitude * (0.8 - np.abs(noise(axes, wavelength, rng)))
        ripples += 0.12 * amplitude * noise([axes[0], np.zeros(1, np.float32), axes[2]], wavelength, rng)
    hollow = hollow + relief
    hollow = np.maximum(hollow, ripples - y)
    top = SPOT + to_sun() * (HIGH[1] + 3.0 - SPOT[1]) / to_sun()[1]
    foot = SPOT + to_sun() * 4.0
    shaft = _from_line(x, y, z, foot, top) - SHAFT_RADIUS + 0.15 * relief
    return np.minimum(hollow, shaft)


def _from_line(x: np.ndarray, y: np.ndarray, z: np.ndarray, start: ArrayLike, end: ArrayLike) -> np.ndarray:
    """Return distances to a straight line from ``start`` to ``end``."""
    along = np.subtract(end, start).astype(np.float32)
    offsets = [value - s for value, s in zip((x, y, z), np.asarray(start, np.float32), strict=True)]
    share = sum(value * a for value, a in zip(offsets, along, strict=True)) / float(along @ along)
    share = np.clip(share, 0, 1)
    return np.sqrt(sum((value - share * a) ** 2 for value, a in zip(offsets, along, strict=True)))


def noise(axes: Sequence[np.ndarray], wavelength: float, rng: np.random.Generator) -> np.ndarray:
    """Return smooth noise of mean 0 and deviation 1 at the points of a grid [x, y, z].

    Random numbers on a lattice half a ``wavelength`` wide, between which cubic B-splines run: along one axis after
    the other that is a product with a matrix.
    """
    step = wavelength / 2
    weights = [_spline(axis, step) for axis in axes]
    lattice = rng.standard_normal([w.shape[1] for w in weights], dtype=np.float32)
    lattice = np.einsum("kz,ijz->ijk", weights[2], lattice, optimize=True)
    lattice = np.einsum("jy,iyk->ijk", weights[1], lattice, optimize=True)
    lattice = np.einsum("ix,xjk->ijk", weights[0], lattice, optimize=True)
    return lattice / lattice.std()


def _spline(axis: np.ndarray, step: float) -> np.ndarray:
    """Return weights [point, lattice point] of the uniform cubic B-spline."""
    position = (axis - axis[0]) / step
    first = position.astype(int)
    t = position - first
    parts = ((1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3)
    weights = np.zeros((len(axis), int(first.max()) + 4), np.float32)
    for k, part in enumerate(parts):
        weights[np.arange(len(axis)), first + k] = part / 6
    return weights


def surface(values: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points [n, 3] and triangles [m, 3] of where ``values`` [x, y, z] on a grid change their sign.

    Naive surface nets (Gibson 1998): a point in each cell that the surface crosses, at the mean of where it crosses
    the cell's edges, and two triangles for each edge of the grid that it crosses; they face what is negative.
    """
    inside = values < 0
    sums, counts = np.zeros((*np.subtract(values.shape, 1), 3), np.float32), np.zeros(np.subtract(values.shape, 1))
    crossed = []
    for axis in range(3):
        low = tuple(slice(0, -1) if k == axis else slice(None) for k in range(3))
        high = tuple(slice(1, None) if k == axis else slice(None) for k in range(3))
        at = np.argwhere(inside[low] != inside[high])
        one, other = values[low][tuple(at.T)], values[high][tuple(at.T)]
        points = at.astype(np.float32)
        points[:, axis] += one / (one - other)
        around = [k for k in range(3) if k != axis]
        for da in (0, 1):
            for db in (0, 1):
                cells = at.copy()
                cells[:, around[0]] -= da
                cells[:, around[1]] -= db
                valid = (cells >= 0).all(axis=1) & (cells < counts.shape).all(axis=1)
                where = tuple(cells[valid].T)
                np.add.at(sums, where, points[valid])
                np.add.at(counts, where, 1)
        # the four cells around an edge, of those inside the grid
        whole = np.ones(len(at), bool)
        for k in around:
            whole &= (at[:, k] > 0) & (at[:, k] < values.shape[k] - 1)
        crossed.append((axis, at[whole], (one < 0)[whole]))
    number = np.full(counts.shape, -1)
    used = counts > 0
    number[used] = np.arange(used.sum())
    faces = []
    for axis, at, backward in crossed:
        a, b = (axis + 1) % 3, (axis + 2) % 3
        corners = []
        for da, db in ((1, 1), (0, 1), (0, 0), (1, 0)):
            cells = at.copy()
            cells[:, a] -= da
            cells[:, b] -= db
            corners.append(number[tuple(cells.T)])
        quads = np.stack(corners, axis=1)  # counter-clockwise seen from the axis' far end
        quads[backward] = quads[backward][:, ::-1]
        faces.append(quads)
    quads = np.concatenate(faces)
    return (sums[used] / counts[used][:, None]) * cell, quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)


def _mapped_by_face(shape: Shape) -> Shape:
    """Return the shape with texture coordinates [m] projected along the axis that each face is most across to."""
    corners = shape.points[shape.indices]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.repeat(np.abs(normals).argmax(axis=1), 3)
    key, vertex = np.unique(shape.indices.reshape(-1) * 3 + axis, return_inverse=True)
    source, axis = key // 3, key % 3
    x, y, z = shape.points[source].T
    uvs = np.stack([np.choose(axis, [z, x, x]), np.choose(axis, [y, z, y])], axis=1)
    return Shape(shape.points[source], vertex.reshape(-1, 3).astype(np.int32), uvs, shape.normals[source])


def stone(name: str, color: Sequence[float], seed: int) -> Material:
    """Return broken rock with veins of rust, over 3 m."""
    grain, blotches = tx.noise(seed, 1.0, 6), tx.smoothstep(-1.5, 1.5, tx.noise(seed + 1, 1.6, 1))
    rust = 0.55 * tx.smoothstep(0.6, 2.2, tx.noise(seed + 2, 1.6, 2) + 0.3 * grain)
    base = tx.blend(color, np.multiply(color, (0.62, 0.60, 0.58)), blotches)
    base = tx.blend(base, np.broadcast_to(np.array((0.42, 0.24, 0.13), np.float32), base.shape), rust)
    relief = 0.012 * tx.noise(seed + 3, 1.5, 2, 120)
    return materials.textured(name, base * (1 + 0.10 * grain)[..., None], 0.9, relief, 3.0)


# ---- what people left ----


def along(path: Sequence[Sequence[float]], step: float, first: float) -> list[tuple[np.ndarray, float]]:
    """Return points on the ground below ``path`` every ``step`` metres, and the turn that makes z run along it."""
    corners = np.asarray(path, np.float64) * (1, 0, 1)
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    starts = np.concatenate([[0], np.cumsum(lengths)])
    result = []
    for distance in np.arange(first, starts[-1], step):
        k = int(np.searchsorted(starts, distance, "right")) - 1
        direction = (corners[k + 1] - corners[k]) / lengths[k]
        turn = math.degrees(math.atan2(direction[0], direction[2]))
        result.append((corners[k] + direction * (distance - starts[k]), turn))
    return result


def timbers() -> Shape:
    """Return a frame of two posts and a cap every few metres of tunnel, planks behind them, and tall props."""
    rng = np.random.default_rng(3)
    parts = []
    for path in TUNNELS.values():
        sets = along(path, PROP_STEP, 2.4)
        for (point, turn), (_, next_turn) in zip(sets, [*sets[1:], (None, None)], strict=True):
            height = rng.uniform(2.05, 2.2)
            pieces = [
                cylinder(0.12, height + 0.3, 10, 0.01).turned(4.0 * side, "z").moved(1.12 * side, -0.3, 0)
                for side in (-1, 1)
            ]
            pieces.append(cylinder(0.13, 2.7, 10, 0.01).turned(90, "z").moved(1.35, height + 0.1, 0))
            for k in range(6):
                x, y = (-1.32, 1.32)[k % 2], 0.5 + 0.5 * (k // 2) + rng.uniform(-0.1, 0.1)
                if turn == next_turn and rng.random() < 0.6:
                    plank = box((-0.02, 0, -1.3), (0.02, 0.22, 1.3), 0.005).turned(rng.uniform(-2, 2), "x")
                    pieces.append(plank.moved(x, y, PROP_STEP / 2))
            place = placement(point) @ placement(turn=turn)
            parts.append(merge(pieces).transformed(place))
    for x, z, tilt in ((-3.4, -3.1, 3.0), (1.2, -3.8, -2.0), (-2.6, 3.9, -3.0)):
        parts.append(cylinder(0.16, 7.0, 12, 0.01).moved(y=-0.4).turned(tilt, "z").moved(x, 0, z))
    return merge(parts).box_mapped()


def rails() -> dict[str, Shape]:
    """Return a track from the west tunnel into the cavern: "steel" rails, "timber" sleepers."""
    path = ((-21.5, 0, 4.3), *[(p[0], 0, p[2]) for p in TUNNELS["west"][2::-1]], (-1.6, 0, 0.2))
    places = along(path, 0.75, 0.3)
    sleeper = box((-0.55, 0.02, -0.09), (0.55, 0.12, 0.09), 0.01)
    steel = []
    line = np.array([point for point, _ in along(path, 0.25, 0.0)])
    line = np.stack([np.convolve(np.pad(axis, 3, "edge"), np.ones(7) / 7, "valid") for axis in line.T], axis=1)
    heading = np.gradient(line, axis=0)
    heading /= np.linalg.norm(heading, axis=1, keepdims=True)
    side = np.stack([heading[:, 2], 0 * line[:, 0], -heading[:, 0]], axis=1)
    for sign in (-1, 1):
        steel.append(tube(line + 0.32 * sign * side + (0, 0.16, 0), 0.035, 6))
    timber = merge([sleeper.transformed(placement(p) @ placement(turn=turn)) for p, turn in places])
    return {"steel": merge(steel), "timber": timber.box_mapped()}


def cart() -> dict[str, Shape]:
    """Return a cart that runs along z: "iron" tub and wheels."""
    sides = [
        box((-0.45, 0.42, -0.7), (0.45, 0.46, 0.7)),
        *[box((s * 0.45 - 0.02, 0.46, -0.7), (s * 0.45 + 0.02, 1.05, 0.7)) for s in (-1, 1)],
        *[box((-0.43, 0.46, s * 0.68 - 0.02), (0.43, 1.05, s * 0.68 + 0.02)) for s in (-1, 1)],
        box((-0.3, 0.33, -0.62), (0.3, 0.42, 0.62)),
    ]
    wheel = cylinder(0.17, 0.06, 18).turned(90, "z").moved(y=0.36)
    wheels = [wheel.moved(x + 0.03, 0, z) for x in (-0.32, 0.32) for z in (-0.42, 0.42)]
    return {"iron": merge([*sides, *wheels]).box_mapped()}


def rubble() -> Shape:
    """Return boulders along the walls of the cavern, and in the cart."""
    rng = np.random.default_rng(29)
    ball, stones = icosphere(1.0, 1), []
    for _ in range(150):
        angle, size = rng.uniform(0, 2 * math.pi), 0.10 + 0.45 * rng.random() ** 4
        radius = rng.uniform(0.55, 0.86)
        place = (CAVERN[0][0] + radius * 7.6 * math.cos(angle), 0.3 * size, radius * 6.4 * math.sin(angle))
        clear = abs(place[2] - 0.6) > 1.3 or place[0] > 0  # the track
        clear &= np.hypot(place[0] - SPOT[0], place[2] - SPOT[2]) > 1.6
        if clear:
            stones.append(_boulder(ball, size, rng).moved(*place))
    for _ in range(14):
        place = (*rng.uniform(-0.25, 0.25, 1), 0.95 + rng.uniform(0, 0.15), *rng.uniform(-0.5, 0.5, 1))
        stones.append(_boulder(ball, rng.uniform(0.13, 0.2), rng).transformed(CART @ placement(place)))
    return merge([_mapped_by_face(s) for s in stones])


def _boulder(ball: Shape, size: float, rng: np.random.Generator) -> Shape:
    """Return a convex stone: a ball of which planes cut pieces off."""
    points = ball.points.copy()
    for normal in rng.standard_normal((9, 3)):
        normal /= np.linalg.norm(normal)
        over = np.maximum(points @ normal - rng.uniform(0.6, 0.8), 0)
        points -= over[:, None] * normal
    return Shape.of(points * size * rng.uniform(0.7, 1.2, 3), ball.indices, crease=25.0)


CART = placement((-3.1, 0.0, 0.42)) @ placement(turn=108.0)


def crates() -> Shape:
    """Return stacked crates beside the cavern's wall and in the west tunnel."""
    rng = np.random.default_rng(41)
    places = (
        (-4.0, 0, -3.9, 0.8),
        (-3.1, 0, -4.4, 0.7),
        (-3.7, 0.8, -4.0, 0.55),
        (0.4, 0, 4.3, 0.8),
        (1.3, 0, 4.5, 0.6),
        (-12.4, 0, 3.2, 0.5),
        (-1.2, 0, -9.0, 0.5),
    )
    parts = []
    for x, y, z, size in places:
        crate = box((-size / 2, 0, -size / 2), (size / 2, size, size / 2), 0.015).turned(rng.uniform(-20, 20))
        parts.append(crate.moved(x, y, z))
    return merge(parts).box_mapped()


def scene() -> Scene:
    """Return the mine."""
    timber, steel = materials.walnut(), materials.plain("rail steel", (0.42, 0.40, 0.38), 0.35, 1.0)
    timber.name = "timber"
    track, tub = rails(), cart()
    iron = materials.plain("rusty iron", (0.30, 0.17, 0.10), 0.55, 0.4)
    rocks = stone("rock", (0.64, 0.58, 0.50), 211)
    nodes = [
        Node("rock", [rock().textured(3.0).mesh(rocks, "rock")]),
        Node("rubble", [rubble().textured(1.5).mesh(rocks, "rubble")]),
        Node("timbers", [timbers().textured(1.2).mesh(timber, "timbers")]),
        Node("track", [track["steel"].mesh(steel, "rails"), track["timber"].textured(1.2).mesh(timber, "sleepers")]),
        Node("cart", [tub["iron"].transformed(CART).mesh(iron, "cart")]),
        Node("crates", [crates().textured(0.8).mesh(materials.crate_wood(), "crates")]),
    ]
    cameras = {
        "main": Camera.look_at((-6.2, 1.7, 2.3), (2.4, 1.35, 0.6), hfov=75.0),
        "spot": Camera.look_at((4.0, 1.7, -2.6), (-4.0, 1.6, 2.2), hfov=75.0),
        "tunnel": Camera.look_at((-11.6, 1.6, 2.5), (-5.0, 1.25, 1.3), hfov=70.0),
    }
    return Scene(nodes, environment=as_environment(SKY), cameras=cameras, name="mine")


def camera_path() -> CameraPath:
    """Return a walk into the cavern."""
    keys = (
        CameraKey(0.0, (-6.2, 1.7, 2.3), (2.4, 1.35, 0.6), hfov=75.0),
        CameraKey(47 / 24, (-4.9, 1.7, 2.1), (3.4, 1.3, 0.5), hfov=75.0),
    )
    return CameraPath(keys, name="mine")
