"""Scenes whose light is known by a formula or a converged sum in float64, for every estimator that is or will be.

`CASES` is the table. Most cameras see no more than the origin, on a surface that faces up, or light is the same
everywhere: one number a channel says what a term must be.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from scene_tools import light, quad, sphere, unit

import warp_gi as gi

MATERIALS = {  # base colour, metallic, roughness, specular
    "lambert": ((0.8, 0.5, 0.2), 0.0, 1.0, 0.0),
    "plastic": ((0.8, 0.5, 0.2), 0.0, 0.3, 1.0),
    "half_specular": ((0.9, 0.9, 0.9), 0.0, 0.6, 0.5),
    "rough_metal": ((0.9, 0.6, 0.3), 1.0, 0.8, 1.0),
    "smooth_metal": ((1.0, 1.0, 1.0), 1.0, 0.2, 1.0),
    "mixed": ((0.2, 0.9, 0.4), 0.5, 0.5, 1.0),
    "black_metal": ((0.0, 0.0, 0.0), 1.0, 0.5, 1.0),
}
ALBEDO = np.array([0.8, 0.5, 0.2])
GROUND = gi.Material("ground", tuple(ALBEDO), specular=0.0)
BLACK = gi.Material("black", (0.0, 0.0, 0.0), specular=0.0)
LOW_VIEW = (-0.9, 0.5, -0.2)  # below what hangs at a height of 1
gauss_legendre = cache(np.polynomial.legendre.leggauss)


# ---- scenes ----


def scene_of(*meshes: gi.Mesh, environment: object = None, lights: Sequence[gi.PunctualLight] = ()) -> gi.Scene:
    return gi.Scene([gi.Node("all", list(meshes))], lights, environment)


def ground(material: gi.Material = GROUND, size: float = 4.0) -> gi.Mesh:
    """A square in the plane y = 0 about the origin, its front up."""
    return quad((-size, 0, size), (2 * size, 0, 0), (0, 0, -2 * size), material, "ground")


def material_of(name: str) -> gi.Material:
    base, metallic, roughness, specular = MATERIALS[name]
    return gi.Material(name, base, metallic=metallic, roughness=roughness, specular=specular)


def spot_camera(direction: object = (0.3, 1.0, 0.2), pixels: int = 8) -> gi.Camera:
    """A camera so narrow that all its pixels see the origin (within 2 mm), from ``direction`` (towards it)."""
    eye = 2.0 * unit(direction)
    return gi.Camera.look_at(eye, (0, 0, 0), up=(0.1, 0.2, 0.97), hfov=0.1, resolution=(pixels, pixels))


def closed_box(albedo: float, emission: float) -> list[gi.Mesh]:
    """Return the sides of a cube of 2 m, fronts inward, that emit and reflect the same everywhere; the second is up."""
    glow = gi.Material("glow", (albedo,) * 3, specular=0.0, emission=(emission,) * 3)
    return [
        quad((-1, -1, 1), (2, 0, 0), (0, 0, -2), glow, "floor"),
        quad((-1, 1, -1), (2, 0, 0), (0, 0, 2), glow, "ceiling"),
        quad((-1, -1, -1), (2, 0, 0), (0, 2, 0), glow, "back"),
        quad((1, -1, 1), (-2, 0, 0), (0, 2, 0), glow, "front"),
        quad((-1, -1, 1), (0, 0, -2), (0, 2, 0), glow, "left"),
        quad((1, -1, -1), (0, 0, 2), (0, 2, 0), glow, "right"),
    ]


def camera_in_box(resolution: tuple[int, int] = (16, 16)) -> gi.Camera:
    return gi.Camera.look_at((0.2, 0.1, 0.3), (1, 0.3, -0.2), hfov=100, resolution=resolution)


def sky_of(radiance: Callable[[np.ndarray], np.ndarray], height: int = 128) -> gi.Environment:
    """Return a map of a radiance [n, 3] that is a function of directions [n, 3]."""
    theta, phi = (np.arange(height) + 0.5) * np.pi / height, (np.arange(2 * height) + 0.5) * np.pi / height
    theta, phi = (grid.ravel() for grid in np.meshgrid(theta, phi, indexing="ij"))
    directions = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=-1)
    return gi.Environment(pixels=radiance(directions).reshape(height, 2 * height, 3).astype(np.float32))


# ---- sums in float64 ----


def gltf(name: str, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """BSDF times cosine, float64 [n, 3], as glTF 2.0 Appendix B and KHR_materials_specular state it; +z is up."""
    base, metallic, roughness, specular = MATERIALS[name]
    base = np.asarray(base)
    alpha2 = max(roughness**2, 1e-3) ** 2
    half = unit(wo + wi)
    n_h, v_h, n_l, n_v = half[:, 2], (wi * half).sum(-1), wi[:, 2], np.broadcast_to(wo, wi.shape)[:, 2]
    d = alpha2 / (np.pi * (n_h**2 * (alpha2 - 1.0) + 1.0) ** 2)
    v = 0.5 / (n_l * np.sqrt(n_v**2 * (1 - alpha2) + alpha2) + n_v * np.sqrt(n_l**2 * (1 - alpha2) + alpha2))
    f0 = 0.04 * specular * (1 - metallic) + base * metallic
    f90 = specular * (1 - metallic) + metallic
    f = f0 + (f90 - f0) * (1 - v_h[:, None]) ** 5
    value = (1 - f) * base * (1 - metallic) / np.pi + f * (d * v)[:, None]
    return np.where((n_l > 0)[:, None], value * n_l[:, None], 0.0)


def albedo(name: str, wo: np.ndarray) -> np.ndarray:
    """Directional albedo, float64 [3]: the integral of `gltf` over the hemisphere, in half vectors drawn by GGX."""
    nodes, weights = gauss_legendre(256)
    s, phi = (nodes + 1) / 2, 2 * np.pi * (np.arange(256) + 0.5) / 256
    alpha2 = max(MATERIALS[name][2] ** 2, 1e-3) ** 2
    z = np.sqrt((1 - s) / (1 + (alpha2 - 1) * s))[:, None] * np.ones_like(phi)
    ring = np.sqrt(1 - z * z)
    half = np.stack([ring * np.cos(phi), ring * np.sin(phi), z], axis=-1).reshape(-1, 3)
    v_h = half @ wo
    wi = 2 * v_h[:, None] * half - wo
    d = alpha2 / (np.pi * (half[:, 2] ** 2 * (alpha2 - 1) + 1) ** 2)
    jacobian = np.where(v_h > 1e-9, 4 * v_h / (d * half[:, 2]), 0.0)
    measure = (weights[:, None] / 2 * np.ones_like(phi) / len(phi)).ravel()
    return (gltf(name, wo, np.where(v_h[:, None] > 1e-9, wi, [0, 0, -1.0])) * (jacobian * measure)[:, None]).sum(0)


def reflected(name: str, view: object, directions: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return radiance [3] towards ``view`` of a material that faces +y, lit by ``light`` [n, 3], radiance times sr."""
    wo, wi = (unit(d)[..., [2, 0, 1]] for d in (view, directions))
    return (gltf(name, wo, wi) * light).sum(axis=0)


