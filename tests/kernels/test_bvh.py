"""Ray queries against a brute-force float64 oracle, and the promises around them."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from ray_tools import oracle, rays, soup

import warp_gi as gi
from warp_gi import bvh as bvh_module
from warp_gi.bvh import AlphaMasks, TriangleBvh
from warp_gi.errors import SceneError
from warp_gi.kernels import bvh as queries
from warp_gi.kernels import bvh_rays, types
from warp_gi.launch import launch

CPU = wp.get_device("cpu")


def hit_points(points, indices, hits, rows):
    """Return the float64 positions that the barycentrics of ``hits`` stand for."""
    face, u, v = hits.face.numpy()[rows], hits.u.numpy()[rows, None], hits.v.numpy()[rows, None]
    p0, p1, p2 = (points[indices[face, k]].astype(np.float64) for k in range(3))
    return (1.0 - u - v) * p0 + u * p1 + v * p2


def grid_sphere(rings=60, sectors=90, radius=1.0):
    """Return a closed sphere of shared vertices."""
    theta = np.pi * np.arange(1, rings) / rings
    phi = 2.0 * np.pi * np.arange(sectors) / sectors
    ring = np.stack(
        [
            np.outer(np.sin(theta), np.cos(phi)),
            np.outer(np.cos(theta), np.ones(sectors)),
            np.outer(np.sin(theta), np.sin(phi)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    points = np.concatenate([ring, [[0, 1, 0], [0, -1, 0]]]).astype(np.float32) * np.float32(radius)
    i, j = np.meshgrid(np.arange(rings - 2), np.arange(sectors), indexing="ij")
    a, b = i * sectors + j, i * sectors + (j + 1) % sectors
    quads = np.stack([a, b, a + sectors, b, b + sectors, a + sectors], axis=-1).reshape(-1, 3)
    j = np.arange(sectors)
    top, bottom = len(ring), len(ring) + 1
    last = (rings - 2) * sectors
    caps = [
        np.stack([j * 0 + top, (j + 1) % sectors, j], -1),
        np.stack([j * 0 + bottom, last + j, last + (j + 1) % sectors], -1),
    ]
    return points, np.concatenate([quads, *caps]).astype(np.int32)


def grid_box(cells=12):
    """Return a closed box of shared vertices, each face a grid."""
    points, indices = [], []
    u, v = np.meshgrid(np.linspace(-1, 1, cells + 1), np.linspace(-1, 1, cells + 1), indexing="ij")
    for axis in range(3):
        for side in (-1.0, 1.0):
            face = np.zeros((*u.shape, 3))
            face[..., axis], face[..., (axis + 1) % 3], face[..., (axis + 2) % 3] = side, u, v
            i, j = np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij")
            a = (i * (cells + 1) + j + sum(len(p) for p in points)).ravel()
            indices.append(np.stack([a, a + 1, a + cells + 1, a + 1, a + cells + 2, a + cells + 1], -1).reshape(-1, 3))
            points.append(face.reshape(-1, 3))
    return np.concatenate(points).astype(np.float32), np.concatenate(indices).astype(np.int32)


@pytest.mark.parametrize("count", [1, 2, 5, 13, 400])
def test_agrees_with_the_oracle(count):
    rng = np.random.default_rng(count)
    points, indices = soup(rng, count, 0.2 if count > 100 else 0.6)
    origins, directions = rays(rng, 6000)
    tree = TriangleBvh(points, indices)
    hits = tree.intersect(origins, directions)
    occluded = tree.occluded(origins, directions)
    expected = oracle(points, indices, origins, directions)
    nearest, hit = expected.argmin(1), np.isfinite(expected.min(1))
    assert 0.001 < hit.mean() < 0.95
    assert (hits.face.numpy() == np.where(hit, nearest, -1)).mean() > 1.0 - 2e-3  # ties and edges within rounding
    differs = (hits.face.numpy() >= 0) != hit
    assert differs.sum() <= 2
    assert ((occluded.numpy() == 1) == (hits.face.numpy() >= 0)).all()
    both = hit & ~differs & (hits.face.numpy() == nearest)
    error = abs(hits.t.numpy()[both] / expected.min(1)[both] - 1.0)
    assert np.quantile(error, 0.99) < 1.5e-7 and error.max() < 1e-6
    along = origins[both] + expected.min(1)[both, None] * directions[both].astype(np.float64)
    np.testing.assert_allclose(hit_points(points, indices, hits, both), along, atol=2e-3)
    assert np.isinf(hits.t.numpy()[hits.face.numpy() < 0]).all()


def test_hits_are_exact_where_triangles_are_edge_on():
    rng = np.random.default_rng(21)
    points, indices = soup(rng, 400, 0.2)
    points[2::3] = points[::3] + 0.5 * (points[1::3] - points[::3]) + rng.normal(size=(400, 3)) * 0.003  # slivers
    tree = TriangleBvh(points, indices)
    face = rng.integers(400, size=20000)
    weights = rng.dirichlet([1, 1, 1], 20000)
    target = (points[indices[face]].astype(np.float64) * weights[..., None]).sum(1)
    along = points[indices[face, 1]] - points[indices[face, 0]]
    spread = 0.01 * np.linalg.norm(along, axis=1)[:, None]
    directions = (along + rng.normal(size=(20000, 3)) * spread).astype(np.float32)
    origins = (target - 3.0 * directions).astype(np.float32)
    hits = tree.intersect(origins, directions)
    t, u, v, face = (getattr(hits, name).numpy() for name in ("t", "u", "v", "face"))
    hit = face >= 0
    assert hit.sum() > 15000
    a, b, c = (points[indices[face[hit], k]].astype(np.float64) for k in range(3))
    o, d = origins[hit].astype(np.float64), directions[hit].astype(np.float64)
    normal = np.cross(b - a, c - a)
    along = (normal * d).sum(1)
    cosine = abs(along) / np.linalg.norm(normal, axis=1) / np.linalg.norm(d, axis=1)
    assert (cosine < 0.01).mean() > 0.1
    expected = (normal * (a - o)).sum(1) / along
    error = abs(t[hit] / expected - 1.0)
    assert np.quantile(error, 0.99) < 1.5e-7 and np.quantile(error, 0.9) < 1e-7
    third = np.cross(a - o, d)
    for found, one in ((u, (third * (c - a)).sum(1) / along), (v, -(third * (b - a)).sum(1) / along)):
        assert np.quantile(abs(found[hit] - one), 0.99) < 1e-7
    assert (u[hit] >= 0).all() and (v[hit] >= 0).all() and (u[hit] + v[hit] <= 1).all()
    assert (t[hit] > 0).all()
    limited = tree.intersect(origins, directions, t * np.float32(1.0000005))  # what is in reach stays below the limit
    found = limited.face.numpy() >= 0
    assert (limited.t.numpy()[found] < (t * np.float32(1.0000005))[found]).all()


def test_exact_hits_stay_inside_of_their_triangle_and_their_limit():
    rng = np.random.default_rng(22)
    points, indices = soup(rng, 300, 0.2)
    points[2::3] = points[::3] + 0.5 * (points[1::3] - points[::3]) + rng.normal(size=(300, 3)) * 0.003  # slivers
    tree = TriangleBvh(points, indices)
    weights = rng.dirichlet([1, 1, 1], 20000)
    weights[np.arange(20000), rng.integers(3, size=20000)] = 0.0  # on edges
    weights /= weights.sum(axis=1, keepdims=True)
    target = (points[indices[rng.integers(300, size=20000)]].astype(np.float64) * weights[..., None]).sum(1)
    directions = rng.normal(size=(20000, 3)).astype(np.float32)
    origins = (target - 2.0 * directions).astype(np.float32)
    free = tree.intersect(origins, directions)
    t, u, v, face = (getattr(free, name).numpy() for name in ("t", "u", "v", "face"))
    hit = face >= 0
    assert hit.sum() > 5000 and ((u[hit] == 0.0) | (v[hit] == 0.0) | (u[hit] + v[hit] == 1.0)).sum() > 100
    assert (u[hit] >= 0.0).all() and (v[hit] >= 0.0).all() and (u[hit] + v[hit] <= 1.0).all()
    for error in (1e-7, 1e-6, 1e-5):  # about those of the test that is made before
        limits = np.where(hit, t * (1.0 + rng.uniform(-error, error, 20000)), 10.0).astype(np.float32)
        limited = tree.intersect(origins, directions, limits)
        found = limited.face.numpy() >= 0
        assert found.sum() > 1000 and (limited.t.numpy()[found] < limits[found]).all()


@pytest.mark.parametrize("scale", [1e-4, 1e-2, 1.0, 1e3, 1e6])
@pytest.mark.parametrize("shift", [0.0, 1.0])
def test_tiny_and_huge_coordinates(scale, shift):
    rng = np.random.default_rng(7)
    points, indices = soup(rng, 200)
    points = ((points + shift * 10.0) * scale).astype(np.float32)
    origins, directions = rays(rng, 4000)
    origins = ((origins + shift * 10.0) * scale).astype(np.float32)
    tree = TriangleBvh(points, indices)
    expected = oracle(points, indices, origins, directions)
    nearest, hit = expected.argmin(1), np.isfinite(expected.min(1))
    hits = tree.intersect(origins, directions)
    assert (hits.face.numpy() == np.where(hit, nearest, -1)).mean() > 1.0 - 2e-3
    assert ((tree.occluded(origins, directions).numpy() == 1) == hit).mean() > 1.0 - 1e-3


@pytest.mark.parametrize("length", [1e-30, 1e-12, 1e12, 1e30])
def test_t_is_in_units_of_the_direction_whatever_its_length(length):
    rng = np.random.default_rng(3)
    points, indices = soup(rng, 100)
    origins, directions = rays(rng, 2000)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    tree = TriangleBvh(points, indices)
    unit, scaled = tree.intersect(origins, directions), tree.intersect(origins, directions * np.float32(length))
    same = unit.face.numpy() == scaled.face.numpy()
    assert same.mean() > 0.999
    hit = same & (unit.face.numpy() >= 0)
    np.testing.assert_allclose(scaled.t.numpy()[hit].astype(np.float64) * length, unit.t.numpy()[hit], rtol=1e-4)


def test_zero_direction_components_and_no_direction():
    rng = np.random.default_rng(5)
    points, indices = soup(rng, 300)
    axes = np.concatenate([np.eye(3), -np.eye(3), [[1, 1, 0], [0, -1, 1], [-0.0, 1, -0.0]]]).astype(np.float32)
    directions = np.repeat(axes, 700, axis=0)
    origins = rays(rng, len(directions))[0]
    origins[::3] = points[rng.integers(len(points), size=len(origins[::3]))]  # on box planes: 0 times infinity
    tree = TriangleBvh(points, indices)
    hits = tree.intersect(origins, directions)
    expected = oracle(points, indices, origins, directions)
    clear = np.ones(len(origins), bool)
    clear[::3] = False  # a ray from a vertex may or may not see that vertex's triangle
    hit = np.isfinite(expected.min(1))
    wrong = (hits.face.numpy() != np.where(hit, expected.argmin(1), -1)) & clear
    assert wrong.sum() <= 3
    beyond = ~clear & np.isfinite(np.where(expected > 1e-3, expected, np.inf).min(1))
    assert (hits.face.numpy()[beyond] >= 0).mean() > 0.999
    for direction in ([0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 1]):
        miss = tree.intersect(origins[:5], np.tile(np.float32(direction), (5, 1)))
        assert (miss.face.numpy() == -1).all()
    assert not tree.occluded(np.full((4, 3), np.nan, np.float32), directions[:4]).numpy().any()


def test_t_max_limits_are_exclusive_and_for_each_ray():
    points = np.float32([[0, 0, 1], [1, 0, 1], [0, 1, 1], [0, 0, 2], [1, 0, 2], [0, 1, 2]])
    tree = TriangleBvh(points, np.int32([[3, 4, 5], [0, 1, 2]]))
    origins, directions = np.tile(np.float32([0.25, 0.25, 0]), (6, 1)), np.tile(np.float32([0, 0, 1]), (6, 1))
    limits = np.float32([0.5, 1.0, 1.001, 3.0, -1.0, np.inf])
    hits = tree.intersect(origins, directions, limits)
    assert hits.face.numpy().tolist() == [-1, -1, 1, 1, -1, 1]
    assert tree.occluded(origins, directions, limits).numpy().tolist() == [0, 0, 1, 1, 0, 1]
    assert hits.t.numpy()[:2].tolist() == [0.5, 1.0]
    assert tree.occluded(origins, directions, 0.9).numpy().sum() == 0
    assert tree.intersect(origins, directions * 4.0, 0.3).t.numpy() == pytest.approx(0.25)
    behind = tree.intersect(origins + np.float32([0, 0, 1]), directions)  # starts on a surface: t = 0 is no hit
    assert behind.face.numpy().tolist() == [0] * 6
    assert behind.t.numpy() == pytest.approx(1.0)


def test_degenerate_triangles_are_never_hit():
    rng = np.random.default_rng(2)
    line = np.float32([[0, 0, 0], [0.5, 0.5, 0.5], [1, 1, 1], [0.3, 0.3, 0.3]])
    indices = np.int32([[0, 1, 2], [0, 0, 2], [3, 3, 3]])
    tree = TriangleBvh(line, indices)
    origins, _ = rays(rng, 20000)
    directions = line[rng.integers(4, size=len(origins))] - origins
    assert not tree.occluded(origins, directions).numpy().any()
    points, real = soup(rng, 50)
    mixed = TriangleBvh(np.concatenate([line, points]), np.concatenate([indices, real + 4]))
    alone = TriangleBvh(points, real).intersect(origins, directions)
    face = mixed.intersect(origins, directions).face.numpy()
    assert (np.where(face >= 0, face - 3, -1) == alone.face.numpy()).all()


def test_coincident_triangles_hit_one_of_them():
    rng = np.random.default_rng(4)
    points, indices = soup(rng, 20)
    tree = TriangleBvh(points, np.tile(indices, (30, 1)))  # 30 copies: no split tells them apart
    origins, directions = rays(rng, 3000)
    once = TriangleBvh(points, indices).intersect(origins, directions)
    many = tree.intersect(origins, directions)
    face = np.where(many.face.numpy() >= 0, many.face.numpy() % 20, -1)
    assert (face == once.face.numpy()).all()
    assert (many.t.numpy() == once.t.numpy()).all()


@pytest.mark.parametrize("shape", ["sphere", "box"])
def test_no_ray_leaks_out_of_a_closed_mesh(shape):
    rng = np.random.default_rng(11)
    points, indices = grid_sphere() if shape == "sphere" else grid_box()
    tree = TriangleBvh(points, indices)
    count = 1_000_000
    origins = rng.uniform(-0.5, 0.5, (count, 3)).astype(np.float32)
    targets = points[indices[rng.integers(len(indices), size=count)]].astype(np.float64)
    weights = rng.random((count, 3))
    weights[: count // 2, 0] = 0.0  # half at edges, a tenth at vertices
    weights[: count // 10, 1] = 0.0
    weights /= weights.sum(1, keepdims=True)
    directions = ((targets * weights[..., None]).sum(1) - origins).astype(np.float32)
    occluded = tree.occluded(origins, directions)
    assert occluded.numpy().sum() == count
    face = tree.intersect(origins, directions).face.numpy()
    assert (face >= 0).sum() == count
    assert tree.occluded(origins, directions, 0.5).numpy().sum() < count  # the test can fail


def test_refit_follows_the_vertices():
    rng = np.random.default_rng(6)
    points, indices = soup(rng, 300)
    tree = TriangleBvh(points, indices)
    origins, directions = rays(rng, 4000)
    tree.refit(points)
    first = tree.intersect(origins, directions)
    assert (first.face.numpy() == TriangleBvh(points, indices).intersect(origins, directions).face.numpy()).all()
    moved = (points[:, [1, 2, 0]] * np.float32([2, 1, 0.5]) + np.float32([0.3, 0, 0])).astype(np.float32)
    tree.refit(moved)
    expected = oracle(moved, indices, origins, directions)
    hit = np.isfinite(expected.min(1))
    assert (tree.intersect(origins, directions).face.numpy() == np.where(hit, expected.argmin(1), -1)).mean() > 0.999
    with pytest.raises(gi.SceneError, match="refit expects 900 vertices, got 3"):
        tree.refit(points[:3])


def test_reordered_batches_give_the_same_hits_in_the_same_places(monkeypatch):
    rng = np.random.default_rng(14)
    points, indices = soup(rng, 3000, 0.05)
    tree = TriangleBvh(points, indices)
    origins, directions = rays(rng, 40000)
    origins[17] = np.nan
    limits = rng.uniform(0, 10, 40000).astype(np.float32)
    plain, occluded = tree.intersect(origins, directions, limits), tree.occluded(origins, directions, limits)
    monkeypatch.setattr(bvh_module, "ORDERED_BYTES", 0)
    assert tree._order(wp.array(origins, dtype=wp.vec3, device=CPU)) is not None
    assert tree._order(wp.array(np.sort(origins, axis=0) * 0.01, dtype=wp.vec3, device=CPU)) is None
    ordered = tree.intersect(origins, directions, limits)
    for name in ("t", "u", "v", "face"):
        assert getattr(plain, name).numpy().tobytes() == getattr(ordered, name).numpy().tobytes()
    assert (tree.occluded(origins, directions, limits).numpy() == occluded.numpy()).all()


def test_equal_to_the_last_bit_for_any_thread_count():
    rng = np.random.default_rng(8)
    points, indices = soup(rng, 5000, 0.05)
    origins, directions = rays(rng, 20000)
    results = []
    try:
        for threads in (1, 2, 3):
            gi.set_threads(threads)
            tree = TriangleBvh(points, indices)
            hits = tree.intersect(origins, directions)
            arrays = (
                hits.t,
                hits.u,
                hits.v,
                hits.face,
                tree.occluded(origins, directions),
                tree.data.nodes,
                tree.data.blocks,
            )
            results.append([array.numpy().copy() for array in arrays])
    finally:
        gi.set_threads(None)
    for other in results[1:]:
        for one, two in zip(results[0], other, strict=True):
            assert one.tobytes() == two.tobytes()


def checker_masks(triangle_count, uvs, wrap=types.WRAP_REPEAT):
    """Return masks on every other triangle: a 2x2 texture, opaque only at the lower left texel."""
    texture = types.Texture()
    texture.width = texture.height = 2
    texture.wrap_u = texture.wrap_v = wrap
    textures = wp.array([texture], dtype=types.Texture, device="cpu")
    texels = wp.array(np.uint32([0xFF0000FF, 0x00FFFFFF, 0x00FFFFFF, 0x00FFFFFF]), dtype=wp.uint32, device="cpu")
    face_mask = np.where(np.arange(triangle_count) % 2 == 0, 0, -1).astype(np.int32)
    return AlphaMasks(face_mask, [(0, 1.0, 0.5)], uvs, textures, texels)


def bilinear_alpha(uv, wrap):
    """Return the alpha of checker_masks' texture in float64."""
    texels = np.array([[1.0, 0.0], [0.0, 0.0]])  # [row, column], row 0 at the bottom
    at = uv * 2 - 0.5
    low = np.floor(at).astype(int)
    fraction = at - low
    total = np.zeros(len(uv))
    for right in (0, 1):
        for up in (0, 1):
            i = low + np.array([right, up])
            if wrap == types.WRAP_REPEAT:
                i = i % 2
            elif wrap == types.WRAP_CLAMP:
                i = i.clip(0, 1)
            else:
                i = np.where(i % 4 < 2, i % 4, 3 - i % 4)
            weight = np.where(right, fraction[:, 0], 1 - fraction[:, 0]) * np.where(
                up, fraction[:, 1], 1 - fraction[:, 1]
            )
            total += weight * texels[i[:, 1], i[:, 0]]
    return total


