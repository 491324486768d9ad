"""Stand-ins for the scenes of the paper (prt_textures.txt, Table 1), of as many triangles, on coarse grounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness import places
from warp_gi.bench.harness.court import block
from warp_gi.bench.harness.scenes import DRAGON, SCENES, quad, sphere

GREY = gi.Material("grey", (0.6, 0.6, 0.6), specular=0.0)


@dataclass(frozen=True)
class StandIn:
    """A scene in place of one of the paper's, and what the paper says of that."""

    name: str
    build: Callable[[int], gi.Scene]
    """Builds it; it is given the size."""
    size: int
    """What decides the number of triangles."""
    quick: int
    """The size of the quick form; 0 leaves the scene out."""
    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    paper_triangles: int
    paper_fps: tuple[float, float, float, float]
    """Frames a second at 1920x1080 on an RTX 3090 (Table 1): at vertices TP and TPFL, by textures TP and TPFL."""
    paper_vertex_mb: float
    """Memory at vertices with 25 coefficients (Table 2); 100 MB by textures, whatever the scene."""
    reads: tuple[str, ...] = ()

    @property
    def missing(self) -> str:
        """Message about files that are missing; empty if none are."""
        return places.missing(self.reads)

    def camera(self, resolution: tuple[int, int]) -> gi.Camera:
        """Return the camera that sees it."""
        return gi.Camera.look_at(self.eye, self.target, hfov=50, resolution=resolution)


def room(rows: int) -> gi.Scene:
    """Return a room of ten triangles with balls and boxes in it; ``rows`` 42 make 20.7 K triangles."""
    shell = [
        quad((-3, 0, 3), (6, 0, 0), (0, 0, -6), GREY, "floor"),
        quad((-3, 0, -3), (6, 0, 0), (0, 3, 0), GREY, "back"),
        quad((-3, 0, 3), (0, 0, -6), (0, 3, 0), gi.Material("red", (0.65, 0.1, 0.08), specular=0.0), "left"),
        quad((3, 0, -3), (0, 0, 6), (0, 3, 0), gi.Material("green", (0.12, 0.5, 0.12), specular=0.0), "right"),
        quad((3, 0, 3), (-6, 0, 0), (0, 3, 0), GREY, "front"),
    ]
    things = [sphere(middle, 0.55, GREY, rows) for middle in ((-1.4, 0.55, 0.3), (0.2, 1.55, -1.2), (1.5, 0.55, 0.6))]
    boxes = [
        *block((0.2, 0, -1.2), (1.2, 1.0, 1.2), 0.3, GREY),
        *block((-1.8, 0, -1.8), (0.9, 1.6, 0.7), -0.4, GREY),
    ]
    return gi.Scene([gi.Node("room", [*shell, *things, *boxes])], name="room")


def dragon(size: int) -> gi.Scene:
    """Return the Stanford dragon, 2 m long and smooth, on a ground of two triangles."""
    loaded = gi.load_scene(SCENES / DRAGON, scale=10.0)
    low, _ = loaded.bounds
    lowered = np.eye(4)
    lowered[1, 3] = -low[1]
    nodes = []
    for node in loaded.nodes:
        meshes = [replace(mesh, material=GREY, normals=_normals(mesh.points, mesh.indices)) for mesh in node.meshes]
        nodes.append(replace(node, meshes=meshes, parent_from_node=lowered @ node.parent_from_node))
    return gi.Scene([*nodes, ground()], name="dragon")


def ground(size: float = 6.0) -> gi.Node:
    """Return a square of two triangles on y = 0."""
    corner = (-size / 2, 0, size / 2)
    return gi.Node("ground", [quad(corner, (size, 0, 0), (0, 0, -size), GREY, "ground")])


def heads(cells: int) -> gi.Scene:
    """Return two heads and a monkey's on a ground; 111 cells along the edge of a cube's face make 441 K triangles."""
    makers = ((-1.3, "head", ()), (0.0, "monkey", ((0.95, 0.25, 0.2), (-0.95, 0.25, 0.2))), (1.3, "head 2", ()))
    meshes = [head((x, 0.75, 0.2 * (k % 2)), cells, name, ears, k) for k, (x, name, ears) in enumerate(makers)]
    return gi.Scene([gi.Node(mesh.name, [mesh]) for mesh in meshes] + [ground()], name="heads")


def head(
    middle: tuple[float, float, float], cells: int, name: str, ears: tuple[tuple[float, float, float], ...], seed: int
) -> gi.Mesh:
    """Return a displaced ball of 12 ``cells``^2 triangles with eyes, a mouth, hair and ears.

    It is a cube's six faces blown up, each of which has a rectangle of the texture for itself.
    """
    points, uvs, faces = [], [], []
    steps = np.linspace(-1, 1, cells + 1)
    across, along = (axis.ravel() for axis in np.meshgrid(steps, steps))
    rows = np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)
    a = rows.ravel()
    quads = np.concatenate(
        [np.stack([a, a + 1, a + cells + 2], axis=1), np.stack([a, a + cells + 2, a + cells + 1], axis=1)]
    )
    for k, (axis, sign) in enumerate((axis, sign) for axis in range(3) for sign in (1.0, -1.0)):
        cube = np.zeros((len(across), 3))
        cube[:, axis], cube[:, (axis + 1) % 3], cube[:, (axis + 2) % 3] = sign, sign * across, along
        points.append(np.tan(cube * np.pi / 4))
        column, row = k % 3, k // 3
        uv = np.stack([(across + 1) / 2, (along + 1) / 2], axis=1) * 0.96 + 0.02
        uvs.append((uv + np.array([column, row])) / (3, 2))
        faces.append(quads + k * len(across))
    directions = np.concatenate(points)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radii = 0.6 * _relief(directions, ears, seed)
    found = (np.asarray(middle) + radii[:, None] * directions).astype(np.float32)
    indices = np.concatenate(faces).astype(np.int32)
    normals = _normals(found, indices)
    return gi.Mesh(found, indices, GREY, normals=normals, uvs=np.concatenate(uvs).astype(np.float32), name=name)


