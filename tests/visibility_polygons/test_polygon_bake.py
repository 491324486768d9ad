"""What vertices see, and what of it belongs together: against maps of rays, known shadows, and brute force."""

import numpy as np
import pytest
from polygon_tools import circle_about, unit
from scene_tools import quad
from statistics_tools import device, every_device  # noqa: F401

import warp_gi as gi
from warp_gi import launch
from warp_gi.baking import load_bake
from warp_gi.kernels import visibility_polygons as kernels
from warp_gi.kernels import visibility_polygons_bake as contour_kernels
from warp_gi.techniques.visibility_polygons import bake as baking
from warp_gi.techniques.visibility_polygons.settings import PolygonSettings
from warp_gi.techniques.visibility_polygons.vertices import corner_sets

GREY = gi.Material("grey", (0.6, 0.5, 0.4), specular=0.0)
SETTINGS = PolygonSettings(32, 0.5, 0.05)


def ball(level=1, center=(0.0, 1.0, 0.0), radius=0.5):
    """An icosphere with normals: closed."""
    import trimesh

    mesh = trimesh.creation.icosphere(level, radius)
    points = np.asarray(mesh.vertices)
    return gi.Mesh(
        (points + center).astype(np.float32), np.asarray(mesh.faces), GREY, normals=unit(points).astype(np.float32)
    )


def floor(count=6, size=3.0):
    edge = np.linspace(-size, size, count + 1)
    x, z = np.meshgrid(edge, edge, indexing="ij")
    first = np.arange(count * (count + 1)).reshape(count, count + 1)[:, :-1].reshape(-1)
    n = count + 1
    faces = np.concatenate(
        [np.stack([first, first + 1, first + n + 1], 1), np.stack([first, first + n + 1, first + n], 1)]
    )
    return gi.Mesh(np.stack([x, 0 * x, z], -1).reshape(-1, 3).astype(np.float32), faces, GREY)


def scene_of(*meshes):
    return gi.Scene([gi.Node(f"part {index}", [mesh]) for index, mesh in enumerate(meshes)])


def baked(scene, settings=SETTINGS):
    return baking.bake_polygons(scene, settings, device().alias, 3)


def contours(bake, one):
    """The contours of a set, float64 [point, 4] each."""
    a = bake.arrays
    first, last = a["contour_starts"][one : one + 2]
    return [a["points"][a["point_starts"][k] : a["point_starts"][k + 1]].astype(np.float64) for k in range(first, last)]


def solid_angle(points, normal):
    a, b = points, np.roll(points, -1, axis=0)
    return 2 * np.arctan2(np.cross(a, b) @ normal, 1 + a @ normal + b @ normal + (a * b).sum(1)).sum()


def test_a_lone_vertex_sees_its_hemisphere():
    bake = baked(scene_of(floor(2)))
    a = bake.arrays
    assert bake.counts["blind"] == bake.counts["traced"] == bake.counts["flagged"] == 0
    assert bake.counts["sets"] == 18  # fronts and backs: the floor is open
    for one, normal in enumerate(a["normals"].astype(np.float64)):
        (horizon,) = contours(bake, one)
        assert (horizon[:, 3] == 0).all()  # at infinity
        np.testing.assert_allclose(horizon[:, :3] @ normal, 0, atol=1e-6)
        assert solid_angle(horizon[:, :3], normal) == pytest.approx(2 * np.pi, rel=1e-3)


