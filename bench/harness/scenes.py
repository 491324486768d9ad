"""Scenes that are measured beside those of files and the built-in ones, and shapes to build them of; see `places`."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import warp_gi as gi
from warp_gi.scene.builtin import shapes

SCENES = Path(os.environ.get("WARP_GI_SCENES", Path(__file__).resolve().parents[2] / ".." / "shared" / "scenes"))
"""Folder of the scene files, which are not part of the project."""

REFERENCE_DEPTH = 64
"""``max_depth`` of the path-traced pictures that others are measured against. Longer paths bring less than a thousandth
of a percent of the indirect light in any scene of `places`."""

LIVING_ROOM, DRAGON = "living_room/living_room.obj", "stanford_dragon.ply"


def peer_scene(
    scene: gi.Scene, diffuse: bool, flat: bool = True, masks: bool = True, emission: bool = True
) -> gi.Scene:
    """Return ``scene`` without normal maps, emission on one side only.

    ``diffuse`` makes every material Lambert of the same base colour, ``flat`` drops the
    vertex normals, ``masks=False`` makes alpha-masked materials opaque, ``emission=False`` dark.
    """
    materials: dict[int, gi.Material] = {}

    def converted(material: gi.Material) -> gi.Material:
        if id(material) not in materials:
            changes: dict[str, Any] = {"normal_texture": None}
            if diffuse:
                changes |= {"specular": 0.0, "metallic": 0.0, "roughness": 1.0, "metallic_roughness_texture": None}
            if any(material.emission):
                changes |= {"double_sided": False} if emission else {"emission": (0.0, 0.0, 0.0)}
            if not masks:
                changes |= {"alpha_cutoff": None, "alpha_blend": False}
            materials[id(material)] = replace(material, **changes)
        return materials[id(material)]

    nodes = [
        replace(
            node,
            meshes=[
                replace(mesh, material=converted(mesh.material), normals=None if flat else mesh.normals)
                for mesh in node.meshes
            ],
        )
        for node in scene.nodes
    ]
    return gi.Scene(nodes, scene.lights, scene.environment, scene.cameras, scene.name)


def quad(corner: object, edge_u: object, edge_v: object, material: gi.Material, name: str = "quad") -> gi.Mesh:
    """Return a parallelogram whose front is the side that ``edge_u`` x ``edge_v`` points to."""
    corner, edge_u, edge_v = (np.asarray(v, dtype=np.float32) for v in (corner, edge_u, edge_v))
    points = np.stack([corner, corner + edge_u, corner + edge_u + edge_v, corner + edge_v])
    uvs = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32)
    return gi.Mesh(points, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32), material, uvs=uvs, name=name)


def sphere(center: object, radius: float, material: gi.Material, rows: int = 24) -> gi.Mesh:
    """Return a sphere of ``rows`` x 2 ``rows`` cells with smooth normals, closed, fronts outward."""
    theta, phi = np.pi * np.arange(rows + 1) / rows, np.pi * np.arange(2 * rows + 1) / rows
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    normals = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], axis=-1)
    normals = normals.reshape(-1, 3).astype(np.float32)
    row, column = (grid.ravel() for grid in np.meshgrid(np.arange(rows), np.arange(2 * rows), indexing="ij"))
    a = row * (2 * rows + 1) + column
    b = a + 2 * rows + 1
    upper, lower = np.stack([a, b, a + 1], axis=1)[row > 0], np.stack([a + 1, b, b + 1], axis=1)[row < rows - 1]
    points = np.asarray(center, dtype=np.float32) + np.float32(radius) * normals
    return gi.Mesh(points, np.concatenate([upper, lower]).astype(np.int32), material, normals=normals, name="sphere")


def light(radiance: tuple[float, float, float]) -> gi.Material:
    """Return a black material that emits on its front."""
    return gi.Material("light", (0.0, 0.0, 0.0), specular=0.0, emission=radiance, double_sided=False)


def lit_room() -> gi.Scene:
    """The living room, lit by a square lamp under its ceiling and its own back light."""
    scene = gi.load_scene(SCENES / LIVING_ROOM)
    mesh = quad((-0.9, 2.95, 1.6), (0.8, 0.0, 0.0), (0.0, 0.0, 0.8), light((14.0, 11.0, 8.0)), "lamp")
    return gi.Scene([*scene.nodes, gi.Node("lamp", [mesh])], scene.lights, None, scene.cameras, scene.name)


def spheres() -> gi.Scene:
    """Metal spheres of rising roughness before coated ones, on a Lambert floor, below a square lamp."""
    meshes = [quad((-6, 0, 6), (12, 0, 0), (0, 0, -12), gi.Material("floor", (0.5, 0.5, 0.5), specular=0.0), "floor")]
    for i, roughness in enumerate((0.1, 0.25, 0.5, 0.75, 1.0)):
        metal = gi.Material(f"metal{i}", (0.95, 0.64, 0.54), metallic=1.0, roughness=roughness)
        coated = gi.Material(f"coated{i}", (0.1, 0.3, 0.7), roughness=roughness)
        meshes.append(sphere((1.1 * (i - 2), 1.3, -0.6), 0.5, metal))
        meshes.append(sphere((1.1 * (i - 2), 0.5, 0.6), 0.5, coated))
    mixed = gi.Material("mixed", (0.8, 0.7, 0.2), metallic=0.5, roughness=0.4, specular=0.6)
    meshes.append(quad((-4, 0, -2), (8, 0, 0), (0, 4, -1), mixed, "wall"))
    meshes.append(quad((-1.0, 3.5, 0.0), (2.0, 0, 0), (0, 0, 1.0), light((9.0, 9.0, 9.0)), "lamp"))
    return gi.Scene([gi.Node("spheres", meshes)], name="spheres")


# ---- a box with cylinders over probes (light_field_probes.txt, Fig. 10) ----


def cylinder(center: tuple[float, float], radius: float, height: float, material: gi.Material) -> gi.Mesh:
    """Return an upright cylinder with a lid, standing at (x, z) on y = 0, fronts outward."""
    sides = 48
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([center[0] + radius * np.sin(angle), 0 * angle, center[1] + radius * np.cos(angle)], axis=1)
    upper_ring, middle = ring + np.array([0, height, 0]), [[center[0], height, center[1]]]
    points = np.concatenate([ring, upper_ring, middle]).astype(np.float32)
    i, j = np.arange(sides), (np.arange(sides) + 1) % sides
    lower, upper = np.stack([i, j, i + sides], axis=1), np.stack([j, j + sides, i + sides], axis=1)
    lid = np.stack([i + sides, j + sides, np.full(sides, 2 * sides)], axis=1)
    return gi.Mesh(points, np.concatenate([lower, upper, lid]).astype(np.int32), material, name="cylinder")


def cylinder_box() -> gi.Scene:
    """Return a box of 6 x 2 x 6 m, open above, with four cylinders; the one in its middle and two more cover probes.

    Probes are at -2.22, 0 and 2.22 along x and z for a grid of 3 x 2 x 3.
    """
    grey = gi.Material("grey", (0.7, 0.7, 0.7), specular=0.0)
    red, blue = (gi.Material(n, c, specular=0.0) for n, c in (("red", (0.7, 0.2, 0.15)), ("blue", (0.15, 0.25, 0.7))))
    walls = [
        quad((-3, 0, 3), (6, 0, 0), (0, 0, -6), grey, "floor"),
        quad((-3, 0, -3), (6, 0, 0), (0, 2, 0), grey, "back"),
        quad((3, 0, 3), (-6, 0, 0), (0, 2, 0), grey, "front"),
        quad((-3, 0, 3), (0, 0, -6), (0, 2, 0), red, "left"),
        quad((3, 0, -3), (0, 0, 6), (0, 2, 0), blue, "right"),
    ]
    places = ((0.0, 0.0, 0.6), (2.2, -2.2, 0.5), (2.2, 0.0, 0.4), (-1.1, 1.2, 0.4))
    columns = [cylinder((x, z), radius, 1.8, grey) for x, z, radius in places]
    lamp = quad((-2.5, 1.95, -2.5), (0.8, 0, 0), (0, 0, 0.8), light((20.0, 20.0, 20.0)), "lamp")
    return gi.Scene([gi.Node("box", [*walls, *columns, lamp])], name="cylinders")


# ---- scenes of sample reuse (temporal_reuse.txt, figures 8, 10 and 13b); seen as they are, by gi alone ----

FPS = 24.0
_COVER = 2.35  # m, height of the dragon's cover
RING_RADIUS, RING_WALL = 2.0, 3.0
"""Radii of the ring's floor and of the wall around it, metres."""
STROBE_PERIODS = {"jump": 32, "slit": 16}
"""Number of frames after which the lamp of `strobe` is back in its place, by kind."""
_CYCLES = 8