def sky_nodes(count: int = 256) -> tuple[np.ndarray, np.ndarray]:
    """Return directions [n, 3] of the upper half sphere and their solid angles [n, 1]."""
    nodes, weights = gauss_legendre(count)
    z, phi = (nodes + 1) / 2, 2 * np.pi * (np.arange(2 * count) + 0.5) / (2 * count)
    y = np.repeat(z, 2 * count)
    ring, phi = np.sqrt(1 - y * y), np.tile(phi, count)
    solid = np.repeat(weights / 2, 2 * count) * np.pi / count
    return np.stack([ring * np.sin(phi), y, -ring * np.cos(phi)], axis=-1), solid[:, None]


def triangle_nodes(corners: np.ndarray, count: int = 24) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points [n, 3] of a triangle [3, 3], their barycentric weights [n, 3], and solid angles [n, 1] that points
    of the front take up at the origin: 0 where it is turned away."""
    nodes, weights = gauss_legendre(count)
    s, t = (grid.ravel() for grid in np.meshgrid((nodes + 1) / 2, (nodes + 1) / 2, indexing="ij"))
    share = np.outer(weights / 2, weights / 2).ravel()
    barycentric = np.stack([1 - s, s * (1 - t), s * t], axis=-1)  # the square collapsed: area grows with s
    points = barycentric @ corners
    cross = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    facing = np.maximum(-(points @ cross), 0.0)  # times 2 area times distance
    return points, barycentric, (share * s * facing / np.linalg.norm(points, axis=1) ** 3)[:, None]


def lit_by(meshes: Sequence[gi.Mesh], name: str, view: object) -> np.ndarray:
    """Return radiance [3] towards ``view`` of a material at the origin, lit by all triangles of ``meshes`` alone.

    The whole of each mesh must be above the ground; an emission texture counts with its colour at each point.
    """
    total = np.zeros(3)
    for mesh in meshes:
        for face in mesh.indices:
            points, barycentric, solid = triangle_nodes(mesh.points[face].astype(np.float64))
            radiance = np.asarray(mesh.material.emission, np.float64) * np.ones((len(points), 1))
            if mesh.material.emission_texture is not None:
                u = (barycentric @ mesh.uvs[face].astype(np.float64))[:, 0]
                radiance = radiance * ramp(mesh.material.emission_texture, u)
            total += reflected(name, view, points, radiance * solid)
    return total


def ramp(texture: gi.Texture, u: np.ndarray) -> np.ndarray:
    """Return linear colours [n, 3] along a texture of one row that is clamped at its ends and not sRGB-coded."""
    row = texture.pixels[0, :, :3].astype(np.float64) / 255.0
    middles = (np.arange(len(row)) + 0.5) / len(row)
    return np.stack([np.interp(u, middles, channel) for channel in row.T], axis=-1)


def quarter_form_factor(a: float, b: float) -> float:
    """From a point to a parallel rectangle with a corner straight above it; sides over distance (Howell, B-4)."""
    p, q = np.sqrt(1 + a * a), np.sqrt(1 + b * b)
    return (a / p * np.arctan(b / p) + b / q * np.arctan(a / q)) / (2 * np.pi)


def strip_form_factor(x: float, width: float, length: float) -> float:
    """From a point to a rectangle a metre above it, from x to x + width, and ``length`` to both sides along z."""
    return 2.0 * (
        np.sign(x + width) * quarter_form_factor(abs(x + width), length)
        - np.sign(x) * quarter_form_factor(abs(x), length)
    )


def wall_form_factor(height: float, half_length: float) -> float:
    """From a point to a wall a metre away that stands on its plane, and is as long to both sides (Howell, B-3)."""
    slant = np.hypot(1.0, height)
    return float(np.arctan(half_length) - np.arctan(half_length / slant) / slant) / np.pi


def wall(material: gi.Material, height: float = 1.0, half_length: float = 3.0) -> gi.Mesh:
    """A wall at x = -1 that faces the origin."""
    return quad((-1, 0, half_length), (0, 0, -2 * half_length), (0, height, 0), material, "wall")


def cube_light(albedo: float, parts: int, points: np.ndarray) -> np.ndarray:
    """Return direct and indirect light, float64 [2, n], at ``points`` [n, 3] of the floor of a closed cube of 2 m.

    Its ceiling emits 1. The six sides are cut into ``parts`` x ``parts`` squares, and the radiosity in the middle of
    each stands for all of it: off by something that falls with parts^1.5, as light changes fast along the cube's edges.
    """
    edge = 2.0 / parts
    at = -1.0 + edge * (np.arange(parts) + 0.5)
    a, b = (grid.ravel() for grid in np.meshgrid(at, at, indexing="ij"))
    sides = np.repeat(np.arange(6), parts * parts)
    rows, axis, sign = np.arange(len(sides)), sides // 2, 1.0 - 2.0 * (sides % 2)  # axis, and which end of it
    middle, normal = np.empty((len(sides), 3)), np.zeros((len(sides), 3))
    middle[rows, axis], normal[rows, axis] = sign, -sign
    middle[rows, (axis + 1) % 3], middle[rows, (axis + 2) % 3] = np.tile(a, 6), np.tile(b, 6)
    emission = (sides == 2).astype(float)
    corners = np.repeat(middle[:, None], 4, axis=1)
    corners[rows, :, (axis + 1) % 3] += np.array([-1, 1, 1, -1]) * edge / 2
    corners[rows, :, (axis + 2) % 3] += np.array([-1, -1, 1, 1]) * edge / 2

    def factors(point: np.ndarray, facing: np.ndarray) -> np.ndarray:
        """Return the form factor of each square from a point: Lambert's sum over its edges; 0 on the point's side."""
        p, q = corners - point, np.roll(corners, -1, axis=1) - point
        cross = np.cross(p, q)
        length = np.linalg.norm(cross, axis=2)
        turn = np.arctan2(length, (p * q).sum(axis=2)) * (cross @ facing) / np.maximum(length, 1e-12)
        return np.where(normal @ facing > 0.5, 0.0, np.abs(turn.sum(axis=1)) / (2 * np.pi))

    transport = np.stack([factors(*each) for each in zip(middle, normal, strict=True)])
    leaving = np.linalg.solve(np.eye(len(middle)) - albedo * transport, emission)
    seen = albedo * np.stack([factors(point, np.array([0.0, 1.0, 0.0])) for point in points])
    return np.stack([seen @ emission, seen @ (leaving - emission)])


# ---- the table ----


@dataclass(frozen=True)
class Case:
    """A scene and what its light is."""

    make: Callable[[], gi.Scene]
    camera: gi.Camera
    terms: dict[str, np.ndarray]
    """By name, each term that is known: 3 numbers, or a picture [height, width, 3] of its values in pixels' middles."""
    tolerance: float = 1e-3
    """What the numbers may be off by, relative: textures of skies, a corner cut off."""
    spp: int = 64
    coarse: tuple[str, ...] = field(default=())
    """Terms of which a coarse bake must be wrong here: what it blocks or how it changes from place to place is fine."""


