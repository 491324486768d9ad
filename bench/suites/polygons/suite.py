"""Visibility polygons: size and time of bakes, evaluators as skies turn, frames beside traced ones.

Lambert materials. What the paper measured stands in columns of its own.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import warp as wp

import warp_gi as gi
from warp_gi import launch
from warp_gi.bench.harness.gallery import CLOSED, Gallery, run_parts
from warp_gi.bench.harness.measure import Row, attempt, clocked
from warp_gi.bench.harness.stages import timed_bake
from warp_gi.bench.suites.polygons.frames import frame_rows
from warp_gi.bench.suites.polygons.shapes import STAND_INS, StandIn, bumpy
from warp_gi.bench.suites.transfer.views import sky_missing, true_sky
from warp_gi.kernels import visibility_polygons_sky as kernels
from warp_gi.kernels import visibility_polygons_vsat as vsat_kernels
from warp_gi.techniques.visibility_polygons.sky import EVALUATORS, Evaluator, polygon_sky, sky_tables

TOLERANCE = gi.VisibilityPolygons().tolerance
POLYGONS, QUICK_POLYGONS = 64, 8
TURNS, QUICK_TURNS = 72, 4
SKIES, QUICK_SKIES = ("city", "forest", "courtyard"), ("city",)
WHITE_POLYGONS, QUICK_WHITE_POLYGONS = 3000, 100
EVALUATED: dict[str, tuple[Evaluator, float]] = {
    "adaptive": ("adaptive", 0.0),
    "exact": ("exact", 0.0),
    "vsat, 5.8": ("vsat", 5.8),
    "vsat, 163": ("vsat", 163.0),
}
"""Evaluators by their names in rows; the paper's has the slope of its sigmoid, its own and that of the least errors."""
LISTS = ("corner_sets", "states", "list_starts", "list_contours", "list_first", "step_starts", "steps", "errors")
"""Arrays of a bake that are of triangles; the others are of vertices."""


def run(quick: bool = False, device: str = "cpu", parts: Sequence[str] = (), gallery: Gallery = CLOSED) -> list[Row]:
    """Return rows of all tables; ``quick`` takes coarse maps, few polygons, turns, pixels and samples."""
    return run_parts(PARTS, parts, quick, device, gallery)


# ---- bakes ----


def bake_rows(quick: bool, device: str) -> list[Row]:
    """Return the paper's table 1, with stand-ins for its meshes."""
    rows: list[Row] = []
    for one in STAND_INS[:1] if quick else STAND_INS:
        rows += attempt({"table": "bakes", "shape": one.name}, partial(bake_row, one, quick, device))
    return rows


def bake_row(one: StandIn, quick: bool, device: str) -> list[Row]:
    """Return the row of one mesh."""
    meshes = one.build()
    scene = gi.Scene([gi.Node(mesh.name, [mesh]) for mesh in meshes])
    bake, (wall, cpu) = timed_bake(scene, gi.VisibilityPolygons(resolution=16 if quick else 64), device)
    counts, arrays = bake.counts, bake.arrays
    lists = sum(arrays[name].nbytes for name in LISTS)
    visibility = sum(array.nbytes for array in arrays.values()) - lists
    row: Row = {"table": "bakes", "shape": one.name, "wall s": wall, "cpu s": cpu}
    row |= {"vertices": sum(len(mesh.points) for mesh in meshes)}
    row |= {"triangles": sum(len(mesh.indices) for mesh in meshes), "sets": counts["sets"]}
    row |= {"points a set": counts["points"] / counts["sets"], "bytes a set": visibility / counts["sets"]}
    row |= {"bytes a side": lists / counts["sides"], "visibility MB": visibility / 1e6, "lists MB": lists / 1e6}
    row |= {name: counts[name] / counts["sides"] for name in ("traced", "flagged")}
    row |= {f"{name} cpu s": counts[f"{name}_cpu_seconds"] for name in ("contours", "correspondence", "check")}
    row |= {"paper vertices": one.paper_vertices}
    row |= dict(zip(("paper visibility MB", "paper lists MB"), one.paper_mb, strict=True))
    return [row | dict(zip(("paper visibility s", "paper correspondence s"), one.paper_s, strict=True))]


