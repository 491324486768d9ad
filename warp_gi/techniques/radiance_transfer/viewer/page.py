"""One self-contained HTML page that relights a bake (prt_textures.txt) with WebGL2, and asks the network for nothing.

Its parts, ``viewer.html``, ``viewer.css`` and the scripts, lie beside this module. What it shows is the diffuse light
of ``shade_transfer``: albedo / pi times (L . T + L . B + lamps), with all of the sky in the 25 numbers of L.
"""

from __future__ import annotations

import json
import logging
import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from warp_gi.baking import Bake
from warp_gi.errors import BakeError, OptionError
from warp_gi.files import replacing
from warp_gi.kernels.transfer_snippets import LIGHT_ORDER
from warp_gi.scene import harmonics
from warp_gi.scene.camera import Camera
from warp_gi.scene.environment import Environment
from warp_gi.scene.scene import Scene
from warp_gi.techniques.radiance_transfer.textures import TransferTextures, transfer_textures
from warp_gi.techniques.radiance_transfer.viewer import pages, skies, surfaces
from warp_gi.techniques.radiance_transfer.viewer.pages import Rows
from warp_gi.techniques.radiance_transfer.viewer.parts import Parts
from warp_gi.techniques.radiance_transfer.viewer.surfaces import Surfaces
from warp_gi.techniques.shared.atlas.atlas import Atlas

_LOG = logging.getLogger("warp_gi")
FOLDER = Path(__file__).parent
SCRIPTS = ("unpack.js", "light.js", "shaders.js", "draw.js", "viewer.js")
SUFFIX = ".html"
LARGEST_MB = 30.0
"""Size of a page in MB (1e6 bytes), unless told otherwise."""
IMAGE_SHARE = 0.35
"""Share of a page that images of base colour may take before they are made smaller."""


@dataclass(frozen=True)
class Detail:
    """How exactly transfer is kept in a page."""

    block: int
    """Texels along a side that become one."""
    fineness: int
    """Steps, to which numbers are rounded, in their RMS."""

    def __str__(self) -> str:
        said = [f"1 texel for {self.block} x {self.block}"] if self.block > 1 else []
        if self.fineness < pages.FINE:
            said.append(f"numbers rounded to 1/{self.fineness} of their RMS")
        return " and ".join(said)


DETAILS = tuple(Detail(block, fineness) for block in (1, 2, 4, 8) for fineness in (pages.FINE, pages.COARSE))
"""Details of pages, the next where one is too large."""


def write_view(
    bake: Bake,
    scene: Scene,
    camera: Camera,
    path: str | Path,
    sky: Environment | None = None,
    largest_mb: float = LARGEST_MB,
    exposure: float | None = None,
) -> Path:
    """Write a page that shows a bake under skies that turn; the file appears whole or not at all.

    The page is for WebGL2 with half-float targets, which browsers have had since 2021. Surfaces are matt, of their base
    colour; bounces are 24 numbers that stand for 75; direct light of lamps is not shown. What is made smaller to fit is
    told by a warning; the page says that, too, and what else it leaves out.

    Args:
        bake: Transfer textures of the scene, in texels of an atlas.
        scene: The scene; it gives triangles at time 0, base colours and emission.
        camera: The first view.
        path: Name of the file, ``.html``.
        sky: The first sky; None is the scene's own. Some made ones can be chosen in the page, as bright as it.
        largest_mb: Largest size of the page in MB (1e6 bytes).
        exposure: Exposure at the start, in stops; None suits the first view.

    Returns the path. Raises OptionError for another suffix, a bake at vertices, or what does not fit however small;
    BakeError for a bake of another technique or scene, OSError for a path that cannot be written.
    """
    path = check_view_name(path)
    if not (math.isfinite(largest_mb) and largest_mb > 0):
        raise OptionError(f"largest_mb must be finite and above 0, got {largest_mb}")
    if exposure is not None and not math.isfinite(exposure):
        raise OptionError(f"exposure must be a finite number of stops, got {exposure}")
    textures = transfer_textures(bake)
    _check(textures, scene)
    with scene.lock:
        shown = surfaces.surfaces_of(scene, textures.atlas)
        rows = pages.rows_of(textures)
        fixed = _fixed(scene, shown, skies.page_skies(scene.environment if sky is None else sky))
        fixed.about.update(_view(camera, shown, scene), exposure=exposure)
        fixed.about["notes"] += _notes(scene, shown, rows)
        lost = _with_images(scene, fixed, largest_mb)
        text, less = _fitted(textures.atlas, rows, shown, fixed, largest_mb)
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")
    for note in fixed.about["notes"]:
        _LOG.info("%s: %s", path.name, note)
    for note in filter(None, (lost, less)):
        warnings.warn(f"{path.name}: {note}", stacklevel=2)
    return path