def _relief(directions: np.ndarray, ears: tuple[tuple[float, float, float], ...], seed: int) -> np.ndarray:
    """Return radii about 1 over unit directions: bumps, and what ``head`` says."""
    rng, radii = np.random.default_rng(seed), np.ones(len(directions))
    features = [((0.35, 0.2, 0.9), 30.0, -0.22), ((-0.35, 0.2, 0.9), 30.0, -0.22)]
    features += [((0.0, -0.35, 0.9), 20.0, -0.15), ((0.0, -0.05, 1.0), 40.0, 0.25)]
    features += [(ear, 60.0, 0.55) for ear in ears]
    features += [(tuple(rng.normal(size=3)), 12.0 + 60.0 * rng.random(), 0.05 * rng.normal()) for _ in range(40)]
    for place, sharpness, height in features:
        axis = np.asarray(place) / np.linalg.norm(place)
        radii += height * np.exp(sharpness * (directions @ axis - 1))
    locks = np.sin(24 * directions[:, 0]) * np.sin(20 * directions[:, 2])
    return np.asarray(radii + 0.03 * np.maximum(directions[:, 1] - 0.3, 0) * locks)


def _normals(points: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Return normals of the vertices, smooth across seams, where vertices of other faces have the same place."""
    corners = points[indices].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    _, place = np.unique(np.round(points, 5), axis=0, return_inverse=True)
    place, sums = place.reshape(-1), np.zeros((len(points), 3))
    for corner in range(3):
        np.add.at(sums, place[indices[:, corner]], normals)
    found = sums[place]
    return (found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-20)).astype(np.float32)


def plants(leaves: int) -> gi.Scene:
    """Return plants of bent leaves on a ground, 12 triangles a leaf; 1,500 leaves make 18 K triangles."""
    rng, segments = np.random.default_rng(3), 6
    side = int(np.ceil(np.sqrt(leaves)))
    along = np.linspace(0, 1, segments + 1)
    points, uvs, faces = [], [], []
    strip = np.arange(segments)[:, None] * 2
    quads = np.concatenate([strip + np.array(corners) for corners in ((0, 1, 3), (0, 3, 2))])
    for k in range(leaves):
        root = np.array([*(rng.integers(-3, 4, 2) * 0.7), 0.0])[[0, 2, 1]] + 0.06 * rng.normal(size=3) * (1, 0, 1)
        turn, length, bend, width = rng.uniform(0, 2 * np.pi), *rng.uniform((0.5, 0.4, 0.03), (1.2, 1.5, 0.07))
        outward, aside = np.array([np.cos(turn), 0, np.sin(turn)]), np.array([-np.sin(turn), 0, np.cos(turn)])
        height = length * along * (1 - 0.35 * bend * along)
        spine = root + outward * (0.4 * length * bend * along**2)[:, None] + np.outer(height, (0, 1, 0))
        half = np.outer(width * np.sin(np.pi * (0.15 + 0.8 * along)), aside)
        points.append(np.stack([spine - half, spine + half], axis=1).reshape(-1, 3))
        cell = np.array([k % side, k // side])
        uv = np.stack(np.broadcast_arrays(np.array([0.1, 0.9]), (0.1 + 0.8 * along)[:, None]), axis=-1).reshape(-1, 2)
        uvs.append((uv + cell) / side)
        faces.append(quads + k * 2 * (segments + 1))
    green = gi.Material("leaf", (0.2, 0.5, 0.15), specular=0.0)
    mesh = gi.Mesh(
        np.concatenate(points).astype(np.float32),
        np.concatenate(faces).astype(np.int32),
        green,
        uvs=np.concatenate(uvs).astype(np.float32),
        name="leaves",
    )
    return gi.Scene([gi.Node("plants", [mesh]), ground()], name="plants")


STAND_INS = (
    StandIn(
        "dragon", dragon, 1, 0, (1.2, 1.4, 2.6), (0, 0.6, 0), 1_300_000, (3.62, 41.2, 5.2, 151.2), 215.8, (DRAGON,)
    ),
    StandIn("TRM", heads, 111, 12, (0.4, 1.8, 3.6), (0, 0.6, 0), 441_000, (10.2, 116.2, 15.2, 202.9), 139.3),
    StandIn("room", room, 42, 8, (1.8, 2.2, 2.6), (-0.3, 0.6, -0.6), 21_000, (352.3, 2432.7, 83.6, 568.2), 2.5),
    StandIn("plants", plants, 1500, 60, (1.6, 1.6, 3.2), (0, 0.4, 0), 18_000, (363.2, 2597.6, 6.7, 168.3), 2.5),
)
"""The scenes of the paper's tables, in its order."""
