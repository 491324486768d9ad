"""Bakes: rays of a slot, uniform and adaptive, what they cost and how exact they are; a whole bake, and its charts."""

from __future__ import annotations

import os
import resource
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

import warp_gi as gi
from warp_gi import launch
from warp_gi.bench.harness.court import court
from warp_gi.bench.harness.measure import Row, attempt, timed
from warp_gi.bench.harness.places import PLACES
from warp_gi.techniques.radiance_transfer.rays import trace_slots, transfer_work
from warp_gi.techniques.shared.atlas.atlas import Atlas
from warp_gi.techniques.shared.atlas.build import make_atlas

UNIFORM, ADAPTIVE = "bakes: 256 rays a slot", "bakes: adaptive rays"
WHOLE, CHARTS = "bakes: whole, charts known", "bakes: charts"
PLACES_BAKED = ("sponza", "living_room_white")
SLOTS, BLOCK = 1 << 18, 1 << 13
"""Slots whose rays are timed, and how many of them lie together, as they do in a bake."""
SCALED = 1 << 20
MOST_CPU, MOST_BAKE_CPU = 60.0, 90.0
MOST_RAYS, MOST_ERROR = 200.0, 0.02
REFERENCE_RAYS = 8192


def bake_rows(quick: bool, device: str) -> list[Row]:
    """Return rows of rays, errors and whole bakes by scene."""
    rows: list[Row] = []
    for key in ("sphere_row",) if quick else PLACES_BAKED:
        place = PLACES[key]
        said = {"table": UNIFORM, "case": place.title}
        if place.missing:
            rows.append(said | {"skipped": place.missing})
            continue
        rows += attempt(said, partial(place_rows, place.title, place.scene(), quick, device))
    return rows


def place_rows(name: str, scene: gi.Scene, quick: bool, device: str) -> list[Row]:
    """Return the rows of one scene."""
    estimator = gi.RadianceTransfer(resolution=128) if quick else gi.RadianceTransfer()
    atlas = make_atlas(scene, estimator.transfer_settings, device)
    rows = [ray_row(name, scene, atlas, estimator, 1 << 11 if quick else SLOTS, device)]
    rows += error_rows(name, scene, atlas, estimator, *((300, 1024) if quick else (3000, REFERENCE_RAYS)), device)
    gi.bake(court(1.0), replace(estimator, resolution=32), device)  # compiles
    return [*rows, whole_row(name, scene, estimator, device), chart_row(name, scene, estimator, device)]


