"""Indirect light from probes beside the path tracer: errors and time of each mode, leaks, and what a bake takes."""

from __future__ import annotations

from typing import Any

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness.gallery import CLOSED, Gallery, PictureSet
from warp_gi.bench.harness.measure import Row, ratios, timed
from warp_gi.bench.harness.stages import Case, Stage, race
from warp_gi.bench.suites.probes.views import (
    CORNELL,
    GLOSSY_LIVING_ROOM,
    LIVING_ROOM,
    ROOM,
    SPONZA,
    ProbeView,
    counts_of,
    room_views,
    view_of,
)
from warp_gi.techniques.shared.lamps import lit_data

SPP = 4
"""Samples a pixel of the modes that trace rays."""
PATH_SPP = 16
"""Samples a pixel of the pictures that the path tracer's time and noise are measured with."""
QUICK_GRIDS = 1
"""Places whose light the quick form measures."""
RESOLUTION = 128
"""Texels along a side of a map, unless a table varies them."""
WAYS = {
    "irradiance": {"mode": "irradiance"},
    "hybrid": {"mode": "hybrid", "through": "probes"},
    "traced": {"mode": "traced", "through": "probes"},
    "traced, geometry": {"mode": "traced", "through": "geometry"},
}
"""Settings by name: the paper's modes, whose rays march through the probes, and one with rays through the scene."""
PAPER_CARD = "GeForce 1080"
PAPER_MS = (
    ("Cornell Box", "2 x 2 x 2", 2048, 0.358, 0.000),
    ("Cornell Box", "2 x 2 x 2", 256, 0.302, 0.000),
    ("Sponza (Statue)", "8 x 2 x 4", 512, 0.332, 0.151),
    ("Living Room", "4 x 4 x 4", 1024, 0.293, 4.401),
    ("Luxury Kitchen", "4 x 4 x 4", 1024, 0.358, 9.334),
    ("San Miguel", "8 x 2 x 8", 1024, 0.520, 47.170),
)
"""The paper's table 1: milliseconds at 1920x1080 for the Lambertian and the glossy term."""
PAPER_BAKE = "60 to 120 s"


# ---- leaks ----


def leak_rows(quick: bool, device: str) -> list[Row]:
    """Return rows of the dark room of two, with and without visibility, and of cylinders over probes."""
    size, spp = ((96, 64), 64) if quick else ((240, 160), 256)
    views = room_views(size, device, spp)
    rows: list[Row] = []
    for counts in ((4, 2, 2),) if quick else ((4, 2, 2), (8, 3, 4)):
        for weights, relocate in (("visibility", True), ("visibility", False), ("trilinear", False)):
            settings = {"counts": counts, "resolution": 128, "weights": weights, "relocate": relocate}
            rows.append(_leak_row(views, settings))
    view = view_of(Case("cylinders"), size, device, spp)
    for weights, relocate in (("visibility", True), ("visibility", False), ("trilinear", False)):
        stage = view.stage(1, mode="irradiance", counts=(3, 2, 3), weights=weights, relocate=relocate)
        row: Row = {"table": "cylinders over probes", "weights": weights, "relocate": relocate}
        rows.append(row | {"covered": covered(stage)} | darkened(view, stage) | view.quality(stage.picture))
    return rows


def _leak_row(views: dict[str, ProbeView], settings: dict[str, Any]) -> Row:
    means = {name: view.stage(1, mode="irradiance", **settings) for name, view in views.items()}
    lit, dark = (float(means[name].picture.mean(dtype=np.float64)) for name in ("lit", "dark"))
    paths = float(views["lit"].reference.mean(dtype=np.float64))
    row: Row = {"table": "leaks: two_rooms", "probes": counts_of(means["lit"]), "resolution": settings["resolution"]}
    row |= {"weights": settings["weights"], "relocate": settings["relocate"], "covered": covered(means["lit"])}
    return row | {"dark / lit": dark / lit, "target": 0.01, "lit / paths": lit / paths}


def covered(stage: Stage) -> int:
    """Return the number of probes that are inside of something."""
    return int((stage.state.field.states.numpy() != 0).sum())


def darkened(view: ProbeView, stage: Stage) -> Row:
    """Return the share of what is seen whose indirect light is less than half, and more than twice, what it should be.

    In blocks of 8 x 8 pixels, in which the path tracer's noise is small.
    """
    ours, paths = (_blocks(image) for image in (stage.picture, view.reference))
    seen = paths > 0.05 * paths.mean()
    return {
        "below half": float((ours < 0.5 * paths)[seen].mean()),
        "above twice": float((ours > 2 * paths)[seen].mean()),
    }


