"""A frame of the sky's direct light beside Mitsuba 3 at equal error.

Mitsuba's error falls as the root of its samples and its time grows with them, so the time for the error of transfer
follows from one measurement. Its variant is ``scalar_rgb``, which needs no LLVM; ``llvm_ad_rgb`` is several times
faster where LLVM 19 is installed (suite ``dvf``).
"""

from __future__ import annotations

from typing import Any

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness.court import court, court_camera
from warp_gi.bench.harness.measure import Row, take_turns
from warp_gi.bench.harness.places import PLACES
from warp_gi.bench.harness.scenes import peer_scene
from warp_gi.bench.peers import mitsuba_peer
from warp_gi.bench.suites.transfer.views import TermView, smooth_sky, under
from warp_gi.frame import TERMS

TABLE = "beside Mitsuba at equal error"
SPP, QUICK_SPP = 16, 4
INTEGRATOR = {"type": "direct", "bsdf_samples": 1, "emitter_samples": 1}


def peer_rows(quick: bool, device: str) -> list[Row]:
    """Return rows of the court and of Sponza, Lambert, under a smooth sky."""
    size = (96, 64) if quick else (320, 180)
    flat = peer_scene(court(smooth_sky()), diffuse=True)  # a material may not be on flat and smooth meshes in Mitsuba
    flat.environment = smooth_sky()
    rows = equal_error("court", flat, court_camera(size), quick, device)
    place = PLACES["sponza"]
    if quick:
        return rows
    if place.missing:
        return [*rows, {"table": TABLE, "case": place.title, "skipped": place.missing}]
    scene = under(peer_scene(place.scene(), diffuse=True, masks=False, emission=False), smooth_sky())
    return rows + equal_error("Sponza", scene, place.camera().at_resolution(*size), quick, device)


def equal_error(name: str, scene: gi.Scene, camera: gi.Camera, quick: bool, device: str) -> list[Row]:
    """Return a row for each renderer: time of a whole frame, error, and what the error of transfer takes."""
    said: Row = {"table": TABLE, "case": name, "pixels": "{}x{}".format(*camera.resolution)}
    spp = QUICK_SPP if quick else SPP
    try:
        peer = mitsuba_peer.renderer(scene, camera, INTEGRATOR, spp, mitsuba_peer.SCALAR)
    except mitsuba_peer.PeerMissing as missing:
        return [said | {"skipped": str(missing)}]
    estimator = gi.RadianceTransfer(bounces=0, resolution=256 if quick or name == "court" else 1024)
    bake = gi.bake(scene, estimator, device)
    view = TermView(scene, camera, "environment", 64 if quick else 256, device, 64, "beauty")

    def ours(used: object, samples: int) -> gi.FrameScheduler:
        terms: dict[str, Any] = dict.fromkeys(TERMS) | {"environment": used}
        pipeline = gi.Pipeline(**terms, spp=samples)
        return gi.FrameScheduler(scene, camera, pipeline, device, bakes=[bake] if used is estimator else [])

    transfer, traced = ours(estimator, spp), ours(gi.TracedEnvironment(), spp)
    works = {
        "transfer": lambda turn: transfer.frame(turn).numpy("beauty").copy(),
        "traced": lambda turn: traced.frame(turn).numpy("beauty").copy(),
        f"Mitsuba {mitsuba_peer.SCALAR}": peer,
    }
    taken = take_turns(works, 1 if quick else 2, device, keep=1, host=[f"Mitsuba {mitsuba_peer.SCALAR}"])
    found = {way: view.errors(np.asarray(one.results[0])) for way, one in taken.items()}
    rows: list[Row] = []
    for way, one in taken.items():
        row: Row = {**said, "way": way, "spp": spp, **found[way], **one.row()}
        factor = max((found[way]["rel"] / max(found["transfer"]["rel"], 1e-6)) ** 2, 0.0 if way == "transfer" else 1e-9)
        row["cpu s for its error"] = one.times[1] * factor
        rows.append(row | {"transfer: times less, cpu": one.times[1] * factor / taken["transfer"].times[1]})
    return rows
