"""Cells of a surface cache: keys, levels, sums and the hash table, against the slow and obvious."""

import numpy as np
import pytest
import statistics_tools as st
import warp as wp
from statistics_tools import every_device  # noqa: F401

from warp_gi import launch
from warp_gi.kernels import surface_cache as kernels
from warp_gi.kernels.bsdf import lambert
from warp_gi.kernels.bvh import BvhHit
from warp_gi.kernels.surface import Surface
from warp_gi.kernels.types import SceneData
from warp_gi.techniques.surface_cache.cells import Sums, coarser, first_slots, hash_table, table_nbytes, with_table
from warp_gi.techniques.surface_cache.fill import grid_at

wp.set_module_options({"enable_backward": False})

LOW, SIDE, GROWTH = np.array([-3.0, -1.0, -2.0]), 0.25, 0.05
BOXES = np.array([[[0, 0, 0], [1, 1, 1]], [[9, 0, 0], [9, 0, 0]]], np.float32)


# Thread: a point of an object. Writes the key of its smallest cell and those of the levels above, the level, the first
# slot of the key in a table of 2^10, and the slot in which the cell is.
@wp.kernel
def look_up(
    first: wp.int32,
    cells: kernels.SurfaceCells,
    grid: kernels.ObjectGrid,
    positions: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    keys: wp.array2d(dtype=wp.uint64),
    levels: wp.array(dtype=wp.int32),
    slots: wp.array2d(dtype=wp.int32),
):
    i = first + wp.tid()
    levels[i] = kernels.cell_level(cells, positions[i])
    keys[i, 0] = kernels.cell_key(cells, grid, positions[i], normals[i], levels[i])
    keys[i, 1] = kernels.coarser_key(keys[i, 0])
    keys[i, 2] = kernels.coarser_key(keys[i, 1])
    slots[i, 0] = kernels.first_slot(keys[i, 0], 10)
    slots[i, 1] = kernels.cell_slot(cells, keys[i, 0])


# Thread: a matt surface seen from a hit at a distance. Writes whether a cell is read there.
@wp.kernel
def read_from(
    first: wp.int32,
    cells: kernels.SurfaceCells,
    positions: wp.array(dtype=wp.vec3),
    distances: wp.array(dtype=wp.float32),
    known: wp.array(dtype=wp.float32),
):
    i = first + wp.tid()
    s = Surface()
    s.position = positions[i]
    s.normal = wp.vec3(0.0, 1.0, 0.0)
    s.bsdf = lambert(wp.vec3(1.0, 1.0, 1.0))
    hit = BvhHit()
    hit.t = distances[i]
    found = kernels.surface_lookup(cells, SceneData(), s, wp.vec3(0.0, 0.0, 1.0), hit, 1.0 / wp.pi, wp.vec2(0.5, 0.5))
    known[i] = found.validity


def looked_up(
    positions: np.ndarray,
    normals: np.ndarray,
    known: np.ndarray,
    rows: np.ndarray | None = None,
    number: int = 0,
    rest: np.ndarray | None = None,
):
    """Return keys, levels and slots of points in a table that holds the cells ``known``, of grid ``number``."""
    count, device = len(positions), st.device()
    rows = np.zeros((len(known), 8), np.float32) if rows is None else rows
    cells = with_table(grid_at(LOW, SIDE, GROWTH, BOXES, device), known, rows, device)
    keys = wp.zeros((count, 3), dtype=wp.uint64, device=device)
    levels, slots = wp.zeros(count, dtype=wp.int32, device=device), wp.zeros((count, 2), dtype=wp.int32, device=device)
    points, sides = (wp.array(a.astype(np.float32), dtype=wp.vec3, device=device) for a in (positions, normals))
    grid = kernels.ObjectGrid()
    grid.number, grid.rest_from_world = number, wp.mat44(*(np.eye(4) if rest is None else rest).ravel().tolist())
    launch.launch(look_up, count, [cells, grid, points, sides, keys, levels, slots], device)
    return keys.numpy(), levels.numpy(), slots.numpy(), cells


