"""Frames of the sky's direct light by transfer beside tracing 64 samples a pixel: the term, primary rays, all of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import warp as wp

import warp_gi as gi
from warp_gi.bench.harness.measure import Row, Taken, attempt, ratios, take_turns
from warp_gi.bench.harness.places import PLACES
from warp_gi.bench.harness.scenes import peer_scene
from warp_gi.bench.suites.transfer.views import BIG, BIGGER, SMALL, true_sky, under
from warp_gi.frame import TERMS

TABLE, LARGE = "frames: beside 64 samples", "frames: 1920x1080"
SPP = 64
TRACED = "traced, 64 samples"
TARGETS = {"term": 60.0, "with primary": 25.0, "frame": 12.0}
"""Targets for how many times less CPU time transfer takes than tracing."""
WAYS: dict[str, dict[str, Any]] = {
    "TPFL": {"glossy": "transfer", "sun": 0.0},
    "TPFL and sun": {"glossy": "transfer"},
    "ratio and sun": {"glossy": "ratio"},
    "default": {},
    "diffuse": {"glossy": "transfer", "sun": 0.0},
    "diffuse and sun": {"glossy": "transfer"},
}
"""Settings by name; those of "diffuse" are for Lambert materials."""


@dataclass(frozen=True)
class OneTerm:
    """Direct light of the sky by one estimator: its frame, and parts of that which can be done again."""

    scheduler: gi.FrameScheduler
    drawn: gi.Frame

    @staticmethod
    def of(scene: gi.Scene, camera: gi.Camera, estimator: Any, spp: int, device: str, bakes: list[gi.Bake]) -> OneTerm:
        """Return the estimator's; the first frame is drawn, which compiles."""
        terms: dict[str, Any] = dict.fromkeys(TERMS) | {"environment": estimator}
        pipeline = gi.Pipeline(**terms, spp=spp, camera_samples=1)
        scheduler = gi.FrameScheduler(scene, camera, pipeline, device, bakes=bakes)
        drawn = scheduler.frame(0)
        for service in estimator.services:  # what they handed over ended with the frame
            service.preprocess(drawn, scheduler.state(service.name))
        return OneTerm(scheduler, drawn)

    def term(self, turn: int = 0) -> None:
        """Do the light once more."""
        estimator = self.scheduler.pipeline.environment
        assert estimator is not None
        estimator.trace(self.drawn, self.scheduler.state("environment"))
        if self.drawn.paths.is_wanted:
            self.drawn.trace_paths()
        wp.synchronize_device(self.drawn.device)

    def primary(self, turn: int = 0) -> None:
        """Trace the primary rays once more."""
        self.drawn.begin_view(0)
        self.scheduler.pipeline.primary()[1].trace(self.drawn, None)
        wp.synchronize_device(self.drawn.device)

    def frame(self, turn: int = 0) -> None:
        """Render a whole frame."""
        self.scheduler.frame(turn)


def frame_rows(quick: bool, device: str) -> list[Row]:
    """Return rows of all scenes."""
    rows: list[Row] = []
    for key in ("sphere_row",) if quick else ("living_room_white", "sponza"):
        place = PLACES[key]
        said = {"table": TABLE, "case": place.title.partition(",")[0]}
        if place.missing:
            rows.append(said | {"skipped": place.missing})
            continue
        rows += attempt(said, partial(place_rows, said["case"], place.scene(), place.camera(), quick, device))
    return rows


def place_rows(name: str, scene: gi.Scene, camera: gi.Camera, quick: bool, device: str) -> list[Row]:
    """Return the rows of one scene under the courtyard's sky: beside tracing, and in a large picture."""
    sky, turns = true_sky("courtyard"), 1 if quick else 3
    rows: list[Row] = []
    small, large = (SMALL, (480, 272)) if quick else (BIG, BIGGER)
    base: dict[str, Any] = {"bounces": 0, "resolution": 128 if quick else 1024}
    bake = None  # without bounces it holds nothing of materials, so one serves both
    for materials in ("own", "Lambert"):
        seen = under(peer_scene(scene, materials == "Lambert", flat=False, emission=False), sky)
        bake = bake or gi.bake(seen, gi.RadianceTransfer(**base), device)
        view = camera.at_resolution(*small)
        every = {TRACED: OneTerm.of(seen, view, gi.TracedEnvironment(), SPP, device, [])}
        for way, settings in WAYS.items():
            if way.startswith("diffuse") == (materials == "Lambert"):
                estimator = gi.RadianceTransfer(**base, **settings)
                every[way] = OneTerm.of(seen, view, estimator, SPP, device, [bake])
        said: Row = {"case": name, "materials": materials}
        rows += traced_rows(said | {"pixels": "{}x{}".format(*small)}, every, turns, device)
        big = camera.at_resolution(*large)
        for way, one in every.items():
            if way != TRACED:
                used = OneTerm.of(seen, big, one.scheduler.pipeline.environment, SPP, device, [bake])
                rows.append(large_row(said | {"way": way}, used, large, turns, device))
    return sorted(rows, key=lambda row: row["table"] == LARGE)


def traced_rows(said: Row, every: Mapping[str, OneTerm], turns: int, device: str) -> list[Row]:
    """Return a row for each estimator, the traced one first: times, and how many times less than traced."""
    parts: dict[str, dict[str, Taken[None]]] = {}
    for part in ("term", "primary", "frame"):
        works: dict[str, Callable[[int], None]] = {way: getattr(one, part) for way, one in every.items()}
        once = take_turns({TRACED: works.pop(TRACED)}, 1, device, warm=False)[TRACED]
        again = Taken[None](once.wall * turns, once.cpu * turns, once.device * turns)  # it takes long, so it is steady
        parts[part] = {TRACED: again, **take_turns(works, turns, device, warm=False)}
    with_primary = {way: added(parts["term"][way], parts["primary"][way]) for way in every}
    rows: list[Row] = []
    for way in every:
        row: Row = {"table": TABLE, **said, "way": way}
        row |= {f"{part} cpu ms": taken[way].times[1] * 1e3 for part, taken in parts.items()}
        for part, taken in (("term", parts["term"]), ("with primary", with_primary), ("frame", parts["frame"])):
            row |= ratios(f"{part}: times less, {{}}", taken[TRACED], taken[way])
            row[f"{part} target"] = TARGETS[part] if way == "TPFL" else 0.0
        rows.append(row)
    return rows


def added(a: Taken[None], b: Taken[None]) -> Taken[None]:
    """Return times of doing one after the other."""

    def sums(x: list[float], y: list[float]) -> list[float]:
        return [p + q for p, q in zip(x, y, strict=True)]

    return Taken(sums(a.wall, b.wall), sums(a.cpu, b.cpu), sums(a.device, b.device))


def large_row(said: Row, one: OneTerm, pixels: tuple[int, int], turns: int, device: str) -> Row:
    """Return milliseconds of the parts of a large frame."""
    works = {"term": one.term, "primary": one.primary, "frame": one.frame}
    taken = take_turns(works, max(turns, 2), device, warm=False)
    row: Row = {"table": LARGE, **said, "pixels": "{}x{}".format(*pixels)}
    row |= {f"{part} cpu ms": taken[part].times[1] * 1e3 for part in works}
    return row | {"ns a pixel": taken["term"].cost / (pixels[0] * pixels[1]) * 1e9}
