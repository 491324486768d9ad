"""What light field probes look like: their maps, where they stand, and the path of a ray through their maps."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import warp as wp

from warp_gi.baking import Bake
from warp_gi.denoise import SpatioTemporal
from warp_gi.frame import Frame
from warp_gi.kernels import light_field as field_kernels
from warp_gi.kernels import light_field_march as march_kernels
from warp_gi.kernels import light_field_trace as trace_kernels
from warp_gi.pipeline import Pipeline
from warp_gi.scene.camera import Camera
from warp_gi.scene.scene import Scene
from warp_gi.scheduler import FrameScheduler
from warp_gi.sequence.preview import magma, tone_map, write_pngs
from warp_gi.techniques.light_field.estimator import VISIBILITIES, LightFieldProbes
from warp_gi.techniques.light_field.export import probe_maps
from warp_gi.techniques.light_field.ray import draw_ray, march_rays, probe_color, ray_looks
from warp_gi.techniques.light_field.state import ProbeState
from warp_gi.techniques.shared.legends import exposure_of, label_font, scale_bar, stacked, with_keys

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw as Drawing

SHOW_SAMPLES = 16
"""Samples a pixel of the view that probes are drawn in."""
SHEET_PIXELS = 1600
"""Width in pixels of a picture of all maps, about."""
SHEET_ASPECT = 1.5
"""Width of a picture of all maps over its height, about."""
MOST_TILES, MOST_COLUMNS = 2500, 200
"""Largest number of maps in a picture of all maps, and of maps side by side."""
MOST_NUMBERS = 150
"""Largest number of probes in view for which each is labelled with its number."""
UNSEEN_COLOR = (0, 158, 115)  # from the palette of Okabe and Ito, as the next
SKY_COLOR = (86, 180, 233)
CANDIDATES = 8
"""Number of rays that are followed look by look, to choose one whose path shows much."""
_SMOOTH = 2  # pixels of a drawing in one of the picture


def write_pictures(
    scene: Scene,
    camera: Camera,
    bake: Bake,
    settings: LightFieldProbes,
    folder: str | Path,
    device: str = "cpu",
    seed: int = 0,
) -> list[Path]:
    """Write what probes hold, where they stand and how a ray finds its way through them; return the paths.

    radiance.png, distance.png, normal.png, irradiance.png: the maps of all probes, with the colour and number of each.
    places.png: the probes in a view of the scene (light_field_probes.txt, Fig. 1). seen.png: for each point of the
    view, how many of the eight probes around it see it. ray.png: the path of a ray that a pixel of the view reflects,
    one that asks several probes if there is one (Fig. 4).

    Args:
        scene: Scene that was baked.
        camera: View that is shown.
        bake: Bake of the scene.
        settings: Settings of the bake.
        folder: Where pictures go; made if missing.
        device: Where to render.
        seed: Seed of the view.
    """
    shown = replace(settings, mode="irradiance", primary="geometry", update=0)
    pipeline = Pipeline(indirect=shown, spp=SHOW_SAMPLES, denoise=SpatioTemporal())
    scheduler = FrameScheduler(scene, camera, pipeline, device, seed, bakes=[bake])
    frame = scheduler.frame(0)
    state = scheduler.state("indirect")
    exposure = exposure_of(bake.arrays["irradiance"].astype(np.float64) / math.pi)
    origin, direction = _telling_ray(frame, state)
    pictures = _sheets(bake, exposure)
    pictures |= {"places": draw_places(frame, state), "seen": draw_seen(frame, state, settings.visibility)}
    pictures["ray"] = draw_ray(state, origin, direction, exposure)
    return write_pngs(folder, pictures)


# ---- all maps ----


def _sheets(bake: Bake, exposure: float) -> dict[str, np.ndarray]:
    """Return a picture of all maps of each kind, by name, uint8 [height, width, 3]."""
    makers, counts = probe_maps(bake), tuple(int(n) for n in bake.arrays["grid_counts"])
    count, total = min(math.prod(counts), MOST_TILES), math.prod(counts)
    columns = min(_sheet_columns(counts[0], count), MOST_COLUMNS)
    covered = bake.arrays["states"] != int(field_kernels.PROBE_USABLE)

    def tiles(name: str) -> np.ndarray:
        """Return the maps of one kind, float32 [probe, size, size, channel], as small as the picture takes.

        Each texel is the mean of those that it stands for; of distances and normals, the one in the middle.
        """
        size = math.isqrt(len(makers[name](0)))
        step = next(f for f in range(1, size + 1) if size % f == 0 and columns * size / f <= SHEET_PIXELS)
        maps = []
        for probe in range(count):
            image = makers[name](probe).astype(np.float32)
            parts = image.reshape(size // step, step, size // step, step, -1)
            maps.append(parts[:, step // 2, :, step // 2] if name in ("distance", "normal") else parts.mean((1, 3)))
        return np.stack(maps)

    order = f"the first {count:,} of {total:,} probes; " if count < total else ""
    order += f"{counts[0]} x {counts[1]} x {counts[2]} probes, along x first, then y, z; up is in the middle of a map"
    if covered.any():
        order += "; crossed out: covered, not used"
    distance = tiles("distance")[..., 0]
    known = np.isfinite(distance)
    top = (float(f"{np.quantile(distance[known], 0.98):.2g}") if known.any() else 0.0) or 1.0
    colors = magma(np.where(known, distance, 0).reshape(-1, distance.shape[-1]) / top).reshape(*distance.shape, 3)
    colors[~known] = SKY_COLOR
    distances = with_keys(_sheet(colors, columns, covered), ((SKY_COLOR, "the sky, or nothing"),))
    pictures = {"distance": stacked(distances, scale_bar(distances.shape[1], top, f"distance, m; {order}"))}
    normals = np.round(127.5 + 127.5 * tiles("normal")).astype(np.uint8)
    for name, maps, title in (
        ("radiance", tone_map(tiles("radiance"), exposure), f"radiance, exposure {exposure:+.1f}"),
        ("normal", normals, "normal: red x, green y, blue z, each from -1 (dark) to 1"),
        ("irradiance", tone_map(tiles("irradiance") / math.pi, exposure), f"irradiance / pi, exposure {exposure:+.1f}"),
    ):
        pictures[name] = with_keys(_sheet(maps, columns, covered), (), f"{title}; {order}")
    return pictures


def _sheet_columns(along_x: int, count: int) -> int:
    """Return the number of tiles side by side: whole rows of the grid, in a sheet of about the wanted shape."""

    def cost(columns: int) -> float:
        rows = math.ceil(count / columns)
        return abs(math.log(columns / rows / SHEET_ASPECT)) + 2 * (1 - count / (rows * columns))

    return min(range(along_x, max(count, along_x) + 1, along_x), key=cost)


def _sheet(maps: np.ndarray, columns: int, covered: np.ndarray) -> np.ndarray:
    """Return maps uint8 [probe, size, size, 3] side by side, each with its number; covered probes are crossed out."""
    from PIL import Image, ImageDraw

    count, size = maps.shape[:2]
    zoom = max(min(SHEET_PIXELS // (columns * size), 8), 1)
    gap = 2
    tile = size * zoom + gap
    rows = -(-count // columns)
    image = Image.new("RGB", (columns * tile - gap, rows * tile - gap), (255, 255, 255))
    draw = ImageDraw.Draw(image)
    font = label_font(14)
    for probe, pixels in enumerate(maps):
        x, y = probe % columns * tile, probe // columns * tile
        side = size * zoom
        image.paste(Image.fromarray(pixels).resize((side, side), Image.Resampling.NEAREST), (x, y))
        if covered[probe]:
            _cross(draw, (x, y, x + side, y + side), 2)
        text = str(probe)
        wide = math.ceil(font.getlength(text)) + 8 if side >= 60 else min(8, side // 4)
        draw.rectangle((x, y, x + wide, y + (18 if side >= 60 else wide)), fill=probe_color(probe), outline=(0, 0, 0))
        if side >= 60:
            draw.text((x + 4, y + 1), text, fill=(0, 0, 0), font=font)
    return np.asarray(image)


def _cross(draw: Drawing, box: tuple[float, float, float, float], width: int) -> None:
    for color, wide in (((0, 0, 0), 3 * width), ((255, 255, 255), width)):
        draw.line(box, fill=color, width=wide)
        draw.line((box[0], box[3], box[2], box[1]), fill=color, width=wide)


# ---- places ----


def draw_places(frame: Frame, state: ProbeState) -> np.ndarray:
    """Return a rendered frame with a disc for each probe, uint8 [height + legend, width, 3].

    Probes in view are filled, those behind a surface are rings; covered ones are crossed out.
    """
    from PIL import Image, ImageDraw

    beauty, depth = frame.numpy("beauty"), frame.numpy("depth")
    camera, (width, height) = frame.camera, frame.camera.resolution
    positions = state.field.positions.numpy().astype(np.float64)
    covered = state.field.states.numpy() != int(field_kernels.PROBE_USABLE)
    away = (positions - camera.position) @ -camera.world_from_camera[:3, 2]
    near = away > 1e-3 * max(float(np.abs(away).max()), 1e-9)
    at = camera.project(np.where(near[:, None], positions, camera.position - camera.world_from_camera[:3, 2]))
    inside = near & (at >= 0).all(1) & (at < (width, height)).all(1)
    focal = camera.intrinsics[0, 0]
    scale = np.ones_like(away) if camera.is_orthographic else away
    size = 0.07 * float(np.min(state.grid.spacing))  # metres
    canvas = Image.new("RGBA", (width * _SMOOTH, height * _SMOOTH))
    draw = ImageDraw.Draw(canvas)
    font = label_font(12 * _SMOOTH)
    for probe in sorted(np.flatnonzero(inside), key=lambda i: -away[i]):
        x, y = at[probe] * _SMOOTH
        r = float(np.clip(size * focal / scale[probe], max(width / 160, 4), max(width / 45, 8))) * _SMOOTH
        color = probe_color(int(probe))
        box = (x - r, y - r, x + r, y + r)
        if away[probe] > depth[int(at[probe, 1]), int(at[probe, 0])] * 1.001:
            draw.ellipse(box, outline=(0, 0, 0, 160), width=max(round(0.45 * r), 3))
            draw.ellipse(tuple(np.add(box, (1, 1, -1, -1))), outline=(*color, 255), width=max(round(0.3 * r), 2))
        else:
            draw.ellipse(box, fill=(*color, 255), outline=(0, 0, 0, 255), width=_SMOOTH)
            if inside.sum() <= MOST_NUMBERS:
                black, white = (0, 0, 0, 255), (255, 255, 255, 255)
                draw.text((x, y - r), str(probe), white, font, "md", stroke_width=_SMOOTH, stroke_fill=black)
        if covered[probe]:
            _cross(draw, (x - 1.4 * r, y - 1.4 * r, x + 1.4 * r, y + 1.4 * r), _SMOOTH)
    image = Image.fromarray(tone_map(beauty, exposure_of(beauty))).convert("RGBA")
    image.alpha_composite(canvas.resize((width, height), Image.Resampling.LANCZOS))
    title = f"{len(positions):,} probes, {int(inside.sum()):,} of them in this view, {int(covered.sum()):,} covered; "
    title += "disc: seen; ring: behind a surface; numbers and colours as in the maps"
    if covered[inside].any():
        title += "; crossed out: covered, not used"
    return with_keys(np.asarray(image.convert("RGB")), (), title)


# ---- who sees what ----


def probes_in_sight(frame: Frame, state: ProbeState, visibility: Literal["probes", "exact"]) -> np.ndarray:
    """Return how many of the eight probes around each pixel's surface see it, int32 [height, width].

    The surface is that of the last camera sample. 0 means that too few probes see it, and rays are traced; -1 that
    there is none. ``visibility`` is that of LightFieldProbes: how it is found out.
    """
    width, height = frame.camera.resolution
    counts = wp.empty(width * height, dtype=wp.int32, device=frame.device)
    inputs = [frame.data, state.field, VISIBILITIES[visibility], frame.hits, counts]
    frame.launch(trace_kernels.count_probes, inputs)
    return counts.numpy().reshape(height, width)


def draw_seen(frame: Frame, state: ProbeState, visibility: Literal["probes", "exact"]) -> np.ndarray:
    """Return ``probes_in_sight`` in colours, shaded as the frame is, uint8 [height + legend, width, 3]."""
    counts = probes_in_sight(frame, state, visibility)
    colors = np.concatenate([[UNSEEN_COLOR], magma(np.arange(1, 9)[None] / 9)[0]]).astype(np.uint8)
    shade = tone_map(frame.numpy("beauty"), exposure_of(frame.numpy("beauty"))).mean(axis=-1, keepdims=True) / 255
    image = colors[np.maximum(counts, 0)] * (0.55 + 0.45 * shade)
    image[counts < 0] = 255
    surface = counts >= 0
    unseen = float((counts == 0).sum() / max(surface.sum(), 1))
    shades = [(int(r), int(g), int(b)) for r, g, b in colors]
    keys = [(shade, str(n) if n else "too few: rays are traced") for n, shade in enumerate(shades)]
    title = f"probes, of the eight around it, that see a point; {unseen:.1%} of the surface in view is left to rays"
    return with_keys(image.astype(np.uint8), tuple(keys), title)


# ---- rays ----


def _reflected_ray(frame: Frame, column: int, row: int) -> tuple[np.ndarray, np.ndarray]:
    """Return origin [m] and unit direction, each float64 [3], of a pixel's ray after its reflection, if it hits."""
    camera = frame.camera
    pixel = np.array([(column + 0.5, row + 0.5)])
    (direction,), (origin,) = camera.directions(pixel), camera.origins(pixel)
    normal = frame.numpy("normal")[row, column].astype(np.float64)
    length = np.linalg.norm(normal)  # below 1 where samples of a pixel differ
    if length == 0 or not np.isfinite(frame.numpy("depth")[row, column]):
        return origin, direction
    position, normal = frame.numpy("position")[row, column].astype(np.float64), normal / length
    distance = np.linalg.norm(position - origin)
    return position + 1e-4 * distance * normal, direction - 2 * (direction @ normal) * normal


