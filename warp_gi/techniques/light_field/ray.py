"""The path of a ray through the maps of light field probes, look by look (light_field_probes.txt, Fig. 4)."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.errors import OptionError
from warp_gi.kernels import light_field as field_kernels
from warp_gi.kernels import light_field_march as march_kernels
from warp_gi.sequence.preview import tone_map
from warp_gi.techniques.light_field.export import unpack_radiance
from warp_gi.techniques.light_field.state import ProbeState
from warp_gi.techniques.shared.legends import with_keys
from warp_gi.techniques.shared.octahedral import encode, texels_of

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw as Drawing

PANEL_PIXELS = 768
"""Pixels along a side of each map that a ray is drawn in, about."""
PICTURE_PIXELS = 2600
"""Largest width in pixels of a picture of several maps."""
MOST_PANELS, MOST_LOOKS = 8, 4000
"""Largest numbers of maps and of looks of a ray's path that are drawn."""
# orange and green as in the paper's figure
COARSE_COLOR, FINE_COLOR, HIT_COLOR, LINE_COLOR = (240, 140, 0), (60, 230, 60), (220, 30, 60), (255, 255, 255)
LOST_COLOR = (120, 120, 120)
NO_LIMIT = 1 << 30
"""Steps after which a ray stops that nothing else stops."""
_DIMMED = 0.6  # brightness of the map below the path
_SMOOTH = 2  # pixels of a drawing along a side of one of the picture's


def probe_color(probe: int) -> tuple[int, int, int]:
    """Return the colour, sRGB 0 to 255, that stands for a probe; probes of near numbers have unlike colours."""
    r, g, b = colorsys.hsv_to_rgb(probe * 0.618034 % 1.0, (0.85, 0.55)[probe % 2], (1.0, 0.85, 0.95)[probe % 3])
    return round(255 * r), round(255 * g), round(255 * b)


def march_rays(
    state: ProbeState, origins: np.ndarray, directions: np.ndarray, most_steps: int = NO_LIMIT
) -> dict[str, np.ndarray]:
    """Return what rays meet in the maps of probes, by the names of the fields of ``MarchHits``, each [ray, ...].

    Args:
        state: State of the probes.
        origins: float [ray, 3], metres.
        directions: float [ray, 3], unit vectors.
        most_steps: Number of blocks and texels after which a ray stops, with the result ``STOPPED``.
    """
    count, device = len(origins), state.device
    hits = march_kernels.MarchHits()
    for name, variable in march_kernels.MarchHits.vars.items():
        setattr(hits, name, wp.empty(count, dtype=variable.type.dtype, device=device))
    rays: list[wp.array] = [
        wp.array(np.asarray(v, np.float32), dtype=wp.vec3, device=device) for v in (origins, directions)
    ]
    inputs = [state.field, *rays, float("inf"), most_steps, hits]
    launch.launch(march_kernels.march_rays, count, inputs, device)
    return {name: getattr(hits, name).numpy() for name in march_kernels.MarchHits.vars}


@dataclass(frozen=True)
class Look:
    """A block or a texel that a ray was tested against."""

    visit: int
    """Number of probes that the ray has asked so far, this one included."""
    probe: int
    """Index of the probe that is asked."""
    level: int
    """1 for a block, 0 for a texel."""
    cell: int
    """Index of the block or texel in the probe's map, row by row."""
    t: float
    """Distance along the ray at which it enters, metres."""


def ray_looks(state: ProbeState, origin: np.ndarray, direction: np.ndarray) -> tuple[list[Look], dict[str, Any]]:
    """Return what a ray is tested against, at most the first ``MOST_LOOKS`` blocks and texels, and the hit.

    They are found by stopping the march after one look, after two, and so on. ``origin`` [m] and ``direction`` (unit)
    are float [3]; the hit has the fields of ``MarchHits``.
    """
    origin, direction = np.asarray(origin, np.float64), np.asarray(direction, np.float64)
    resolution, positions = state.resolution, state.field.positions.numpy()

    def march(most_steps: int) -> dict[str, Any]:
        found = march_rays(state, origin[None], direction[None], most_steps)
        return {name: values[0] for name, values in found.items()}

    hit = march(NO_LIMIT)
    looks, before = [], march(0)
    for number in range(1, min(int(hit["counts"][:2].sum()), MOST_LOOKS) + 1):
        after = march(number)
        visit, probe, t = int(before["counts"][2]), int(before["probes"]), float(before["t"])
        level, cell = int(after["counts"][1] > before["counts"][1]), int(after["stops"][1])
        if after["counts"][2] != visit:  # the next probe was begun since, and the cell forgotten: where the ray was
            size = resolution // int(field_kernels.BLOCK) if level else resolution
            way = origin + direction * t - positions[probe]
            column, row = texels_of(way + direction * 0.1 * np.linalg.norm(way) / resolution, size)
            cell = int(row * size + column)
        looks.append(Look(visit, probe, level, cell, t))
        before = after
    return looks, hit