def ray_row(name: str, scene: gi.Scene, atlas: Atlas, estimator: gi.RadianceTransfer, count: int, device: str) -> Row:
    """Return CPU seconds of 256 rays a slot, for blocks of slots all over the atlas, scaled to 2^20 slots."""
    starts = np.linspace(0, max(atlas.count - BLOCK, 0), max(count // BLOCK, 1)).astype(int)
    chosen = np.unique(np.concatenate([np.arange(start, min(start + BLOCK, atlas.count)) for start in starts]))
    settings = replace(estimator, first_rays=256, rays=256, bounce_rays=4).transfer_settings
    some = of_slots(atlas, chosen)
    trace_slots(transfer_work(scene, of_slots(atlas, chosen[:64]), settings, launch.get_device(device), 0))
    work = transfer_work(scene, some, settings, launch.get_device(device), 0)
    traced, (wall, cpu) = timed(lambda: trace_slots(work))
    rays = int(traced.rays.sum(dtype=np.int64))
    row: Row = {"table": UNIFORM, "case": name, "triangles": scene.triangle_count, "slots": atlas.count}
    row |= {"slots traced": len(chosen), "rays": rays, "wall s": wall, "cpu s": cpu}
    row |= {"ns a ray": cpu / rays * 1e9, "cpu s for 2^20 slots": cpu / len(chosen) * SCALED}
    return row | {"target cpu s": MOST_CPU}


def of_slots(atlas: Atlas, some: np.ndarray) -> Atlas:
    """Return an atlas of some slots, of which rays may be traced."""
    names = ("slot_faces", "slot_points", "slot_sides")
    return replace(atlas, **{name: getattr(atlas, name)[some] for name in names})


def error_rows(
    name: str,
    scene: gi.Scene,
    atlas: Atlas,
    estimator: gi.RadianceTransfer,
    count: int,
    reference_rays: int,
    device: str,
) -> list[Row]:
    """Return rays a slot and the error of T against many rays, over the size of T, of slots chosen at random."""
    rng = np.random.default_rng(0)
    some = of_slots(atlas, np.sort(rng.choice(atlas.count, min(count, atlas.count), replace=False)))

    def traced(seed: int, **settings: Any) -> tuple[np.ndarray, float]:
        wanted = replace(estimator.transfer_settings, **settings)  # more rays than the estimator would take
        found = trace_slots(transfer_work(scene, some, wanted, launch.get_device(device), seed))
        return found.transfer.astype(np.float64), float(found.rays.mean())

    reference, _ = traced(11, first_rays=reference_rays, rays=reference_rays)
    rows: list[Row] = []
    ways: dict[str, dict[str, Any]] = {"defaults": {}, "64 then 512": {"first_rays": 64, "rays": 512}}
    ways["256 each"] = {"first_rays": 256, "rays": 256}
    for way, settings in ways.items():
        found, rays = traced(0, **settings)
        error = float(np.sqrt(((found - reference) ** 2).sum() / (reference**2).sum()))
        row: Row = {"table": ADAPTIVE, "case": name, "rays": way, "slots traced": some.count, "rays a slot": rays}
        rows.append(row | {"rel error of T": error, "target rays": MOST_RAYS, "target error": MOST_ERROR})
    return rows


def whole_row(name: str, scene: gi.Scene, estimator: gi.RadianceTransfer, device: str) -> Row:
    """Return seconds of a bake with all kernels compiled and charts known, by stage."""
    bake, (wall, cpu) = timed(lambda: gi.bake(scene, estimator, device))
    row: Row = {"table": WHOLE, "case": name, "resolution": estimator.resolution, "slots": bake.counts["slots"]}
    row |= {"rays a slot": bake.counts["rays"] / bake.counts["slots"], "wall s": wall, "cpu s": cpu}
    row |= {f"{stage} cpu s": bake.counts[f"{stage}_cpu_seconds"] for stage in ("charts", "rays", "bounces")}
    row |= {"target cpu s": MOST_BAKE_CPU, "bounces": bake.counts["bounces"]}
    return row | {"last share": bake.counts["last_share"], "file MB": _file_mb(bake)}


def _file_mb(bake: gi.Bake) -> float:
    with tempfile.TemporaryDirectory() as folder:
        return bake.save(os.path.join(folder, "bake.safetensors")).stat().st_size / 1e6


def chart_row(name: str, scene: gi.Scene, estimator: gi.RadianceTransfer, device: str) -> Row:
    """Return seconds of an atlas whose charts nobody knows; their CPU seconds are those of other processes."""
    with tempfile.TemporaryDirectory() as folder, cache_in(folder):
        before, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        atlas = make_atlas(scene, replace(estimator, chart_seconds=0.0).transfer_settings, device)
        wall, after = time.perf_counter() - wall, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    row: Row = {"table": CHARTS, "case": name, "triangles": scene.triangle_count, "charts": int(atlas.charts.max()) + 1}
    texels = int((atlas.pages[:, 1] * atlas.pages[:, 2]).sum())
    covered = int((atlas.slots[0] >= 0).sum())
    row |= {"covered": covered / texels, "backs": (atlas.count - covered) / covered}
    return row | {"wall s": wall, "cpu s": cpu}


@contextmanager
def cache_in(folder: str) -> Iterator[None]:
    """Let charts be kept in a folder for a while."""
    before = os.environ.get("XDG_CACHE_HOME")
    os.environ["XDG_CACHE_HOME"] = folder
    try:
        yield
    finally:
        if before is None:
            del os.environ["XDG_CACHE_HOME"]
        else:
            os.environ["XDG_CACHE_HOME"] = before
