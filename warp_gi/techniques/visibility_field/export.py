"""Baked visibility fields for others to use and to look at: texture arrays, and pictures.

The texture array is the paper's (dvf.txt, section 4.2 and Fig. 4): 128 visible, 64 occluded, 32 the occlusion label;
a layer is a height of the grid, its octahedral maps padded by one texel and tiled. The paper's z is up, here y is.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from warp_gi.baking import Bake
from warp_gi.errors import BakeError, OptionError
from warp_gi.files import replacing
from warp_gi.kernels import visibility_field as field_kernels
from warp_gi.pipeline import Pipeline
from warp_gi.scene.camera import Camera
from warp_gi.scene.scene import Scene
from warp_gi.scheduler import FrameScheduler
from warp_gi.sequence.frames import frame_path
from warp_gi.sequence.preview import tone_map, write_pngs
from warp_gi.techniques.shared.legends import exposure_of, round_above, with_keys, with_scale
from warp_gi.techniques.shared.octahedral import texels_of
from warp_gi.techniques.shared.octahedral_atlas import (
    MAPPING,
    PADDING,
    PADDING_TEXT,
    padded,
    warn_if_too_large,
    write_parts,
)
from warp_gi.techniques.visibility_field import audit as visibility_audit

TEXTURE_VISIBLE, TEXTURE_OCCLUDED, TEXTURE_LABEL = 128, 64, 32
SHOW_SAMPLES = 64
MAPS_PIXELS = 1600
"""Along a side of the picture of maps, about."""

TEXT = {
    "layers": "Layer k holds the cells of grid y = k. The texel with column c, row r of the map of cell (x, y, z) is "
    "at column x * (resolution + 2 * padding) + padding + c, row z * (resolution + 2 * padding) + padding + r; row 0 "
    "is the first row of the image. Cell (x, y, z) spans grid_low + cell_size * (x, y, z) to grid_low + cell_size * "
    "(x + 1, y + 1, z + 1), in metres, y up, right-handed.",
    "bits": "Texels are whole numbers 0 to 255; read them unfiltered and not as sRGB. visible: some point on the "
    "surfaces in the cell sees the sky that way. occluded: from some point the scene blocks it. Only visible: no ray "
    "needs tracing, it reaches the sky. Only occluded: no ray needs tracing, it is blocked. Both, or none: trace. "
    "label: more than half of the map is occluded; it is the same in all texels of a cell, padding included. Cells "
    "without surfaces, or that were not baked, are 0.",
    "map": MAPPING,
    "position": "Look up the position that rays start from: the surface point moved a little along its normal, to the "
    "side that is seen. A point on the border of two cells otherwise finds the wrong one.",
    "padding": f"{PADDING_TEXT}, so that a lookup that is off by one texel stays in the cell.",
}


def check_export_name(path: str | Path) -> None:
    """Raise OptionError unless ``path`` names a .png or .exr file."""
    if Path(path).suffix.lower() not in (".png", ".exr"):
        raise OptionError(f"cannot write {Path(path).name}: textures are .png files, one a layer, or one .exr file")


def cell_maps(bake: Bake) -> np.ndarray:
    """Return uint8 [cell of the bake, resolution, resolution]: the paper's eight bits of each texel."""
    resolution = _resolution(bake)
    shifts = np.arange(0, 32, 2, dtype=np.uint32)
    states = (bake.arrays["masks"][:, :, None] >> shifts & 3).astype(np.uint8)
    states = states.reshape(len(states), -1)[:, : resolution**2]
    label = (bake.arrays["flags"] & int(field_kernels.SLOT_LABEL)) != 0
    texels = TEXTURE_VISIBLE * (states & 1) + TEXTURE_OCCLUDED * (states >> 1) + TEXTURE_LABEL * label[:, None]
    return texels.astype(np.uint8).reshape(-1, resolution, resolution)


def _resolution(bake: Bake) -> int:
    if bake.technique != "VisibilityField":
        raise BakeError(f"only bakes of VisibilityField can be exported as textures, this one is of {bake.technique}")
    return int(bake.settings["resolution"])


