"""Frames lit through visibility polygons beside traced ones, against a reference of many samples."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness.gallery import CLOSED, Gallery, PictureSet
from warp_gi.bench.harness.measure import Row, attempt
from warp_gi.bench.harness.stages import Stage, race, timed_bake
from warp_gi.bench.suites.polygons.shapes import bumpy, ground
from warp_gi.bench.suites.transfer.views import true_sky

SIZE, QUICK_SIZE = (120, 68), (24, 14)
REFERENCE, QUICK_REFERENCE = 4096, 64
SPP, QUICK_SPP = (64, 256), (4,)
TURNS, QUICK_TURNS = 3, 1
CAMERA = gi.Camera.look_at((2.2, 1.2, 2.2), (0, -0.25, 0), hfov=45)
SEED = 7
"""Of the reference, whose samples are others than those of the frames."""


def frame_rows(quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return rows of a closed object alone and on coarse ground, under the city's sky."""
    small = (10, 16) if quick else (40, 64)
    meshes = {"closed object": [bumpy(*small)], "on ground": [bumpy(*small), ground(8 if quick else 40)]}
    rows: list[Row] = []
    for name, parts in meshes.items():
        scene = gi.Scene([gi.Node(mesh.name, [mesh]) for mesh in parts], environment=true_sky("city"))
        rows += attempt({"table": "frames", "scene": name}, partial(_rows, name, scene, quick, device, gallery))
    return rows


def _rows(name: str, scene: gi.Scene, quick: bool, device: str, gallery: Gallery) -> list[Row]:
    camera = CAMERA.at_resolution(*(QUICK_SIZE if quick else SIZE))
    reference_spp = QUICK_REFERENCE if quick else REFERENCE
    polygons, traced = gi.VisibilityPolygons(resolution=16 if quick else 64), gi.TracedEnvironment()
    bake = timed_bake(scene, polygons, device)[0]
    kinds: dict[str, tuple[gi.Estimator, gi.Bake | None]] = {
        "polygons": (polygons, bake),
        "three evaluations": (replace(polygons, evaluations=3), bake),
        "unbiased": (replace(polygons, mode="unbiased"), bake),
        "traced": (traced, None),
    }
    contenders, again = (
        {
            (kind, spp): Stage(scene, camera, estimator, spp, device, known, seed)
            for spp in (QUICK_SPP if quick else SPP)
            for kind, (estimator, known) in kinds.items()
        }
        for seed in (0, SEED + 1)
    )
    truth = Stage(scene, camera, traced, reference_spp, device, seed=SEED)
    named = {f"{kind}, {spp}": stage for (kind, spp), stage in contenders.items()}
    taken = race(named, QUICK_TURNS if quick else TURNS, device)
    surface = truth.frame.numpy("alpha") > 0
    slowest = taken[list(named)[-1]].cost
    rows: list[Row] = []
    for (kind, spp), stage in contenders.items():
        cost = taken[f"{kind}, {spp}"]
        row: Row = {
            "table": "frames",
            "scene": name,
            "renderer": kind,
            "spp": spp,
            "pixels": f"{surface.shape[1]}x{surface.shape[0]}",
        }
        row |= {"reference spp": reference_spp} | cost.row() | errors_of(stage.picture[surface], truth.picture[surface])
        row["noise %"] = errors_of(stage.picture[surface], again[kind, spp].picture[surface])["rms %"] / 2**0.5
        rows.append(row if quick else row | {"time over traced 256": cost.cost / slowest})
    images = {key: stage.picture for key, stage in named.items()}
    gallery.add(PictureSet(f"{name} under the city's sky", truth.picture, images))
    return rows


def errors_of(pixels: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """Return errors of pixels [n, 3], of their mean over channels in percent of the truth's, and the PSNR.

    The peak of the PSNR is the truth's 98th percentile.
    """
    truth = truth.astype(np.float64)
    error = 100 * (pixels - truth).mean(axis=1) / truth.mean()
    return {
        "rms %": float(np.sqrt(np.mean(error**2))),
        "median %": float(np.median(np.abs(error))),
        "p95 %": float(np.quantile(np.abs(error), 0.95)),
        "mean %": float(error.mean()),
        "PSNR": gi.metrics.psnr(pixels, truth, float(np.quantile(truth, 0.98))),
    }