def blocked_sky() -> Case:
    """A dim sky over a wall that hides its form factor of it, and reflects it onto a ground too small to answer."""
    radiance, seen = np.array([0.01, 0.02, 0.03]), wall_form_factor(1.0, 3.0)
    grey = gi.Material("grey", (0.5, 0.6, 0.7), specular=0.0)
    sky = sky_of(lambda d: np.broadcast_to(radiance, d.shape), 64)
    terms = {
        "environment": ALBEDO * radiance * (1 - seen),
        "indirect": ALBEDO * radiance * [0.5, 0.6, 0.7] * seen,
    }
    make = lambda: scene_of(ground(size=0.02), wall(grey), environment=sky)  # noqa: E731
    return Case(make, spot_camera(), terms)


def slats() -> Case:
    """Five black slats a metre above the ground, below a uniform sky."""
    places = [-0.75 + 0.3 * i for i in range(5)]
    blocked = sum(strip_form_factor(x, 0.15, 2.0) for x in places)
    meshes = [quad((x, 1.0, -2), (0.15, 0, 0), (0, 0, 4), BLACK, f"slat{i}") for i, x in enumerate(places)]
    make = lambda: scene_of(ground(), *meshes, environment=(2.0, 3.0, 4.0))  # noqa: E731
    truth = ALBEDO * [2.0, 3.0, 4.0] * (1 - blocked)
    return Case(make, spot_camera(LOW_VIEW), {"environment": truth}, coarse=("environment",))


