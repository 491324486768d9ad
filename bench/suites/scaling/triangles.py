"""Builds and rays over the number of triangles, of one shape in ever finer meshes; beside Embree on the CPU."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from warp_gi import launch
from warp_gi.bench.harness.measure import (
    PeakMemory,
    Row,
    Taken,
    median_and_spread,
    ratio_and_spread,
    resident_memory,
    take_turns,
)
from warp_gi.bench.suites.rays.suite import NO_EMBREE, diffuse_rays, embree_builder, primary_rays, trace
from warp_gi.bench.suites.scaling.fits import Growth
from warp_gi.bench.suites.scaling.mesh import CROWD_VIEW, crowd
from warp_gi.bvh import TriangleBvh

COUNTS = (10_000, 31_600, 100_000, 316_000, 1_000_000, 3_160_000, 10_000_000)
QUICK_COUNTS = COUNTS[:4]
RAYS, QUICK_RAYS = 250_000, 30_000
TURNS, QUICK_TURNS = 5, 3
BUILDS = 3
MOST_GROWTH, MOST_BYTES = 1.8, 120.0
"""Targets: how many times longer a ray may take with ten times the triangles, and the tree's bytes a triangle."""
QUERIES = {"any": "OCCLUDED", "closest": "INTERSECT"}
"""Names of queries: ours, and Embree's by ours."""
CONTENDERS = ("ours", "embree")
FEW, TIMES = 128, 4
KINDS = ("primary", "diffuse", "diffuse, sorted", "diffuse, few")
"""Kinds of rays. Sorted ones start near those before them. "few" repeats FEW rays, so that all nodes stay in the cache:
its time grows as the traversal work does; where the time of other kinds grows more, the rest is memory. Each of the few
comes TIMES in a row, which the tree takes as in order already."""


@dataclass
class Mesh:
    """One of the meshes: its trees, its rays, and what building took."""

    triangles: int
    trees: dict[str, Any]
    batches: dict[str, tuple[np.ndarray, np.ndarray]]
    builds: dict[str, Taken]
    row: Row

    def trace(self, contender: str, kind: str, query: str) -> np.ndarray:
        """Return 0 or 1 (any) or the face (closest) for each ray of a batch; Embree's -1 or 0 (any)."""
        tree, rays = self.trees[contender], self.batches[kind]
        return trace(tree, query, *rays) if contender == "ours" else tree[0].run(*rays, query=QUERIES[query])


def triangle_rows(quick: bool, device: str) -> list[Row]:
    """Return rows of builds and rays for each number of triangles, and of their growth."""
    counts, rays, turns = (QUICK_COUNTS, QUICK_RAYS, QUICK_TURNS) if quick else (COUNTS, RAYS, TURNS)
    return rows_of(counts, rays, turns, device)


def rows_of(counts: Sequence[int], rays: int, turns: int, device: str, builds: int = BUILDS) -> list[Row]:
    """Return the rows for meshes of about ``counts`` triangles, all of which are kept: their rays take turns."""
    TriangleBvh(*crowd(100), device)  # compiles
    meshes = [build(count, rays, device, builds) for count in counts]
    rows = [mesh.row for mesh in meshes]
    if "embree" not in meshes[0].trees:
        rows.append({"table": "triangles", "skipped": NO_EMBREE})
    return rows + build_growth(meshes) + ray_rows(meshes, turns, device)


# ---- builds ----


def build(count: int, rays: int, device: str, builds: int) -> Mesh:
    """Return a mesh with its trees and rays."""
    points, indices = crowd(count)
    peaks = []

    def ours(_: int) -> TriangleBvh:
        before, peak = resident_memory(), PeakMemory()
        tree = TriangleBvh(points, indices, device)
        if peak.is_anew:
            peaks.append(peak.bytes - before)
        return tree

    builders: dict[str, Callable[[int], Any]] = {"ours": ours}
    with suppress(ImportError):
        commit = embree_builder(points, indices, robust=False)
        builders["embree"] = lambda turn: commit()
    taken = take_turns(builders, builds, device, keep=1, warm=False, host=("embree",))
    trees = {name: turns.results.pop() for name, turns in taken.items()}
    row: Row = {"table": "triangles", "triangles": len(indices)}
    for name, turns in taken.items():
        row |= turns.row("build " if name == "ours" else f"{name} build ")
    row["bytes a triangle"] = trees["ours"].memory_bytes / len(indices)
    if peaks:
        row["build peak GB"] = max(peaks) / 1e9
    return Mesh(len(indices), trees, batches_of(points, indices, rays), taken, row)