def check_view_name(path: str | Path) -> Path:
    """Return the path of a page; raises OptionError unless it ends in .html."""
    path = Path(path)
    if path.suffix.lower() != SUFFIX:
        raise OptionError(f"cannot write {path.name}: a view is one {SUFFIX} file")
    return path


def _check(textures: TransferTextures, scene: Scene) -> None:
    """Raise OptionError or BakeError for a bake that a page cannot show."""
    atlas = textures.atlas
    if len(atlas.corner_slots):
        raise OptionError('a view shows texels of an atlas, this bake is at vertices; bake with storage "texture"')
    if len(atlas.corners) != scene.triangle_count:
        raise BakeError(
            f"expected a bake of scene {scene.name!r} with {scene.triangle_count:,} triangles,"
            f" got one of {len(atlas.corners):,}; bake it again"
        )


# ---- what a page holds ----


@dataclass(frozen=True, eq=False)
class _Fixed:
    """What a page holds whatever the detail of its textures."""

    parts: Parts
    """Vertices, triangles, skies and images."""
    about: dict[str, Any]
    """What says how they are read, and all else that the scripts know of the scene."""


def _fixed(scene: Scene, shown: Surfaces, sky_list: list[skies.PageSky]) -> _Fixed:
    parts = Parts()
    directions, weights = harmonics.sphere(2 * LIGHT_ORDER - 2)
    about = {
        "name": scene.name,
        "positions": parts.add(shown.positions.T),
        "uvs": parts.add(shown.uvs.T),
        "triangles": parts.add(shown.triangles.T),
        "groups": shown.groups,
        "bounds": scene.bounds.tolist(),
        "sphere": np.column_stack([directions, weights]).round(9).tolist(),
        "skies": [
            {
                "name": one.name,
                "light": [[float(f"{number:.7g}") for number in row] for row in one.light],
                "range": [part.tolist() for part in one.range],
                "rotation": one.rotation,
                "map": parts.add(np.moveaxis(one.pixels, -1, 0)),
            }
            for one in sky_list
        ],
        "notes": [],
    }
    return _Fixed(parts, about)


def _notes(scene: Scene, shown: Surfaces, rows: Rows) -> list[str]:
    """Return what the page does not show, or not exactly."""
    notes = []
    if shown.left_out:
        count = f"{shown.left_out:,} of {scene.triangle_count:,}"
        notes.append(f"Left out are {count} triangles: they move, or nothing is kept there.")
    if len(rows.components):
        notes.append(
            f"{len(rows.components)} numbers stand for the 75 of bounces, error {rows.error:.2g} of their mean."
        )
    if scene.emitter_count:
        notes.append("Direct light of lamps is not shown.")
    if scene._flat.colors is not None:
        notes.append("Colours of vertices are in the light of bounces, and not on the surfaces themselves.")
    return notes


def _with_images(scene: Scene, fixed: _Fixed, largest_mb: float) -> str:
    """Add materials, and images of base colour and emission; return how much smaller they are, or ""."""
    images = surfaces.images_of(scene.materials)
    cut = {id(one.base_color_texture) for one in scene.materials if one.lets_rays_pass}
    for step in (1, 2, 4, 8, 16):
        files = [surfaces.image_file(one, id(one) in cut, step) for one in images]
        if sum(map(len, files)) * 4 / 3 <= IMAGE_SHARE * largest_mb * 1e6:
            break
    fixed.about["images"] = [
        {**fixed.parts.add_file(file), "wrap": list(one.wrap), "srgb": one.srgb}
        for file, one in zip(files, images, strict=True)
    ]
    fixed.about["materials"] = [surfaces.material_record(one, images) for one in scene.materials]
    said = f"Images have 1/{step} of their pixels a side, to stay under {largest_mb:g} MB." if step > 1 else ""
    fixed.about["notes"] += [said] if said else []
    return said