def masked_oracle(points, indices, alpha, wrap, origins, directions):
    """Return t [ray, triangle] with transparent hits taken out, and the distance of alpha to the cutoff."""
    t = oracle(points, indices, origins, directions)
    ray, face = np.nonzero(np.isfinite(t) & (alpha.face_mask >= 0))
    at = origins[ray].astype(np.float64) + t[ray, face, None] * directions[ray]
    a, b, c = (points[indices[face, k]].astype(np.float64) for k in range(3))
    area = np.cross(b - a, c - a)
    u = (np.cross(at - a, c - a) * area).sum(1) / (area**2).sum(1)
    v = (np.cross(b - a, at - a) * area).sum(1) / (area**2).sum(1)
    uv = [alpha.uvs[indices[face, k]].astype(np.float64) for k in range(3)]
    texture_alpha = bilinear_alpha((1 - u - v)[:, None] * uv[0] + u[:, None] * uv[1] + v[:, None] * uv[2], wrap)
    t[ray[texture_alpha < 0.5], face[texture_alpha < 0.5]] = np.inf
    margin = np.full(t.shape, np.inf)
    margin[ray, face] = abs(texture_alpha - 0.5)
    return t, margin.min(1)


@pytest.mark.parametrize("wrap", [types.WRAP_REPEAT, types.WRAP_CLAMP, types.WRAP_MIRROR])
def test_masked_triangles_are_passed_through_where_their_texture_says(wrap):
    rng = np.random.default_rng(9 + wrap)
    points, indices = soup(rng, 300)
    alpha = checker_masks(300, rng.uniform(-2, 3, (900, 2)).astype(np.float32), wrap)
    origins, directions = rays(rng, 6000)
    expected, margin = masked_oracle(points, indices, alpha, wrap, origins, directions)
    clear = margin > 1e-3
    hit = np.isfinite(expected.min(1))
    solid = np.isfinite(oracle(points, indices, origins, directions).min(1))
    assert (solid & ~hit).sum() > 200  # masks matter here
    tree = TriangleBvh(points, indices, alpha=alpha)
    face, occluded = tree.intersect(origins, directions).face.numpy(), tree.occluded(origins, directions).numpy()
    assert (face == np.where(hit, expected.argmin(1), -1))[clear].mean() > 0.999
    assert ((occluded == 1) == hit)[clear].mean() > 0.999


