"""Errors of transfer against the path tracer: by resolution and bounce under a smooth sky, and under real ones."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness.court import court, court_camera
from warp_gi.bench.harness.gallery import CLOSED, Gallery, PictureSet
from warp_gi.bench.harness.measure import Row, attempt
from warp_gi.bench.harness.places import PLACES
from warp_gi.bench.suites.transfer.views import (
    DENSE,
    SEED,
    TermView,
    sky_missing,
    smooth_sky,
    true_sky,
    under,
)
from warp_gi.techniques.radiance_transfer.textures import transfer_textures
from warp_gi.techniques.shared.atlas.atlas import Atlas

RESOLUTION, BOUNCES = "errors: resolution", "errors: bounces"
OTHER, SKIES = "errors: another smooth sky", "errors: real skies"
RESOLUTIONS, QUICK_RESOLUTIONS = (48, 112, DENSE), (48,)
"""About 5, 12 and 27 texels a metre of the court's floor."""
BOUNCE_COUNTS, QUICK_BOUNCE_COUNTS = (1, 2, 3, 4, 6, 8, 12), (1, 8)
SKY_TARGETS = {"city": 0.06, "courtyard": 0.12, "forest": 0.0, "interior": 0.0, "night": 0.0, "studio": 0.0}
"""Largest errors wanted under photographed skies; 0 is none."""
MOST_ERROR, MOST_BIAS, MOST_OTHER_BIAS = 0.05, 0.5, 2.0
"""Largest error at 27 texels a metre, and biases in percent: of all bounces, and under another sky."""
SIZE, QUICK_SIZE = (180, 120), (72, 48)
EDGES = 64
"""Camera samples where the sun's shadows are soft, by one ray each."""
INDIRECT = gi.RadianceTransfer(term="indirect", resolution=DENSE)


def error_rows(quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return the rows of all tables."""
    rows: list[Row] = []
    reflected = court_view("indirect", smooth_sky(), quick, device)
    for name, part in {RESOLUTION: resolution_rows, BOUNCES: bounce_rows, OTHER: other_rows}.items():
        rows += attempt({"table": name}, partial(part, reflected, quick, device))
    rows += attempt({"table": SKIES}, partial(sky_rows, quick, device, gallery))
    return rows


def court_view(term: str, sky: gi.Environment, quick: bool, device: str, camera_samples: int = 1) -> TermView:
    """Return the view of the Lambert court under a sky."""
    spp = {"environment": 1024, "indirect": 256}[term]
    if camera_samples > 1:
        spp = 512
    size = QUICK_SIZE if quick else SIZE
    return TermView(court(sky), court_camera(size), term, 64 if quick else spp, device, camera_samples)


def texels_a_metre(scene: gi.Scene, atlas: Atlas, name: str) -> float:
    """Return the density of texels on a node's surfaces."""
    data = scene.data("cpu")
    faces = np.flatnonzero(data.geometry.objects.numpy() == [node.name for node in scene.nodes].index(name))
    points = data.geometry.points.numpy()[data.geometry.indices.numpy().reshape(-1, 3)[faces]]
    area = np.linalg.norm(np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]), axis=1).sum()
    edges = atlas.corners[faces, 1:] - atlas.corners[faces, :1]
    texels = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]).sum()
    return float(np.sqrt(texels / area))


def resolution_rows(reflected: TermView, quick: bool, device: str) -> list[Row]:
    """Return errors of both terms by texels a metre; ``reflected`` is the view of the court's indirect light."""
    sky, rows = smooth_sky(), list[Row]()
    views = {"environment": court_view("environment", sky, quick, device), "indirect": reflected}
    for resolution in QUICK_RESOLUTIONS if quick else RESOLUTIONS:
        bake = gi.bake(court(sky), replace(INDIRECT, resolution=resolution), device)
        density = texels_a_metre(court(sky), transfer_textures(bake).atlas, "floor")
        for term, view in views.items():
            estimator = replace(INDIRECT, term=term, resolution=resolution)
            row: Row = {"table": RESOLUTION, "term": term, "resolution": resolution, "texels a metre": density}
            row |= view.errors(view.picture(estimator, 1, [bake]))
            is_dense = resolution == DENSE and term == "environment"
            rows.append(row | {"target": MOST_ERROR if is_dense else 0.0})
    return sorted(rows, key=lambda row: row["term"])


