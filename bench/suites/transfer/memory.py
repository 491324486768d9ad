"""Memory: bytes a texel, what halves lose, and bounces as principal components."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness.court import court
from warp_gi.bench.harness.measure import Row, attempt
from warp_gi.bench.harness.places import PLACES
from warp_gi.bench.suites.transfer.views import DENSE, smooth_sky
from warp_gi.kernels.transfer_products import WIDTHS
from warp_gi.scene import harmonics
from warp_gi.techniques.radiance_transfer.pca import compress_bounces
from warp_gi.techniques.radiance_transfer.textures import LIGHT_NUMBERS, TransferTextures, transfer_textures

BYTES, HALVES, PCA = "memory: bytes a texel", "memory: halves", "memory: components of bounces"
COMPONENTS = (8, 16, 24)
MOST_OF_HALVES, MOST_OF_PCA = 0.001, 0.03
"""Largest errors: of halves, and of 16 components."""


def memory_rows(quick: bool, device: str) -> list[Row]:
    """Return the rows of all tables."""
    base = gi.RadianceTransfer(resolution=48 if quick else DENSE)
    bake = gi.bake(court(1.0), base, device)
    textures = transfer_textures(bake)
    six = gi.bake(court(1.0), replace(base, order=6, bounces=0), device)
    rows = [byte_row(name, transfer_textures(one)) for name, one in (("5", bake), ("6", six))]
    rows += [halves_row(court(1.0), textures, 300 if quick else 3000), *component_rows("court", textures)]
    place = PLACES["living_room_white"]
    if quick:
        return rows
    said = {"table": PCA, "case": "living room"}
    if place.missing:
        return [*rows, said | {"skipped": place.missing}]
    return rows + attempt(said, partial(living_rows, place.scene(), device))


def living_rows(scene: gi.Scene, device: str) -> list[Row]:
    """Return errors of components in the living room."""
    bake = gi.bake(scene, gi.RadianceTransfer(resolution=512), device)
    return component_rows("living room", transfer_textures(bake))


def byte_row(order: str, textures: TransferTextures) -> Row:
    """Return bytes of a slot on the device, of a file, and of the atlas a texel."""
    atlas, count = textures.atlas, textures.atlas.count
    stored = textures.transfer.nbytes + textures.bounces.nbytes + textures.lamps.nbytes
    row: Row = {"table": BYTES, "case": "court", "order": order, "slots": count}
    row |= {"transfer bytes": 2 * WIDTHS[int(order)], "bounces bytes": 2 * 3 * WIDTHS[5] * bool(textures.bounces.size)}
    row |= {"stored bytes": stored / count, "atlas bytes a texel": sum(a.nbytes for a in vars(atlas).values())}
    texels = int((atlas.pages[:, 1] * atlas.pages[:, 2]).sum())
    row["atlas bytes a texel"] /= texels
    return row | {"slots a texel": count / texels}


def halves_row(scene: gi.Scene, textures: TransferTextures, count: int, rays: int = 256, seed: int = 0) -> Row:
    """Return what rounding to halves changes of transfer by random rays, and of light: RMS over the mean."""
    rng, atlas = np.random.default_rng(seed), textures.atlas
    some = rng.choice(np.flatnonzero(atlas.slot_sides == 0), min(count, atlas.count), replace=False)
    geometry = scene.data("cpu").geometry
    corners = geometry.points.numpy()[geometry.indices.numpy().reshape(-1, 3)[atlas.slot_faces[some]]].astype(float)
    weights = np.column_stack([1 - atlas.slot_points[some].sum(axis=1), atlas.slot_points[some]])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ways = rng.normal(size=(len(some), rays, 3))
    ways = normals[:, None] + ways / np.linalg.norm(ways, axis=2, keepdims=True)
    ways /= np.linalg.norm(ways, axis=2, keepdims=True)
    origins = np.repeat((weights[:, :, None] * corners).sum(axis=1) + 1e-4 * normals, rays, axis=0)
    hits = scene.bvh("cpu").intersect(origins.astype(np.float32), ways.reshape(-1, 3).astype(np.float32))
    open_ = (hits.face.numpy() < 0).reshape(len(some), rays)
    transfer = np.pi * (harmonics.basis(ways, 5) * open_[..., None]).mean(axis=1)
    change = transfer.astype(np.float16) - transfer
    light = smooth_sky().harmonics_of(5)
    row: Row = {"table": HALVES, "case": "court", "slots": len(some)}
    row["rel error of T"] = float(np.sqrt((change**2).sum() / (transfer**2).sum()))
    row["rel error of light"] = float(np.sqrt(((change @ light.T) ** 2).mean()) / (transfer @ light.T).mean())
    return row | {"target": MOST_OF_HALVES}


def component_rows(case: str, textures: TransferTextures) -> list[Row]:
    """Return bytes and error of bounces as principal components."""
    rows: list[Row] = []
    for components in COMPONENTS:
        found = compress_bounces(textures.bounces, components)
        row: Row = {"table": PCA, "case": case, "components": components, "numbers": 3 * LIGHT_NUMBERS}
        row |= {"stored bytes": 2 * components, "rel": found.error}
        rows.append(row | {"target": MOST_OF_PCA if components == 16 else 0.0})
    return rows