def test_masks_without_texture_use_their_factor():
    points, indices = soup(np.random.default_rng(1), 40)
    origins, directions = rays(np.random.default_rng(2), 2000)
    empty = wp.empty(0, dtype=types.Texture, device="cpu"), wp.empty(0, dtype=wp.uint32, device="cpu")
    uvs, face_mask = np.zeros((120, 2), np.float32), np.arange(40, dtype=np.int32) % 2
    tree = TriangleBvh(points, indices, alpha=AlphaMasks(face_mask, [(-1, 0.2, 0.5), (-1, 0.7, 0.5)], uvs, *empty))
    odd = TriangleBvh(points, indices[1::2]).intersect(origins, directions).face.numpy()
    assert (tree.intersect(origins, directions).face.numpy() == np.where(odd >= 0, 2 * odd + 1, -1)).all()


@wp.kernel(enable_backward=False, module="unique")
def mesh_path(
    first: wp.int32,
    bvh: types.Bvh,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    hits: bvh_rays.RayHits,
    occluded: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    hit = queries.mesh_intersect(bvh, origins[i], directions[i], wp.inf)
    hits.t[i] = hit.t
    hits.face[i] = hit.face
    hits.u[i] = hit.u
    hits.v[i] = hit.v
    occluded[i] = queries.mesh_occluded(bvh, origins[i], directions[i], wp.inf)


@pytest.mark.parametrize("masked", [False, True, "blended"])
def test_the_cuda_path_agrees_with_the_cpu_path(masked):
    rng = np.random.default_rng(12)
    points, indices = soup(rng, 300)
    indices[50:60] = indices[50:60, :1]  # degenerate
    indices[80:90] = indices[90:100]  # coincident, one of each pair masked
    indices[81:91:2] = indices[80:90:2]
    alpha = checker_masks(300, rng.uniform(-2, 3, (900, 2)).astype(np.float32)) if masked else None
    if masked == "blended":
        alpha.masks = [(0, 1.0, None)]
    tree = TriangleBvh(points, indices, alpha=alpha)
    origins, directions = rays(rng, 6000)
    mesh = bvh_module._make_mesh(wp.array(points, dtype=wp.vec3, device=CPU), indices, points)
    tree.data.mesh = mesh.id
    hits = bvh_rays.RayHits()
    hits.t, hits.u, hits.v = (wp.zeros(6000, dtype=wp.float32, device=CPU) for _ in range(3))
    hits.face, occluded = wp.zeros(6000, dtype=wp.int32, device=CPU), wp.zeros(6000, dtype=wp.int32, device=CPU)
    arrays = [wp.array(a, dtype=wp.vec3, device=CPU) for a in (origins, directions)]
    launch(mesh_path, 6000, [tree.data, *arrays, hits, occluded], CPU)
    wide = tree.intersect(origins, directions)
    hit = wide.face.numpy() >= 0
    assert ((hits.face.numpy() >= 0) == hit).mean() > 0.9995
    assert ((occluded.numpy() != 0) == hit).mean() > 0.9995
    both = hit & (hits.face.numpy() >= 0)
    close = np.isclose(hits.t.numpy(), wide.t.numpy(), rtol=1e-4)
    assert close[both].mean() > 0.9995
    np.testing.assert_allclose(
        hit_points(points, indices, hits, both & close), hit_points(points, indices, wide, both & close), atol=1e-3
    )


@pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device")
def test_cuda_equals_cpu():
    rng = np.random.default_rng(13)
    points, indices = soup(rng, 2000, 0.05)
    origins, directions = rays(rng, 20000)
    cpu, cuda = TriangleBvh(points, indices), TriangleBvh(points, indices, device="cuda")
    one, two = cpu.intersect(origins, directions), cuda.intersect(origins, directions)
    assert (one.face.numpy() == two.face.numpy()).mean() > 0.999
    assert (cpu.occluded(origins, directions).numpy() == cuda.occluded(origins, directions).numpy()).mean() > 0.999
    cuda.refit(points + 1)
    assert (cuda.intersect(origins + 1, directions).face.numpy() == two.face.numpy()).mean() > 0.999


@pytest.mark.parametrize("arch", [80, 90])
def test_compiles_for_cuda_without_a_gpu(arch, tmp_path):
    module = wp.get_module("warp_gi.kernels.bvh_rays")
    written = wp.compile_aot_module(module, device=None, arch=arch, module_dir=tmp_path)
    assert any(path.suffix in (".cubin", ".ptx") and path.stat().st_size > 0 for path in written)


def test_takes_numpy_warp_and_dlpack_and_says_what_is_wrong():
    points, indices = soup(np.random.default_rng(1), 4)
    origins, directions = rays(np.random.default_rng(2), 500)

    class Exported:
        def __init__(self, array):
            self.array = array

        def __dlpack__(self, **keywords):
            return self.array.__dlpack__(**keywords)

        def __dlpack_device__(self):
            return self.array.__dlpack_device__()

    expected = TriangleBvh(points, indices).intersect(origins, directions).face.numpy()
    for wrap in (lambda a: wp.array(a, device="cpu"), Exported, lambda a: a.tolist()):
        tree = TriangleBvh(wrap(points), wrap(indices))
        assert (tree.intersect(wrap(origins), wrap(directions)).face.numpy() == expected).all()
    vectors = wp.array(origins, dtype=wp.vec3, device="cpu"), wp.array(directions, dtype=wp.vec3, device="cpu")
    assert (
        tree.intersect(*vectors, wp.full(500, np.inf, dtype=wp.float32, device="cpu")).face.numpy() == expected
    ).all()
    assert len(tree.occluded(origins[:0], directions[:0])) == 0
    assert 0 < tree.memory_bytes < 10_000


@pytest.mark.parametrize(
    ("points", "indices", "message"),
    [
        (np.zeros((3, 3)), np.zeros((0, 3), int), "at least one triangle"),
        (np.zeros((3, 3)), [[0, 1, 3]], "0 to 2, got 3"),
        (np.zeros((3, 3)), [[0, 1, -1]], "0 to 2, got -1"),
        (np.float32([[0, 0, 0], [1, np.nan, 0], [0, 1, 0]]), [[0, 1, 2]], "vertex 1"),
        (np.float32([[0, 0, 0], [1, 0, np.inf], [0, 1, 0]]), [[0, 1, 2]], "vertex 1"),
        (np.zeros((3, 2)), [[0, 1, 2]], r"\[vertex, 3\], got \[3, 2\]"),
        (np.zeros((3, 3)), [[0.0, 1.0, 2.0]], "whole numbers"),
        (np.zeros((3, 3)), [0, 1, 2], r"\[triangle, 3\]"),
        (np.zeros((0, 3)), [[0, 1, 2]], "at least one vertex"),
    ],
)
def test_bad_geometry_is_one_clear_line(points, indices, message):
    with pytest.raises(gi.SceneError, match=message) as error:
        TriangleBvh(points, indices)
    assert "\n" not in str(error.value)


def test_bad_rays_and_devices_are_one_clear_line():
    tree = TriangleBvh(*soup(np.random.default_rng(1), 2))
    good = np.zeros((4, 3), np.float32)
    with pytest.raises(gi.SceneError, match=r"ray origins must have shape \[ray, 3\], got \[3\]"):
        tree.occluded(np.zeros(3), good)
    with pytest.raises(gi.SceneError, match="as many ray directions as origins"):
        tree.intersect(good, good[:2])
    with pytest.raises(gi.SceneError, match="t_max must be"):
        tree.intersect(good, good, np.ones(3))
    with pytest.raises(gi.OptionError, match="device 'toaster'"):
        TriangleBvh(good, [[0, 1, 2]], device="toaster")
    textures = wp.empty(0, dtype=types.Texture, device="cpu"), wp.empty(0, dtype=wp.uint32, device="cpu")
    with pytest.raises(gi.SceneError, match="face_mask"):
        TriangleBvh(good, [[0, 1, 2]], alpha=AlphaMasks(np.int32([0, 0]), [(-1, 1, 1)], np.zeros((4, 2)), *textures))
    with pytest.raises(gi.SceneError, match="texture 3"):
        TriangleBvh(good, [[0, 1, 2]], alpha=AlphaMasks(np.int32([0]), [(3, 1, 1)], np.zeros((4, 2)), *textures))


@pytest.mark.parametrize("far", [1e13, -1e20, 3e38])
def test_vertices_past_what_boxes_can_hold_are_refused(far):
    """Areas of such boxes are infinite, and trees of them were written past the end of their memory."""
    points = np.random.default_rng(1).uniform(-1, 1, (300, 3)).astype(np.float32)
    points[17, 1] = far
    faces = np.arange(300, dtype=np.int32).reshape(-1, 3)
    with pytest.raises(SceneError, match=r"within 1e\+12 m, but vertex 17"):
        TriangleBvh(points, faces)
    with pytest.raises(SceneError, match=r"within 1e\+12 m"):
        gi.Scene([gi.Node("far", [gi.Mesh(points, faces)])])


def test_the_farthest_vertices_are_found():
    points = np.random.default_rng(1).uniform(-1e12, 1e12, (300, 3)).astype(np.float32)
    tree = TriangleBvh(points, np.arange(300, dtype=np.int32).reshape(-1, 3))
    middles = points.reshape(-1, 3, 3).mean(axis=1)
    eye = np.float32([0, 0, 9e12])
    ways = (middles - eye) / np.linalg.norm((middles - eye).astype(np.float64), axis=1, keepdims=True)
    assert (tree.intersect(np.repeat(eye[None], 100, 0), np.float32(ways)).face.numpy() >= 0).all()
