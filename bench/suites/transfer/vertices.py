"""Transfer at vertices against textures (the paper's Fig. 4): floor and walls in 2 to 32 K triangles each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness.court import court, court_camera
from warp_gi.bench.harness.gallery import CLOSED, Gallery, PictureSet
from warp_gi.bench.harness.measure import Row
from warp_gi.bench.suites.transfer.views import QUICK_SIZE, SIZE, TermView, smooth_sky

TABLE = "vertices and textures"
CELLS, QUICK_CELLS = (1, 4, 16, 64, 128), (1, 16)
"""Cells along a side of the floor, of two triangles each."""
RESOLUTIONS, QUICK_RESOLUTIONS = (128, 256, 512, 1024), (128,)
TARGETS = {"16x16": 2.0, "1x1": 10.0}
"""Target for how many times less error on the floor a texture of 256 has than vertices."""
BASE = gi.RadianceTransfer(bounces=0)


def vertex_rows(quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return a row for each tessellation and each texture."""
    size, spp = (QUICK_SIZE, 64) if quick else (SIZE, 1024)
    sky, camera = smooth_sky(), court_camera(size)
    view = TermView(court(sky), camera, "environment", spp, device)
    rows, pictures = list[Row](), dict[str, np.ndarray]()
    for cells in QUICK_CELLS if quick else CELLS:
        scene, estimator = court(sky, floor=cells), replace(BASE, storage="vertices")
        row, pictures[f"vertices {cells}x{cells}"] = storage_row(view, scene, estimator, device)
        rows.append(row | {"storage": "vertices", "size": f"{cells}x{cells}", "floor triangles": 2 * cells**2})
    floors = {row["size"]: row["floor rel"] for row in rows}
    for resolution in QUICK_RESOLUTIONS if quick else RESOLUTIONS:
        row, pictures[f"texture {resolution}"] = storage_row(
            view, view.scene, replace(BASE, resolution=resolution), device
        )
        row |= {"storage": "texture", "size": str(resolution), "floor triangles": 2}
        for coarse, least in TARGETS.items():
            row[f"times better than {coarse}"] = floors[coarse] / max(row["floor rel"], 1e-6)
            row[f"target over {coarse}"] = least if resolution == 256 else 0.0
        rows.append(row)
    gallery.add(PictureSet("court: direct light of a smooth sky, vertices and textures", view.reference, pictures))
    return [{"table": TABLE, **row} for row in rows]


def storage_row(view: TermView, scene: gi.Scene, estimator: gi.RadianceTransfer, device: str) -> tuple[Row, np.ndarray]:
    """Return errors, on the floor and in all, of a bake of ``scene``, which looks like that of the view."""
    bake = gi.bake(scene, estimator, device)
    frame = replace(view, scene=scene, _halves=view.halves).frame(estimator, 1, [bake])
    picture = frame.numpy("environment").copy()
    floor = frame.numpy("object_id") == [node.name for node in scene.nodes].index("floor")
    whole, on_floor = view.errors(picture), view.errors(picture, floor)
    row: Row = {"slots": bake.counts["slots"], "floor rel": on_floor["rel"], "floor bias, %": on_floor["bias, %"]}
    row |= whole | {"FLIP": gi.metrics.flip(picture, view.reference)}
    return row | {"MB": 64e-6 * bake.counts["slots"], "bake cpu s": bake_seconds(bake)}, picture


def bake_seconds(bake: gi.Bake) -> float:
    """Return the CPU seconds of a bake's stages but charts, which another process makes."""
    return sum(bake.counts.get(f"{stage}_cpu_seconds", 0.0) for stage in ("rays", "bounces"))
