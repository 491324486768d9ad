"""The light sampler: where its samples go, against a density computed here from the triangles alone."""

from __future__ import annotations

import numpy as np
import pytest
import statistics_tools as st
import warp as wp
from scene_tools import quad
from statistics_tools import every_device  # noqa: F401

import warp_gi as gi
from warp_gi.kernels.emitters import sample_emitter
from warp_gi.kernels.path_samplers import AliasLights, alias_light
from warp_gi.kernels.sampling import sample_2d
from warp_gi.kernels.surface import Surface
from warp_gi.kernels.types import SceneData
from warp_gi.launch import launch

wp.set_module_options({"enable_backward": False})


# Thread: one sample of one emitter; direction and distance, pdf (0: rejected), radiance.
@wp.kernel
def sample_lights(
    first: wp.int32,
    scene: SceneData,
    position: wp.vec3,
    to_light: wp.array(dtype=wp.vec4),
    pdf: wp.array(dtype=wp.float32),
    radiance: wp.array(dtype=wp.vec3),
):
    i = first + wp.tid()
    seed = wp.uint32(3 * i + 1)
    u = sample_2d(wp.uint32(0), seed, 0)
    choice = alias_light(AliasLights(), scene, -1, Surface(), position, u)
    r = sample_emitter(scene, position, choice, sample_2d(wp.uint32(0), seed, 1))
    to_light[i] = wp.vec4(r.direction[0], r.direction[1], r.direction[2], r.distance)
    pdf[i] = r.pdf
    radiance[i] = r.radiance


def lamps() -> tuple[gi.Scene, np.ndarray, np.ndarray, np.ndarray]:
    """Return five lamps about the origin: the scene, triangles [n, 3, 3], powers [n], whether one-sided [n]."""
    frames = [  # corner, edges, radiance, double-sided
        ((-1, 2, -1), (2, 0, 0), (0, 0, 2), (1, 1, 1), False),
        ((1, -1, -1), (0, 0, 1.5), (0, 1.5, 0.5), (5, 2, 1), True),
        ((-2, -1, 1), (0, 1, 0.3), (0, 0.1, -2), (0.5, 0.5, 4), False),
        ((-0.5, -0.5, 2), (1, 0, 0), (0, 1, 0), (3, 3, 3), False),  # turned away
        ((-0.2, -1.5, -0.2), (0.4, 0, 0), (0, 0, 0.4), (30, 20, 10), True),
    ]
    meshes, triangles, weights, one_sided = [], [], [], []
    for i, (corner, u, v, radiance, both) in enumerate(frames):
        material = gi.Material(f"lamp{i}", (0, 0, 0), specular=0.0, emission=radiance, double_sided=both)
        mesh = quad(corner, u, v, material, f"lamp{i}")
        meshes.append(mesh)
        area = 0.5 * np.linalg.norm(np.cross(u, v))
        for face in mesh.indices:
            triangles.append(mesh.points[face])
            weights.append(area * np.dot(radiance, [0.2126, 0.7152, 0.0722]) * (2 if both else 1))
            one_sided.append(not both)
    return gi.Scene([gi.Node("lamps", meshes)]), np.array(triangles, float), np.array(weights), np.array(one_sided)


def density(triangles: np.ndarray, chances: np.ndarray, one_sided: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Solid-angle density [n] seen from the origin: of every triangle on the ray, chance * t^2 / (area * cosine)."""
    total = np.zeros(len(directions))
    for (a, b, c), chance, single in zip(triangles, chances, one_sided, strict=True):
        cross = np.cross(b - a, c - a)
        slant = directions @ cross
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (a @ cross) / slant
            hit = directions * t[:, None] - a
            inverse = np.linalg.pinv(np.stack([b - a, c - a], axis=1))
            u, v = (hit @ inverse.T).T
            inside = (t > 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & ((slant < 0) | (not single))
            total += np.where(inside, chance * t * t / (0.5 * np.abs(slant)), 0.0)
    return total


@pytest.mark.parametrize("sampler", [gi.PowerLights(), gi.UniformLights()])
def test_samples_follow_the_density_of_the_lamps(sampler):
    scene, triangles, weights, one_sided = lamps()
    chances = (
        weights / weights.sum() if isinstance(sampler, gi.PowerLights) else np.full(len(weights), 1 / len(weights))
    )
    camera = gi.Camera.look_at((0, 0, 0), (1, 0, 0), resolution=(1, 1))
    frame = next(iter(gi.render(scene, camera, gi.Pipeline(spp=1, emitters=sampler), device=str(st.device()))))
    count = 200_000
    outputs = [wp.empty(count, dtype=t, device=st.device()) for t in (wp.vec4, wp.float32, wp.vec3)]
    launch(sample_lights, count, [frame.data, wp.vec3(0.0, 0.0, 0.0), *outputs], st.device())
    to_light, pdf, radiance = (x.numpy() for x in outputs)
    kept = pdf > 0
    directions = np.where(kept[:, None], to_light[:, :3], 0.0)

    expected = st.sphere_expectation(lambda d: density(triangles, chances, one_sided, d), count, 24, 24, 20)
    p = st.chi_squared(st.sphere_histogram(directions, 24, 24), expected, total=count)
    assert p > 1e-4, f"p = {p:.1e}"

    # each sample names the density of the one triangle it lies on, and that lamp's radiance
    points = to_light[:, :3] * to_light[:, 3:]
    some = np.flatnonzero(kept)[:2000]
    alone = np.stack(
        [density(triangles[k : k + 1], chances[k : k + 1], one_sided[k : k + 1], to_light[some, :3]) for k in range(10)]
    )
    planes = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    offset = np.abs(np.einsum("kc,nkc->kn", planes, points[some][:, None] - triangles[None, :, 0]))
    offset[alone == 0] = np.inf
    nearest = offset.argmin(axis=0)
    on_edge = ~np.isfinite(offset.min(axis=0))  # rounding put it just outside
    assert on_edge.mean() < 0.01
    agrees = np.isclose(pdf[some], alone[nearest, np.arange(len(some))], rtol=1e-3)
    assert agrees[~on_edge].mean() > 0.995  # the rest lies on the diagonal between two triangles of a lamp
    emission = np.array([m.emission for m in scene.materials], dtype=np.float32).repeat(2, axis=0)
    assert np.array_equal(radiance[some][~on_edge], emission[nearest][~on_edge])

    # mean of 1 / pdf is the solid angle that shines this way, counted once a triangle
    inverse = np.where(kept, 1.0 / np.maximum(pdf, 1e-30), 0.0).astype(np.float64)
    angle = sum(solid_angle(t) for t, single in zip(triangles, one_sided, strict=True) if not single or faces_origin(t))
    assert abs(inverse.mean() - angle) < 5 * inverse.std() / np.sqrt(count)


def faces_origin(triangle: np.ndarray) -> bool:
    a, b, c = triangle
    return float(a @ np.cross(b - a, c - a)) < 0


def solid_angle(triangle: np.ndarray) -> float:
    """Of a triangle seen from the origin (van Oosterom and Strackee 1983)."""
    a, b, c = triangle
    la, lb, lc = (np.linalg.norm(x) for x in triangle)
    return 2 * abs(np.arctan2(a @ np.cross(b, c), la * lb * lc + (a @ b) * lc + (a @ c) * lb + (b @ c) * la))
