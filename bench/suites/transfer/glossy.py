"""Glossy lobes by transfer against the path tracer: white metal, so that one lobe is all that is seen."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import warp_gi as gi
from warp_gi.bench.harness.court import court, court_camera
from warp_gi.bench.harness.gallery import CLOSED, Gallery, PictureSet
from warp_gi.bench.harness.measure import Row, attempt
from warp_gi.bench.suites.transfer import shapes
from warp_gi.bench.suites.transfer.errors import EDGES, QUICK_SIZE, SIZE
from warp_gi.bench.suites.transfer.views import DENSE, TermView, metal, sky_missing, smooth_sky, true_sky

SMOOTH, REAL = "glossy: smooth sky", "glossy: real sky"
TARGETS = {0.7: 0.08, 0.6: 0.16, 0.5: 0.30}
"""Largest errors of order 5 by roughness, court."""
SIX_OVER_FIVE = 0.6
"""Most error of order 6, as a share of that of order 5, at roughness 0.6 and 0.5."""
RATIO_TARGETS = {0.5: 0.20, 0.4: 0.30}
"""Largest errors of the ratio form, dragon under the courtyard's sky."""
BASE = gi.RadianceTransfer(resolution=DENSE, bounces=0, glossy="transfer", traced_below=0.0, window=0.0)
WAYS: dict[str, dict[str, Any]] = {
    "ratio": {"glossy": "ratio"},
    "transfer": {"glossy": "transfer"},
    "transfer, window 0.005": {"glossy": "transfer", "window": 0.005},
}


def glossy_rows(quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return errors by roughness and order under a smooth sky, and of the ratio form under a real one."""
    rows = attempt({"table": SMOOTH}, partial(roughness_rows, quick, device))
    return rows + attempt({"table": REAL}, partial(real_rows, quick, device, gallery))


def roughness_rows(quick: bool, device: str) -> list[Row]:
    """Return errors in the court; the sky is the same for both, so no window is on it."""
    camera, rows = court_camera(QUICK_SIZE if quick else SIZE), list[Row]()
    size = 48 if quick else DENSE
    estimators = {order: replace(BASE, order=order, resolution=size) for order in (5, 6)}
    bakes = {order: gi.bake(court(1.0), one, device) for order, one in estimators.items()}
    for roughness in (0.6,) if quick else TARGETS:
        scene = metal(court(smooth_sky()), roughness)
        view = TermView(scene, camera, "environment", 64 if quick else 512, device)
        found: dict[int, Row] = {}
        for order, estimator in estimators.items():
            found[order] = view.errors(view.picture(estimator, 1, [bakes[order]]))
            over = found[order]["rel"] / max(found[5]["rel"], 1e-9)
            row: Row = {"table": SMOOTH, "case": "court", "roughness": roughness, "order": order, **found[order]}
            row |= {"target": TARGETS[roughness] if order == 5 else 0.0, "over order 5": over}
            rows.append(row | {"target over order 5": SIX_OVER_FIVE if order == 6 and roughness < 0.7 else 0.0})
    return rows


def real_rows(quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return errors of the dragon's lobe; in the quick form of a head's."""
    one = next(one for one in shapes.STAND_INS if one.name == ("TRM" if quick else "dragon"))
    if why := one.missing or ("" if quick else sky_missing("courtyard")):
        return [{"table": REAL, "case": one.name, "skipped": why}]
    scene, sky = one.build(one.quick if quick else one.size), true_sky("courtyard")
    base = gi.RadianceTransfer(bounces=0, resolution=96 if quick else 1024, traced_below=0.0, chart_seconds=0.0)
    bake = gi.bake(scene, base, device)
    rows, camera = list[Row](), one.camera(QUICK_SIZE if quick else SIZE)
    for roughness in (0.5,) if quick else RATIO_TARGETS:
        shiny = metal(scene, roughness)
        shiny.environment = sky
        view = TermView(shiny, camera, "environment", 64 if quick else 512, device, EDGES)
        mask, pictures = None, {}
        for way, settings in WAYS.items():
            frame = view.frame(replace(base, **settings), EDGES, [bake])
            pictures[way] = frame.numpy("environment").copy()
            if mask is None:
                thing = [k for k, node in enumerate(shiny.nodes) if node.name != "ground"]
                ids = frame.numpy("object_id")
                mask = (ids[..., None] == thing).any(axis=-1)
            row: Row = {"table": REAL, "case": one.name, "roughness": roughness, "way": way}
            row |= view.errors(pictures[way]) | {"thing rel": view.errors(pictures[way], mask)["rel"]}
            rows.append(row | {"target": RATIO_TARGETS[roughness] if way == "ratio" else 0.0})
        gallery.add(PictureSet(f"{one.name}: white metal of roughness {roughness}", view.reference, pictures))
    return rows