# ---- evaluators ----


def evaluator_rows(quick: bool, device: str) -> list[Row]:
    """Return errors and times of evaluators over turns of real skies, and under a white sky against a closed form."""
    target = launch.get_device(device)
    polygons, normals = seen_polygons(QUICK_POLYGONS if quick else POLYGONS, quick, device)
    rows: list[Row] = []
    for name in QUICK_SKIES if quick else SKIES:
        said: Row = {"table": "evaluators", "sky": name}
        if sky_missing(name) and not quick:
            rows.append({**said, "skipped": sky_missing(name)})
            continue
        turns = np.arange(QUICK_TURNS if quick else TURNS) * (360.0 / (QUICK_TURNS if quick else TURNS))
        rows += attempt(said, partial(sweep_rows, name, polygons, normals, turns, target))
    return rows + white_rows(QUICK_WHITE_POLYGONS if quick else WHITE_POLYGONS, target)


def seen_polygons(count: int, quick: bool, device: str) -> tuple[list[list[np.ndarray]], np.ndarray]:
    """Return what vertices of a closed object see, contours [point, 3] of directions, and their normals [count, 3]."""
    mesh = bumpy(10, 16) if quick else bumpy()
    arrays = gi.bake(gi.Scene([gi.Node("bumpy", [mesh])]), gi.VisibilityPolygons(), device).arrays
    contours, points = arrays["contour_starts"], arrays["point_starts"]
    seeing = np.flatnonzero(np.diff(contours))
    chosen = seeing[np.linspace(0, len(seeing) - 1, count).astype(int)]
    polygons = []
    for one in chosen:
        found = [arrays["points"][points[k] : points[k + 1], :3] for k in range(contours[one], contours[one + 1])]
        polygons.append([d / np.linalg.norm(d, axis=1, keepdims=True) for d in found])
    return polygons, arrays["normals"][chosen]


def sweep_rows(
    name: str, polygons: list[list[np.ndarray]], normals: np.ndarray, turns: np.ndarray, device: wp.Device
) -> list[Row]:
    """Return a row for each evaluator, with errors in percent of the sky's mean irradiance against "exact"."""
    sky = true_sky(name)
    mean = np.pi * float(sky.mean_radiance.mean())
    light: dict[str, list[np.ndarray]] = {one: [] for one in EVALUATED}
    seconds: dict[str, list[float]] = {one: [] for one in EVALUATED}
    for turn in turns:
        for one, method in EVALUATED.items():
            found, cost = integrated(sky.rotated(float(turn)), *method, polygons, normals, device)
            light[one].append(found.mean(axis=1))
            seconds[one].append(cost)
    rows: list[Row] = []
    for one, (evaluator, _) in EVALUATED.items():
        row: Row = {"table": "evaluators", "sky": name, "evaluator": one, "polygons": len(polygons)}
        row |= {"turns": len(turns), "us a polygon": 1e6 * float(np.median(seconds[one])) / len(polygons)}
        begun = time.process_time()
        assert sky.pixels is not None
        sky_tables(sky.pixels, evaluator)
        row["tables cpu s"] = time.process_time() - begun
        if one != "exact":
            row |= spread_of(100 * (np.array(light[one]) - np.array(light["exact"])) / mean)
        rows.append(row)
    return rows


def spread_of(error: np.ndarray) -> dict[str, Any]:
    """Return root mean square, 99th percentile and maximum of errors."""
    size = np.abs(error)
    return {
        "rms %": float(np.sqrt(np.mean(size**2))),
        "p99 %": float(np.quantile(size, 0.99)),
        "max %": float(size.max()),
    }