@pytest.mark.parametrize("resolution", [32, 64])
def test_the_shadow_of_a_ball(resolution):
    """A hole for a ball that hangs above, as large as it is by its known solid angle, at the ball's distance."""
    settings = PolygonSettings(resolution, 0.1, 0.05)
    bake = baked(scene_of(floor(4, 1.0), ball(4, (0.2, 1.5, 0.1))), settings)
    a = bake.arrays
    one = int(np.flatnonzero((np.abs(a["positions"]).max(axis=1) < 1e-6) & (a["normals"][:, 1] > 0.9))[0])
    horizon, hole = sorted(contours(bake, one), key=lambda points: (points[:, 3] > 0).mean())
    axis = np.array([0.2, 1.5, 0.1])
    distance = np.linalg.norm(axis)
    sine = 0.5 / distance
    np.testing.assert_allclose(hole[:, :3] @ axis / distance, np.sqrt(1 - sine**2), atol=0.004)
    expected = -2 * np.pi * (1 - np.sqrt(1 - sine**2))
    assert solid_angle(hole[:, :3], axis / distance) == pytest.approx(expected, rel=0.02)
    np.testing.assert_allclose(1 / hole[:, 3], np.sqrt(distance**2 - 0.25), rtol=0.1)
    assert (horizon[:, 3] == 0).all()


def test_areas_as_the_map_they_came_from():
    """Solid angles of what vertices see on a floor beside a wall and under a ball, against 40,000 rays each."""
    scene = scene_of(floor(4), quad((-3, 0, -1.1), (6, 0, 0), (0, 2, 0), GREY), ball(2))
    bake = baked(scene, PolygonSettings(64, 0.25, 0.05))
    rng = np.random.default_rng(4)
    directions = unit(rng.normal(size=(40000, 3)))
    import trimesh

    flat = scene._flat
    mesh = trimesh.Trimesh(flat.points, flat.indices, process=False)
    triangles = mesh.triangles.astype(np.float64)
    for one in rng.choice(np.flatnonzero(bake.arrays["set_states"] == 0), 5, replace=False):
        normal = bake.arrays["normals"][one].astype(np.float64)
        origin = bake.arrays["positions"][one] + 1e-4 * scene.radius * normal
        above = directions[directions @ normal > 0]
        seen = ~occluded(triangles, origin, above)
        got = sum(solid_angle(points[:, :3], normal) for points in contours(bake, one))
        assert got == pytest.approx(2 * np.pi * seen.mean(), abs=0.006 * 2 * np.pi)


def occluded(triangles, origin, directions):
    """Whether rays meet triangles, bool [ray] (Moeller and Trumbore)."""
    hit = np.zeros(len(directions), bool)
    for p0, p1, p2 in triangles:
        across = np.cross(directions, p2 - p0)
        scale = across @ (p1 - p0)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = across @ (origin - p0) / scale
            other = np.cross(origin - p0, p1 - p0)
            v = directions @ other / scale
            hit |= (u >= 0) & (v >= 0) & (u + v <= 1) & ((p2 - p0) @ other / scale > 0)
    return hit


def lists_of(bake):
    """Yield record, counts of the three contours, start and steps [step, 3] of every list."""
    a = bake.arrays
    sizes = np.diff(a["point_starts"])
    for record in np.flatnonzero(a["states"] > 0):
        for k in range(a["list_starts"][record], a["list_starts"][record + 1]):
            steps = a["steps"][a["step_starts"][k] : a["step_starts"][k + 1]]
            yield record, sizes[a["list_contours"][k]], a["list_first"][k], (steps[:, None] >> np.arange(3)) & 1


def test_lists_go_once_around_every_contour():
    """Monotone and complete: each step advances, none by more than a point, and each contour is gone round once; no
    contour is in two lists of a triangle."""
    bake = baked(scene_of(floor(4), ball(1)))
    a, count = bake.arrays, 0
    assert (a["states"] > 0).any()
    for _, sizes, first, steps in lists_of(bake):
        count += 1
        assert (first < sizes).all() and (first >= 0).all()
        assert steps.any(axis=1).all()
        np.testing.assert_array_equal(steps.sum(axis=0), sizes)
    assert count == len(a["list_contours"]) > 40
    for record in np.flatnonzero(a["states"] > 0):
        used = a["list_contours"][a["list_starts"][record] : a["list_starts"][record + 1]]
        for corner, own in enumerate(a["corner_sets"][record]):
            assert sorted(used[:, corner]) == list(range(*a["contour_starts"][own : own + 2]))


