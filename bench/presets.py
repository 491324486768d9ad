"""The scenes that truth and speed are measured on: one table for the reference script, the tests and the benchmarks."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import warp_gi as gi

SCENES = Path(os.environ.get("WARP_GI_SCENES", Path(__file__).resolve().parents[1] / ".." / "shared" / "scenes"))
"""Folder of the scene files, which are not part of the project."""

SIZE = (72, 40)
"""Width and height of the reference pictures."""


@dataclass(frozen=True)
class Preset:
    """A scene as both renderers get it: the materials Mitsuba has an equal for, flat normals, one-sided emission."""

    build: Callable[[], gi.Scene]
    camera: gi.Camera
    max_depth: int
    """Edges of the longest path, camera to light: 2 is direct light."""
    files: tuple[str, ...] = ()
    """What has to be in `SCENES`."""
    peer_error: float = 0.0
    """Relative standard error of Mitsuba's picture that comes from its ray offset: rays start 9e-5 (1 + |x|) m
    off a surface at x and look past what is thinner, such as paint. With that offset here the difference is gone."""

    @property
    def missing(self) -> str:
        """The files that are not there, or nothing."""
        return ", ".join(str(SCENES / name) for name in self.files if not (SCENES / name).exists())


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
            changes: dict[str, object] = {"normal_texture": None}
            if diffuse:
                changes |= {"specular": 0.0, "metallic": 0.0, "roughness": 1.0, "metallic_roughness_texture": None}
            if any(material.emission):
                changes |= {"double_sided": False} if emission else {"emission": (0.0, 0.0, 0.0)}
            if not masks:
                changes["alpha_cutoff"] = None
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


def sponza(environment: object) -> gi.Scene:
    scene = gi.load_scene(SCENES / "crytek_sponza.glb", environment=environment)
    return peer_scene(scene, diffuse=True)


def living_room(lamp: bool, diffuse: bool = True) -> gi.Scene:
    """The living room, lit by a square lamp under its ceiling and its own back light, or by nothing but a white sky."""
    scene = gi.load_scene(SCENES / "living_room" / "living_room.obj", environment=None if lamp else (1.0, 1.0, 1.0))
    if lamp:
        mesh = quad((-0.9, 2.95, 1.6), (0.8, 0.0, 0.0), (0.0, 0.0, 0.8), light((14.0, 11.0, 8.0)), "lamp")
        scene = gi.Scene([*scene.nodes, gi.Node("lamp", [mesh])], scene.lights, None, scene.cameras, scene.name)
    return peer_scene(scene, diffuse=diffuse, emission=lamp)


def spheres(environment: object) -> gi.Scene:
    """Metal spheres of rising roughness before coated ones, on a Lambert floor, below a square lamp and a sky."""
    meshes = [quad((-6, 0, 6), (12, 0, 0), (0, 0, -12), gi.Material("floor", (0.5, 0.5, 0.5), specular=0.0), "floor")]
    for i, roughness in enumerate((0.1, 0.25, 0.5, 0.75, 1.0)):
        metal = gi.Material(f"metal{i}", (0.95, 0.64, 0.54), metallic=1.0, roughness=roughness)
        coated = gi.Material(f"coated{i}", (0.1, 0.3, 0.7), roughness=roughness)
        meshes.append(sphere((1.1 * (i - 2), 1.3, -0.6), 0.5, metal))
        meshes.append(sphere((1.1 * (i - 2), 0.5, 0.6), 0.5, coated))
    mixed = gi.Material("mixed", (0.8, 0.7, 0.2), metallic=0.5, roughness=0.4, specular=0.6)
    meshes.append(quad((-4, 0, -2), (8, 0, 0), (0, 4, -1), mixed, "wall"))
    meshes.append(quad((-1.0, 3.5, 0.0), (2.0, 0, 0), (0, 0, 1.0), light((9.0, 9.0, 9.0)), "lamp"))
    return peer_scene(gi.Scene([gi.Node("spheres", meshes)], environment=environment, name="spheres"), diffuse=False)


def _view(eye: object, target: object, hfov: float) -> gi.Camera:
    return gi.Camera.look_at(eye, target, hfov=hfov, resolution=SIZE)


SPONZA_VIEW = _view((-11, 1.5, -0.3), (5, 4, 0), 65.0)
LIVING_ROOM_VIEW = _view((0, 1, 4), (0.5, 1.2, 0), 60.0)
SPHERES_VIEW = _view((0, 1.6, 7), (0, 1.1, 0), 50.0)
_SPONZA, _LIVING_ROOM = "crytek_sponza.glb", "living_room/living_room.obj"


def _cornell() -> gi.Scene:
    return peer_scene(gi.builtin_scene("cornell_box"), diffuse=True)


PRESETS: dict[str, Preset] = {
    "cornell_box": Preset(_cornell, _view((0, 1, 3.4), (0, 1, 0), 55.0), 6),
    "sponza_white_sky": Preset(lambda: sponza((1.0, 1.0, 1.0)), SPONZA_VIEW, 4, (_SPONZA,)),
    "sponza_courtyard": Preset(
        lambda: sponza(SCENES / "environments/courtyard.exr"),
        SPONZA_VIEW,
        4,
        (_SPONZA, "environments/courtyard.exr"),
    ),
    "living_room_lamp": Preset(lambda: living_room(lamp=True), LIVING_ROOM_VIEW, 5, (_LIVING_ROOM,), 0.003),
    "spheres_lamp": Preset(lambda: spheres((0.2, 0.3, 0.5)), SPHERES_VIEW, 5),
    "spheres_interior": Preset(
        lambda: spheres(SCENES / "environments/interior.exr"), SPHERES_VIEW, 5, ("environments/interior.exr",)
    ),
}