def _blocks(image: np.ndarray, size: int = 8) -> np.ndarray:
    height, width = (n // size * size for n in image.shape[:2])
    return image[:height, :width].reshape(height // size, size, width // size, size, 3).mean(axis=(1, 3, 4))


# ---- modes ----


def light_rows(quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return errors and times of the modes by place and grid, what the path tracer needs for the same, and table 1."""
    grids: list[tuple[Case, list[dict[str, Any]]]] = [
        (CORNELL, _grids((4, 4, 4), (8, 8, 8))),
        (ROOM, _grids((4, 4, 4), (8, 4, 8))),
        (SPONZA, _grids((8, 4, 4), (12, 6, 6))),
        (GLOSSY_LIVING_ROOM, _grids((8, 4, 8))),
    ]
    rows: list[Row] = []
    for place, settings in grids[:QUICK_GRIDS] if quick else grids:
        if place.missing:
            rows.append({"table": "indirect light", "case": place.name, "skipped": place.missing})
            continue
        view = view_of(place, (80, 45) if quick else (240, 135), device, 32 if quick else 256)
        rows += mode_rows(place, view, settings[:1] if quick else settings, 1 if quick else 3, gallery)
    for name, counts, resolution, lambertian, glossy in PAPER_MS:
        row = {
            "table": f"indirect light: paper, {PAPER_CARD}",
            "case": name,
            "probes": counts,
            "resolution": resolution,
        }
        rows.append(row | {"Lambertian ms": lambertian, "glossy ms": glossy})
    return rows


def _grids(*counts: tuple[int, int, int]) -> list[dict[str, Any]]:
    return [{"counts": number, "resolution": RESOLUTION} for number in counts]


def mode_rows(
    place: Case, view: ProbeView, grids: list[dict[str, Any]], repetitions: int, gallery: Gallery = CLOSED
) -> list[Row]:
    """Return rows of one place: of each mode and grid, beside the path tracer at equal time and equal error.

    Its error falls with the root of its samples and it takes as long for each of them, so both follow from its noise
    and its time at ``PATH_SPP``. Nothing is faster than one sample a pixel.
    """
    paths = view.paths(PATH_SPP)
    noise = view.mean_squared(paths.picture) * PATH_SPP
    rows: list[Row] = []
    for settings in grids:
        stages: dict[str, Stage] = {"paths": paths}
        for name, way in WAYS.items():
            stages[name] = view.stage(1 if name == "irradiance" else SPP, **settings, **way)
        taken = race(stages, repetitions, view.device)
        one_sample = taken["paths"].cost / PATH_SPP
        for name, way in WAYS.items():
            stage, seconds = stages[name], taken[name].cost
            quality = view.quality(stage.picture)
            needed = max(noise / max(quality["RMSE"] ** 2, 1e-30), 1.0)
            row: Row = {"table": "indirect light", "case": place.name, "probes": counts_of(stage)}
            row |= {"mode": way["mode"], "through": way.get("through", "none"), "spp": stage.spp} | quality
            row |= {"ns a pixel": seconds / np.prod(view.camera.resolution) * 1e9} | taken[name].row()
            row["paths spp for this RMSE"] = needed
            ratio = ratios("faster, {}", taken["paths"], taken[name])
            row |= {key: value * needed / PATH_SPP for key, value in ratio.items()}
            row["target"] = place.target if name == "irradiance" else 0.0
            samples = max(seconds / one_sample, 1.0)
            rows.append(row | {"paths RMSE in this time": float((noise / samples) ** 0.5)})
    pictures = {name: stage.picture for name, stage in stages.items() if name != "paths"}
    case = f"{place.name}: indirect light, {counts_of(stages['irradiance'])} probes"
    gallery.add(PictureSet(case, view.reference, pictures))
    return rows


# ---- bakes ----


def bake_rows(quick: bool, device: str) -> list[Row]:
    """Return seconds and memory of bakes, passes until light had settled, and milliseconds to refresh a probe."""
    rows: list[Row] = []
    for place in (CORNELL,) if quick else (CORNELL, LIVING_ROOM, SPONZA):
        if place.missing:
            rows.append({"table": "bakes", "case": place.name, "skipped": place.missing})
            continue
        view = view_of(place, (32, 18), device, 1)
        sizes = (64,) if quick else (256, 1024)
        for resolution in sizes:
            if resolution < 1024 or place is LIVING_ROOM:
                rows.append(bake_row(place, view, resolution))
    return [*rows, {"table": f"bakes: paper, {PAPER_CARD}", "all its scenes": PAPER_BAKE}]


def bake_row(place: Case, view: ProbeView, resolution: int) -> Row:
    """Return the row of one bake with 4 x 4 x 4 probes."""
    settings = gi.LightFieldProbes(counts=(4, 4, 4), resolution=resolution)
    bake, (wall, cpu) = view.bake(settings)
    view.bakes.clear()
    state = settings.start(view.scene, view.device, bake)
    changes = state.changes
    data, some = lit_data(view.scene, state.device), np.arange(8)
    state.refresh(view.scene, data, some)
    refreshes = [timed(lambda: state.refresh(view.scene, data, some))[1] for _ in range(5)]
    update_wall, update_cpu = np.median(refreshes, axis=0) / len(some)
    row: Row = {"table": "bakes", "case": place.name, "probes": "4 x 4 x 4", "resolution": resolution}
    row |= {"wall s": wall, "cpu s": cpu, "million rays": bake.counts["rays"] / 1e6, "MB": state.nbytes / 1e6}
    row |= {"passes": len(changes), "last change": changes[-1]}
    return row | {"update ms a probe, wall": update_wall * 1e3, "update ms a probe, cpu": update_cpu * 1e3}
