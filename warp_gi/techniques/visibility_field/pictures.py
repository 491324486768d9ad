"""What baked visibility fields look like: their maps, and in a view labels, shares of traced rays and the error."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from warp_gi.baking import Bake
from warp_gi.pipeline import Pipeline
from warp_gi.scene.camera import Camera
from warp_gi.scene.scene import Scene
from warp_gi.scheduler import FrameScheduler
from warp_gi.sequence.preview import tone_map, write_pngs
from warp_gi.techniques.shared.legends import exposure_of, round_above, with_keys, with_scale
from warp_gi.techniques.visibility_field import audit as visibility_audit
from warp_gi.techniques.visibility_field.estimator import VisibilityField
from warp_gi.techniques.visibility_field.export import cell_maps, cells_at_height, map_resolution

SHOW_SAMPLES = 64
"""Samples a pixel of the pictures."""
MAPS_PIXELS = 1600
"""Pixels along a side of the picture of maps, about."""

# colours from the palettes of Okabe and Ito and of Tol, which stay distinct to the colour-blind
VISIBLE_COLOR, OCCLUDED_COLOR = (86, 180, 233), (34, 34, 85)
MIXED_COLOR, UNKNOWN_COLOR, NOTHING_COLOR = (230, 159, 0), (187, 187, 187), (255, 255, 255)
_STATE_COLORS = np.array([UNKNOWN_COLOR, VISIBLE_COLOR, OCCLUDED_COLOR, MIXED_COLOR], np.uint8)
_STATE_NAMES = ((VISIBLE_COLOR, "visible"), (OCCLUDED_COLOR, "occluded"), (MIXED_COLOR, "mixed: traced"))


def write_pictures(
    scene: Scene,
    camera: Camera,
    bake: Bake,
    settings: VisibilityField,
    folder: str | Path,
    device: str = "cpu",
    seed: int = 0,
) -> list[Path]:
    """Write what a field looks like, and what it does in a view of the scene, under the scene's sky alone.

    maps.png: the octahedral maps of the height of the grid that has most cells. render.png: the view.
    error.png: how far it is from tracing all of the same rays. labels.png: the occlusion label of each pixel's cell.
    traced.png: share of a pixel's rays that are traced.

    Args:
        scene: Scene that was baked, with a sky.
        camera: View that is shown.
        bake: Bake of the scene.
        settings: Settings of the bake.
        folder: Where pictures go; made if missing.
        device: Where to render.
        seed: Seed of the rays.
    """
    shown = replace(settings, budget=0.0, relight=False)  # pictures of this bake, not of what it lacks
    ours = _sky_only(shown)
    traced = _sky_only(replace(shown, mode="traced"))
    frame = FrameScheduler(scene, camera, ours, device, seed, bakes=[bake]).frame(0)
    image = frame.numpy("beauty")
    reference = FrameScheduler(scene, camera, traced, device, seed).frame(0).numpy("beauty")
    share, label, surface = _audit(scene, camera, bake, shown, device, seed)
    error = np.abs(image.astype(np.float64) - reference).mean(-1)
    wrong = error[error > 1e-4 * reference.mean()]
    top = round_above(float(np.quantile(wrong, 0.9))) if wrong.size else 1.0
    rmse = math.sqrt(np.mean(np.square(image.astype(np.float64) - reference)))
    mean = float(share[surface].mean()) if surface.any() else 0.0
    labels = np.full((*label.shape, 3), NOTHING_COLOR, np.uint8)
    for value, color in ((0, VISIBLE_COLOR), (1, OCCLUDED_COLOR), (-1, UNKNOWN_COLOR)):
        labels[surface & (label == value)] = color
    told = f"RMSE {rmse:.2g} of mean {reference.mean():.2g}; {wrong.size / error.size:.2%} of the pixels are wrong"
    exposure = exposure_of(reference)
    pictures = {
        "maps": _maps_picture(bake),
        "render": tone_map(image, exposure),
        "error": with_scale(error, top, f"|error|, W/(m2 sr); {told}"),
        "labels": with_keys(
            labels,
            (
                (VISIBLE_COLOR, "label 0: up to half occluded"),
                (OCCLUDED_COLOR, "label 1: more than half"),
                (UNKNOWN_COLOR, "not baked"),
                (NOTHING_COLOR, "no surface"),
            ),
        ),
        "traced": with_scale(share, 1.0, f"share of rays traced, mean {mean:.1%} ({settings.mode})"),
    }
    return write_pngs(folder, pictures)


def _sky_only(settings: VisibilityField) -> Pipeline:
    return Pipeline(environment=settings, emitters=None, indirect=None, spp=SHOW_SAMPLES)


def _audit(
    scene: Scene, camera: Camera, bake: Bake, settings: VisibilityField, device: str, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return images [height, width]: share of rays traced, label (-1 without a cell), whether there is a surface."""
    pipeline = replace(_sky_only(settings), camera_samples=1)
    scheduler = FrameScheduler(scene, camera, pipeline, device, seed, bakes=[bake])
    frame, state = scheduler.frame(0), scheduler.state("environment")
    counts = visibility_audit.audit(frame, state)
    asked, traced = visibility_audit.rays_asked(counts), visibility_audit.rays_traced(counts, settings)
    share, label = traced / np.maximum(asked, 1), visibility_audit.occlusion_labels(counts)
    width, height = camera.resolution
    share, label, surface = (image.reshape(height, width) for image in (share, label, asked > 0))
    return share, label, surface


