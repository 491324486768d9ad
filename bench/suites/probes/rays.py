"""Rays through light field probes beside the tree of triangles: whether they hit the same, and how fast.

A ray starts at a surface, in a cosine-distributed direction: one half where camera rays end, the other half where the
rays of the first do. It agrees if both end within 2 % of the distance or 5 cm of each other, or both nowhere. A ray
that no probe can follow to its end is unknown; its last occluder counts as its hit, as it does in a picture.
"""

from __future__ import annotations

import numpy as np

import warp_gi as gi
from warp_gi import launch
from warp_gi.bench.harness.measure import Row, median_and_spread, ratio_and_spread
from warp_gi.bench.harness.stages import Case, race
from warp_gi.bench.suites.probes.views import CORNELL, LIVING_ROOM, SPONZA, ProbeView, view_of
from warp_gi.kernels import light_field_march as march_kernels
from warp_gi.techniques.light_field.ray import march_rays

SHARE, METRES = 0.02, 0.05
"""Largest difference of hits that agree: a share of their distance, or metres, whichever is more."""
CASE = (4, 4, 4), 256
RESOLUTIONS = (64, 256, 1024)
COUNTS = ((1, 4, 1), (4, 4, 4), (8, 4, 8))
"""Probes along x, y and z, as in the paper's figures 18 and 19."""
RAYS = 100_000


def ray_rows(quick: bool, device: str) -> list[Row]:
    """Return a row for each place and grid."""
    rows: list[Row] = []
    for place in (CORNELL,) if quick else (LIVING_ROOM, SPONZA, CORNELL):
        if place.missing:
            rows.append({"table": "rays", "case": place.name, "skipped": place.missing})
            continue
        rows += place_rows(place, view_of(place, (320, 180), device, 1), quick)
    return rows


def place_rows(place: Case, view: ProbeView, quick: bool, count: int = RAYS) -> list[Row]:
    """Return the rows of one place: the resolution varies with the paper's counts, the counts with its default."""
    (counts, resolution), grids = CASE, []
    for size in RESOLUTIONS[:2] if quick else RESOLUTIONS:
        grids.append((counts, size))
    for number in COUNTS[:1] if quick else COUNTS:
        if number != counts:
            grids.append((number, resolution))
    rays = surface_rays(view, count // 4 if quick else count)
    return [ray_row(place, view, rays, *grid, 1 if quick else 3) for grid in grids]


def surface_rays(view: ProbeView, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return float32 [ray, 3] origins, just off a surface, and unit directions; fewer than asked if many get lost."""
    rng = np.random.default_rng(seed)
    ways = view.camera.directions(rng.uniform(size=(count, 2)) * view.camera.resolution)
    rays = np.broadcast_to(view.camera.position, ways.shape), ways
    parts = []
    for _ in range(2):
        rays = bounced(view, *rays, rng)
        parts.append(rays)
    half = count // 2
    joined = [np.concatenate([part[:half] for part in kind]) for kind in zip(*parts, strict=True)]
    return joined[0].astype(np.float32), joined[1].astype(np.float32)


def bounced(
    view: ProbeView, origins: np.ndarray, directions: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return rays that go on from where others hit, cosine-distributed about the normal; fewer if some hit nothing."""
    hits = view.scene.bvh(view.device).intersect(origins.astype(np.float32), directions.astype(np.float32))
    face, t = hits.face.numpy(), hits.t.numpy().astype(np.float64)
    hit = face >= 0
    origins, directions, t = origins[hit], directions[hit], t[hit, None]
    geometry = view.scene.data(view.device).geometry
    corners = geometry.points.numpy()[geometry.indices.numpy()[face[hit]]].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals *= -np.sign((normals * directions).sum(axis=1, keepdims=True))
    on_sphere = rng.normal(size=normals.shape)
    ways = normals + on_sphere / np.linalg.norm(on_sphere, axis=1, keepdims=True)
    ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-9)
    return origins + directions * t + 1e-4 * np.maximum(t, 1.0) * normals, ways


def ray_row(
    place: Case,
    view: ProbeView,
    rays: tuple[np.ndarray, np.ndarray],
    counts: tuple[int, int, int],
    resolution: int,
    repetitions: int,
) -> Row:
    """Return the share of rays that end in a grid as in the scene, and million rays a second of both on one thread."""
    settings = gi.LightFieldProbes(counts=counts, resolution=resolution, rays=1, bounces=1, through="probes")
    state = settings.start(view.scene, view.device, view.bake(settings)[0])
    view.bakes.clear()  # they are large
    tree = view.scene.bvh(view.device)
    truth = tree.intersect(*rays)
    agree = agreement(march_rays(state, *rays), truth.face.numpy() >= 0, truth.t.numpy())
    threads = launch.thread_count()
    try:
        launch.set_threads(1)
        taken = race(
            {"march": lambda: march_rays(state, *rays), "tree": lambda: tree.intersect(*rays)}, repetitions, view.device
        )
    finally:
        launch.set_threads(threads)
    rates = {name: [len(rays[0]) / 1e6 / seconds for seconds in one.counting] for name, one in taken.items()}
    row: Row = {"table": "rays", "case": place.name, "probes": " x ".join(map(str, counts)), "resolution": resolution}
    row |= agree | median_and_spread("Mrays/s", rates["march"]) | median_and_spread("tree Mrays/s", rates["tree"])
    return row | ratio_and_spread("of tree", rates["march"], rates["tree"]) | {"MB": state.nbytes / 1e6}


def agreement(hits: dict[str, np.ndarray], is_hit: np.ndarray, t: np.ndarray) -> Row:
    """Return the shares of rays of ``march_rays`` that agree with the truth, and what they cost."""
    unknown = hits["results"] == int(march_kernels.UNKNOWN)
    ours = (hits["results"] == int(march_kernels.HIT)) | unknown
    with np.errstate(invalid="ignore"):
        near = np.abs(hits["t"] - t) <= np.maximum(SHARE * t, METRES)
    agree = np.where(is_hit & ours, near, is_hit == ours)
    steps, blocks, probes = hits["counts"].mean(axis=0)
    return {
        "agree": float(agree.mean()),
        "of known": float(agree[~unknown].mean()),
        "unknown": float(unknown.mean()),
        "texels a ray": float(steps),
        "blocks a ray": float(blocks),
        "probes a ray": float(probes),
    }