def draw_ray(state: ProbeState, origin: np.ndarray, direction: np.ndarray, exposure: float = 0.0) -> np.ndarray:
    """Return the path of a ray through the radiance maps of the probes that it asks, uint8 [height, width, 3].

    Args:
        state: State of a frame (``FrameScheduler.state("indirect")``) or of a bake (``LightFieldProbes.start``).
        origin: float [3], metres.
        direction: float [3], of any length above zero.
        exposure: Exposure of the radiance, in stops.

    Of more than ``MOST_PANELS`` probes the first ones are drawn. Raises OptionError unless origin and direction are
    three finite numbers each, and the direction is above zero.
    """
    origin, direction = np.asarray(origin, np.float64), np.asarray(direction, np.float64)
    length = float(np.linalg.norm(direction))
    if origin.shape != (3,) or direction.shape != (3,) or not np.isfinite([*origin, length]).all() or length == 0:
        raise OptionError(
            f"expected the ray's origin and a direction above zero, three finite numbers each, "
            f"got {origin.tolist()} and {direction.tolist()}"
        )
    direction = direction / length
    looks, hit = ray_looks(state, origin, direction)
    visits = sorted({look.visit for look in looks})
    result = int(hit["results"])
    # where no probe was sure, the hit is in the map of any of those asked
    last = max((look.visit for look in looks if look.probe == hit["probes"]), default=0)
    panels = []
    for visit in visits[:MOST_PANELS]:
        own = [look for look in looks if look.visit == visit]
        after = next((look.t for look in looks if look.visit > visit), float(hit["t"]))
        is_last = visit == last and result != int(march_kernels.MISS)
        color = HIT_COLOR if result == int(march_kernels.HIT) else LOST_COLOR
        end = float(hit["t"]) if visit == last else max(after, own[-1].t)
        panels.append(_panel(state, own, origin, direction, end, color if is_last else None, exposure))
    if not panels:
        panels = [np.full((PANEL_PIXELS // 2, PANEL_PIXELS, 3), 230, np.uint8)]
    told = f"the ray from ({_numbers(origin)}) m towards ({_numbers(direction)}) {_end(result, float(hit['t']))}; "
    steps, blocks, probes = (int(n) for n in hit["counts"])
    told += f"{_count(probes, 'probe')} asked, {_count(blocks, 'block')} and {_count(steps, 'texel')} looked at"
    if len(visits) > len(panels) and looks:
        told += f"; the first {len(panels)} probes are shown"
    keys = [(COARSE_COLOR, "block of 16 x 16 texels looked at"), (FINE_COLOR, "texel looked at")]
    keys.append((LINE_COLOR, "the ray, from its white dot on"))
    if result == int(march_kernels.HIT):
        keys.append((HIT_COLOR, "where it hits"))
    elif result != int(march_kernels.MISS):
        keys.append((LOST_COLOR, "where it is lost"))
    return with_keys(_arranged(panels), tuple(keys), told)


def _end(result: int, t: float) -> str:
    """Return in words how a ray's march ends."""
    if result == int(march_kernels.MISS):
        return "meets nothing"
    return f"hits after {t:.3g} m" if result == int(march_kernels.HIT) else "is lost: no probe sees further"


def _arranged(panels: list[np.ndarray]) -> np.ndarray:
    """Return pictures of one size in rows, on white."""
    across = min(len(panels), max(PICTURE_PIXELS // (panels[0].shape[1] + 12), 1))
    across = -(-len(panels) // -(-len(panels) // across))  # rows of about equal length
    panels = [*panels, *[np.full_like(panels[0], 255)] * (-len(panels) % across)]
    spaced = [np.pad(p, ((0, 4), (0, 12), (0, 0)), constant_values=255) for p in panels]
    return np.concatenate([np.concatenate(spaced[i : i + across], axis=1) for i in range(0, len(spaced), across)])


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


def _numbers(values: np.ndarray) -> str:
    return ", ".join(f"{v:.2f}" for v in values)


def _panel(
    state: ProbeState,
    looks: list[Look],
    origin: np.ndarray,
    direction: np.ndarray,
    t_end: float,
    end_color: tuple[int, int, int] | None,
    exposure: float,
) -> np.ndarray:
    """Return a probe's map with the ``looks`` at it and the ray drawn over it, and a caption below."""
    from PIL import Image, ImageDraw

    probe, resolution, block = looks[0].probe, state.resolution, int(field_kernels.BLOCK)
    texels = resolution**2
    light = unpack_radiance(state.field.radiance[probe * texels : (probe + 1) * texels].numpy())
    colors = tone_map(light.reshape(resolution, resolution, 3), exposure)
    zoom = max(PANEL_PIXELS // resolution, 1)
    side, scale = resolution * zoom, zoom * _SMOOTH
    full, half = side * _SMOOTH, side * _SMOOTH // 2
    canvas = Image.new("RGBA", (full, full))
    draw = ImageDraw.Draw(canvas, "RGBA")
    for at in range(0, full + 1, block * scale):
        draw.line((at, 0, at, full), fill=(255, 255, 255, 60))
        draw.line((0, at, full, at), fill=(255, 255, 255, 60))
    for points in ((half, 0, full, half, half, full, 0, half, half, 0), (half, 0, half, full), (0, half, full, half)):
        draw.line(points, fill=(255, 255, 255, 170), width=_SMOOTH)  # borders of the octahedron's faces
    for look in looks:
        if look.level:
            box = _cell_box(look.cell, resolution // block, block * scale)
            draw.rectangle(box, fill=(*COARSE_COLOR, 70), outline=(*COARSE_COLOR, 255), width=2 * _SMOOTH)
    line = _line_on_map(origin - state.field.positions.numpy()[probe], direction, looks[0].t, t_end) * full
    pieces = np.split(line, 1 + np.flatnonzero(np.linalg.norm(np.diff(line, axis=0), axis=1) > full / 50))
    for color, width in (((0, 0, 0, 255), 4), ((*LINE_COLOR, 255), 2)):
        for piece in pieces:
            if len(piece) > 1:
                draw.line([tuple(p) for p in piece], fill=color, width=width * _SMOOTH, joint="curve")
    edge = (0, 60, 0, 255) if scale >= 4 * _SMOOTH else None
    for look in looks:
        if not look.level:  # over the line, which is wider than they are in a fine map
            draw.rectangle(_cell_box(look.cell, resolution, scale), fill=(*FINE_COLOR, 255), outline=edge)
    _draw_dot(draw, line[0], 5, LINE_COLOR)
    if end_color is not None:
        _draw_dot(draw, line[-1], 7, end_color)
    image = Image.fromarray((_DIMMED * colors).astype(np.uint8)).resize((side, side), Image.Resampling.NEAREST)
    image = image.convert("RGBA")
    image.alpha_composite(canvas.resize((side, side), Image.Resampling.LANCZOS))
    nx, ny = state.grid.counts[:2]
    place = f"({probe % nx}, {probe // nx % ny}, {probe // (nx * ny)})"
    blocks = sum(look.level for look in looks)
    told = f"{looks[0].visit}: probe {probe} {place}; {_count(blocks, 'block')}, {_count(len(looks) - blocks, 'texel')}"
    return with_keys(np.asarray(image.convert("RGB")), ((probe_color(probe), told),))


def _cell_box(cell: int, across: int, size: int) -> tuple[int, int, int, int]:
    """Return x and y of the corners of a cell, ``size`` pixels wide, in a map of ``across`` cells a side."""
    x, y = cell % across * size, cell // across * size
    return x, y, x + size - 1, y + size - 1


def _draw_dot(draw: Drawing, at: np.ndarray, radius: int, color: tuple[int, int, int]) -> None:
    for r, fill in ((radius + 1, (0, 0, 0)), (radius, (255, 255, 255)), (radius - 2, color)):
        draw.ellipse((*(at - r * _SMOOTH), *(at + r * _SMOOTH)), fill=(*fill, 255))


def _line_on_map(origin: np.ndarray, direction: np.ndarray, t_start: float, t_end: float) -> np.ndarray:
    """Return where points of a ray lie on a probe's map, float64 [point, 2] in [0, 1].

    The points are at even angles as the probe sees them; ``origin`` [m] is relative to the probe.
    """
    nearest = -origin @ direction
    height = max(float(np.linalg.norm(origin + nearest * direction)), 1e-6)
    first, last = np.arctan((np.array([t_start, max(t_end, t_start)]) - nearest) / height)
    angles = np.linspace(first, last, 1000)
    return encode(origin + (nearest + height * np.tan(angles))[:, None] * direction)
