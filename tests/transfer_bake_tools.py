"""Bakes of transfer textures for tests: a slow one in NumPy, and one of random numbers on pages of an own making."""

from __future__ import annotations

import numpy as np
from atlas_tools import settings, slot_positions
from scene_tools import quad

import warp_gi as gi
from warp_gi.baking import Bake
from warp_gi.scene import harmonics
from warp_gi.scene.model import Material, Mesh, Node, Texture
from warp_gi.scene.scene import Scene
from warp_gi.techniques.radiance_transfer.textures import TECHNIQUE, TransferTextures
from warp_gi.techniques.shared.atlas.atlas import Atlas
from warp_gi.techniques.shared.atlas.build import make_atlas

GROUND = Texture("checks", np.tile(np.array([[[250, 128, 64, 255], [10, 200, 90, 255]]], np.uint8), (2, 1, 1)))


def court() -> Scene:
    """Return a floor of 4 m with a texture, a red and a green wall of 2 m, and a box that casts shadows on them."""
    floor = Material("floor", (0.6, 0.6, 0.6), specular=0.0, base_color_texture=GROUND)
    red, green, grey = (
        Material(name, color, specular=0.0)
        for name, color in (("red", (0.7, 0.1, 0.1)), ("green", (0.1, 0.6, 0.1)), ("grey", (0.6, 0.6, 0.6)))
    )
    ground = quad((-2, 0, 2), (4, 0, 0), (0, 0, -4), floor)
    ground = Mesh(ground.points, ground.indices, floor, uvs=np.array([[0, 0], [2, 0], [2, 2], [0, 2]], np.float32))
    walls = [quad((-2, 0, 2), (0, 0, -4), (0, 2, 0), red), quad((-2, 0, -2), (4, 0, 0), (0, 2, 0), green)]
    corner, edges = np.array([-0.6, 0.0, -0.4]), np.diag([0.9, 1.1, 0.8])
    box = [quad(corner + edges[a], edges[b], edges[c], grey) for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1))]
    box += [quad(corner, edges[2], edges[1], grey), quad(corner, edges[1], edges[0], grey)]
    return Scene([Node("ground", [ground]), Node("walls", walls), Node("box", box)], name="court")


def bake_of(textures: TransferTextures, scene: Scene, technique: str = TECHNIQUE) -> Bake:
    """Return a bake that holds these textures."""
    return Bake(technique, scene.geometry_hash, {}, textures.arrays(), {"bounces": 1}, scene.name)


def slow_bake(scene: Scene, rays: int = 64, bounces: int = 3, seed: int = 1, **changes) -> TransferTextures:
    """Return transfer of fronts by random rays of the cosine's density, in NumPy."""
    atlas = make_atlas(scene, settings(**changes), "cpu")
    flat, rng = scene._flat, np.random.default_rng(seed)
    corners = flat.points[flat.indices[atlas.slot_faces]].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    directions = rng.normal(size=(atlas.count, rays, 3))
    directions = normals[:, None] + directions / np.linalg.norm(directions, axis=2, keepdims=True)
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    origins = np.repeat(slot_positions(scene, atlas) + 1e-4 * normals, rays, axis=0)
    hits = gi.TriangleBvh(flat.points, flat.indices).intersect(
        origins.astype(np.float32), directions.reshape(-1, 3).astype(np.float32)
    )
    faces, u, v = (one.numpy().reshape(atlas.count, rays) for one in (hits.face, hits.u, hits.v))
    sees = faces < 0
    functions = harmonics.basis(directions, 5)
    transfer = np.pi * (functions * sees[..., None]).mean(axis=1)
    albedo = np.array([material.base_color for material in scene.materials])[flat.materials]
    p = (atlas.corners[faces] * np.stack([1 - u - v, u, v], axis=-1)[..., None]).sum(axis=2).astype(int)
    width, height = atlas.pages[0, 1:]
    slots = atlas.slots[0][np.clip(p[..., 1], 0, height - 1) * width + np.clip(p[..., 0], 0, width - 1)]
    weight = np.where(sees | (slots < 0), 0, 1)[..., None] * albedo[faces] / rays
    last, total = np.repeat(transfer[:, None], 3, axis=1), np.zeros((atlas.count, 3, 25))
    for _ in range(bounces):
        following = np.zeros_like(last)
        for ray in range(rays):
            following += weight[:, ray, :, None] * last[slots[:, ray]]
        last = following
        total += last
    kept = total if bounces else np.zeros((0, 3, 25))
    return TransferTextures(atlas, transfer.astype(np.float16), kept.astype(np.float16), np.zeros((0, 3), np.float32))


def random_bake(scene: Scene, order: int = 5, seed: int = 5, **changes) -> TransferTextures:
    """Return random numbers on two pages of unequal sizes, of which the first is seen from behind in a part.

    Some texels have lost their slots, so that something is missing between others.
    """
    one = make_atlas(scene, settings(**{"resolution": 48, **changes}), "cpu")
    (_, width, height), rng = one.pages[0], np.random.default_rng(seed)
    wide, high = width + 5, height + 3
    owner = np.full(width * height, -1)
    owner[one.slots[0] >= 0] = one.slot_faces[one.slots[0][one.slots[0] >= 0]]
    half = len(one.face_pages) // 2
    second = np.full((high, wide), -1)
    second[:height, :width] = np.where(owner >= half, owner, -1).reshape(height, width)
    owners = np.concatenate([np.where(owner < half, owner, -1), second.ravel()])
    backs = np.concatenate([np.where(owner < half // 2, owner, -1), np.full(second.size, -1)])
    faces = np.concatenate([owners[owners >= 0], backs[backs >= 0]]).astype(np.int32)
    slots = np.full((2, len(owners)), -1, np.int32)
    slots[0][owners >= 0] = np.arange((owners >= 0).sum())
    slots[1][backs >= 0] = np.arange((owners >= 0).sum(), len(faces))
    slots[rng.random(slots.shape) < 0.1] = -1
    count = len(faces)
    atlas = Atlas(
        corners=one.corners,
        face_pages=(np.arange(len(one.face_pages)) >= half).astype(np.int32),
        charts=one.charts,
        pages=np.array([[0, width, height], [width * height, wide, high]], np.int32),
        slots=slots,
        corner_slots=one.corner_slots,
        slot_faces=faces,
        slot_points=np.full((count, 2), 0.25, np.float32),
        slot_sides=(np.arange(count) >= (owners >= 0).sum()).astype(np.uint8),
    )
    numbers = lambda *shape: rng.normal(size=(count, *shape)).astype(np.float16)  # noqa: E731
    return TransferTextures(atlas, numbers(order**2), numbers(3, 25), rng.random((count, 3), np.float32) * 1e5)