def some_points(count: int = 4000):
    random = np.random.default_rng(4)
    normals = random.normal(size=(count, 3))
    return random.uniform(LOW, [60, 30, 40], (count, 3)), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def level_of(position: np.ndarray) -> int:
    """Return the level of a point: the largest whose side is at most GROWTH times the distance to a box."""
    away = min(np.linalg.norm(np.maximum(np.maximum(low - position, position - high), 0)) for low, high in BOXES)
    level = 0
    while SIDE * 2 ** (level + 1) <= GROWTH * away:
        level += 1
    return level


def key_of(position: np.ndarray, normal: np.ndarray, level: int, number: int = 0) -> int:
    """Return the key by floors, axis and level: 9 bits of the grid, 16 a coordinate, 3 of the side, 4 of level + 1."""
    axis = int(np.argmax(np.abs(normal)))
    x, y, z = (int(np.floor((p - low) / (SIDE * 2**level))) for p, low in zip(position, LOW, strict=True))
    return number << 55 | x << 39 | y << 23 | z << 7 | (2 * axis + int(normal[axis] < 0)) << 4 | level + 1


def test_keys_are_floors_axis_and_level():
    positions, normals = some_points()
    positions = positions.astype(np.float32).astype(np.float64)
    keys, levels, slots, _ = looked_up(positions, normals, np.zeros(0, np.uint64))
    expected = np.array([level_of(p) for p in positions])
    assert set(expected) >= {0, 1, 2, 3}
    np.testing.assert_array_equal(levels, expected)
    levels = levels.tolist()
    for k in range(3):
        wanted = [key_of(p, n, level + k) for p, n, level in zip(positions, normals, levels, strict=True)]
        np.testing.assert_array_equal(keys[:, k], np.array(wanted, np.uint64))
    np.testing.assert_array_equal(coarser(keys[:, 0]), keys[:, 1])
    np.testing.assert_array_equal(first_slots(keys[:, 0], 10), slots[:, 0])
    assert (slots[:, 1] == -1).all()  # none is known


@pytest.mark.parametrize("number", [1, 511])
def test_a_moved_object_keeps_its_cells(number):
    """Keys are of the point and normal at rest; the level is that of the place now, as the camera sees it."""
    positions, normals = some_points(1000)
    positions = positions.astype(np.float32).astype(np.float64)
    turn = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])  # a quarter: floats round nothing
    move = np.eye(4)
    move[:3, 3] = (16.0, 8.0, 64.0)
    rest = move @ turn
    keys, levels, _, _ = looked_up(positions, normals, np.zeros(0, np.uint64), number=number, rest=rest)
    there, facing = positions @ rest[:3, :3].T + rest[:3, 3], normals @ rest[:3, :3].T
    inside = (there > LOW).all(axis=1)
    assert inside.sum() > 300
    for k in range(2):
        wanted = [key_of(p, n, int(level) + k, number) for p, n, level in zip(there, facing, levels, strict=True)]
        np.testing.assert_array_equal(keys[inside, k], np.array(wanted, object)[inside].astype(np.uint64))
    np.testing.assert_array_equal(coarser(keys[:, 0]), keys[:, 1])
    np.testing.assert_array_equal(levels, [level_of(p) for p in positions])


def test_coordinates_end_at_16_bits():
    far = np.array([[1e9, -1e9, 0.0]])
    key = int(looked_up(far, np.array([[0.0, 0, 1]]), np.zeros(0, np.uint64))[0][0, 0])
    level = (key & 15) - 1
    assert key >> 39 == ((1 << 16) - 1) >> level and key >> 23 & ((1 << 16) - 1) == 0


def test_every_known_cell_is_found_and_no_other():
    positions, normals = some_points()
    every = np.unique(looked_up(positions, normals, np.zeros(0, np.uint64))[0][:, 0])
    known = every[::2]
    rows = np.arange(8 * len(known), dtype=np.float32).reshape(-1, 8)
    keys, _, slots, cells = looked_up(positions, normals, known, rows)
    values = cells.values.numpy().reshape(-1, 8)
    place = np.searchsorted(known, keys[:, 0])
    is_known = (place < len(known)) & (known[np.minimum(place, len(known) - 1)] == keys[:, 0])
    assert 0.2 < is_known.mean() < 0.8
    assert (slots[~is_known, 1] == -1).all()
    np.testing.assert_array_equal(values[slots[is_known, 1]], rows[place[is_known]])


