"""Directions as they are seen from a region's anchor, against rays and spheres in float64."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from parallax_tools import NEAREST, has_parallax, random_directions, seen_from_anchor
from statistics_tools import device, every_device, sphere_expectation  # noqa: F401

from warp_gi.kernels import parallax
from warp_gi.launch import launch

wp.set_module_options({"enable_backward": False})


# Thread: an anchor, a position and a direction. How each sees the other's direction, and the stretch.
@wp.kernel
def see(
    first: wp.int32,
    anchors: wp.array(dtype=wp.vec4),
    positions: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    at_anchor: wp.array(dtype=wp.vec4),
    at_point: wp.array(dtype=wp.vec4),
):
    i = first + wp.tid()
    a = parallax.seen_from_anchor(anchors[i], positions[i], directions[i])
    at_anchor[i] = wp.vec4(a.direction[0], a.direction[1], a.direction[2], a.stretch)
    p = parallax.seen_from_point(anchors[i], positions[i], directions[i])
    at_point[i] = wp.vec4(p.direction[0], p.direction[1], p.direction[2], p.stretch)


def seen(anchors, positions, directions):
    """Directions [n, 3] and stretches [n]: of directions at the positions as seen from the anchor, then of directions
    at the anchor as seen from the positions."""
    n = max(map(len, (anchors, positions, directions)))
    arrays = [(anchors, wp.vec4), (positions, wp.vec3), (directions, wp.vec3)]
    inputs = []
    for values, dtype in arrays:
        values = np.broadcast_to(np.asarray(values, np.float32), (n, np.shape(values)[1]))
        inputs.append(wp.array(np.ascontiguousarray(values), dtype=dtype, device=device()))
    outputs = [wp.zeros(n, dtype=wp.vec4, device=device()) for _ in range(2)]
    launch(see, n, [*inputs, *outputs], device())
    a, p = (output.numpy() for output in outputs)
    return (a[:, :3], a[:, 3]), (p[:, :3], p[:, 3])


def places(count=20_000, least=0.0, most=0.949, seed=1):
    """Anchors, positions that are so far from them, in units of their radius, and directions; as float32 has them."""
    rng = np.random.default_rng(seed)
    radii = 10.0 ** rng.uniform(-2, 2, count)
    anchors = np.column_stack([rng.uniform(-1, 1, (count, 3)) * radii[:, None], 1 / radii]).astype(np.float32)
    share = rng.uniform(least, most, count)
    away = random_directions(count, seed + 1) * (share * radii)[:, None]
    return anchors, (anchors[:, :3] + away).astype(np.float32), random_directions(count, seed + 2)


def test_what_the_anchor_sees():
    anchors, positions, directions = places()
    assert float(parallax.NEAREST) == np.float32(NEAREST) and has_parallax(anchors, positions).all()
    expected, stretch = seen_from_anchor(anchors, positions, directions)
    (got, got_stretch), _ = seen(anchors, positions, directions)
    assert np.abs(got - expected).max() < 2e-6
    assert np.allclose(got_stretch, stretch, rtol=3e-5)
    assert stretch.min() < 0.01 and stretch.max() > 3.5


def test_both_ways_are_inverse():
    anchors, positions, directions = places(seed=5)
    (at_anchor, stretch), (at_point, stretch_there) = seen(anchors, positions, directions)
    for found in (at_anchor, at_point):
        assert np.abs(np.linalg.norm(found.astype(np.float64), axis=1) - 1).max() < 1e-6
    _, (back, again) = seen(anchors, positions, at_anchor)
    assert np.abs(back - directions).max() < 5e-6  # a near side of the sphere magnifies rounding
    assert np.allclose(again, stretch, rtol=3e-5)
    (back, again), _ = seen(anchors, positions, at_point)
    assert np.abs(back - directions).max() < 3e-6
    assert np.allclose(again, stretch_there, rtol=3e-5)
    assert np.abs(at_anchor - directions).max() > 0.9


def test_light_on_the_sphere_is_in_one_direction():
    """Whatever point of the region looks at it."""
    rng = np.random.default_rng(3)
    anchor, light = np.array([[1.0, -2.0, 0.5, 0.25]]), np.array([0.36, -0.48, 0.8])
    positions = anchor[:, :3] + random_directions(5000, 4) * (3.5 * rng.random((5000, 1)))
    ways = anchor[:, :3] + 4.0 * light - positions
    directions = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    (got, _), _ = seen(anchor, positions, directions)
    assert np.abs(got - light).max() < 2e-6
    assert np.abs(directions - light).max() > 0.5


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 0.94])
def test_solid_angles_add_up(share):
    """A uniform density at the anchor, mapped to any point inside of the sphere, integrates to one."""
    anchor = np.array([[0.2, 0.1, -0.3, 0.5]])
    position = anchor[:, :3] + 2.0 * share * np.array([[0.48, 0.64, 0.6]])
    total = sphere_expectation(lambda d: seen(anchor, position, d)[0][1] / (4 * np.pi), 1, 16, 16, 16).sum()
    assert np.isclose(total, 1, rtol=1e-5)


@pytest.mark.parametrize("case", ["no sphere", "near the sphere", "outside"])
def test_no_parallax(case):
    anchors, positions, directions = {
        "no sphere": lambda: places(most=0.9),
        "near the sphere": lambda: places(least=0.951, most=1.05),
        "outside": lambda: places(least=1.05, most=50.0),
    }[case]()
    if case == "no sphere":
        anchors[:, 3] = 0
    for got, stretch in seen(anchors, positions, directions):
        assert np.array_equal(got, directions) and (stretch == 1).all()


def test_the_anchor_sees_what_it_sees():
    anchors, _, directions = places()
    for got, stretch in seen(anchors, anchors[:, :3], directions):
        assert np.abs(got - directions).max() < 2e-7 and np.abs(stretch - 1).max() < 5e-7