def half_sky() -> Case:
    """A sky of radiance 2 on the side of +x, black on the other."""
    sky = sky_of(lambda d: 2.0 * (d[:, :1] > 0) * np.ones(3))
    make = lambda: scene_of(ground(), environment=sky)  # noqa: E731
    return Case(make, spot_camera(), {"environment": ALBEDO}, tolerance=2e-3)


def glossy_sky(name: str, view: tuple[float, float, float]) -> Case:
    """A glossy plane under a bright sky that nine harmonics hold."""

    def radiance(d: np.ndarray) -> np.ndarray:
        x, y, z = d.T
        return 100.0 * np.stack(
            [1 + 0.5 * x + 0.4 * y, 1 + 0.6 * x * z + 0.2 * y, 1.2 - 0.6 * x + 0.3 * x * y], axis=-1
        )

    directions, solid = sky_nodes()
    truth = reflected(name, view, directions, radiance(directions) * solid)
    sky = sky_of(radiance)
    make = lambda: scene_of(ground(material_of(name)), environment=sky)  # noqa: E731
    return Case(make, spot_camera(view), {"environment": truth})


def textured_lamp(name: str) -> Case:
    """A bright rectangle whose light changes along it, and of which a mask leaves a half."""
    colors = np.uint8([[[255, 40, 10, 255], [60, 200, 90, 255], [20, 120, 250, 255]]])
    texture = gi.Texture("ramp", colors, srgb=False, wrap=("clamp", "clamp"))
    mask = gi.Texture("cut", np.uint8([[[255, 255, 255, 0], [255, 255, 255, 255]]]), wrap=("clamp", "clamp"))
    shining = replace(light((3e3, 2e3, 1e3)), emission_texture=texture)
    masked = replace(shining, base_color_texture=mask, alpha_cutoff=0.5)
    view = LOW_VIEW
    lamp = quad((-0.5, 1.0, 0), (1.0, 0, 0), (0, 0, 0.7), masked, "lamp")
    left = quad((0, 1.0, 0), (0.5, 0, 0), (0, 0, 0.7), shining, "what the mask leaves")
    left = replace(left, uvs=(left.uvs * [0.5, 1.0] + [0.5, 0.0]).astype(np.float32))
    make = lambda: scene_of(ground(material_of(name)), lamp)  # noqa: E731
    return Case(make, spot_camera(view), {"emitters": lit_by([left], name, view)}, spp=128)