def test_a_table_is_as_linear_probing_fills_it():
    """Cells one after the other in the order of their first slots, each in the first free slot."""
    keys = np.random.default_rng(1).integers(1, 1 << 63, 5000).astype(np.uint64)
    keys = np.unique(keys)
    bits, slots, count = hash_table(keys)
    assert 2 * len(keys) <= 1 << bits < 4 * len(keys) and count > slots.max() + 1
    taken = np.zeros(count, bool)
    for key in np.argsort(first_slots(keys, bits), kind="stable"):
        slot = int(first_slots(keys[key : key + 1], bits)[0])
        while taken[slot]:
            slot += 1
        taken[slot] = True
        assert slots[key] == slot
    assert hash_table(keys[:0])[2] > 1


def test_sums_by_key_and_level():
    random = np.random.default_rng(2)
    positions, normals = some_points(900)
    positions[:, :] = LOW + (positions - LOW) * 0.05
    keys = looked_up(positions, normals, np.zeros(0, np.uint64))[0][:, 0]
    light = random.random((len(keys), 7)).astype(np.float32)
    keys[:7], light[9, 2] = 0, np.nan
    expected: dict[int, list[np.ndarray]] = {}
    for key, row in zip(keys, light, strict=True):
        for _ in range(kernels.LEVELS):
            if key and np.isfinite(row).all():
                expected.setdefault(int(key), []).append(row.astype(np.float64))
                key = coarser(np.array([key]))[0]
    half = Sums.of(keys[:400], light[:400]), Sums.of(keys[400:], light[400:])
    total = (half[0] + half[1]).with_levels()
    assert list(map(int, total.keys)) == sorted(expected) and max(total.counts) > 20
    np.testing.assert_array_equal(total.counts, [len(expected[int(key)]) for key in total.keys])
    np.testing.assert_allclose(total.light, [sum(expected[int(key)]) for key in total.keys], rtol=1e-12)
    rest = half[0].without(half[1])
    assert set(rest.keys) == set(half[0].keys) - set(half[1].keys) and len(rest.keys)


@pytest.mark.parametrize("above", [0, 1, 2])
def test_cells_are_read_from_a_side_of_the_cell_that_is_there(above):
    """Where only a wider cell is known, hits must be farther; a cell four times as wide is not read at all."""
    device, random = st.device(), np.random.default_rng(3)
    positions = random.uniform([-2, 0, -1], [3, 2, 3], (2000, 3))
    levels = np.array([level_of(p) for p in positions])
    side = SIDE * 2.0 ** (levels + above)
    distances = side * random.uniform(0.2, 2.0, 2000)
    keys = {key_of(p, np.array([0, 1, 0]), level + above) for p, level in zip(positions, levels.tolist(), strict=True)}
    table = np.array(sorted(keys), np.uint64)
    cells = with_table(grid_at(LOW, SIDE, GROWTH, BOXES, device), table, np.ones((len(table), 8), np.float32), device)
    points = wp.array(positions.astype(np.float32), dtype=wp.vec3, device=device)
    lengths = wp.array(distances.astype(np.float32), dtype=wp.float32, device=device)
    known = wp.zeros(2000, dtype=wp.float32, device=device)
    launch.launch(read_from, 2000, [cells, points, lengths, known], device)
    assert set(levels) == {0} and 0.3 < (distances > side).mean() < 0.7
    np.testing.assert_array_equal(known.numpy() > 0, (distances > side) & (above < 2))


def test_a_table_is_as_large_as_it_says():
    for count in (0, 1, 100, 1000):
        keys = np.arange(1, count + 1, dtype=np.uint64) * np.uint64(977)
        cells = with_table(grid_at(LOW, SIDE, GROWTH, BOXES, st.device()), keys, np.zeros((count, 8)), st.device())
        assert table_nbytes(keys) == cells.keys.numpy().nbytes + cells.values.numpy().nbytes


@pytest.mark.parametrize(("capacity", "kept", "over"), [(9, [3, 4, 6], 0), (2, [3, 6], 1)])
def test_cells_with_few_samples_are_left_out(capacity, kept, over):
    sums = Sums(np.arange(1, 7, dtype=np.uint64), np.ones((6, 7)), np.array([1, 3, 9, 4, 2, 5]))
    found, without = sums.most_sampled(capacity)
    assert list(found.keys) == kept and without == over
    np.testing.assert_allclose(found.means()[:, 3], sums.counts[np.array(kept) - 1])