def _telling_ray(frame: Frame, state: ProbeState) -> tuple[np.ndarray, np.ndarray]:
    """Return the reflected ray of the pixel, of some that are tried, whose path shows most.

    That is a ray that hits and asks two to four probes, each of which it looks at for long.
    """
    width, height = frame.camera.resolution
    at = np.meshgrid(np.arange(1, 24, 2) * width // 24, np.arange(1, 16, 2) * height // 16)
    rays = [_reflected_ray(frame, int(x), int(y)) for x, y in zip(at[0].ravel(), at[1].ravel(), strict=True)]
    origins, directions = (np.stack(values) for values in zip(*rays, strict=True))
    hits = march_rays(state, origins, directions)
    probes, blocks = hits["counts"][:, 2], hits["counts"][:, 1]
    value = 2.0 * (hits["results"] == int(march_kernels.HIT)) + ((probes > 1) & (probes <= 4)) + 1e-6 * blocks
    best = np.argsort(-value, kind="stable")[:CANDIDATES]
    best = best[value[best] > value[best[0]] - 0.5]

    def shortest(ray: int) -> int:
        """Return the number of blocks that a ray looks at in the probe where it looks at the fewest."""
        looks, _ = ray_looks(state, *rays[ray])
        visits = [look.visit for look in looks if look.level]
        return min((visits.count(look.visit) for look in looks), default=0)

    return rays[int(max(best, key=shortest))]