def integrated(
    sky: gi.Environment,
    evaluator: Evaluator,
    slope: float,
    polygons: list[list[np.ndarray]],
    normals: np.ndarray,
    device: wp.Device,
) -> tuple[np.ndarray, float]:
    """Return irradiance through polygons of directions in world space, float64 [polygon, 3], and its seconds."""
    tables = polygon_sky(sky, evaluator, TOLERANCE, device)
    turn = np.array(tables.sky_from_world, np.float64).reshape(3, 3)
    plain = kernels.PlainPolygons()
    contours = [contour for polygon in polygons for contour in polygon]
    for name, parts in (("starts", polygons), ("contour_starts", contours)):
        ends = np.cumsum([0, *(len(part) for part in parts)]).astype(np.int32)
        setattr(plain, name, launch.on_device(ends, wp.int32, device))
    plain.points = launch.on_device((np.concatenate(contours) @ turn.T).astype(np.float32), wp.vec3, device)
    plain.normals = launch.on_device((normals @ turn.T).astype(np.float32), wp.vec3, device)
    plain.light = wp.zeros(len(polygons), dtype=wp.vec3, device=device)
    kernel, inputs = kernels.integrate_polygons, [tables, plain]
    if evaluator == "vsat":
        kernel, inputs = vsat_kernels.integrate_vsat, [tables, slope, plain]
    _, (_, cpu), on_device = clocked(lambda: launch.launch(kernel, len(polygons), inputs, device), device.alias)
    return plain.light.numpy().astype(np.float64), cpu if on_device is None else on_device


def white_rows(count: int, device: wp.Device) -> list[Row]:
    """Return errors of polygons about poles and of walls under a map of 1, where light has a closed form (Lambert)."""
    rows: list[Row] = []
    sky = gi.Environment(pixels=np.ones((128, 256, 3), np.float32))
    for walls in (False, True):
        polygons, normals = bitten(count, walls)
        truth = np.array([closed_form(*one) for one in zip(polygons, normals, strict=True)])
        for one in EVALUATORS:
            found, _ = integrated(sky, one, 0.0, polygons, normals, device)
            row: Row = {"table": "white sky", "walls": walls, "evaluator": one, "polygons": count}
            rows.append(row | spread_of(100 * (found[:, 0] - truth) / np.pi))
    return rows


def bitten(count: int, walls: bool) -> tuple[list[list[np.ndarray]], np.ndarray]:
    """Return horizons of which a part was pushed inwards at random, and their normals [count, 3]; upright if walls."""
    rng = np.random.default_rng(1)
    normals = rng.normal(size=(count, 3)) * ((1, 0, 1) if walls else (1, 1, 1))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    polygons = []
    for normal in normals:
        side = np.cross(normal, (0.0, 1.0, 0.0) if abs(normal[1]) < 0.9 else (1.0, 0.0, 0.0))
        side /= np.linalg.norm(side)
        number = int(rng.integers(20, 40))
        turn = rng.uniform(0, 6) + 2 * np.pi * np.arange(number)[:, None] / number
        points = np.cos(turn) * side + np.sin(turn) * np.cross(normal, side)
        pushed = (rng.integers(number) + np.arange(rng.integers(number // 2))) % number
        points[pushed] += normal * rng.uniform(0, 1, (len(pushed), 1))
        polygons.append([points / np.linalg.norm(points, axis=1, keepdims=True)])
    return polygons, normals


def closed_form(polygon: list[np.ndarray], normal: np.ndarray) -> float:
    """Return the irradiance through a polygon under a sky of 1: half the sum of angle times normal of its edges."""
    total = 0.0
    for contour in polygon:
        after = np.roll(contour, -1, axis=0)
        across = np.cross(contour, after)
        size = np.linalg.norm(across, axis=1)
        angle = np.arctan2(size, (contour * after).sum(axis=1))
        total += 0.5 * float((angle * (across @ normal) / np.maximum(size, 1e-12)).sum())
    return total


PARTS = {"bakes": bake_rows, "evaluators": evaluator_rows, "frames": frame_rows}
