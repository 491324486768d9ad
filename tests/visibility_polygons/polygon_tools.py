"""What tests of visibility polygons share: light through polygons by quadrature, and polygons to try it on."""

import math

import numpy as np
import warp as wp
from statistics_tools import device

from warp_gi import launch
from warp_gi.kernels import visibility_polygons_sky as kernels
from warp_gi.techniques.visibility_polygons.sky import polygon_sky


def unit(v):
    v = np.asarray(v, np.float64)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def city(height=32, seed=1):
    """A sky with a sun of two texels, a bright horizon and noise, float32 [height, 2 height, 3]."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform(0.1, 1.0, (height, 2 * height, 3)) * np.linspace(1.0, 0.2, height)[:, None, None]
    pixels[height // 4, height // 2 : height // 2 + 2] = (900.0, 800.0, 600.0)
    return pixels.astype(np.float32)


def integrate(environment, polygons, normals, evaluator="adaptive", tolerance=1e-3):
    """Return irradiance through polygons in world space, float64 [polygon, 3]: each a list of contours [point, 3]."""
    sky = polygon_sky(environment, evaluator, tolerance, device())
    turn = np.array(sky.sky_from_world, np.float64).reshape(3, 3)
    contours = [np.asarray(contour) @ turn.T for polygon in polygons for contour in polygon]
    plain = kernels.PlainPolygons()
    for name, parts in (("starts", polygons), ("contour_starts", contours)):
        ends = np.cumsum([0, *(len(part) for part in parts)]).astype(np.int32)
        setattr(plain, name, launch.on_device(ends, wp.int32, device()))
    plain.points = launch.on_device(np.concatenate(contours).astype(np.float32), wp.vec3, device())
    plain.normals = launch.on_device((np.asarray(normals) @ turn.T).astype(np.float32), wp.vec3, device())
    plain.light = wp.zeros(len(polygons), dtype=wp.vec3, device=device())
    launch.launch(kernels.integrate_polygons, len(polygons), [sky, plain], device())
    return plain.light.numpy().astype(np.float64)


def circle_about(normal, angle=math.pi / 2, count=24, phase=0.0):
    """A regular polygon about a normal, counter-clockwise seen from outside; of 90 degrees it is the horizon."""
    normal = unit(normal)
    tangent = unit(np.cross(normal, (0.0, 1.0, 0.0) if abs(normal[1]) < 0.9 else (1.0, 0.0, 0.0)))
    other = np.cross(normal, tangent)
    at = phase + np.arange(count) * 2 * np.pi / count
    ring = np.cos(at)[:, None] * tangent + np.sin(at)[:, None] * other
    return math.cos(angle) * normal + math.sin(angle) * ring


def closed_form(polygon, normal):
    """Irradiance through a polygon under a sky of 1 (Lambert): half the sum of angle times normal of each edge."""
    total = 0.0
    for contour in polygon:
        for a, b in zip(contour, np.roll(contour, -1, axis=0), strict=True):
            across = np.cross(a, b)
            size = np.linalg.norm(across)
            if size > 1e-12:
                total += 0.5 * math.atan2(size, float(a @ b)) * float(across @ normal) / size
    return total


def patches(pixels, parts):
    """Directions [n, 3], solid angles [n] and radiances [n, 3] of parts x parts points in each patch of a map."""
    nodes = 0.5 * (pixels[:-1].astype(np.float64) + pixels[1:])
    texels = 0.5 * (nodes + np.roll(nodes, -1, axis=1))
    height, width = texels.shape[:2]
    edges = np.linspace(0, np.pi, height * parts + 1)
    polar = 0.5 * (edges[1:] + edges[:-1])
    azimuth = (np.arange(width * parts) + 0.5) / (width * parts) * 2 * np.pi + np.pi / width
    t, p = np.meshgrid(polar, azimuth, indexing="ij")
    directions = np.stack([np.sin(t) * np.sin(p), np.cos(t), -np.sin(t) * np.cos(p)], -1).reshape(-1, 3)
    solid = np.repeat(np.cos(edges[:-1]) - np.cos(edges[1:]), width * parts) * 2 * np.pi / (width * parts)
    return directions, solid, texels.repeat(parts, 0).repeat(parts, 1).reshape(-1, 3)


def quadrature(pixels, contour, normal, parts=16):
    """Irradiance [3] through a convex polygon by points in patches."""
    directions, solid, radiance = patches(pixels, parts)
    inside = np.ones(len(directions), bool)
    for a, b in zip(contour, np.roll(contour, -1, axis=0), strict=True):
        inside &= directions @ np.cross(a, b) > 0
    return (radiance * (directions @ normal * solid * inside)[:, None]).sum(0)
