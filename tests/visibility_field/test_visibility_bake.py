"""Baking visibility fields: analytic masks, pieces against a float64 oracle, merging, the index, files and errors."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import warp as wp
from scene_tools import quad
from statistics_tools import device, every_device  # noqa: F401

import warp_gi as gi
from warp_gi.errors import BakeError, GiError, OptionError
from warp_gi.kernels import gbuffer, types
from warp_gi.kernels import visibility_field as field
from warp_gi.kernels import visibility_field_audit as auditing
from warp_gi.kernels import visibility_field_bake as baking
from warp_gi.kernels.bvh import bvh_occluded, bvh_occluder
from warp_gi.launch import launch, set_threads
from warp_gi.scene.pinhole import camera_data
from warp_gi.techniques.visibility_field import bake as visibility_bake
from warp_gi.techniques.visibility_field.bake import FieldBaker, Grid, field_query, grid_of, neighbor_table, words_of
from warp_gi.techniques.visibility_field.state import FieldState

wp.set_module_options({"enable_backward": False})
SMALL = {"cell_size": 0.5, "resolution": 16, "rays": 64}
VISIBLE, OCCLUDED = 1, 2


@wp.kernel
def points_of_pieces(
    first: wp.int32,
    geometry: types.Geometry,
    search: baking.PieceSearch,
    cells: wp.array(dtype=wp.int32),
    sides: wp.array(dtype=wp.int32),
    numbers: wp.array(dtype=wp.vec2),
    points: wp.array(dtype=wp.vec3),
):
    i = first + wp.tid()
    cell = cells[i]
    x = cell % search.nx
    y = (cell / search.nx) % search.ny
    z = cell / (search.nx * search.ny)
    low = baking.cell_low(search, x, y, z)
    high = baking.cell_low(search, x + 1, y + 1, z + 1)
    t = baking.side_triangle(geometry, sides[i], search.radius)
    points[i] = baking.piece_point(t.p0, t.p1, t.p2, low, high, numbers[i][0], numbers[i][1])


@wp.kernel
def draw_samples(
    first: wp.int32,
    geometry: types.Geometry,
    cells: baking.CellSurfaces,
    slots: wp.array(dtype=wp.int32),
    numbers: wp.array(dtype=wp.int32),
    origins: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
):
    i = first + wp.tid()
    s = baking.surface_sample(geometry, cells, slots[i], numbers[i])
    origins[i] = s.origin
    normals[i] = s.normal


@wp.kernel
def trace_hinted(
    first: wp.int32,
    bvh: types.Bvh,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    limits: wp.array(dtype=wp.float32),
    hints: wp.array(dtype=wp.int32),
    found: wp.array(dtype=wp.int32),
    plain: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    found[i] = bvh_occluder(bvh, origins[i], directions[i], limits[i], hints[i])
    plain[i] = bvh_occluded(bvh, origins[i], directions[i], limits[i])


def box(half):
    meshes = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            corner, u, v = np.full(3, -1.0), np.zeros(3), np.zeros(3)
            corner[axis], u[(axis + 1) % 3], v[(axis + 2) % 3] = side, 2.0, 2.0
            meshes.append(quad(half * corner, half * u, half * v))
    return meshes


def scene_of(*meshes):
    return gi.Scene([gi.Node(f"mesh {i}", [mesh]) for i, mesh in enumerate(meshes)], environment=(1.0, 1.0, 1.0))


def corner_scene():
    """A floor, a wall and a canopy, at odd places."""
    return scene_of(
        quad((-1.03, 0.02, 1.01), (2.2, 0, 0), (0, 0, -2.1)),
        quad((-1.03, 0, -1.0), (2.2, 0, 0.1), (0, 1.4, 0)),
        quad((-0.9, 1.1, -0.9), (1.3, 0.1, 0), (0, 0, 1.1)),
    )


def soup(count=40, seed=3):
    rng = np.random.default_rng(seed)
    corners = rng.random((count, 1, 3)) * 2 + rng.normal(size=(count, 3, 3)) * 0.4
    return gi.Mesh(corners.reshape(-1, 3).astype(np.float32), np.arange(3 * count, dtype=np.int32).reshape(-1, 3))


def state_of(scene, seed=1, cells=None, **settings):
    state = FieldState(scene, device(), gi.VisibilityField(**(SMALL | settings)).mask_settings, seed)
    state.bake(cells)
    return state


def bits_of(masks, resolution):
    """States [cell, texel], 0 to 3, of masks [cell, words]."""
    bits = (masks[:, :, None] >> np.arange(0, 32, 2, dtype=np.uint32)) & np.uint32(3)
    return bits.reshape(len(masks), -1)[:, : resolution**2].astype(int)


def packed(states, words):
    padded = np.zeros((len(states), 16 * words), np.uint32)
    padded[:, : states.shape[1]] = states
    return np.bitwise_or.reduce(padded.reshape(len(states), words, 16) << np.arange(0, 32, 2, dtype=np.uint32), axis=2)


def texel_directions(resolution):
    v, u = np.meshgrid(*2 * [(np.arange(resolution) + 0.5) * 2 / resolution - 1], indexing="ij")
    x, z, y = u.ravel(), v.ravel(), 1 - np.abs(u.ravel()) - np.abs(v.ravel())
    folded = np.sign(x) * (1 - np.abs(z)), np.sign(z) * (1 - np.abs(x))
    d = np.stack([np.where(y < 0, folded[0], x), y, np.where(y < 0, folded[1], z)], axis=-1)
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def centres(state, cells):
    nx, ny, _ = state.grid.shape
    places = np.stack([cells % nx, cells // nx % ny, cells // (nx * ny)], axis=-1)
    return state.grid.low + (places + 0.5) * state.grid.cell_size


def baker_of(scene, grid, seed=1, **settings):
    data = scene.data(device())
    chosen = gi.VisibilityField(**(SMALL | settings)).mask_settings
    return FieldBaker(data.geometry, data.bvh, scene.radius, grid, chosen, device(), seed)


# ---- what analytic scenes show ----


def test_a_lone_card_sees_everything():
    state = state_of(scene_of(quad((-1, 0, 1), (2, 0, 0), (0, 0, -2))), rays=256)
    assert len(state.cells) == 25
    assert (bits_of(state.masks, 16) == VISIBLE).all() and not state.flags.any()


@pytest.mark.parametrize("resolution", [16, 21])
def test_the_top_of_a_slab_sees_the_upper_half(resolution):
    """Its other side faces into the slab, and sees nothing below."""
    slab = [gi.Node("slab", box(np.array([2.0, 0.5, 2.0])))]
    state = state_of(gi.Scene(slab), rays=256, resolution=resolution)
    middles = centres(state, state.cells)
    top = (middles[:, 1] > 0.4) & (np.abs(middles[:, [0, 2]]).max(axis=1) < 1.5)
    bottom = (middles[:, 1] < -0.2) & (np.abs(middles[:, [0, 2]]).max(axis=1) < 1.5)
    assert top.sum() >= 9 and bottom.sum() >= 9
    d, states = texel_directions(resolution), bits_of(state.masks, resolution)
    up = d[:, 1] / np.abs(d).sum(axis=1)  # 2 / resolution a texel along the map's axes
    margin = 6.1 / resolution  # a texel of dilation along both, and half of one
    for rows, sign in ((top, 1), (bottom, -1)):
        assert (states[rows][:, sign * up > margin] == VISIBLE).all()
        assert (states[rows][:, sign * up < -margin] == OCCLUDED).all()
    assert (up > margin).mean() > 0.1 and ((states[top] & VISIBLE) != 0)[:, up > 0].all()


def test_a_closed_box_shows_no_sky_inside():
    """Walls a metre thick, so that outer surfaces lie in other cells."""
    state = state_of(gi.Scene([gi.Node("walls", box(2.0) + box(1.0))]))
    middles = centres(state, state.cells)
    inside = np.abs(middles).max(axis=1) < 1.5
    outside = np.abs(middles).max(axis=1) > 1.7
    assert inside.sum() > 50 and (inside | outside).all()
    states = bits_of(state.masks, 16)
    assert not (states[inside] & VISIBLE).any() and (states[inside] & OCCLUDED).all()
    assert (state.flags[inside] == int(field.SLOT_LABEL)).all()
    assert ((states[outside] & VISIBLE) != 0).any(axis=1).all() and ((states[outside] & OCCLUDED) != 0).any(
        axis=1
    ).all()


def test_a_wall_blocks_half_of_the_sky():
    scene = scene_of(quad((0, 0, 1), (1, 0, 0), (0, 0, -1)), quad((-1e4, -1e4, -1), (2e4, 0, 0), (0, 2e4, 0)))
    baker = baker_of(scene, Grid(np.full(3, -0.1), 0.6, (2, 1, 2)), rays=256)
    pieces = baker.find()
    masks, _ = baker.bake(pieces)
    assert len(pieces.cells) == 4 and set(pieces.sides) == {0, 1, 2, 3}
    z, states = texel_directions(16)[:, 2], bits_of(masks, 16)
    assert (states[:, z < -0.35] == OCCLUDED).all() and (states[:, z > 0.35] == VISIBLE).all()


def test_a_mask_of_holes_lets_rays_through():
    glass = gi.Material("glass", alpha=0.2, alpha_cutoff=0.5)
    bits = []
    for material in (gi.Material(), glass):
        canopy = quad((-3, 2, 3), (6, 0, 0), (0, 0, -6), material)
        state = state_of(scene_of(quad((-1, 0, 1), (2, 0, 0), (0, 0, -2)), canopy))
        low = centres(state, state.cells)[:, 1] < 1
        bits.append(np.bitwise_or.reduce(bits_of(state.masks[low], 16), axis=None))
    assert bits == [VISIBLE | OCCLUDED, VISIBLE]


# ---- pieces ----


def clipped_area(triangle, low, high):
    """Square metres of a triangle in a box (Sutherland and Hodgman), float64."""
    polygon = list(triangle)
    for axis in range(3):
        for sign, limit in ((1.0, low[axis]), (-1.0, -high[axis])):
            kept = []
            for a, b in zip(polygon, polygon[1:] + polygon[:1], strict=True):
                da, db = sign * a[axis] - limit, sign * b[axis] - limit
                if da >= 0:
                    kept.append(a)
                if (da >= 0) != (db >= 0):
                    kept.append(a + da / (da - db) * (b - a))
            polygon = kept
    if len(polygon) < 3:
        return 0.0
    fans = [np.cross(b - polygon[0], c - polygon[0]) for b, c in pairwise(polygon)]
    return 0.5 * float(np.linalg.norm(np.sum(fans, axis=0)))


def side_corners(mesh, sides, radius):
    """Corners float64 [side, 3, 3], moved off the surface, and normals."""
    corners = mesh.points.astype(np.float64)[mesh.indices][sides // 2]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals *= np.where(sides % 2, -1, 1)[:, None] / np.linalg.norm(normals, axis=1, keepdims=True)
    offsets = 4e-6 * np.maximum(np.abs(corners).max(axis=2), 0.25 * radius)
    return corners + offsets[..., None] * normals[:, None], normals


def test_pieces_are_those_of_the_oracle():
    mesh = soup()
    scene = scene_of(mesh)
    grid = grid_of(scene.bounds, 0.5)
    baker = baker_of(scene, grid)
    pieces = baker.find()
    cells = np.repeat(pieces.cells, np.diff(pieces.starts))
    found = {(int(cell), int(side)): area for cell, side, area in zip(cells, pieces.sides, pieces.areas, strict=True)}
    assert len(found) == len(cells) and (np.diff(pieces.cells) > 0).all()
    sides = np.arange(2 * len(mesh.indices))
    corners, _ = side_corners(mesh, sides, scene.radius)
    nx, ny, nz = grid.shape
    missed = 0.0
    for side in sides:
        a = np.maximum(((corners[side].min(axis=0) - grid.low) / 0.5).astype(int), 0)
        b = ((corners[side].max(axis=0) - grid.low) / 0.5).astype(int)
        for x, y, z in np.ndindex(*(b - a + 1)):
            place = a + np.array((x, y, z))
            low = grid.low + place * 0.5
            expected = clipped_area(corners[side], low, low + 0.5)
            cell = int(place @ [1, nx, nx * ny])
            assert found.pop((cell, int(side)), 0.0) == pytest.approx(expected, abs=3e-6)
            missed = max(missed, expected)
    assert not found or max(found.values()) < 1e-6
    plain = mesh.points.astype(np.float64)[mesh.indices]
    area = 0.5 * np.linalg.norm(np.cross(plain[:, 1] - plain[:, 0], plain[:, 2] - plain[:, 0]), axis=1).sum()
    assert pieces.areas.sum() == pytest.approx(2 * area, rel=2e-5) and missed > 0.01 and nz > 2
    part = baker.find(pieces.cells[::3])
    assert np.array_equal(part.cells, pieces.cells[::3])
    rows = np.concatenate([np.arange(pieces.starts[i], pieces.starts[i + 1]) for i in range(0, len(pieces.cells), 3)])
    assert np.array_equal(part.sides, pieces.sides[rows]) and np.array_equal(part.areas, pieces.areas[rows])


def test_points_lie_in_their_piece_and_spread_by_area():
    mesh, count = soup(12, 5), 2304
    scene = scene_of(mesh)
    grid = grid_of(scene.bounds, 0.5)
    baker = baker_of(scene, grid)
    pieces = baker.find()
    cells = np.repeat(np.repeat(pieces.cells, np.diff(pieces.starts)), count)
    sides = np.repeat(pieces.sides, count)
    numbers = (np.stack(np.meshgrid(*2 * [(np.arange(48) + 0.5) / 48]), axis=-1)).reshape(-1, 2)
    arrays = [wp.array(a, dtype=wp.int32, device=device()) for a in (cells, sides)]
    arrays += [wp.array(np.tile(numbers, (len(cells) // count, 1)), dtype=wp.vec2, device=device())]
    points = wp.zeros(len(cells), dtype=wp.vec3, device=device())
    launch(points_of_pieces, len(cells), [baker.geometry, baker._search, *arrays, points], device())
    p = points.numpy().astype(np.float64)
    nx, ny, _ = grid.shape
    low = grid.low + np.stack([cells % nx, cells // nx % ny, cells // (nx * ny)], axis=-1) * 0.5
    assert (p > low - 1e-6).all() and (p < low + 0.5 + 1e-6).all()
    _, normals = side_corners(mesh, sides, 0.0)
    unmoved = mesh.points.astype(np.float64)[mesh.indices][sides // 2]
    height = ((p - unmoved[:, 0]) * normals).sum(axis=1)
    size = np.maximum(np.abs(unmoved).max(axis=(1, 2)), 0.25 * scene.radius)
    assert (height > 1e-7).all() and (height < 4e-6 * size + 1e-6).all()
    for k in range(3):  # inside of every edge
        edge = unmoved[:, (k + 1) % 3] - unmoved[:, k]
        assert ((np.cross(edge, p - unmoved[:, k]) * normals).sum(axis=1) * np.where(sides % 2, -1, 1) > -1e-5).all()
    areas = np.linalg.norm(np.cross(unmoved[:, 1] - unmoved[:, 0], unmoved[:, 2] - unmoved[:, 0]), axis=1) / 2
    means = p.reshape(-1, count, 3).mean(axis=1)
    total = np.zeros((2 * len(mesh.indices), 3))
    np.add.at(total, pieces.sides, means * pieces.areas[:, None])  # area-weighted means of pieces: the centroid
    expected = unmoved[::count].mean(axis=1) * areas[::count, None]
    assert np.abs(total[pieces.sides] - expected).max() < 2e-3


def test_samples_of_a_cell_share_out_by_area_and_stay_in_it():
    scene = scene_of(quad((0, 0, 0), (0.4, 0, 0), (0, 0, -0.4)), quad((0, 0.2, 0), (0.2, 0, 0), (0, 0, -0.2)))
    grid = Grid(np.array([-0.01, -0.01, -0.49]), 0.5, (1, 1, 1))
    baker = baker_of(scene, grid)
    pieces = baker.find()
    by_area = np.array([500])
    surfaces = baker._surfaces(pieces, 0, 1, by_area)
    total = 500 + int(pieces.edge_counts.sum())
    slots, numbers = np.zeros(total, np.int32), np.arange(total, dtype=np.int32)
    arrays = [wp.array(a, dtype=wp.int32, device=device()) for a in (slots, numbers)]
    outputs = [wp.zeros(total, dtype=wp.vec3, device=device()) for _ in range(2)]
    launch(draw_samples, total, [baker.geometry, surfaces, *arrays, *outputs], device())
    origins, normals = (array.numpy() for array in outputs)
    up, high = normals[:, 1] > 0, origins[:, 1] > 0.1
    assert np.allclose(np.abs(normals[:, 1]), 1) and ((origins[:, 1] - np.where(high, 0.2, 0) > 0) == up).all()
    counts = [int((high[:500] == h)[up[:500] == u].sum()) for h in (False, True) for u in (False, True)]
    assert np.abs(np.array(counts) - [200, 200, 50, 50]).max() <= 1  # one to a stratum
    assert np.abs(np.array([int((high[:100] == h).sum()) for h in (False, True)]) - [80, 20]).max() <= 4
    edge = origins[500:][~high[500:]]
    rim, diagonal = np.abs(np.abs(edge - [0.2, 0, -0.2])[:, [0, 2]].max(axis=1) - 0.2), np.abs(edge[:, 0] + edge[:, 2])
    assert (np.minimum(rim, diagonal) < 1e-3).all() and (rim < 1e-3).sum() > 10 and (diagonal < 1e-3).sum() > 10


def test_triangles_without_area_are_skipped():
    flat = quad((-1, 0, 1), (2, 0, 0), (0, 0, -2))
    line = replace(flat, indices=np.array([[0, 1, 2], [0, 2, 3], [0, 2, 2], [1, 1, 1]], np.int32))
    plain, with_lines = state_of(scene_of(flat)), state_of(scene_of(line))
    assert np.array_equal(plain.masks, with_lines.masks) and np.array_equal(plain.cells, with_lines.cells)
    assert set(with_lines.baker("static").find().sides) == {0, 1, 2, 3}


# ---- merging ----


@pytest.mark.parametrize("resolution, dilation", [(5, 0), (8, 1), (9, 2)])
def test_merging_is_or_and_dilation(resolution, dilation):
    rng = np.random.default_rng(resolution)
    words, texels, count = words_of(resolution), resolution**2, 40
    chunk_start = np.append(0, np.cumsum(rng.integers(0, 4, count)))
    share = rng.choice([0.02, 0.1, 0.5], chunk_start[-1])[:, None]
    partial = np.where(rng.random((chunk_start[-1], texels)) < share, rng.integers(0, 4, (chunk_start[-1], texels)), 0)
    raw = np.where(rng.random((count, texels)) < 0.05, rng.integers(0, 4, (count, texels)), 0)
    raw[0], raw[1], partial[chunk_start[0] : chunk_start[2]] = 1, 2, 0
    near, wider = neighbor_table(resolution, dilation), neighbor_table(resolution, dilation + 1)
    cells = baking.MergeCells()
    cells.chunk_start = wp.array(chunk_start, dtype=wp.int32, device=device())
    for name, states in (("partial", partial), ("raw", raw)):
        setattr(cells, name, wp.array(packed(states, words).ravel(), dtype=wp.uint32, device=device()))
    cells.masks, cells.settled = (wp.zeros(count * words, dtype=wp.uint32, device=device()) for _ in range(2))
    cells.neighbors, cells.neighbor_count = wp.array(near.ravel(), dtype=wp.int32, device=device()), near.shape[1]
    cells.quiet_neighbors = wp.array(wider.ravel(), dtype=wp.int32, device=device())
    cells.quiet_count, cells.resolution, cells.words = wider.shape[1], resolution, words
    cells.flags = wp.zeros(count, dtype=wp.int32, device=device())
    launch(baking.merge_masks, count, [cells], device())
    parts = [partial[chunk_start[i] : chunk_start[i + 1]] for i in range(count)]
    merged = np.stack([np.bitwise_or.reduce([row, *part]) for row, part in zip(raw, parts, strict=True)])
    dilated = np.bitwise_or.reduce(merged[:, near], axis=2)
    shape = count, words
    assert np.array_equal(bits_of(cells.raw.numpy().reshape(shape), resolution), merged)
    assert np.array_equal(cells.masks.numpy().reshape(shape), packed(dilated, words))
    label = 2 * (dilated >> 1).sum(axis=1) > texels
    assert np.array_equal(cells.flags.numpy() != 0, label) and 0 < label.mean() < 1
    settled = (dilated[:, near] == 3).all(axis=2)
    quiet = (dilated[:, wider] == 1).all(axis=2) | (dilated[:, wider] == 2).all(axis=2)
    assert np.array_equal(bits_of(cells.settled.numpy().reshape(shape), resolution), settled + 2 * quiet)
    assert settled.any() and quiet.any()


def test_dilation_only_adds():
    """With so few samples that there is one round, a dilated bake is the undilated one, dilated."""
    scene = corner_scene()
    masks = [bits_of(state_of(scene, dilation=d, samples=800).masks, 16) for d in (0, 1, 2)]
    for d in (1, 2):
        assert ((masks[d] & masks[d - 1]) == masks[d - 1]).all() and (masks[d] != masks[d - 1]).any()
        assert np.array_equal(masks[d], np.bitwise_or.reduce(masks[0][:, neighbor_table(16, d)], axis=2))


def test_rounds_lose_next_to_nothing(monkeypatch):
    """What is skipped because it is settled cannot matter; what is quiet is looked at less often."""
    scene, shares = corner_scene(), []
    rounds = state_of(scene)
    monkeypatch.setattr(visibility_bake, "ROUND_ENDS", (1 << 30,))
    once = state_of(scene)
    for one, other in ((rounds, once), (once, rounds)):
        a, b = bits_of(one.masks, 16), bits_of(other.masks, 16)
        shares.append(np.mean((a & ~b) != 0))
    assert shares[0] == 0 and shares[1] < 2e-3
    assert rounds.counts["rays_traced"] < 0.6 * once.counts["rays_traced"]


# ---- the same bits ----


def test_cells_baked_alone_have_the_bits_of_all():
    scene = corner_scene()
    whole = state_of(scene)
    some = np.sort(np.random.default_rng(0).permutation(whole.cells)[:9])
    part = state_of(scene, cells=some)
    assert np.array_equal(part.cells, some)
    rows = np.searchsorted(whole.cells, some)
    assert np.array_equal(part.masks, whole.masks[rows]) and np.array_equal(part.flags, whole.flags[rows])
    part.bake(whole.cells)  # the rest, in another order of slots
    order = np.argsort(part.cells)
    assert np.array_equal(part.cells[order], whole.cells) and np.array_equal(part.masks[order], whole.masks)
    before = part.masks
    part.bake(whole.cells)
    assert part.masks is before


def test_threads_and_batches_do_not_change_a_bit_and_seeds_do(monkeypatch):
    scene, masks = corner_scene(), []
    for threads in (1, 2, 5):
        set_threads(threads)
        masks.append(state_of(scene, seed=4).masks)
    set_threads(None)
    monkeypatch.setattr(visibility_bake, "BATCH_BYTES", 4 * words_of(16) * 30)
    masks.append(state_of(scene, seed=4).masks)
    assert all(np.array_equal(masks[0], other) for other in masks[1:])
    assert not np.array_equal(state_of(scene, seed=5).masks, masks[0])


# ---- the index ----


def audit(scene, state, camera, count=64):
    """Rays of all pixels by state, how many were wrong, and the slots [pixel] that they asked."""
    width, height = camera.resolution
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    half = np.tan(np.radians(camera.hfov) / 2)
    local = np.stack([(2 * x / width - 1) * half, (1 - 2 * y / height) * half * height / width, -np.ones_like(x)], -1)
    directions = local.reshape(-1, 3) @ camera.world_from_camera[:3, :3].T
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    found = scene.bvh(device()).intersect(np.tile(np.float32(camera.position), (len(directions), 1)), directions)
    hits = gbuffer.PrimaryHits()
    hits.face, hits.u, hits.v = found.face, found.u, found.v
    hits.direction = wp.array(directions, dtype=wp.vec3, device=device())
    settings = gbuffer.PassSettings()
    settings.seed, settings.sample_count = 7, count
    buffers = auditing.AuditBuffers()
    names = ("visible", "occluded", "mixed", "unknown", "lost", "leaked", "label")
    for name in names:
        setattr(buffers, name, wp.zeros(width * height, dtype=wp.int32, device=device()))
    state.upload()
    tiles = -(-width // gbuffer.TILE) * -(-height // gbuffer.TILE) * gbuffer.TILE**2
    query = field_query(device(), count, 16, 7)
    inputs = [scene.data(device()), camera_data(camera), settings, state.data, query, hits, buffers]
    launch(auditing.audit_field, tiles, inputs, device())
    assert (found.face.numpy() >= 0).any()
    result = {name: int(getattr(buffers, name).numpy().sum()) for name in names[:-1]}
    return result, buffers.label.numpy()[found.face.numpy() >= 0]


def test_cells_without_a_surface_have_no_slot_and_are_unknown():
    scene = corner_scene()
    state = state_of(scene, cell_size=0.2, rays=128)
    assert (state.slots < 0).sum() == state.grid.cell_count - len(state.cells) and (state.slots < 0).any()
    assert (state.slots[state.slots < 0] == -1).all() and np.array_equal(state.empty, state.slots < 0)
    slots = state.slots[state.cells]
    assert np.array_equal(slots & int(field.SLOT_BITS), np.arange(len(state.cells)))
    assert np.array_equal(slots & int(field.SLOT_LABEL), state.flags)
    camera = gi.Camera.look_at((0.8, 1.6, 3.0), (0, 0.4, 0), hfov=50, resolution=(24, 16))
    counts, labels = audit(scene, state, camera)
    assert counts["unknown"] < 0.01 * counts["visible"] and (labels >= 0).all()
    assert counts["visible"] > 1000 and counts["occluded"] > 200 and counts["mixed"] > 0
    assert counts["lost"] + counts["leaked"] < 0.005 * (counts["visible"] + counts["occluded"])
    nothing = FieldState(scene, device(), state.settings, 1)
    counts, labels = audit(scene, nothing, camera)
    assert counts["unknown"] > 1000 and (labels == -1).all()
    assert not any(counts[name] for name in ("visible", "occluded", "mixed", "lost", "leaked"))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_wall_on_a_border_of_cells_is_looked_up_where_it_was_baked(axis):
    """Both sides: each lies in a cell of its own, on its side of the border."""
    low = np.array([-1.0, 2.0, 31.0])
    u, v = np.eye(3)[(axis + 1) % 3] * 2, np.eye(3)[(axis + 2) % 3] * 2
    walls = [quad(low + np.eye(3)[axis] * offset, u, v) for offset in (0.0, 0.495, 0.995, 1.495, 2.2)]
    scene = scene_of(*walls)
    state = state_of(scene, resolution=8, rays=128)
    assert np.allclose(state.grid.low + 0.005, low)
    layers = np.unique(np.round((centres(state, state.cells) - state.grid.low)[:, axis] / 0.5 - 0.5))
    assert layers.tolist() == [0, 1, 2, 3, 4]
    middle = low + (u + v) / 2
    for k, wall in enumerate((0.495, 0.995, 1.495)):
        for side in (-0.3, 0.3):
            eye = middle + np.eye(3)[axis] * (wall + side)
            up = tuple(np.eye(3)[(axis + 1) % 3])
            camera = gi.Camera.look_at(
                tuple(eye), tuple(eye - np.eye(3)[axis] * side), up=up, hfov=80, resolution=(16, 16)
            )
            counts, labels = audit(scene, state, camera)
            cells = state.cells[labels & int(field.SLOT_BITS)]
            assert counts["unknown"] == 0 and (labels >= 0).all()
            layer = np.round((centres(state, cells) - state.grid.low)[:, axis] / 0.5 - 0.5)
            assert (layer == (k if side < 0 else k + 1)).all()


# ---- files and errors ----


def test_a_saved_bake_comes_back_bit_by_bit(tmp_path):
    scene, settings = corner_scene(), gi.VisibilityField(**SMALL)
    made = gi.bake(scene, settings, str(device()), seed=3)
    loaded = gi.load_bake(made.save(tmp_path / "corner.bake"))
    assert set(made.arrays) == set(loaded.arrays) and made.settings == loaded.settings and made.counts == loaded.counts
    assert all(np.array_equal(made.arrays[name], loaded.arrays[name]) for name in made.arrays)
    state, fresh = FieldState.from_bake(scene, device(), settings.mask_settings, 3, loaded), state_of(scene, seed=3)
    for name in ("slots", "masks", "flags", "cells", "empty"):
        assert np.array_equal(getattr(state, name), getattr(fresh, name)), name
    assert state.counts == fresh.counts and state.counts["rays_traced"] > 0
    again = state.to_bake()
    assert again.save(tmp_path / "again.bake").read_bytes() == (tmp_path / "corner.bake").read_bytes()


def test_a_bake_of_something_else_is_refused_in_one_line():
    scene, settings = corner_scene(), gi.VisibilityField(**SMALL)
    made = gi.bake(scene, settings, str(device()))
    camera = gi.CameraPath.still(gi.Camera.look_at((0, 1, 3), (0, 0, 0), resolution=(8, 8)))

    def render(scene, environment):
        pipeline = gi.Pipeline(environment=environment, emitters=None, indirect=None, spp=8)
        return list(gi.render(scene, camera, pipeline, device=str(device()), bakes=[made]))

    assert render(scene, settings)
    for other, estimator, words in (
        (scene_of(quad((0, 0, 0), (1, 0, 0), (0, 1, 0))), settings, "bake is of"),
        (scene, replace(settings, resolution=18), "resolution: bake has 16, asked for 18"),
        (scene, replace(settings, dilation=2), "dilation: bake has 1, asked for 2"),
        (scene, replace(settings, rays=72), "rays"),
        (scene, replace(settings, samples=99), "samples"),
        (scene, replace(settings, cell_size=0.0), "cell_size"),
        (scene, gi.TracedEnvironment(), "VisibilityField"),
    ):
        with pytest.raises(BakeError, match=words) as caught:
            render(other, estimator)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "change",
    [
        lambda arrays: arrays.pop("masks"),
        lambda arrays: arrays.pop("empty_cells"),
        lambda arrays: arrays.update(masks=arrays["masks"][:, :-1]),
        lambda arrays: arrays.update(masks=arrays["masks"][1:]),
        lambda arrays: arrays.update(flags=arrays["flags"][1:]),
        lambda arrays: arrays.update(cells=arrays["cells"] - 1000),
        lambda arrays: arrays.update(cells=arrays["cells"] + 100_000),
        lambda arrays: arrays.update(cells=0 * arrays["cells"]),
        lambda arrays: arrays.update(empty_cells=np.array([100_000])),
        lambda arrays: arrays.update(empty_cells=np.array([-100_000])),
    ],
)
def test_foreign_arrays_are_refused_in_one_line(change):
    scene, settings = corner_scene(), gi.VisibilityField(**(SMALL | {"rays": 8, "samples": 100}))
    made = gi.bake(scene, settings, str(device()))
    change(made.arrays)
    with pytest.raises(BakeError, match="bake it again") as caught:
        FieldState.from_bake(scene, device(), settings.mask_settings, 0, made)
    assert "\n" not in str(caught.value)


def test_a_mode_without_a_bake_says_so():
    with pytest.raises(OptionError, match="nothing to bake"):
        gi.bake(corner_scene(), gi.VisibilityField("traced"))


@pytest.mark.parametrize("extent", [(3.0, 2.0, 4.0), (5.0, 0.0, 5.0), (7.0, 0.0, 0.0), (100.0, 1e-3, 1.0)])
def test_cells_too_small_name_a_size_that_works(extent):
    bounds = np.array([(-1.0, 0.0, 2.0), np.add((-1.0, 0.0, 2.0), extent)], np.float32)
    for size in (1e-9, 1e-20, 1e-200):
        with pytest.raises(OptionError, match="cell_size") as caught:
            grid_of(bounds, size)
        least = float(re.search(r"use (\S+) m or more", str(caught.value)).group(1))
        assert "\n" not in str(caught.value)
        assert visibility_bake.MOST_CELLS / 20 < grid_of(bounds, least).cell_count <= visibility_bake.MOST_CELLS
    automatic = grid_of(bounds, 0.0)
    assert automatic.cell_size == pytest.approx(max(extent) / 77)


@pytest.mark.parametrize(
    "settings, words",
    [
        ({"mode": "thre_state"}, "did you mean 'three_state'"),
        ({"sky": "harmonic"}, "did you mean 'harmonics'"),
        ({"mode": "paper"}, "harmonics"),
        ({"relight": True}, "harmonics"),
        ({"resolution": 3}, "resolution"),
        ({"resolution": 513}, "resolution"),
        ({"resolution": 18.0}, "resolution must be a whole number"),
        ({"samples": -1}, "samples"),
        ({"samples": True}, "samples must be a whole number"),
        ({"rays": 0}, "rays"),
        ({"rays": 5000}, "rays"),
        ({"dilation": -1}, "dilation"),
        ({"dilation": 9}, "dilation"),
        ({"dilation": 8, "resolution": 17}, "dilation must be below half"),
        ({"cell_size": -1.0}, "cell_size"),
        ({"cell_size": float("nan")}, "cell_size"),
        ({"cell_size": float("inf")}, "cell_size"),
        ({"verify": 0.0}, "verify"),
        ({"verify": 1.1}, "verify"),
        ({"verify": float("nan")}, "verify"),
        ({"budget": -1.0}, "budget"),
        ({"budget": float("nan")}, "budget"),
    ],
)
def test_bad_settings_are_one_line(settings, words):
    with pytest.raises(OptionError, match=words) as caught:
        gi.VisibilityField(**settings)
    assert "\n" not in str(caught.value) and isinstance(caught.value, GiError)


# ---- hints ----


def test_hints_never_change_an_answer():
    if device().is_cuda:
        pytest.skip("CUDA has no use for hints")
    scene, rng, count = gi.builtin_scene("warehouse"), np.random.default_rng(8), 200_000
    bvh = scene.bvh(device()).data
    parents = np.unique(bvh.parents.numpy())
    low, high = scene.bounds
    arrays = [low + rng.random((count, 3)) * (high - low), rng.normal(size=(count, 3))]
    limits = np.where(rng.random(count) < 0.5, np.inf, scene.radius * rng.random(count) ** 3)  # it is a closed hall
    limits = wp.array(limits, dtype=wp.float32, device=device())
    rays = [wp.array(array.astype(np.float32), dtype=wp.vec3, device=device()) for array in arrays]
    found, plain = (wp.zeros(count, dtype=wp.int32, device=device()) for _ in range(2))
    hints = wp.array(rng.choice(parents, count), dtype=wp.int32, device=device())
    launch(trace_hinted, count, [bvh, *rays, limits, hints, found, plain], device())
    blocked = plain.numpy() != 0
    assert len(parents) > 100 and 0.05 < blocked.mean() < 0.95
    assert np.array_equal(found.numpy() != 0, blocked)
    assert np.isin(found.numpy()[blocked] - 1, parents).all()
