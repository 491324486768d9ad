"""Denoisers on a moving camera: error before and after, by rays a pixel."""

from __future__ import annotations

from typing import Any

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness.gallery import CLOSED, Gallery, PictureSet
from warp_gi.bench.harness.measure import Row
from warp_gi.bench.harness.stages import LAMBERT, Case
from warp_gi.denoise import denoiser_named
from warp_gi.errors import OptionError

FRAME = 7
"""Number of the frame whose errors are measured; the denoiser averages over it and those before it."""
RAYS = (1, 2, 8)
DENOISERS = {"spatiotemporal": "ST", "oidn": "OIDN"}


CASES = (Case("cornell_box", "cornell_box", materials=LAMBERT), Case("atrium"))
PIPELINES: dict[str, dict[str, Any]] = {
    "paths": {},
    "probes, traced": {"indirect": gi.LightFieldProbes(mode="traced", resolution=128)},
}


def denoise_rows(quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return a row for each scene, pipeline and number of rays: the beauty against that of the pipeline's many rays.

    Probes are in the first scene only.
    """
    size, spp = ((120, 68), 32) if quick else ((480, 270), 256)
    rows: list[Row] = []
    for case in CASES[: 1 if quick else None]:
        scene, path = case.scene(), case.path().at_resolution(*size)
        for label, terms in PIPELINES.items() if case is CASES[0] else [("paths", PIPELINES["paths"])]:
            rows += pipeline_rows(case.name, scene, path, label, terms, spp, device, gallery)
    return rows


def pipeline_rows(
    name: str,
    scene: gi.Scene,
    path: gi.CameraPath,
    label: str,
    terms: dict[str, Any],
    spp: int,
    device: str,
    gallery: Gallery = CLOSED,
) -> list[Row]:
    """Return the rows of one scene and pipeline; pictures are of the fewest rays."""
    indirect = terms.get("indirect")
    bakes = [gi.bake(scene, indirect, device, camera_path=path)] if indirect is not None else []
    many = gi.Pipeline(**terms, spp=spp, camera_samples=min(spp, 64))
    truth = gi.FrameScheduler(scene, path, many, device, seed=101, bakes=bakes).frame(FRAME).numpy("beauty")
    rows: list[Row] = []
    for rays in RAYS:
        row: Row = {"table": "denoise", "case": name, "pipeline": label, "rays a pixel": rays}
        pictures: dict[str, np.ndarray] = {}
        for denoiser, short in DENOISERS.items():
            few = gi.Pipeline(**terms, spp=rays, denoise=denoiser_named(denoiser))
            try:
                scheduler = gi.FrameScheduler(scene, path, few, device, seed=1, bakes=bakes)
            except OptionError as missing:
                said: Row = {"table": "denoise", "case": name, "pipeline": label, "skipped": str(missing)}
                rows += [said] if said not in rows else []
                continue
            seconds = []
            for index in range(FRAME + 1):
                frame = scheduler.frame(index)
                seconds.append(frame.timings["denoise"])
            if "noisy RMSE" not in row:
                row |= _errors("noisy", frame.numpy("noisy"), truth)
            pictures |= {"noisy": frame.numpy("noisy"), denoiser: frame.numpy("beauty")}
            row |= _errors(short, frame.numpy("beauty"), truth)
            row[f"{short} ms"] = float(np.median(seconds)) * 1e3
        rows.append(row)
        if rays == RAYS[0]:
            gallery.add(PictureSet(f"{name}: denoised {label}, rays a pixel: {rays}", truth, pictures))
    return rows


def _errors(name: str, picture: np.ndarray, truth: np.ndarray) -> Row:
    return {
        f"{name} RMSE": gi.metrics.rmse(picture, truth),
        f"{name} relMSE": gi.metrics.rel_mse(picture, truth),
        f"{name} FLIP": gi.metrics.flip(picture, truth),
    }