def many_lights(name: str) -> Case:
    """Sixteen unequal rectangles, an icy ball and lights of every other kind, most of them dim."""
    rng, view = np.random.default_rng(7), LOW_VIEW
    meshes = [
        quad(
            (0.2 * (i % 4), 1.0, 0.2 * (i // 4)),
            (0.15, 0, 0),
            (0, 0, 0.15),
            light(tuple(rng.random(3) ** 3 * 20 + 0.01)),
        )
        for i in range(16)
    ]
    meshes.append(sphere((-0.7, 0.6, -0.5), 0.2, light((0.5, 1.0, 2.0)), rows=8))
    lights = [
        gi.PunctualLight("point", (0.3, 0.2, 0.1), position=(0.6, 0.5, -0.4)),
        gi.PunctualLight("spot", (0.4, 0.4, 0.1), (0, 1, -0.5), (0, -1, 0.5), inner_cone=0.3, outer_cone=0.6),
        gi.PunctualLight("directional", (0.1, 0.2, 0.3), direction=(0.3, -1.0, 0.2)),
    ]
    directions = np.array([[0.6, 0.5, -0.4], [0, 1, -0.5], [-0.3, 1.0, -0.2]])
    strength = np.array([[1 / (0.36 + 0.25 + 0.16)], [1 / 1.25], [1.0]])
    truth = lit_by(meshes, name, view)
    truth += reflected(name, view, directions, strength * [one.intensity for one in lights])
    make = lambda: scene_of(ground(material_of(name)), *meshes, lights=lights)  # noqa: E731
    return Case(make, spot_camera(view), {"emitters": truth}, spp=128)


def furnace(albedo: float, emission: float) -> Case:
    """A closed box: light that was reflected once is direct, the rest of the geometric series indirect."""
    terms = {"emitters": np.full(3, emission * albedo), "indirect": np.full(3, emission * albedo**2 / (1 - albedo))}
    make = lambda: scene_of(*closed_box(albedo, emission))  # noqa: E731
    return Case(make, camera_in_box(), terms)


def sunlit_wall() -> Case:
    """Sun along the ground meets a wall alone, which lights the ground by its form factor."""
    sun = gi.PunctualLight("directional", (30.0, 20.0, 10.0), direction=(-1.0, 0.0, 0.0))
    white = gi.Material("white", (0.9, 0.6, 0.3), specular=0.0)
    truth = ALBEDO * np.array([30.0, 20.0, 10.0]) / np.pi * [0.9, 0.6, 0.3] * wall_form_factor(2.0, 1.0)
    make = lambda: scene_of(ground(size=0.02), wall(white, 2.0, 1.0), lights=[sun])  # noqa: E731
    return Case(make, spot_camera(), {"indirect": truth})


def lit_room(albedo: float, emission: float) -> Case:
    """The floor of a closed cube whose ceiling emits, from below the ceiling: light differs from place to place."""
    size, height, hfov = 8, 1.9, 40.0
    reach = height * np.tan(np.radians(hfov / 2)) * (2 * (np.arange(size) + 0.5) / size - 1)
    x, z = np.meshgrid(reach, reach)
    points = np.stack([x.ravel(), np.full(size * size, -1.0), z.ravel()], axis=1)
    four, eight = (cube_light(albedo, parts, points) for parts in (4, 8))
    direct, indirect = eight + (eight - four) / (2**1.5 - 1)
    pictures = (np.repeat(emission * light.reshape(size, size, 1), 3, axis=2) for light in (direct, indirect))
    sides, lamp = closed_box(albedo, 0.0), closed_box(albedo, emission)[1]
    make = lambda: scene_of(sides[0], lamp, *sides[2:])  # noqa: E731
    camera = gi.Camera.look_at((0, height - 1, 0), (0, -1, 0), up=(0, 0, -1), hfov=hfov, resolution=(size, size))
    return Case(make, camera, dict(zip(("emitters", "indirect"), pictures, strict=True)), coarse=("indirect",))


CASES: dict[str, Callable[[], Case]] = {
    "blocked sky": cache(blocked_sky),
    "slats": cache(slats),
    "half sky": cache(half_sky),
    "glossy sky": cache(lambda: glossy_sky("plastic", (0.9, 0.35, 0.2))),
    "textured lamp": cache(lambda: textured_lamp("half_specular")),
    "many lights": cache(lambda: many_lights("plastic")),
    "white box": cache(lambda: furnace(0.8, 1e-3)),
    "grey box": cache(lambda: furnace(0.4, 50.0)),
    "sunlit wall": cache(sunlit_wall),
    "lit room": cache(lambda: lit_room(0.5, 10.0)),
}
