"""What baked visibility polygons look like: what vertices see, which triangles are traced, a view and its error."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from warp_gi.baking import Bake
from warp_gi.kernels import visibility_polygons as kernels
from warp_gi.pipeline import Pipeline
from warp_gi.scene.camera import Camera
from warp_gi.scene.scene import Scene
from warp_gi.scheduler import FrameScheduler
from warp_gi.sequence.preview import tone_map, write_pngs
from warp_gi.techniques.paths.estimators import TracedEnvironment
from warp_gi.techniques.shared.legends import exposure_of, round_above, with_keys, with_scale
from warp_gi.techniques.visibility_polygons.bake import contours_of
from warp_gi.techniques.visibility_polygons.estimator import VisibilityPolygons

SHOW_SAMPLES, REFERENCE_SAMPLES = 16, 256
"""Samples a pixel of the pictures, and of the traced one that they are compared with."""
SHOWN_SETS, DISC = (6, 3), 180
"""Columns and rows of vertices whose polygons are shown, and pixels along a side of each."""

# colours from the palette of Okabe and Ito, which stay distinct to the colour-blind
SEEN_COLOR, HIDDEN_COLOR, EDGE_COLOR = (86, 180, 233), (60, 60, 66), (230, 159, 0)
STATE_COLORS = {
    int(kernels.TRACED): ((213, 94, 0), "traced: contours do not match, or a corner sees nothing"),
    int(kernels.MATCHED): ((0, 158, 115), "interpolated"),
    int(kernels.FLAGGED): ((240, 228, 66), "flagged: traced"),
}
NOTHING_COLOR = (255, 255, 255)


def write_pictures(
    scene: Scene,
    camera: Camera,
    bake: Bake,
    settings: VisibilityPolygons,
    folder: str | Path,
    device: str = "cpu",
    seed: int = 0,
) -> list[Path]:
    """Write what polygons look like, and what they do in a view under the scene's sky alone.

    polygons.png: what some vertices see, their hemispheres from above. states.png: which triangles are traced.
    render.png: the view. error.png: how far it is from a traced picture.

    Args:
        scene: Scene that was baked, with a sky.
        camera: View that is shown.
        bake: Bake of the scene.
        settings: Settings of the bake.
        folder: Where pictures go; made if missing.
        device: Where to render.
        seed: Seed of the rays.
    """
    ours = Pipeline(environment=settings, emitters=None, indirect=None, spp=SHOW_SAMPLES, camera_samples=1)
    traced = Pipeline(
        environment=TracedEnvironment(), emitters=None, indirect=None, spp=REFERENCE_SAMPLES, camera_samples=1
    )
    frame = FrameScheduler(scene, camera, ours, device, seed, bakes=[bake]).frame(0)
    image = frame.numpy("beauty")
    reference = FrameScheduler(scene, camera, traced, device, seed).frame(0).numpy("beauty")
    error = np.abs(image.astype(np.float64) - reference).mean(-1)
    top = round_above(float(np.quantile(error, 0.99)) or 1.0)
    told = (
        f"RMSE {math.sqrt(np.mean(np.square(image.astype(np.float64) - reference))):.2g}, mean {reference.mean():.2g}"
    )
    states = _state_picture(scene, bake, frame.hits.face.numpy(), frame.hits.direction.numpy(), camera.resolution)
    exposure = exposure_of(reference)
    pictures = {
        "polygons": _polygon_picture(bake),
        "states": with_keys(states, [*STATE_COLORS.values(), (NOTHING_COLOR, "no surface")]),
        "render": tone_map(image, exposure),
        "error": with_scale(error, top, f"|error| to {REFERENCE_SAMPLES} traced samples a pixel, W/(m2 sr); {told}"),
    }
    return write_pngs(folder, pictures)


def _state_picture(
    scene: Scene, bake: Bake, faces: np.ndarray, directions: np.ndarray, resolution: tuple[int, int]
) -> np.ndarray:
    """Return the colour of each pixel's side of a triangle, uint8 [height, width, 3]."""
    flat = scene._flat
    points = flat.points[flat.indices[np.maximum(faces, 0)]]
    across = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    is_back = (across * directions).sum(axis=1) > 0
    states = bake.arrays["states"][np.maximum(faces, 0) + is_back * len(flat.indices)]
    colors = np.array([STATE_COLORS[state][0] for state in sorted(STATE_COLORS)], np.uint8)[states]
    colors[faces < 0] = NOTHING_COLOR
    return colors.reshape(resolution[1], resolution[0], 3)


def _polygon_picture(bake: Bake) -> np.ndarray:
    """Return discs of what vertices see that see most contours and points, uint8 [height, width, 3]."""
    from PIL import Image, ImageDraw

    contours = contours_of(bake)
    columns, rows = SHOWN_SETS
    counts = np.diff(contours.point_starts[contours.contour_starts])
    shown = np.argsort(-counts, kind="stable")[: columns * rows]
    canvas = Image.new("RGB", (columns * DISC, rows * DISC), NOTHING_COLOR)
    draw = ImageDraw.Draw(canvas)
    radius = DISC / 2 - 6
    for place, one in enumerate(shown):
        center = np.array([(place % columns + 0.5) * DISC, (place // columns + 0.5) * DISC])
        normal = bake.arrays["normals"][one].astype(np.float64)
        tangent = np.cross(normal, (0.0, 0.0, 1.0) if abs(normal[2]) < 0.9 else (0.0, 1.0, 0.0))
        tangent /= np.linalg.norm(tangent)
        draw.ellipse([*(center - radius), *(center + radius)], fill=HIDDEN_COLOR)
        drawn = []
        for contour in range(*contours.contour_starts[one : one + 2]):
            points = contours.points[contours.point_starts[contour] : contours.point_starts[contour + 1], :3]
            flat = np.stack([points @ tangent, -(points @ np.cross(normal, tangent))], axis=1)
            flat /= np.sqrt(1.0 + np.clip(points @ normal, 0.0, 1.0))[:, None]  # areas stay in proportion (Lambert)
            x, y = flat.T
            signed = float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
            drawn.append((abs(signed), signed < 0, center + radius * flat))
        for _, is_seen, outline in sorted(drawn, key=lambda entry: -entry[0]):
            draw.polygon(
                [tuple(at) for at in outline], fill=SEEN_COLOR if is_seen else HIDDEN_COLOR, outline=EDGE_COLOR
            )
    keys = ((SEEN_COLOR, "sky"), (HIDDEN_COLOR, "occluded"), (EDGE_COLOR, "contours"))
    most = int(counts[shown[0]])
    note = f"the hemispheres of {len(shown)} of {len(counts)} sets, those with most points: up to {most}"
    return with_keys(np.asarray(canvas), keys, note)
