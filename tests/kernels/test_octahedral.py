"""Octahedral maps against a float64 oracle: the map itself, its edges, its texels, octets of cosine-weighted rays."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from statistics_tools import chi_squared, device, every_device, sphere_expectation, sphere_histogram  # noqa: F401

from warp_gi.kernels import octahedral, sampling
from warp_gi.kernels import visibility_field as field
from warp_gi.launch import launch
from warp_gi.techniques.visibility_field.bake import Grid, field_query, grid_struct, neighbor_table, words_of

wp.set_module_options({"enable_backward": False})


@wp.kernel
def encode(
    first: wp.int32,
    grid: field.VisibilityGrid,
    directions: wp.array(dtype=wp.vec3),
    uvs: wp.array(dtype=wp.vec2),
    back: wp.array(dtype=wp.vec3),
    texels: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    uvs[i] = octahedral.octahedral_encode(directions[i])
    back[i] = octahedral.octahedral_decode(uvs[i])
    texels[i] = field.direction_texel(grid, directions[i])


@wp.kernel
def decode(first: wp.int32, uvs: wp.array(dtype=wp.vec2), directions: wp.array(dtype=wp.vec3)):
    i = first + wp.tid()
    directions[i] = octahedral.octahedral_decode(uvs[i])


@wp.kernel
def wrap(first: wp.int32, resolution: wp.int32, places: wp.array(dtype=wp.vec2i), texels: wp.array(dtype=wp.int32)):
    i = first + wp.tid()
    texels[i] = octahedral.octahedral_wrap(places[i][0], places[i][1], resolution)


# What an octet says (x, y, z, texel, visible, occluded, above), and the same from scalar functions.
@wp.kernel
def octets(
    first: wp.int32,
    grid: field.VisibilityGrid,
    query: field.FieldQuery,
    slot: wp.int32,
    normals: wp.array(dtype=wp.vec3),
    vectors: wp.array2d(dtype=wp.float32),
    scalars: wp.array2d(dtype=wp.float32),
):
    i = first + wp.tid()
    frame = field.turned_frame(sampling.frame_of(normals[i]), wp.float32(i) * 0.618 % 1.0)
    start = i % (query.set_size * query.set_count)  # not only where octets begin
    octet = field.cosine_octet(grid, query.cosines, slot, start, frame, normals[i])
    bits = field.octet_bits(octet)
    for lane in range(8):
        row = 8 * i + lane
        d = field.octet_direction(octet, lane)
        local = wp.vec3(query.cosines[0, start + lane], query.cosines[1, start + lane], query.cosines[2, start + lane])
        turned = frame * local
        state = field.texel_state(grid, slot, field.octet_texel(octet, lane))
        for axis in range(3):
            vectors[row, axis] = d[axis]
            scalars[row, axis] = turned[axis]
        vectors[row, 3] = wp.float32(field.octet_texel(octet, lane))
        scalars[row, 3] = wp.float32(field.direction_texel(grid, d))
        vectors[row, 4] = wp.float32((bits >> lane) & 1)
        scalars[row, 4] = wp.float32(state & 1)
        vectors[row, 5] = wp.float32((bits >> (8 + lane)) & 1)
        scalars[row, 5] = wp.float32(state >> 1)
        vectors[row, 6] = wp.float32((bits >> (16 + lane)) & 1)
        scalars[row, 6] = wp.float32(wp.dot(d, normals[i]) > 0.0)
        vectors[row, 7] = wp.float32(bits >> 24)


# ---- oracle ----


def oracle_decode(u, v):
    """Unit directions, float64 [..., 3], of coordinates in [0, 1]: the diamond is the upper half, corners are -y."""
    x, z = 2 * np.asarray(u, np.float64) - 1, 2 * np.asarray(v, np.float64) - 1
    lower = np.abs(x) + np.abs(z) > 1
    folded_x = np.where(x >= 0, 1.0, -1.0) * (1 - np.abs(z))
    folded_z = np.where(z >= 0, 1.0, -1.0) * (1 - np.abs(x))
    y = 1 - np.abs(x) - np.abs(z)
    d = np.stack([np.where(lower, folded_x, x), y, np.where(lower, folded_z, z)], axis=-1)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def oracle_encode(directions):
    d = np.asarray(directions, np.float64)
    d = d / np.abs(d).sum(axis=-1, keepdims=True)
    x, y, z = np.moveaxis(d, -1, 0)
    u = np.where(y < 0, np.where(x >= 0, 1.0, -1.0) * (1 - np.abs(z)), x)
    v = np.where(y < 0, np.where(z >= 0, 1.0, -1.0) * (1 - np.abs(x)), z)
    return (np.stack([u, v], axis=-1) + 1) / 2


def centres(resolution):
    """Texel centres' (u, v), float64 [texel, 2], row by row."""
    v, u = np.meshgrid(*2 * [(np.arange(resolution) + 0.5) / resolution], indexing="ij")
    return np.stack([u.ravel(), v.ravel()], axis=-1)