def batches_of(points: np.ndarray, indices: np.ndarray, rays: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return batches of about ``rays`` origins and directions; see ``KINDS``."""
    diffuse = diffuse_rays(points, indices, rays)
    again = np.random.default_rng(0).integers(FEW, size=-(-rays // TIMES)).repeat(TIMES)[:rays]
    few = diffuse[0][:FEW][again], diffuse[1][:FEW][again]
    return dict(zip(KINDS, (primary_rays(CROWD_VIEW, rays), diffuse, in_cells(*diffuse), few), strict=True))


def in_cells(origins: np.ndarray, directions: np.ndarray, cells: int = 32) -> tuple[np.ndarray, np.ndarray]:
    """Return rays in the order of the cells that they start in, along a Morton curve."""
    low, high = origins.min(axis=0), origins.max(axis=0)
    cell = ((origins - low) / (high - low).max() * (cells - 0.01)).astype(np.int64)
    key = np.zeros(len(origins), np.int64)
    for bit in range(cells.bit_length()):
        for axis in range(3):
            key |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    order = np.argsort(key, kind="stable")
    return origins[order], directions[order]


def build_growth(meshes: Sequence[Mesh]) -> list[Row]:
    """Return rows of the growth of build times and tree sizes."""
    counts, rows = [mesh.triangles for mesh in meshes], []
    for name in meshes[0].builds:
        said = {"table": "triangles: build growth", "renderer": name, "what": "build cost s"}
        rows.append(said | Growth.of(counts, [mesh.builds[name].counting for mesh in meshes]).row())
    peaks = [[mesh.row["build peak GB"]] for mesh in meshes if "build peak GB" in mesh.row]
    if len(peaks) == len(meshes):
        said = {"table": "triangles: build growth", "renderer": "ours", "what": "build peak GB"}
        rows.append(said | Growth.of(counts, peaks).row())
    most = max(mesh.row["bytes a triangle"] for mesh in meshes)
    return [*rows, {"table": "triangles: memory", "bytes a triangle": most, "target": MOST_BYTES}]


# ---- rays ----


def ray_rows(meshes: Sequence[Mesh], turns: int, device: str) -> list[Row]:
    """Return a row for each mesh, kind of ray and query, one thread each, and rows of how they grow."""
    rows: list[Row] = []
    measured: dict[tuple[str, str, str], list[np.ndarray]] = {}
    for kind in KINDS:
        for query in QUERIES:
            taken = race(meshes, kind, query, turns, device)
            for i, mesh in enumerate(meshes):
                here = {name: taken[f"{name} {i}"] for name in mesh.trees}
                scale = 1e9 / len(mesh.batches[kind][0])
                spent = {name: scale * np.array(one.counting) for name, one in here.items()}
                for name, values in spent.items():
                    measured.setdefault((name, kind, query), []).append(values)
                rows.append(ray_row(mesh, kind, query, spent) | agreement(query, here))
    return rows + ray_growth([mesh.triangles for mesh in meshes], measured)


def race(meshes: Sequence[Mesh], kind: str, query: str, turns: int, device: str) -> dict[str, Taken]:
    """Return the turns of "contender number-of-mesh"; each has one thread."""
    works = {
        f"{name} {i}": partial(lambda mesh, name, turn: mesh.trace(name, kind, query), mesh, name)
        for i, mesh in enumerate(meshes)
        for name in mesh.trees
    }
    before = launch.thread_count()
    try:
        launch.set_threads(1)
        return take_turns(works, turns, device, keep=1, host=[name for name in works if name.startswith("embree")])
    finally:
        launch.set_threads(before)


def ray_row(mesh: Mesh, kind: str, query: str, spent: dict[str, np.ndarray]) -> Row:
    """Return the row of nanoseconds a ray by contender."""
    row: Row = {"table": "triangles: rays", "triangles": mesh.triangles, "rays": kind, "query": query}
    for name, values in spent.items():
        row |= median_and_spread(f"{name} ns a ray", values)
    return row | (ratio_and_spread("ours / embree", spent["embree"], spent["ours"]) if "embree" in spent else {})


def agreement(query: str, taken: dict[str, Taken]) -> Row:
    """Return the share of rays of which both say the same."""
    if "embree" not in taken:
        return {}
    ours, embree = (taken[name].results.pop() for name in CONTENDERS)
    return {"agree": float(np.mean(ours == ((embree == 0) if query == "any" else embree)))}


def ray_growth(counts: Sequence[int], measured: dict[tuple[str, str, str], list[np.ndarray]]) -> list[Row]:
    """Return the growth of nanoseconds a ray by contender, kind and query, beside others' where ours is worst."""
    found = {key: Growth.of(counts, values) for key, values in measured.items()}
    rows = []
    for (name, kind, query), growth in found.items():
        row = {"table": "triangles: growth", "renderer": name, "what": "ns a ray", "rays": kind, "query": query}
        row |= growth.row(MOST_GROWTH if name == "ours" else "")
        if name == "ours" and growth.worst is not None:
            work = found[name, "diffuse, few", query].ratio(growth.worst)
            row["says"] += f", where the work of diffuse rays grows {work:.2f} times"
            if ("embree", kind, query) in found:
                row["says"] += f", Embree's time {found['embree', kind, query].ratio(growth.worst):.2f}"
        rows.append(row)
    return rows
