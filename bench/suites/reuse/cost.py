"""What sample reuse takes: preprocessing pass by pass (Fig. 11), slower paths (Fig. 12), and memory."""

from __future__ import annotations

from typing import Any

import warp as wp

import warp_gi as gi
from warp_gi.bench.harness.measure import Row
from warp_gi.bench.harness.stages import Case
from warp_gi.bench.suites.reuse.views import MINE, WAREHOUSE, FrameRun, Truth, run_sequences

CARD = "RTX 2080 Ti, 1920x1080"
TARGET_SHARE = 0.08
"""Share of a frame that all preprocessing may take."""
PAPER_PASSES = (
    ("octree: mark, adapt, augment, allocate", 0.2),
    ("cache: deduplicate", 0.2),
    ("cache: merge neighbours and buckets", 0.2),
    ("quadtrees: accumulate and adapt", 0.5),
    ("all", 1.2),
)
PAPER_PATHS = (("LH", 11.2), ("SLL", 15.1), ("VLC", 15.1), ("VLC + CDQ", 17.1))
BASELINE = "LightHierarchy + BsdfPaths"
BOTH = "VisibilityLightCache + GuidedPaths"
CACHED, GUIDED = gi.VisibilityLightCache(rests=False), gi.GuidedPaths(rests=False)
"""As in the paper, in every frame."""


def pipelines() -> dict[str, gi.Pipeline]:
    """Return the pipelines that the paper's figure 12 compares, by name."""
    choices = {
        BASELINE: (gi.LightHierarchy(), gi.BsdfPaths()),
        "LightHierarchy + GuidedPaths": (gi.LightHierarchy(), GUIDED),
        "VisibilityLightCache + BsdfPaths": (CACHED, gi.BsdfPaths()),
        BOTH: (CACHED, GUIDED),
    }
    return {
        name: gi.Pipeline(emitters=emitters, indirect=indirect, spp=1, camera_samples=1)
        for name, (emitters, indirect) in choices.items()
    }


def cost_rows(quick: bool, device: str) -> list[Row]:
    """Return passes, overheads and memory of the warehouse and the mine, and the paper's."""
    size, frames, first = ((160, 90), 10, 5) if quick else ((640, 360), 14, 7)
    rows: list[Row] = []
    for place in (WAREHOUSE,) if quick else (WAREHOUSE, MINE):
        rows += place_cost(place, size, frames, first, device)
    for name, milliseconds in PAPER_PASSES:
        rows.append({"table": f"passes: paper, {CARD}", "pass": name, "ms": milliseconds})
    for name, milliseconds in PAPER_PATHS:
        row: Row = {"table": f"path tracing: paper, {CARD}", "combination": name, "ms": milliseconds}
        rows.append(row | {"ms / LH": milliseconds / PAPER_PATHS[0][1]})
    return rows


def place_cost(place: Case, size: tuple[int, int], frames: int, first: int, device: str) -> list[Row]:
    """Return the rows of one place, medians of the frames from ``first`` on."""
    scene, camera = place.scene(), place.camera().at_resolution(*size)
    truth = Truth(scene, camera, device, 1)
    runs = run_sequences(scene, camera, pipelines(), frames, lambda index: truth, device)
    rows = pass_rows(place.name, runs[BOTH], first)
    base = runs[BASELINE].milliseconds("paths", first)
    for name, run in runs.items():
        row: Row = {"table": "path tracing", "case": place.name, "combination": name}
        row |= {"paths ms": run.milliseconds("paths", first), "frame ms": run.milliseconds("", first)}
        row |= {"paths / baseline": row["paths ms"] / max(base, 1e-9)}
        rows.append(row | {"frame cost / baseline": run.cost(first, device) / runs[BASELINE].cost(first, device)})
    return rows + memory_rows(place.name, runs[BOTH])


def pass_rows(case: str, run: FrameRun, first: int) -> list[Row]:
    """Return a row for each pass other than tracing, and one for all of them together."""
    frame = run.milliseconds("", first)
    passes = {
        name: ms for name, ms in run.stage_milliseconds(first).items() if name.startswith(("preprocess", "learn"))
    }
    rows: list[Row] = []
    for name, ms in {**passes, "all": sum(passes.values())}.items():
        row: Row = {"table": "passes", "case": case, "pass": name, "ms": ms, "share of the frame": ms / frame}
        rows.append(row | {"target": TARGET_SHARE if name == "all" else ""})
    return rows


def memory_rows(case: str, run: FrameRun) -> list[Row]:
    """Return bytes of what is kept from frame to frame, in all and for each leaf."""
    state = run.scheduler.state
    parts: dict[str, Any] = {"octree": state("octree"), "quadtrees": state("indirect")}
    cache = state("emitters")
    if cache is not None:
        parts |= {"cache: tables": cache.tables, "cache: lists": cache.known, "cache: lights": cache.shapes}
    parts["samples"] = run.frame.paths.regions.data.records
    leaves, sizes = state("octree").leaf_count, {name: nbytes(part) for name, part in parts.items()}
    rows: list[Row] = []
    for name, size in {**sizes, "all": sum(sizes.values())}.items():
        a_leaf = "" if name in ("samples", "cache: lights", "all") else size / leaves
        row: Row = {"table": "memory", "case": case, "part": name, "leaves": leaves, "KB": size / 1e3}
        rows.append(row | {"bytes a leaf": a_leaf})
    return rows


def nbytes(what: Any) -> int:
    """Return the bytes of all arrays in a state, in kernel structs, and in what these hold."""
    if isinstance(what, wp.array):
        return what.size * wp.types.type_size_in_bytes(what.dtype)
    fields = getattr(type(what), "__dataclass_fields__", None) or getattr(getattr(what, "_cls", None), "vars", {})
    return sum(nbytes(getattr(what, name)) for name in fields)
