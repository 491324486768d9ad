"""Four metal plates of rising roughness under four ball lamps of one power.

After Veach and Guibas, "Optimally Combining Sampling Techniques for Monte Carlo Rendering" (SIGGRAPH 1995), figure 2.
Each plate mirrors the row of lamps to the eye. On smooth plates sampling the BSDF finds large lamps best, on rough ones
sampling the lamps finds small ones, and which of the lamps to sample differs from point to point.
"""

from __future__ import annotations

import math

import numpy as np

from warp_gi.scene.builtin.materials import lamp, matte, plain
from warp_gi.scene.builtin.shapes import Shape, box, icosphere, merge, quad
from warp_gi.scene.camera import Camera, CameraKey, CameraPath
from warp_gi.scene.model import Node
from warp_gi.scene.scene import Scene

EYE, TARGET, HFOV = (0.0, 3.1, 11.0), (0.0, 1.5, 0.0), 48.0
ALPHAS = (0.005, 0.02, 0.05, 0.1)
"""GGX alpha of the plates from the back to the front; a material's roughness is its root."""
CENTERS = ((0.0, 1.05, -2.3), (0.0, 0.65, -0.7), (0.0, 0.35, 0.9), (0.0, 0.18, 2.5))
WIDTH, LENGTH, THICKNESS = 7.6, 1.25, 0.03  # m
RADII = (0.03, 0.1, 0.3, 0.9)
LAMP_X = (-3.3, -1.5, 0.1, 2.4)
LAMP_Y, LAMP_Z = 3.3, -4.2
RADIANCE = 1.0
"""Of the largest lamp, W/(m^2 sr); the others' grows as their surfaces shrink."""
TINTS = ((1.0, 0.75, 0.5), (0.75, 1.0, 0.6), (0.6, 0.8, 1.0), (1.0, 0.7, 0.9))


def plate(center: tuple[float, float, float]) -> Shape:
    """Return a plate that mirrors the middle of the row of lamps to the eye."""
    middle = np.asarray(center)
    ways = [np.asarray(place) - middle for place in (EYE, (0.0, LAMP_Y, LAMP_Z))]
    normal = sum(way / np.linalg.norm(way) for way in ways)
    tilt = math.degrees(math.atan2(normal[2], normal[1]))
    half = (WIDTH / 2, THICKNESS, LENGTH / 2)
    flat = box((-half[0], -half[1], -half[2]), (half[0], 0.0, half[2]))
    return flat.turned(tilt, "x").moved(*center)


def scene() -> Scene:
    """Return the plates before a grey wall; four balls of 320 triangles glow, and there is no sky."""
    grey = matte("grey", (0.35, 0.35, 0.36))
    room = merge([quad((-12, 0, 12), (24, 0, 0), (0, 0, -18)), quad((-12, 0, -6), (24, 0, 0), (0, 12, 0))])
    nodes = [Node("room", [room.mesh(grey, "room")])]
    for k, (alpha, center) in enumerate(zip(ALPHAS, CENTERS, strict=True)):
        metal = plain(f"alpha {alpha:g}", (0.62, 0.65, 0.70), math.sqrt(alpha), 1.0)
        nodes.append(Node(f"plate {k}", [plate(center).mesh(metal, f"plate {k}")]))
    for k, (radius, x, tint) in enumerate(zip(RADII, LAMP_X, TINTS, strict=True)):
        radiance = RADIANCE * (RADII[-1] / radius) ** 2
        color = (radiance * tint[0], radiance * tint[1], radiance * tint[2])
        ball = icosphere(radius, 2).moved(x, LAMP_Y, LAMP_Z)
        nodes.append(Node(f"lamp {k}", [ball.mesh(lamp(f"lamp {k}", color), f"lamp {k}")]))
    cameras = {"main": Camera.look_at(EYE, TARGET, hfov=HFOV)}
    return Scene(nodes, cameras=cameras, name="plates")


def camera_path() -> CameraPath:
    """Return a slow move to the side, along which the lamps wander over the plates."""
    keys = (CameraKey(0.0, EYE, TARGET, hfov=HFOV), CameraKey(47 / 24, (1.2, 3.3, 10.6), TARGET, hfov=HFOV))
    return CameraPath(keys, name="plates")