def covered_dragon() -> gi.Scene:
    """The Stanford dragon, 2 m long, in a room under a grille, above which ten lamps hang."""
    grey = gi.Material("grey", (0.6, 0.6, 0.6), specular=0.0)
    brass = gi.Material("dragon", (0.55, 0.40, 0.22), roughness=0.5)
    loaded = gi.load_scene(SCENES / DRAGON, scale=10.0)
    low, _ = loaded.bounds
    nodes = []
    for node in loaded.nodes:
        meshes = [replace(mesh, material=brass) for mesh in node.meshes]
        nodes.append(replace(node, meshes=meshes, parent_from_node=_moved(-low[1]) @ node.parent_from_node))
    room = [
        quad((-3, 0, 3), (6, 0, 0), (0, 0, -6), grey, "floor"),
        quad((-3, 0, -3), (6, 0, 0), (0, 4, 0), grey, "back"),
        quad((-3, 0, 3), (0, 0, -6), (0, 4, 0), gi.Material("red", (0.6, 0.25, 0.2), specular=0.0), "left"),
        quad((3, 0, -3), (0, 0, 6), (0, 4, 0), gi.Material("blue", (0.2, 0.3, 0.6), specular=0.0), "right"),
        quad((3, 0, 3), (-6, 0, 0), (0, 4, 0), grey, "front"),
        quad((-3, 4, -3), (6, 0, 0), (0, 0, 6), grey, "ceiling"),
    ]
    bars = [shapes.box((-3, _COVER, z - 0.11), (3, _COVER + 0.06, z + 0.11)) for z in np.arange(-2.85, 3, 0.3)]
    bars += [shapes.box((x - 0.11, _COVER, -3), (x + 0.11, _COVER + 0.06, 3)) for x in np.arange(-2.85, 3, 0.3)]
    lamps = []
    for k in range(10):
        x, z, strength = 1.1 * (k % 5 - 2), (-0.9, 0.8)[k // 5] + 0.15 * (k % 3), 40.0 * (1 + k % 4)
        radiance = (strength, strength * (1.0, 0.85, 0.7)[k % 3], strength * (1.0, 0.7, 0.45)[k % 3])
        lamps.append(quad((x, 3.3, z), (0.3, 0, 0), (0, 0, 0.3), light(radiance), f"lamp {k}"))
    cover = shapes.merge(bars).mesh(grey, "cover")
    return gi.Scene([*nodes, gi.Node("room", room), gi.Node("cover", [cover]), gi.Node("lamps", lamps)], name="dragon")


def guiding_ring(turn: float = 9.0, frame: int = 40, start: float = 0.0) -> gi.Scene:
    """Figure 10: a round floor in a round wall, lit by a spot on the wall from a light below the floor.

    The light turns by ``turn`` degrees from ``start`` between ``frame`` - 1 and ``frame``.
    """
    grey = gi.Material("grey", (0.6, 0.6, 0.6), specular=0.0)
    height = np.array([-1.5, 2.5])
    wall = shapes.lathe([(RING_WALL, y) for y in height[::-1]], 120)
    floor = shapes.lathe([(RING_RADIUS, 0.0), (0.0, 0.0)], 120)
    node = gi.Node("light", [], keyframes=_steps([(0.0, (0, 0, 0), start), (frame / FPS, (0, 0, 0), start + turn)]))
    # the cone leaves through the gap between floor and wall, and meets the wall about 1 m above the floor
    below = gi.PunctualLight(
        "spot", (300.0, 300.0, 300.0), (1.5, -1.0, 0.0), (0.6, 0.8, 0.0), np.radians(7.0), np.radians(10.0), node=0
    )
    meshes = [wall.mesh(grey, "wall"), floor.mesh(grey, "floor")]
    return gi.Scene([node, gi.Node("arena", meshes)], [below], name="guiding_ring")


def strobe(kind: str = "jump") -> gi.Scene:
    """A room of dim lamps, and a bright one that is not where it was: "jump"s into a closed box, or passes a "slit".

    It jumps every half of `STROBE_PERIODS`; along the slits it moves every frame, there and back.
    """
    grey = gi.Material("grey", (0.6, 0.6, 0.6), specular=0.0)
    room = [shapes.box((-3, 0, -3), (3, 3, 3)).flipped().mesh(grey, "room")]
    room += [shapes.box((-1.6, 0, -1.2), (-0.8, 1.1, -0.4)).mesh(grey, "block")]
    dim = light((6.0, 6.0, 6.0))
    room += [quad((x, 2.98, z), (0.2, 0, 0), (0, 0, 0.2), dim, "dim") for x in (-2.2, 2.0) for z in (-2.2, 2.0)]
    lamp = quad((-0.15, 0, -0.15), (0.3, 0, 0), (0, 0, 0.3), light((60.0, 50.0, 40.0)), "lamp")
    period = STROBE_PERIODS[kind]
    half = period // 2
    if kind == "jump":
        room.append(shapes.box((1.5, 0.02, -2.5), (2.5, 0.9, -1.5)).mesh(grey, "box"))
        places = [(0.3, 2.6, 0.0), (2.0, 0.45, -2.0)] * _CYCLES
        poses = [(k * half / FPS, place, 0.0) for k, place in enumerate(places)]
    else:
        slats = [shapes.box((x - 0.22, 1.95, -1), (x + 0.22, 2.0, 1)) for x in np.arange(-2.75, 3, 0.5)]
        room.append(shapes.merge(slats).mesh(grey, "slats"))
        steps = [strobe_place(kind, k) for k in range(period * _CYCLES)]
        poses = [(k / FPS, (3.6 * step / half - 1.8, 2.6, 0.0), 0.0) for k, step in enumerate(steps)]
    return gi.Scene([gi.Node("room", room), gi.Node("lamp", [lamp], keyframes=_steps(poses))], name=f"strobe {kind}")


def strobe_place(kind: str, frame: int) -> int:
    """Return the number of the place, 0 to half the period at most, where the lamp of `strobe` is in a frame."""
    half = STROBE_PERIODS[kind] // 2
    phase = frame % (2 * half)
    return phase // half if kind == "jump" else min(phase, 2 * half - phase)


def _steps(poses: list[tuple[float, tuple[float, float, float], float]]) -> list[gi.Keyframe]:
    """Return keyframes that hold each of ``poses`` (seconds, place, degrees about y) until the next begins."""
    keys: list[gi.Keyframe] = []
    for k, (begin, place, turn) in enumerate(poses):
        half = np.radians(turn) / 2
        x, y, z = map(float, place)
        rotation = (0.0, float(np.sin(half)), 0.0, float(np.cos(half)))
        end = poses[k + 1][0] if k + 1 < len(poses) else begin + 1.0
        for time in (begin - 0.25 / FPS, end - 0.5 / FPS):
            keys.append(gi.Keyframe(time, (x, y, z), rotation))
    return keys


def _moved(y: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[1, 3] = y
    return matrix