def _layer(bake: Bake, y: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which entries of the bake have grid y, and their x and z."""
    nx, ny, _ = (int(n) for n in bake.arrays["grid_shape"])
    cells = bake.arrays["cells"].astype(np.int64)
    chosen = np.flatnonzero(cells // nx % ny == y)
    return chosen, cells[chosen] % nx, cells[chosen] // (nx * ny)


def export_textures(bake: Bake, path: str | Path) -> list[Path]:
    """Write a field as a texture array, and a JSON file beside it that says how to read it; return all paths, it last.

    A .png path makes a file for each layer, NAME.####.png; an .exr path one file with a part for each layer. Raises
    OptionError for other names, OSError when nothing can be written.
    """
    path = Path(path)
    check_export_name(path)
    nx, ny, nz = (int(n) for n in bake.arrays["grid_shape"])
    maps = padded(cell_maps(bake))
    size = maps.shape[-1]
    warn_if_too_large(path.name, nx * size, nz * size, "use larger cells or a lower resolution")

    def pixels(y: int) -> np.ndarray:
        chosen, x, z = _layer(bake, y)
        tiles = np.zeros((nz, nx, size, size), np.uint8)
        tiles[z, x] = maps[chosen]
        return np.ascontiguousarray(tiles.transpose(0, 2, 1, 3)).reshape(nz * size, nx * size)

    is_png = path.suffix.lower() == ".png"
    pattern = path if "#" in path.name or not is_png else path.with_name(f"{path.stem}.####.png")
    name = pattern.stem.replace("#", "").rstrip("._- ") if is_png else path.stem
    description = path.with_name(f"{name or 'layers'}.json")
    description.unlink(missing_ok=True)  # while layers of two exports stand beside each other
    if is_png:
        files = [frame_path(pattern, y) for y in range(ny)]
        for y, file in enumerate(files):
            _write_gray(file, pixels(y))
    else:
        files = [path]
        with replacing(path) as part:  # half floats hold 0 to 255 exactly
            planes = lambda y: pixels(y)[:, :, None].astype(np.float16)  # noqa: E731
            write_parts(part, path, planes, ("Y",), [_part_name(y) for y in range(ny)])
    layers = {"files": [file.name for file in files]}
    if not is_png:
        layers = {"file": path.name, "parts": [_part_name(y) for y in range(ny)], "channel": "Y"}
    low = [float(v) for v in bake.arrays["grid_low"]]
    text = {
        "format": "warp_gi visibility field textures",
        "scene": bake.scene_name,
        "grid_low": low,
        "cell_size": float(bake.arrays["grid_cell_size"][0]),
        "grid_shape": {"x": nx, "y": ny, "z": nz},
        "resolution": size - 2 * PADDING,
        "padding": PADDING,
        "bits": {"visible": TEXTURE_VISIBLE, "occluded": TEXTURE_OCCLUDED, "label": TEXTURE_LABEL},
        "layers": layers,
        "how_to_read": TEXT,
    }
    with replacing(description) as part:
        part.write_text(json.dumps(text, indent=2) + "\n")
    return [*files, description]


def _write_gray(path: Path, pixels: np.ndarray) -> None:
    from PIL import Image

    with replacing(path) as part:
        Image.fromarray(pixels).save(part, format="PNG")


def _part_name(y: int) -> str:
    return f"layer{y:04d}"


# ---- an example of a reader ----


def read_textures(path: str | Path) -> tuple[np.ndarray, dict[str, Any]]:
    """Return the layers uint8 [grid y, row, column] and the description of an export as .png files, by its JSON."""
    from PIL import Image

    info = json.loads(Path(path).read_text())
    return np.stack([np.asarray(Image.open(Path(path).parent / name)) for name in info["layers"]["files"]]), info


def look_up(layers: np.ndarray, info: dict[str, Any], positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return uint8 [n]: the texel of each ray's origin and direction, both [n, 3]; 0 outside of the grid."""
    cell = np.floor((positions - info["grid_low"]) / info["cell_size"]).astype(int)
    shape = np.array([info["grid_shape"][axis] for axis in "xyz"])
    inside = ((cell >= 0) & (cell < shape)).all(1)
    x, y, z = np.clip(cell, 0, shape - 1).T
    size, padding = info["resolution"], info["padding"]
    column, row = (at + padding for at in texels_of(directions, size))
    tile = size + 2 * padding
    return np.where(inside, layers[y, z * tile + row, x * tile + column], 0)


# ---- pictures ----

# of Okabe and Ito's and Tol's palettes, which stay distinct to the colour-blind
VISIBLE_COLOR, OCCLUDED_COLOR = (86, 180, 233), (34, 34, 85)
MIXED_COLOR, UNKNOWN_COLOR, NOTHING_COLOR = (230, 159, 0), (187, 187, 187), (255, 255, 255)
_STATE_COLORS = np.array([UNKNOWN_COLOR, VISIBLE_COLOR, OCCLUDED_COLOR, MIXED_COLOR], np.uint8)
_STATE_NAMES = ((VISIBLE_COLOR, "visible"), (OCCLUDED_COLOR, "occluded"), (MIXED_COLOR, "mixed: traced"))


def write_pictures(
    scene: Scene,
    camera: Camera,
    bake: Bake,
    settings: Any,
    folder: str | Path,
    device: str = "cpu",
    seed: int = 0,
) -> list[Path]:
    """Write what a field looks like, and what it does in a view of the scene, under the scene's sky alone.

    maps.png: the octahedral maps of the height of the grid that has most cells. render.png: the view.
    error.png: how far it is from tracing all of the same rays. labels.png: the occlusion label of each pixel's cell.
    traced.png: share of a pixel's rays that are traced.

    Args:
        scene: What was baked, with a sky.
        camera: The view.
        bake: Of the scene.
        settings: The VisibilityField of the bake.
        folder: Where pictures go; made if missing.
        device: Where to render.
        seed: Of the rays.
    """
    fields = {"mode": settings.mode, "budget": 0.0, "relight": False}  # pictures of this bake, not of what it lacks
    ours = _sky_only(replace(settings, **fields), SHOW_SAMPLES)
    traced = _sky_only(replace(settings, **fields | {"mode": "traced"}), SHOW_SAMPLES)
    frame = FrameScheduler(scene, camera, ours, device, seed, bakes=[bake]).frame(0)
    image = frame.numpy("beauty")
    reference = FrameScheduler(scene, camera, traced, device, seed).frame(0).numpy("beauty")
    share, label, surface = _audit(scene, camera, bake, replace(settings, **fields), device, seed)
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


def _sky_only(settings: Any, samples: int, **more: Any) -> Pipeline:
    return Pipeline(environment=settings, emitters=None, indirect=None, spp=samples, **more)


def _audit(
    scene: Scene, camera: Camera, bake: Bake, settings: Any, device: str, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return images: share of rays traced, label (-1 for cells that are not there), and whether there is a surface."""
    pipeline = _sky_only(settings, SHOW_SAMPLES, camera_samples=1)
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
    chosen, x, z = _layer(bake, y)
    size = _resolution(bake)
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