def matched(rings, corners):
    """Match three contours of points at infinity, each [point, 3]; return steps [step, 3] and the first triple."""
    starts = np.concatenate([[0], np.cumsum([len(ring) for ring in rings])]).astype(np.int32)
    points = np.concatenate([np.column_stack([ring, np.zeros(len(ring))]) for ring in rings]).astype(np.float32)
    found = baking.Contours(np.arange(4, dtype=np.int32), starts, points, np.zeros(3, np.uint8))
    sets = baking.sets_on(
        np.asarray(corners, np.float32), np.tile((0, 1, 0), (3, 1)).astype(np.float32), found, device()
    )
    arrays = baking.match_triangles(sets, np.array([[0, 1, 2]], np.int32), device())
    return (arrays["steps"][:, None] >> np.arange(3)) & 1, arrays["list_first"][0]


CORNERS = ((0, 0, 0), (1, 0, 0), (0, 0, 1))


def test_equal_contours_match_point_by_point_wherever_they_begin():
    ring = circle_about((0, 1, 0), 1.0, 17)
    steps, first = matched([ring, np.roll(ring, 5, axis=0), np.roll(ring, -3, axis=0)], CORNERS)
    assert (steps == 1).all() and len(steps) == 17
    assert (first[1] - first[0]) % 17 == 5 and (first[2] - first[0]) % 17 == 14


def cheapest(rings, first):
    """The smallest sum of distances over all paths once around from a triple, by trying every step (float64)."""
    sizes = [len(ring) for ring in rings]
    ordered = [np.roll(ring, -start, axis=0) for ring, start in zip(rings, first, strict=True)]
    spread = lambda i, j, k: sum(  # noqa: E731
        np.linalg.norm(x - y)
        for x, y in (
            (ordered[0][i % sizes[0]], ordered[1][j % sizes[1]]),
            (ordered[1][j % sizes[1]], ordered[2][k % sizes[2]]),
            (ordered[2][k % sizes[2]], ordered[0][i % sizes[0]]),
        )
    )
    cost = np.full([size + 1 for size in sizes], np.inf)
    cost[0, 0, 0] = spread(0, 0, 0)
    for at in np.ndindex(*cost.shape):
        if any(at):
            before = [tuple(np.subtract(at, move)) for move in np.ndindex(2, 2, 2) if any(move)]
            cost[at] = min(cost[one] for one in before if min(one) >= 0) + spread(*at)
    return cost[-1, -1, -1]


@pytest.mark.parametrize("counts", [(5, 7, 4), (3, 9, 6), (12, 3, 3)])
def test_paths_cost_as_little_as_any(counts):
    """Where contours have no anchor but one, the path is the cheapest of all, found by trying every step."""
    rng = np.random.default_rng(sum(counts))
    rings = [
        unit(circle_about((0, 1, 0), 0.9, count, 0.3 * k) + rng.normal(size=(count, 3)) * 0.03)
        for k, count in enumerate(counts)
    ]
    steps, first = matched(rings, CORNERS)
    at = first + np.concatenate([[[0, 0, 0]], np.cumsum(steps, axis=0)])
    points = [ring[at[:, k] % counts[k]] for k, ring in enumerate(rings)]
    cost = sum(np.linalg.norm(points[k] - points[(k + 1) % 3], axis=1).sum() for k in range(3))
    assert cost <= 1.15 * cheapest(rings, first)  # anchors may cost a little
    np.testing.assert_array_equal(steps.sum(axis=0), counts)


def interpolated(bake, record, weights):
    """The polygon at a point of a record, in NumPy (Eq. 3 and 21): float64 [point, 3] for each list."""
    a = bake.arrays
    corners = a["corner_sets"][record]
    positions = a["positions"][corners].astype(np.float64)
    away = positions - weights @ positions
    result = []
    for k in range(a["list_starts"][record], a["list_starts"][record + 1]):
        steps = (a["steps"][a["step_starts"][k] : a["step_starts"][k + 1], None] >> np.arange(3)) & 1
        at = a["list_first"][k] + np.concatenate([[[0, 0, 0]], np.cumsum(steps, axis=0)])
        sum_of = np.zeros((len(at), 3))
        for corner, contour in enumerate(a["list_contours"][k]):
            points = a["points"][a["point_starts"][contour] : a["point_starts"][contour + 1]].astype(np.float64)
            q = points[at[:, corner] % len(points)]
            sum_of += weights[corner] * unit(q[:, :3] + q[:, 3:] * away[corner])
        result.append(unit(sum_of))
    return result