def bounce_rows(view: TermView, quick: bool, device: str) -> list[Row]:
    """Return errors of reflected light by the number of bounces, and of as many as the defaults take."""
    rows: list[Row] = []
    for bounces in (*(QUICK_BOUNCE_COUNTS if quick else BOUNCE_COUNTS), 0):
        estimator = replace(INDIRECT, bounces=bounces, tolerance=0.0) if bounces else INDIRECT
        bake = gi.bake(view.scene, estimator, device)
        row: Row = {"table": BOUNCES, "bounces": str(bounces) if bounces else f"default, {bake.counts['bounces']}"}
        row |= view.errors(view.picture(estimator, 1, [bake])) | {"last share": bake.counts["last_share"]}
        rows.append(row | {"target bias, %": MOST_BIAS if not bounces else 0.0})
    return rows


def other_rows(reflected: TermView, quick: bool, device: str) -> list[Row]:
    """Return errors of one bake, which holds no light, under several smooth skies; ``reflected`` is of the first."""
    rows: list[Row] = []
    bake = gi.bake(court(1.0), INDIRECT, device)
    for name in ("courtyard",) if quick else ("courtyard", "forest", "city"):
        if not quick and (why := sky_missing(name)):
            rows.append({"table": OTHER, "sky": name, "skipped": why})
            continue
        view = reflected if name == "courtyard" else court_view("indirect", smooth_sky(name), quick, device)
        row: Row = {"table": OTHER, "sky": name} | view.errors(view.picture(INDIRECT, 1, [bake]))
        rows.append(row | {"target bias, %": MOST_OTHER_BIAS})
    return rows


def sky_rows(quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return errors of the direct light of real skies: suns apart and not, and of as much tracing as pipelines do."""
    rows: list[Row] = []
    base = gi.RadianceTransfer(resolution=DENSE, bounces=0)
    bake = gi.bake(court(1.0), base, device)
    for name in ("courtyard",) if quick else SKY_TARGETS:
        if not quick and (why := sky_missing(name)):
            rows.append({"table": SKIES, "case": "court", "sky": name, "skipped": why})
            continue
        view = court_view("environment", true_sky(name), quick, device, EDGES)
        rows += one_sky_rows("court", name, view, base, bake, gallery)
    place = PLACES["living_room_white"]
    if quick:
        return rows
    if why := place.missing or sky_missing("courtyard"):
        return [*rows, {"table": SKIES, "case": "living room", "sky": "courtyard", "skipped": why}]
    scene = under(place.scene(), true_sky("courtyard"))
    base = gi.RadianceTransfer(bounces=0)
    view = TermView(scene, place.camera().at_resolution(*SIZE), "environment", 512, device, EDGES)
    return rows + one_sky_rows("living room", "courtyard", view, base, gi.bake(scene, base, device), gallery)


def one_sky_rows(
    case: str, sky: str, view: TermView, base: gi.RadianceTransfer, bake: gi.Bake, gallery: Gallery
) -> list[Row]:
    """Return the rows of one sky; the share is of its light that suns hold."""
    suns = {"sun apart": base.sun, "sun apart from 5 means": 5.0, "no sun apart": 0.0}
    ways: dict[str, tuple[Any, int]] = {way: (replace(base, sun=sun), EDGES) for way, sun in suns.items()}
    for spp in (16, 64):
        ways[f"traced, {spp} samples"] = (gi.TracedEnvironment(), spp)
    environment = view.scene.environment
    share = environment.split_sun(base.sun).share if environment is not None else 0.0
    rows, pictures = [], {}
    for way, (estimator, spp) in ways.items():
        used = view if isinstance(estimator, gi.RadianceTransfer) else replace(view, camera_samples=4)
        bakes = [bake] if used is view else []
        pictures[way] = used.picture(estimator, spp, bakes, SEED)
        row: Row = {"table": SKIES, "case": case, "sky": sky, "way": way, "share of suns": share}
        row |= view.errors(pictures[way])
        is_wanted = case == "court" and way == "sun apart"
        rows.append(row | {"target": SKY_TARGETS.get(sky, 0.0) if is_wanted else 0.0})
    gallery.add(PictureSet(f"{case}: direct light of the sky {sky!r}", view.reference, pictures))
    return rows
