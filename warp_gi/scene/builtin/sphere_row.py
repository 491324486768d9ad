"""A row of spheres of rising roughness, for the eye and for checks of the BSDF."""

from __future__ import annotations

from collections.abc import Sequence

from warp_gi.scene.builtin.materials import matte, plain
from warp_gi.scene.builtin.shapes import quad, uv_sphere
from warp_gi.scene.camera import Camera, CameraKey, CameraPath
from warp_gi.scene.environment import Sky, SunSky
from warp_gi.scene.model import Color, Node
from warp_gi.scene.scene import Scene

SPACING = 1.15  # m between centres
ROUGHNESSES = (0.05, 0.2, 0.4, 0.6, 0.8, 1.0)


def scene(
    roughnesses: Sequence[float] = ROUGHNESSES,
    metallic: float = 1.0,
    color: Color = (0.91, 0.62, 0.30),
    environment: Sky = None,
) -> Scene:
    """Return spheres of radius 0.5 m along x on a grey plane, one a perceptual roughness, under a sun and sky."""
    ball = uv_sphere(0.5, 64, 32)
    nodes = [
        Node("plane", [quad((-20, 0, 20), (40, 0, 0), (0, 0, -40)).mesh(matte("plane", (0.3, 0.3, 0.3)), "plane")])
    ]
    for k, roughness in enumerate(roughnesses):
        x = (k - (len(roughnesses) - 1) / 2) * SPACING
        material = plain(f"roughness {roughness:g}", color, roughness, metallic)
        nodes.append(Node(f"sphere {k}", [ball.moved(x, 0.5).mesh(material, f"sphere {k}")]))
    if environment is None:
        environment = SunSky(elevation=35.0, azimuth=120.0)
    distance = 1.1 * SPACING * max(len(roughnesses), 3)
    cameras = {"main": Camera.look_at((0, 1.6, distance), (0, 0.45, 0), hfov=50.0)}
    return Scene(nodes, environment=environment, cameras=cameras, name="sphere_row")


def camera_path() -> CameraPath:
    """Return a dolly along the row."""
    far = 1.1 * SPACING * len(ROUGHNESSES)
    keys = (
        CameraKey(0.0, (-1, 1.6, far), (-0.3, 0.45, 0), hfov=50.0),
        CameraKey(47 / 24, (1, 1.6, far), (0.3, 0.45, 0), hfov=50.0),
    )
    return CameraPath(keys, name="sphere_row")