def test_at_a_vertex_the_polygon_is_that_vertex_own():
    bake = baked(scene_of(floor(4), ball(1)))
    a = bake.arrays
    for record in np.flatnonzero(a["states"] > 0)[::7]:
        for corner in range(3):
            polygon = interpolated(bake, record, np.eye(3)[corner])
            own = contours(bake, a["corner_sets"][record, corner])
            normal = a["normals"][a["corner_sets"][record, corner]].astype(np.float64)
            mine = sorted(solid_angle(points, normal) for points in polygon)
            np.testing.assert_allclose(mine, sorted(solid_angle(p[:, :3], normal) for p in own), rtol=1e-6)


def test_blind_vertices_and_what_does_not_match_are_traced():
    """A floor under the ground of a box: corners inside see nothing, and no triangle blends them."""
    inside = quad((-0.2, 0.9, 0.2), (0.4, 0, 0), (0, 0, -0.4), GREY)
    bake = baked(scene_of(ball(1), inside))
    a = bake.arrays
    blind = a["set_states"] == int(contour_kernels.SET_BLIND)
    assert bake.counts["blind"] == blind.sum() == 8  # both sides of four corners
    touched = (a["corner_sets"] >= 0).all(axis=1) & blind[a["corner_sets"]].any(axis=1)
    assert touched.sum() == 4 and (a["states"][touched] == int(kernels.TRACED)).all()
    assert (a["states"][a["corner_sets"][:, 0] < 0] == int(kernels.TRACED)).all()
    lengths = np.diff(a["contour_starts"])[a["corner_sets"]]
    differ = (lengths.max(axis=1) != lengths.min(axis=1)) & (a["corner_sets"][:, 0] >= 0)
    assert (a["states"][differ] == int(kernels.TRACED)).all()


def test_most_vertices_blind_is_told():
    closed = [quad((-1, -1, 1), (2, 0, 0), (0, 0, -2), GREY), quad((-1, 1, 1), (2, 0, 0), (0, 0, -2), GREY)]
    closed += [quad((x, -1, -1), (0, 0, 2), (0, 2, 0), GREY) for x in (-1, 1)]
    closed += [quad((-1, -1, z), (2, 0, 0), (0, 2, 0), GREY) for z in (-1, 1)]
    inside = [quad((-0.5, y, 0.5), (1, 0, 0), (0, 0, -1), GREY) for y in (-0.6, -0.3, 0, 0.3, 0.6)]
    with pytest.warns(
        UserWarning, match="of .* vertices see no sky: their pixels are traced; VisibilityField is faster"
    ):
        baked(scene_of(*closed, *inside))


def test_open_and_unwelded_surfaces():
    """A closed ball has fronts alone, an open one both sides; corners at one place share a set if normals agree."""
    closed = corner_sets(scene_of(ball(1))._flat)
    assert (closed.corner_sets[80:] == -1).all() and len(closed.positions) == 42
    mesh = ball(1)
    cut = gi.Mesh(mesh.points, mesh.indices[1:], GREY, normals=mesh.normals)
    both = corner_sets(scene_of(cut)._flat)
    assert (both.corner_sets >= 0).all() and len(both.positions) == 84
    fronts, backs = both.corner_sets[:79], both.corner_sets[79:]
    np.testing.assert_array_equal(both.normals[fronts], -both.normals[backs])
    soup = gi.Mesh(
        mesh.points[mesh.indices].reshape(-1, 3),
        np.arange(240).reshape(-1, 3),
        GREY,
        normals=mesh.normals[mesh.indices].reshape(-1, 3),
    )
    again = corner_sets(scene_of(soup)._flat)
    assert len(again.positions) == 42 and (again.corner_sets[80:] == -1).all()
    flat = corner_sets(scene_of(gi.Mesh(mesh.points, mesh.indices, GREY))._flat)
    assert len(flat.positions) == 240  # flat faces do not share
    fan = gi.Mesh(  # three triangles at one edge: not a manifold
        np.array([(0, 0, 0), (0, 1, 0), (1, 0, 0), (-1, 0, 0), (0, 0, 1)], np.float32),
        np.array([(0, 1, 2), (0, 1, 3), (0, 1, 4), (0, 0, 2)]),
        GREY,
    )
    sets = corner_sets(scene_of(fan)._flat).corner_sets
    assert (sets[[0, 1, 2, 4, 5, 6]] >= 0).all() and (sets[[3, 7]] == -1).all()  # the last has no area