def continued(resolution, columns, rows):
    """Texel of a place up to a map outside of the square, by geometry alone.

    Texels are squares of a sheet that is turned by half a turn about the middle of the edge it crosses (that is where
    the sheet is glued to itself: the two halves of an edge are the same arc).
    """
    u, v = (np.asarray(columns) + 0.5) / resolution, (np.asarray(rows) + 0.5) / resolution
    for _ in range(2):
        for edge in (0.0, 1.0):
            across = (u < 0) if edge == 0 else (u > 1)
            u, v = np.where(across, 2 * edge - u, u), np.where(across, 1 - v, v)
            across = (v < 0) if edge == 0 else (v > 1)
            u, v = np.where(across, 1 - u, u), np.where(across, 2 * edge - v, v)
    return np.floor(v * resolution).astype(int) * resolution + np.floor(u * resolution).astype(int)


def random_directions(count, seed=1):
    d = np.random.default_rng(seed).standard_normal((count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def vec3s(values):
    return wp.array(np.asarray(values, np.float32), dtype=wp.vec3, device=device())


def grid(resolution, masks=None):
    """A grid of one cell."""
    data = wp.array([] if masks is None else masks, dtype=wp.uint32, device=device())
    slots = wp.zeros(1, dtype=wp.int32, device=device())
    return grid_struct(Grid(np.zeros(3), 1.0, (1, 1, 1)), resolution, slots, data)


def encoded(directions, resolution=18):
    count = len(directions)
    uvs, back = (wp.zeros(count, dtype=t, device=device()) for t in (wp.vec2, wp.vec3))
    texels = wp.zeros(count, dtype=wp.int32, device=device())
    launch(encode, count, [grid(resolution), vec3s(directions), uvs, back, texels], device())
    return uvs.numpy(), back.numpy(), texels.numpy()


def decoded(uvs):
    directions = wp.zeros(len(uvs), dtype=wp.vec3, device=device())
    launch(decode, len(uvs), [wp.array(uvs, dtype=wp.vec2, device=device()), directions], device())
    return directions.numpy()


def wrapped(columns, rows, resolution):
    places = wp.array(np.stack([columns, rows], axis=-1), dtype=wp.vec2i, device=device())
    texels = wp.zeros(len(places), dtype=wp.int32, device=device())
    launch(wrap, len(places), [resolution, places, texels], device())
    return texels.numpy()


# ---- the map ----


@pytest.mark.parametrize("resolution", [1, 4, 5, 18, 72, 161])
def test_every_texel_centre_comes_back(resolution):
    uvs = centres(resolution)
    directions = decoded(uvs)
    assert np.abs(directions - oracle_decode(*uvs.T)).max() < 1e-6
    assert np.abs(np.linalg.norm(directions, axis=1) - 1).max() < 1e-6
    _, back, texels = encoded(directions, resolution)
    assert np.array_equal(texels, np.arange(resolution**2))
    assert np.abs(back - directions).max() < 1e-6


def test_random_directions_come_back():
    directions = np.concatenate([np.eye(3), -np.eye(3), random_directions(20_000)])
    uvs, back, _ = encoded(directions)
    assert np.abs(back - directions).max() < 1e-6
    assert np.abs(uvs[6:] - oracle_encode(directions[6:])).max() < 1e-6  # the axes below lie on several edges
    assert uvs.min() >= 0 and uvs.max() <= 1
    assert np.allclose(uvs[[1, 0, 2]], [[0.5, 0.5], [1, 0.5], [0.5, 1]])
    assert set(uvs[4]) <= {0, 1}  # -y is a corner
    longer, _, texels = encoded(directions * 37.0)
    assert np.abs(longer - uvs).max() < 1e-6 and np.mean(texels == encoded(directions)[2]) > 0.999


@pytest.mark.parametrize("resolution", [4, 18, 72, 512])
def test_direction_texel(resolution):
    directions = random_directions(20_000).astype(np.float32)
    places = oracle_encode(directions) * resolution
    sure = np.abs(places - np.round(places)).min(axis=1) > 1e-4
    expected = places.astype(int) @ [1, resolution]
    assert sure.mean() > 0.99
    assert np.array_equal(encoded(directions, resolution)[2][sure], expected[sure])
    edges = oracle_decode(*np.array([[0, 0.3], [1, 0.3], [0.3, 0], [0.3, 1], [0, 0], [1, 1], [0, 1], [1, 0]]).T)
    texels = encoded(edges, resolution)[2]
    assert texels.min() >= 0 and texels.max() < resolution**2


# ---- its edges ----


@pytest.mark.parametrize("resolution", [4, 7, 18])
def test_wrap_goes_on_across_all_borders(resolution):
    everywhere = np.arange(-resolution, 2 * resolution)
    columns, rows = (places.ravel() for places in np.meshgrid(everywhere, everywhere))
    texels = wrapped(columns, rows, resolution)
    assert np.array_equal(texels, continued(resolution, columns, rows))
    inside = (columns >= 0) & (columns < resolution) & (rows >= 0) & (rows < resolution)
    assert np.array_equal(texels[inside], rows[inside] * resolution + columns[inside])


@pytest.mark.parametrize("resolution", [18, 72])
def test_wrap_is_where_a_step_over_the_border_leads(resolution):
    """In directions: one texel outside of a border lies as far from the texel inside of it as texels there do."""
    along = np.arange(resolution)
    low, high = np.full(resolution, 0), np.full(resolution, resolution - 1)
    of = lambda texels: oracle_decode(*centres(resolution)[texels].T)  # noqa: E731
    for dx, dy, columns, rows in ((-1, 0, low, along), (1, 0, high, along), (0, -1, along, low), (0, 1, along, high)):
        there = of(wrapped(columns + dx, rows + dy, resolution))
        here, inside = of(rows * resolution + columns), of((rows - dy) * resolution + columns - dx)
        step, usual = np.linalg.norm(there - here, axis=1), np.linalg.norm(inside - here, axis=1)
        assert (step < 1.5 * usual).all()
        # the point on the border halfway there, on both of its sides the same direction
        edge = np.stack([(columns + 0.5 + 0.5 * dx) / resolution, (rows + 0.5 + 0.5 * dy) / resolution])
        assert (np.linalg.norm(there - oracle_decode(*edge), axis=1) < usual).all()
    ends = np.array([0, 0, resolution - 1, resolution - 1]), np.array([0, resolution - 1, 0, resolution - 1])
    outside = [np.where(end == 0, -1, resolution) for end in ends]
    assert (of(wrapped(*outside, resolution))[:, 1] < -1 + 3 / resolution).all()  # all corners are -y


@pytest.mark.parametrize("resolution, dilation", [(4, 1), (7, 2), (18, 0), (18, 3), (72, 1)])
def test_neighbors_are_mutual_and_those_of_the_oracle(resolution, dilation):
    table = neighbor_table(resolution, dilation)
    assert table.dtype == np.int32 and table.shape == (resolution**2, (2 * dilation + 1) ** 2)
    rows, columns = np.divmod(np.arange(resolution**2), resolution)
    steps = np.arange(-dilation, dilation + 1)
    expected = [continued(resolution, columns + dx, rows + dy) for dy in steps for dx in steps]
    assert np.array_equal(np.sort(table, axis=1), np.sort(np.stack(expected, axis=1), axis=1))
    assert [wrapped(columns + dx, rows + dy, resolution).tolist() for dy in steps for dx in steps] == table.T.tolist()
    near = np.zeros((resolution**2, resolution**2), bool)
    near[np.arange(resolution**2)[:, None], table] = True
    assert near.diagonal().all() and np.array_equal(near, near.T)


# ---- octets ----


@pytest.mark.parametrize("resolution", [4, 18, 72, 161])
def test_octets_say_what_scalar_functions_say(resolution):
    rng = np.random.default_rng(resolution)
    masks = rng.integers(0, 1 << 32, 3 * words_of(resolution), dtype=np.uint32)
    query = field_query(device(), 24, 16, 5)
    normals = np.concatenate([np.eye(3), -np.eye(3), random_directions(2000)])
    for slot in (2 | int(field.SLOT_LABEL) | int(field.SLOT_BOXED), -1):
        vectors, scalars = (wp.zeros((8 * len(normals), 8), dtype=wp.float32, device=device()) for _ in range(2))
        inputs = [grid(resolution, masks), query, slot, vec3s(normals), vectors, scalars]
        launch(octets, len(normals), inputs, device())
        vectors, scalars = vectors.numpy(), scalars.numpy()
        assert np.abs(vectors[:, :3] - scalars[:, :3]).max() < 3e-7
        assert np.abs(np.linalg.norm(vectors[:, :3], axis=1) - 1).max() < 1e-6
        places = oracle_encode(vectors[:, :3]) * resolution
        sure = np.abs(places - np.round(places)).min(axis=1) > 1e-4
        sure &= np.abs((vectors[:, :3] * np.repeat(normals, 8, axis=0)).sum(axis=1)) > 1e-6
        assert sure.mean() > 0.95
        assert np.array_equal(vectors[sure, 3:], scalars[sure, 3:])
        assert np.array_equal(vectors[:, 4:6], scalars[:, 4:6])  # bits are those of the octet's own texels
        assert (np.bincount(vectors[:, 3].astype(int), minlength=resolution**2) > 0).mean() > 0.3
        if slot < 0:
            assert not vectors[:, 4:6].any()
        else:
            bits = (masks.reshape(3, -1)[2][:, None] >> np.arange(0, 32, 2, dtype=np.uint32)) & 3
            state = bits.reshape(-1)[vectors[:, 3].astype(int)]
            assert np.array_equal(vectors[:, 4] + 2 * vectors[:, 5], state)
            assert set(state) == {0, 1, 2, 3}


def test_cosines_follow_their_density():
    size, count = 256, 256
    query = field_query(device(), size, count, 3)
    directions = query.cosines.numpy().T[: size * count].astype(np.float64)
    assert np.abs(np.linalg.norm(directions, axis=1) - 1).max() < 1e-6 and directions[:, 2].min() >= 0
    # the points of a set are spread, so their counts scatter less than random ones: one of each set is independent
    for chosen in (directions[7::size], directions):
        counts = sphere_histogram(chosen, 16, 16)
        expected = sphere_expectation(lambda d: np.maximum(d[:, 2], 0) / np.pi, len(chosen), 16, 16)
        assert chi_squared(counts, expected) > 1e-3
    assert np.abs(directions[:, 2].mean() - 2 / 3) < 1e-4
    sets = directions.reshape(count, size, 3).mean(axis=1)  # independent samples: 0.036 in x and y
    assert sets[:, :2].std() < 0.01 and sets.std(axis=0).max() < 0.01
    other = field_query(device(), size, count, 4).cosines.numpy()
    assert not np.array_equal(other, query.cosines.numpy())
    assert np.array_equal(field_query(device(), size, count, 3).cosines.numpy(), query.cosines.numpy())
