"""Rays through light field probes: the texels of a line against dense sampling, hits against the tree of triangles."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scene_tools import unit
from statistics_tools import device, every_device  # noqa: F401

from warp_gi import TriangleBvh
from warp_gi.kernels import light_field as fields
from warp_gi.kernels import light_field_march as marching
from warp_gi.launch import launch, set_threads

wp.set_module_options({"enable_backward": False})

MISS, HIT, UNKNOWN, STOPPED = 0, 1, 2, 3
SKY = 65536.0


@wp.kernel
def pack(
    first: wp.int32,
    distances: wp.array(dtype=wp.float32),
    normals: wp.array(dtype=wp.vec3),
    words: wp.array(dtype=wp.uint32),
):
    i = first + wp.tid()
    words[i] = fields.pack_surfel(distances[i], normals[i])


# ---- fields ----


def vec3s(values):
    return wp.array(np.asarray(values, np.float32).reshape(-1, 3), dtype=wp.vec3, device=device())


def decode(u, v):
    """Unit directions, float64 [..., 3], of coordinates in [-1, 1]."""
    y = 1 - np.abs(u) - np.abs(v)
    x = np.where(y < 0, np.where(u < 0, -1.0, 1.0) * (1 - np.abs(v)), u)
    z = np.where(y < 0, np.where(v < 0, -1.0, 1.0) * (1 - np.abs(u)), v)
    d = np.stack([x, y, z], axis=-1)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def encode(points):
    """Coordinates in [-1, 1], float64 [..., 2], of directions of any length."""
    x, y, z = np.moveaxis(points / np.abs(points).sum(axis=-1, keepdims=True), -1, 0)
    u = np.where(y < 0, np.where(x < 0, -1.0, 1.0) * (1 - np.abs(z)), x)
    v = np.where(y < 0, np.where(z < 0, -1.0, 1.0) * (1 - np.abs(x)), z)
    return np.stack([u, v], axis=-1)


def block_minima(distances, resolution):
    """Least distance in 16 x 16 texels and the ring of texels around them, across the edges of the map."""
    t = distances.reshape(resolution, resolution)
    ring = np.full((resolution + 2, resolution + 2), np.inf)
    ring[1:-1, 1:-1] = t
    ring[0, 1:-1], ring[-1, 1:-1], ring[1:-1, 0], ring[1:-1, -1] = t[0, ::-1], t[-1, ::-1], t[::-1, 0], t[::-1, -1]
    n = resolution // 16
    shifted = [ring[j : j + resolution, i : i + resolution] for i in range(3) for j in range(3)]
    return np.min([s.reshape(n, 16, n, 16).min(axis=(1, 3)) for s in shifted], axis=0).ravel()


def make_field(cast, bounds, counts=(1, 1, 1), resolution=64, low=(0.0, 0.0, 0.0), spacing=(1.0, 1.0, 1.0)):
    """Probes of what ``cast(origins, directions)`` returns: distances (inf is the sky) and normals."""
    z, y, x = np.meshgrid(*[np.arange(n) for n in counts[::-1]], indexing="ij")
    positions = np.asarray(low) + np.stack([x, y, z], axis=-1).reshape(-1, 3) * spacing
    at = (np.arange(resolution) + 0.5) / resolution * 2 - 1
    v, u = np.meshgrid(at, at, indexing="ij")
    directions = decode(u.ravel(), v.ravel())
    distances, normals = zip(*(cast(np.tile(p, (len(directions), 1)), directions) for p in positions), strict=True)
    normals = [np.where((n * directions).sum(axis=1, keepdims=True) > 0, -n, n) for n in normals]
    distances = np.minimum(np.array(distances), SKY)
    words = wp.zeros(distances.size, dtype=wp.uint32, device=device())
    flat = wp.array(distances.ravel().astype(np.float32), dtype=wp.float32, device=device())
    launch(pack, distances.size, [flat, vec3s(normals), words], device())
    field = fields.LightField()
    field.low, field.spacing, field.counts = wp.vec3(*low), wp.vec3(*spacing), wp.vec3i(*counts)
    field.resolution = resolution
    field.bounds_low, field.bounds_high = (wp.vec3(*map(float, b)) for b in bounds)
    field.positions = vec3s(positions)
    field.states = wp.zeros(len(positions), dtype=wp.int32, device=device())
    field.surfels = words
    nearest = np.concatenate([block_minima(d, resolution) for d in distances])
    field.nearest = wp.array(nearest.astype(np.float32), dtype=wp.float32, device=device())
    return field


def march(field, origins, directions, t_max=1e30, most_steps=1 << 30):
    """What `march_rays` writes, as arrays: results, t, probes, texels, counts, stops."""
    count = len(origins)
    hits = marching.MarchHits()
    for name, dtype in (
        ("results", wp.int32),
        ("t", wp.float32),
        ("probes", wp.int32),
        ("texels", wp.int32),
        ("counts", wp.vec3i),
        ("stops", wp.vec2i),
    ):
        setattr(hits, name, wp.zeros(count, dtype=dtype, device=device()))
    arguments = [field, vec3s(origins), vec3s(directions), t_max, most_steps, hits]
    launch(marching.march_rays, count, arguments, device())
    return {name: getattr(hits, name).numpy() for name in ("results", "t", "probes", "texels", "counts", "stops")}


def sky(origins, directions):
    return np.full(len(origins), np.inf), np.tile([0.0, 1.0, 0.0], (len(origins), 1))


def box(low, high):
    """Triangles, float32 [12, 3, 3]."""
    corners = np.array([[(low, high)[(i >> k) & 1][k] for k in range(3)] for i in range(8)], np.float32)
    quads = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
    return np.array([corners[[q[0], q[k], q[k + 1]]] for q in quads for k in (1, 2)])


class Triangles:
    """An oracle: calling it casts rays."""

    def __init__(self, *parts):
        self.triangles = np.concatenate(parts)
        a, b, c = np.moveaxis(self.triangles.astype(np.float64), 1, 0)
        self.normals = unit(np.cross(b - a, c - a))
        self.areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        points = self.triangles.reshape(-1, 3)
        self.bounds = points.min(axis=0), points.max(axis=0)
        self.bvh = TriangleBvh(points, np.arange(len(points), dtype=np.int32).reshape(-1, 3))

    def __call__(self, origins, directions):
        hits = self.bvh.intersect(origins.astype(np.float32), directions.astype(np.float32))
        face = hits.face.numpy()
        return np.where(face < 0, np.inf, hits.t.numpy()), self.normals[face]

    def surface_rays(self, count, inside, seed=3):
        """Cosine-distributed rays from surface points, on the side that ``inside`` (a point) can reach."""
        rng = np.random.default_rng(seed)
        d = unit(rng.standard_normal((4 * count, 3)))
        o = np.tile(inside, (4 * count, 1))
        for _ in range(3):
            t, n = self(o, d)
            n = np.where((n * d).sum(axis=1, keepdims=True) > 0, -n, n)
            o = o + t[:, None] * d + 1e-4 * n
            d = unit(n + 0.999 * unit(rng.standard_normal(n.shape)))
        return o[:count], d[:count]


# ---- texels of a line ----


def lines():
    """Rays relative to a probe: through all octants, along axes, in the planes of the axes, near and through it."""
    rng = np.random.default_rng(5)
    o, d = rng.uniform(-3, 3, (60, 3)), unit(rng.standard_normal((60, 3)))
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    off = np.tile([[0.31, -0.72, 0.53]], (6, 1))
    through = rng.uniform(-2, 2, (12, 3))
    near = through + 1e-3 * rng.standard_normal((12, 3))
    flat = np.eye(3)[rng.integers(0, 3, 12)] == 1
    return (
        np.concatenate([o, off - 2 * axes, -1.7 * axes, through, near, np.where(flat, 0, rng.uniform(-2, 2, (12, 3)))]),
        np.concatenate(
            [d, axes, axes, unit(-through), unit(-through), unit(np.where(flat, 0, rng.normal(size=(12, 3))))]
        ),
    )


def far_from(places, texels, resolution):
    """Greatest, over the axes, distance of each place to the square of each texel, in texels: [texel, place]."""
    low = np.stack([texels % resolution, texels // resolution], axis=-1)[:, None]
    return np.maximum(low - places, places - low - 1).max(axis=2).clip(0)


@pytest.mark.parametrize("resolution", [16, 48])
def test_visits_the_texels_of_a_line(resolution):
    origins, directions = lines()
    field = make_field(sky, ([-5] * 3, [5] * 3), resolution=resolution)
    field.nearest.fill_(0.0)
    whole = march(field, origins, directions)
    assert (whole["results"] == MISS).all()
    looks = whole["counts"][:, :2].sum(axis=1)
    assert looks.max() < 7 * resolution
    visited = [[] for _ in origins]
    for most in range(1, looks.max() + 1):
        stops = march(field, origins, directions, most_steps=most)
        assert np.array_equal(stops["results"] == STOPPED, most < looks)
        for i in np.flatnonzero((most <= looks) & (stops["stops"][:, 0] == 0)):
            visited[i].append(stops["stops"][i, 1])
    for i, (o, d) in enumerate(zip(origins, directions, strict=True)):
        # evenly in angle about the probe, which is no distance from some lines
        middle = -(o @ d)
        off = max(np.linalg.norm(o + middle * d), 1e-5)
        angles = np.linspace(np.arctan2(-middle, off), np.arctan2(whole["t"][i] - middle, off), 40_001)
        t = (middle + off * np.tan(angles))[1:-1]
        if off < 1e-4:
            t = t[np.abs(t - middle) > 1e-2]  # nearer to the probe than that, rounding picks the direction
        places = (encode(o + t[:, None] * d) + 1) / 2 * resolution
        texels = places.astype(int).clip(0, resolution - 1) @ [1, resolution]
        runs = np.flatnonzero(np.diff(texels, prepend=-1))
        inside = np.abs(places - np.round(places)).min(axis=1)
        sure = [texels[a] for a, b in zip(runs, [*runs[1:], len(t)], strict=True) if inside[a:b].max() > 1e-3]
        rest = iter(visited[i])
        assert all(texel in rest for texel in sure), (i, o, d)  # in this order
        assert len(visited[i]) == whole["counts"][i, 0]
        if off < 1e-4:
            continue
        others = np.array(sorted(set(visited[i]) - set(sure)), int)
        assert (far_from(places[::7], others, resolution).min(axis=1, initial=np.inf) < 0.02).all(), (i, o, d)


def test_a_ray_ends_at_its_limit_or_outside_of_the_bounds():
    field = make_field(sky, ([-2] * 3, [2] * 3), resolution=32)
    origins, directions = [[0.5, 0.2, 0.1]] * 3 + [[9, 0, 0]] * 3, [[1, 0, 0], [0, -1, 0], [0, 0, 1]] * 2
    hits = march(field, origins, directions)
    assert (hits["results"] == MISS).all()
    assert np.allclose(hits["t"][:3], [1.58, 2.28, 1.98]) and (hits["probes"][3:] == -1).all()
    assert (hits["counts"][:3, 0] == 0).all() and (hits["counts"][:3, 1] > 0).all()  # all in blocks of nothing but sky
    ends = np.array(origins[:3]) + hits["t"][:3, None] * directions[:3]
    assert np.array_equal(hits["texels"][:3], ((encode(ends) + 1) / 2 * 32).astype(int) @ [1, 32])
    assert np.allclose(march(field, origins, directions, t_max=0.75)["t"][:3], 0.75)


# ---- one probe ----


def round_room(origins, directions):
    """From the inside of a sphere of radius 2 about (0.2, 0.3, -0.1)."""
    o = origins - [0.2, 0.3, -0.1]
    b = (o * directions).sum(axis=1)
    t = -b + np.sqrt(b * b - (o * o).sum(axis=1) + 4)
    return t, -unit(o + t[:, None] * directions)


ROOM = (-2.0, -1.0, -2.5), (3.0, 2.0, 1.5)


@pytest.mark.parametrize("room", ["box", "sphere"])
def test_one_probe_in_a_room_that_it_sees_all_of(room):
    rng = np.random.default_rng(11)
    directions = unit(rng.standard_normal((4000, 3)))
    if room == "box":
        cast, bounds, origins = Triangles(box(*ROOM)), ROOM, rng.uniform(*ROOM, (4000, 3)) * 0.98
    else:
        cast, bounds = round_room, ([-1.8, -1.7, -2.1], [2.2, 2.3, 1.9])
        origins = [0.2, 0.3, -0.1] + 1.98 * unit(rng.standard_normal((4000, 3))) * rng.random((4000, 1)) ** (1 / 3)
    exact, _ = cast(origins, directions)
    probe = np.array([0.3, 0.4, -0.2])
    reach = np.linalg.norm(origins + exact[:, None] * directions - probe, axis=1)
    means = []
    for resolution in (32, 64, 128, 256):
        field = make_field(cast, bounds, resolution=resolution, low=probe)
        hits = march(field, origins, directions)
        error = np.abs(hits["t"] - exact)
        assert (hits["results"] != MISS).all() and (hits["results"] == HIT).mean() > 0.99
        # a texel is at most 8.5 / resolution wide; where a ray meets an edge at a slant the error is longer
        assert (error < 8.5 / resolution * reach + 0.005).mean() > 0.998
        means.append(error.mean())
    # the planes' own precision remains, 2^-11 of the distance
    assert means[0] > means[1] > means[2] > means[3] and means[0] > 2 * means[2] and means[3] < 1e-3


def test_objects_from_outside():
    floor = np.array([[(-8, 0, -8), (-8, 0, 8), (8, 0, 8)], [(-8, 0, -8), (8, 0, 8), (8, 0, -8)]], np.float32)
    scene = Triangles(floor, box((-2, 0, -1), (-1, 1, 0)))
    ball, radius = np.array([1.5, 1.5, -1.0]), 0.75

    def cast(origins, directions):
        t, n = scene(origins, directions)
        o = origins - ball
        b = (o * directions).sum(axis=1)
        root = b * b - (o * o).sum(axis=1) + radius**2
        near = -b - np.sqrt(np.maximum(root, 0))
        first = (root > 0) & (near > 0) & (near < t)
        return np.where(first, near, t), np.where(first[:, None], unit(o + near[:, None] * directions), n)

    field = make_field(cast, ([-8, 0, -8], [8, 4, 8]), resolution=256, low=(0.0, 2.0, 3.0))
    eye = np.array([0.4, 1.7, 4.0])
    targets = np.array(
        [(1.5, 1.5, radius - 1.0), [-1.5, 0.5, 0], [-1.5, 1, -0.5], [0.3, 0, 1.0], [3, 0, 4.0], [-5, 0, -2]]
    )
    directions = unit(targets - eye)
    distances = np.linalg.norm(targets - eye, axis=1)
    hits = march(field, np.tile(eye, (6, 1)), directions)
    assert (hits["results"] == HIT).all()
    assert np.abs(hits["t"] / distances - 1).max() < 0.005
    words = field.surfels.numpy()[hits["texels"]]
    surfels = (words & 0x7FFF).astype(np.uint16).view(np.float16)
    expected = np.linalg.norm(targets - [0.0, 2.0, 3.0], axis=1)
    assert np.abs(surfels / expected - 1).max() < 0.03
    # in front of a target nothing is in the way; the sky is met by what goes past everything
    assert (march(field, np.tile(eye, (6, 1)), directions, t_max=float(distances.min()) - 0.1)["results"] == MISS).all()
    up = unit(np.random.default_rng(2).normal((0, 1, 0), 0.4, (500, 3)))
    up = np.concatenate([up[up[:, 1] > 0.2], [[0, 1, 0], unit((1.5, 1.8 + radius, -1.0) - eye)]])
    hits = march(field, np.tile(eye, (len(up), 1)), up)
    assert (hits["results"] == MISS).all()
    assert ((field.surfels.numpy()[hits["texels"]] & 0x7FFF) == 0x7C00).mean() > 0.99
    every = unit(np.random.default_rng(3).standard_normal((4000, 3)))
    exact, _ = cast(np.tile(eye, (4000, 1)), every)
    hits = march(field, np.tile(eye, (4000, 1)), every)
    found = np.where(hits["results"] == MISS, np.inf, hits["t"])
    assert agrees(found, exact).mean() > 0.985


# ---- many probes ----


def pillar_room():
    return Triangles(box(*ROOM), box((0.2, -1.0, -0.9), (0.9, 2.0, -0.2)))


def pillar_field(cast, resolution=128, counts=(2, 2, 2)):
    spacing = (np.array(ROOM[1]) - ROOM[0]) / counts
    return make_field(cast, ROOM, counts, resolution, ROOM[0] + spacing / 2, spacing)


def agrees(t, exact):
    with np.errstate(invalid="ignore"):
        return (t == exact) | (np.abs(t - exact) < np.maximum(0.02 * exact, 0.05))


def test_a_room_with_a_pillar():
    room = pillar_room()
    field = pillar_field(room)
    origins, directions = room.surface_rays(20_000, (-1.0, 0.5, 0.5))
    exact, _ = room(origins, directions)
    hits = march(field, origins, directions)
    assert agrees(hits["t"], exact).mean() > 0.995  # 0.9988
    assert (hits["results"] == HIT).mean() > 0.999
    assert not (hits["t"] < 0.02)[exact > 0.08].any()  # nothing meets its own start
    assert hits["counts"][:, 2].mean() < 1.3
    field.nearest.zero_()
    fine = march(field, origins, directions)
    assert (np.abs(fine["t"] - hits["t"]) < 1e-3).mean() > 0.998
    assert agrees(fine["t"], exact).mean() > 0.995
    assert fine["counts"][:, 0].mean() > hits["counts"][:, 0].mean()


def test_results_do_not_depend_on_threads():
    room = pillar_room()
    field = pillar_field(room, resolution=32)
    rays = room.surface_rays(3000, (-1.0, 0.5, 0.5))
    try:
        set_threads(1)
        one = march(field, *rays)
        set_threads(3)
        three = march(field, *rays)
    finally:
        set_threads(None)
    for name, values in one.items():
        assert np.array_equal(values, three[name]), name


def test_covered_probes_are_not_asked():
    room = pillar_room()
    field = pillar_field(room, resolution=64)
    origins, directions = room.surface_rays(3000, (-1.0, 0.5, 0.5))
    exact, _ = room(origins, directions)
    assert set(march(field, origins, directions)["probes"]) == set(range(8))
    field.states = wp.array([0, 1, 1, 1, 1, 1, 1, 0], dtype=wp.int32, device=device())
    hits = march(field, origins, directions)
    assert set(hits["probes"]) == {0, 7}
    assert agrees(hits["t"], exact).mean() > 0.9
    field.states = wp.array([1] * 8, dtype=wp.int32, device=device())
    hits = march(field, origins, directions)
    assert (hits["results"] == UNKNOWN).all() and (hits["probes"] == -1).all() and (hits["counts"] == 0).all()


@pytest.mark.parametrize("counts", [(1, 1, 1), (1, 2, 1), (3, 1, 2)])
def test_grids_of_one_probe_along_an_axis(counts):
    room = Triangles(box(*ROOM))
    field = pillar_field(room, 64, counts)
    origins, directions = room.surface_rays(3000, (0.0, 0.5, 0.5))
    exact, _ = room(origins, directions)
    hits = march(field, origins, directions)
    assert agrees(hits["t"], exact).mean() > 0.98
    assert (hits["results"] == HIT).mean() > 0.99
    assert hits["counts"][:, 2].max() <= 2 * np.prod(counts)


def test_a_start_that_no_probe_sees_is_unknown_at_once():
    room = pillar_room()
    field = pillar_field(room, resolution=64)
    inside = np.tile([[0.5, 0.5, -0.5]], (50, 1))
    hits = march(field, inside, unit(np.random.default_rng(1).standard_normal((50, 3))))
    assert (hits["results"] == UNKNOWN).all() and (hits["t"] < 0.01).all()
    assert (hits["counts"] == 8).all()  # a block and a texel of each
    assert (hits["probes"] >= 0).all() and (hits["texels"] >= 0).all()