def test_the_same_on_any_number_of_threads_and_after_saving(tmp_path):
    scene = scene_of(floor(4), ball(1))
    one = baked(scene)
    launch.set_threads(2)
    try:
        two = baked(scene)
    finally:
        launch.set_threads(None)
    assert one.digest == two.digest
    back = load_bake(one.save(tmp_path / "a.safetensors"))
    assert back.digest == one.digest and back.settings == SETTINGS.stored()
    assert set(one.settings) == {"resolution", "simplified", "flagged_above"}


def test_clamped_parallax():
    """No occluder is nearer than the longest edge around its vertex: it would move too far over a triangle."""
    bake = baked(scene_of(floor(4), ball(1, (0, 0.6, 0))))
    scene_sets = corner_sets(scene_of(floor(4), ball(1, (0, 0.6, 0)))._flat)
    longest = scene_sets.lengths[:, 1]
    seen = 0
    for one in range(len(longest)):
        for points in contours(bake, one):
            assert (points[:, 3] <= 1.0001 / longest[one]).all()
            seen += int((points[:, 3] > 0).sum())
    assert seen > 100


def times_covered(polygon, center, directions):
    """How often a polygon covers directions, int [direction]: by the fan of triangles from a centre."""
    count = np.zeros(len(directions), int)
    for points in polygon:
        for a, b in zip(points, np.roll(points, -1, axis=0), strict=True):
            side = np.sign(center @ np.cross(a, b))
            sides = directions @ np.stack([np.cross(center, a), np.cross(a, b), np.cross(b, center)], axis=1)
            count += (side * (sides * side > 0).all(axis=1)).astype(int)
    return count


def test_the_check_finds_what_interpolation_gets_wrong():
    """Nothing over a bare floor; over a coarse one under a ball what cosine-weighted rays find, in NumPy."""
    assert baked(scene_of(floor(2))).arrays["errors"].max() < 0.01
    scene = scene_of(floor(6), ball(2, (0.3, 0.8, 0.2), 0.4))
    bake = baked(scene)
    a, flat = bake.arrays, scene._flat
    assert 0 < bake.counts["flagged"] < 0.5 * bake.counts["sides"]
    triangles = flat.points[flat.indices].astype(np.float64)
    fronts = a["states"][: len(triangles)]
    rng = np.random.default_rng(6)
    chosen = [*np.flatnonzero(fronts == kernels.FLAGGED)[:2], *np.flatnonzero(fronts == kernels.MATCHED)[:2]]
    for record in chosen:
        errors = []
        for weights in (*(0.15 + 0.55 * np.eye(3)), np.full(3, 1 / 3)):
            normal = unit(weights @ a["normals"][a["corner_sets"][record]])
            directions = unit(normal + unit(rng.normal(size=(1500, 3))))
            face = np.cross(triangles[record, 1] - triangles[record, 0], triangles[record, 2] - triangles[record, 0])
            origin = weights @ triangles[record] + 1e-5 * unit(face)
            seen = ~occluded(triangles, origin, directions) & (directions @ face > 0)
            covered = times_covered(interpolated(bake, record, weights), normal, directions) > 0
            errors.append(np.mean(covered != seen))
        assert float(a["errors"][record]) == pytest.approx(max(errors), abs=0.025)