def _fitted(atlas: Atlas, rows: Rows, shown: Surfaces, fixed: _Fixed, largest_mb: float) -> tuple[str, str]:
    """Return the page with the most detail that fits, and what is less in it, or ""; raises OptionError."""
    size, limit = 0, int(largest_mb * 1e6)
    for detail in DETAILS:
        parts = Parts([*fixed.parts.texts])
        said = f"It has {detail}, to stay under {largest_mb:g} MB." if str(detail) else ""
        about = {
            **fixed.about,
            "layers": rows.layers,
            "components": np.round(rows.components, 7).tolist(),
            "hasBounces": bool(len(rows.components)) or rows.has_lamps,
            "places": parts.add(_places(atlas, shown, detail.block).T),
            "pages": _page_parts(atlas, rows, shown, detail, parts, limit),
            "notes": [*fixed.about["notes"], *filter(None, [said])],
        }
        text = _page(about, parts) if parts.nbytes <= limit else ""
        size = len(text.encode()) or parts.nbytes
        if size <= limit:
            return text, said
    raise OptionError(
        f"expected a page of at most {largest_mb:g} MB, got {size / 1e6:.3g} MB with the fewest texels"
        f" ({len(shown.triangles):,} triangles); allow a larger one, or bake fewer texels or triangles"
    )


def _page_parts(
    atlas: Atlas, rows: Rows, shown: Surfaces, detail: Detail, parts: Parts, limit: int
) -> list[list[dict[str, Any] | None]]:
    """Add the textures of each page and side that is drawn; stops where the page is too large anyhow."""
    drawn = {(group["page"], group["side"]) for group in shown.groups}
    steps = pages.steps_of(rows, detail.fineness)
    result: list[list[dict[str, Any] | None]] = []
    for page in range(len(atlas.pages)):
        result.append([None, None])
        for side in range(2):
            if (page, side) in drawn and parts.nbytes <= limit:
                layers: list[dict[str, Any]] = []
                for texels in pages.page_layers(atlas, rows, page, side, detail.block, steps):
                    layers.append(parts.add(texels))
                    if parts.nbytes > limit:
                        break
                size = pages.page_size(atlas, page, detail.block)
                result[-1][side] = {"size": size, "layers": layers, "steps": steps.tolist()}
    return result


def _places(atlas: Atlas, shown: Surfaces, block: int) -> np.ndarray:
    """Return places of vertices in 0..1 of their page's texture, float32 [n, 2]."""
    result = shown.places.astype(np.float64)
    for group in shown.groups:
        first = group["first"]
        vertices = np.unique(shown.triangles[first : first + group["count"]])
        size = np.array(pages.page_size(atlas, group["page"], block)) * block
        result[vertices] = shown.places[vertices] / size
    return result.astype(np.float32)


def _view(camera: Camera, shown: Surfaces, scene: Scene) -> dict[str, Any]:
    width, height = camera.resolution
    matrix = camera.world_from_camera
    return {
        "camera": {
            "position": matrix[:3, 3].tolist(),
            "axes": matrix[:3, :3].T.tolist(),
            "hfov": camera.hfov,
            "aspect": width / height,
            "distance": _distance(camera, shown, scene),
        }
    }


def _distance(camera: Camera, shown: Surfaces, scene: Scene) -> float:
    """Return how far in front of the camera the first surface is in the middle of its picture, in metres."""
    p0, p1, p2 = np.moveaxis(shown.positions[shown.triangles].astype(np.float64), 1, 0)
    forward, e1, e2 = -camera.world_from_camera[:3, 2], p1 - p0, p2 - p0
    cross = np.cross(forward, e2)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / (e1 * cross).sum(axis=1)
        start = camera.position - p0
        u = (start * cross).sum(axis=1) * inverse
        other = np.cross(start, e1)
        v, t = (other @ forward) * inverse, (e2 * other).sum(axis=1) * inverse
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    if hit.any():
        return float(t[hit].min())
    ahead = float((scene.bounds.mean(axis=0) - camera.position) @ forward)
    return max(ahead, 0.1 * scene.radius, 1e-6)


# ---- the page ----


def _page(about: dict[str, Any], parts: Parts) -> str:
    data = "\n".join(
        f'<script type="application/octet-stream" id="part-{number}">{text}</script>'
        for number, text in enumerate(parts.texts)
    )
    return Template(_part("viewer.html")).substitute(
        title=escape(about["name"]),
        style=_part("viewer.css"),
        about=json.dumps(about).replace("<", "\\u003c"),
        data=data,
        script="\n".join(_scripts()),
    )


def _scripts() -> Iterator[str]:
    return map(_part, SCRIPTS)


def _part(name: str) -> str:
    return (FOLDER / name).read_text(encoding="utf-8")