def _maps_picture(bake: Bake) -> np.ndarray:
    """Return the maps of the fullest layer, or as many around its middle as can be told apart."""
    nx, ny = (int(n) for n in bake.arrays["grid_shape"][:2])
    heights = np.bincount(bake.arrays["cells"].astype(np.int64) // nx % ny, minlength=ny)
    y = int(heights.argmax())
    chosen, x, z = cells_at_height(bake, y)
    size = map_resolution(bake)
    most = max(MAPS_PIXELS // (size + 1), 1)  # maps along a side
    window = [_fullest(values, most) for values in (x, z)] if len(chosen) else [(0, 1), (0, 1)]
    (x0, x1), (z0, z1) = window
    shown = (x >= x0) & (x < x1) & (z >= z0) & (z < z1)
    zoom = max(min(MAPS_PIXELS // (max(x1 - x0, z1 - z0) * (size + 1)), 8), 1)
    tile = size * zoom + max(zoom // 2, 1)
    canvas = np.full(((z1 - z0) * tile, (x1 - x0) * tile, 3), NOTHING_COLOR, np.uint8)
    maps = cell_maps(_part(bake, chosen[shown]))
    colors = _STATE_COLORS[(maps >> 7) + 2 * (maps >> 6 & 1)]
    for picture, column, row in zip(colors, x[shown] - x0, z[shown] - z0, strict=True):
        picture = picture.repeat(zoom, axis=0).repeat(zoom, axis=1)
        canvas[row * tile : row * tile + size * zoom, column * tile : column * tile + size * zoom] = picture
    low, cell = bake.arrays["grid_low"], float(bake.arrays["grid_cell_size"][0])
    keys = (*_STATE_NAMES, (UNKNOWN_COLOR, "unknown: traced"), (NOTHING_COLOR, "no cell"))
    note = f"height {low[1] + y * cell:.3g} to {low[1] + (y + 1) * cell:.3g} m, {len(chosen)} cells"
    if not shown.all():
        note += f", {int(shown.sum())} of them here"
    return with_keys(canvas, keys, f"{note}; from above: x right, z down")


def _part(bake: Bake, chosen: np.ndarray) -> Bake:
    arrays = bake.arrays | {name: bake.arrays[name][chosen] for name in ("cells", "flags", "masks")}
    return replace(bake, arrays=arrays)


def _fullest(values: np.ndarray, most: int) -> tuple[int, int]:
    """Return the range of at most ``most`` numbers in a row with most of the ``values`` in it."""
    low, high = int(values.min()), int(values.max()) + 1
    if high - low <= most:
        return low, high
    sums = np.cumsum(np.append(0, np.bincount(values - low, minlength=high - low)))
    first = low + int((sums[most:] - sums[:-most]).argmax())
    return first, first + most
