"""Ray queries and tree builds beside Embree 4 at its best and Warp's own mesh queries.

All get the same rays and triangles, as NumPy arrays, and one thread each; they take turns in one process and the median
CPU time counts. "ours" is the batch call, which on large trees traces incoherent rays in Morton order and returns them
in theirs; "ours in order" is without that. "presorted" are the rays of such a batch given in Morton order to both.
"embree" is its fast mode, which may leak through edges, "embree robust" is watertight like ours; both are of medium
quality, its default, and "embree high" has spatial splits. "best" is the better of "embree" and "embree high" in each
turn. "embree packets" are of 16 rays, of the tree that serves them better; "ours coherent" are the same rays in packets
of 16 of ours, the others single rays.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, TypeVar

import numpy as np
import warp as wp

from warp_gi import bvh as bvh_module
from warp_gi import launch
from warp_gi.bench.harness import scenes
from warp_gi.bench.harness.measure import Row, attempt, median_and_spread, ratio_and_spread, take_turns
from warp_gi.bench.harness.places import PLACES, Place
from warp_gi.bench.suites.rays import embree
from warp_gi.bench.suites.rays.embree import EmbreeScene
from warp_gi.bench.suites.rays.kernels import warp_any, warp_closest
from warp_gi.bvh import TriangleBvh
from warp_gi.scene.camera import CameraKey

T = TypeVar("T")
REPETITIONS = 5
RAYS = 1_000_000
QUICK_RAYS = 200_000
QUICK_SCENES = ("living room", "sponza", "atrium")
NEVER = 1 << 62
NO_EMBREE = "embreex is not installed: pip install embreex"
EMBREE = {"embree": ("medium", False), "embree robust": ("medium", True), "embree high": ("high", False)}
"""Embree's trees by their names in rows: quality and whether edges are watertight."""
FAST = ("embree", "embree high")
COHERENT = ("primary", "shadow")
"""Kinds of rays that packets are for."""
Batch = tuple[np.ndarray, np.ndarray, Any]
"""Origins and directions, float32 [ray, 3], and t_max, a number or float32 [ray]."""
CASES = {
    "living room": "living_room",
    "sponza": "sponza",
    "bistro": "bistro",
    "dragon": "dragon_white",
    "atrium": "atrium",
    "street": "street",
    "modern hall": "modern_hall",
    "warehouse": "warehouse",
    "mine": "mine",
}
"""Places by their names in rows; primary rays are those of their cameras."""
PARTS = CASES


def run(quick: bool = False, device: str = "cpu", parts: Sequence[str] = ()) -> list[Row]:
    """Return a row for each scene's builds and one for each kind of ray and query; ``parts`` are scenes.

    ``quick`` takes three scenes and fewer rays. Scenes whose file is missing, and peers that are not installed, give
    a row that says so.
    """
    rows: list[Row] = []
    for name in parts or (QUICK_SCENES if quick else CASES):
        rows += attempt({"scene": name}, partial(scene_rows, name, quick, device))
    return rows


def scene_rows(name: str, quick: bool, device: str) -> list[Row]:
    """Return the rows of a scene."""
    place = PLACES[CASES[name]]
    if place.missing:
        return [{"scene": name, "skipped": place.missing}]
    points, indices = load_triangles(place)
    count = QUICK_RAYS if quick else RAYS
    camera = place.path().keys[0]
    primary = primary_rays(camera, count)
    rays: dict[str, Batch] = {"diffuse": (*diffuse_rays(points, indices, count), np.inf), "primary": (*primary, np.inf)}
    rays["shadow"] = shadow_rays(TriangleBvh(points, indices), camera, *primary)
    return compare(name, points, indices, rays, device, 3 if quick else REPETITIONS)


def compare(
    name: str,
    points: np.ndarray,
    indices: np.ndarray,
    batches: Mapping[str, Batch],
    device: str = "cpu",
    repetitions: int = REPETITIONS,
) -> list[Row]:
    """Return the rows of one mesh: float32 [vertex, 3] points, int32 [triangle, 3], batches of rays by kind."""
    found = launch.get_device(device)
    threads = launch.thread_count()
    try:
        launch.set_threads(1)
        tree, mesh, peers, row = build_all(name, points, indices, device, repetitions)
        rows = [row]
        if not peers:
            rows.append({"table": "builds", "scene": name, "skipped": NO_EMBREE})
        for kind, rays in batches.items():
            for query in ("any",) if kind == "shadow" else ("any", "closest"):
                row = {"table": "rays", "scene": name, "triangles": len(indices), "rays": kind, "query": query}
                row |= race(query, tree, mesh, peers, rays, repetitions, kind in COHERENT)
                if found.is_cpu:
                    row |= presorted(query, tree, peers, rays, repetitions)
                if found.is_cpu and threads > 1:
                    row |= scaling(tree, query, rays, repetitions)
                rows.append(row)
    finally:
        launch.set_threads(threads)
    return rows


def build_all(name: str, points: np.ndarray, indices: np.ndarray, device: str, repetitions: int) -> tuple:
    """Return our tree, a wp.Mesh, Embree's scenes by name, and the row of build times (CPU seconds)."""
    TriangleBvh(points, indices[:100], device)  # compiles
    row: Row = {"table": "builds", "scene": name, "triangles": len(indices)}
    builders: dict[str, Callable[[], Any]] = {
        "ours": lambda: TriangleBvh(points, indices, device),
        "warp": lambda: warp_mesh(points, indices, device),
    }
    with suppress(ImportError):
        builders |= {name: embree.builder(points, indices, *kind) for name, kind in EMBREE.items()}
    turns = {name: _ignoring(build) for name, build in builders.items()}
    built = take_turns(turns, min(repetitions, 3), device, 1, host=EMBREE)
    for key, taken in built.items():
        row |= median_and_spread(f"{key} build s", taken.counting)
    for key in [name for name in EMBREE if name in built]:
        row |= ratio_and_spread(f"{key} / ours", built[key].cpu, built["ours"].counting)
    row["bytes a triangle"] = built["ours"].results[0].memory_bytes / len(indices)
    results = {key: taken.results[0] for key, taken in built.items()}
    return results.pop("ours"), results.pop("warp"), results, row


def embree_builder(points: np.ndarray, indices: np.ndarray, robust: bool) -> Callable[[], tuple]:
    """Return what builds Embree's scene and mesh; raises ImportError without embreex."""
    from embreex import mesh_construction, rtcore_scene

    def build() -> tuple:
        scene = rtcore_scene.EmbreeScene(robust=robust)
        mesh = mesh_construction.TriangleMesh(scene, points, indices)
        scene.run(points[:1], points[:1] + 1.0, query="OCCLUDED")  # commits
        return scene, mesh

    return build


def _ignoring(work: Callable[[], T]) -> Callable[[int], T]:
    return lambda turn: work()


def warp_mesh(points: np.ndarray, indices: np.ndarray, device: str) -> wp.Mesh:
    """Return a wp.Mesh as fast as Warp makes it."""
    options: dict[str, Any] = {"bvh_constructor": "sah", "bvh_leaf_size": 4} if launch.get_device(device).is_cpu else {}
    return wp.Mesh(
        wp.array(points, dtype=wp.vec3, device=device),
        wp.array(indices.ravel(), dtype=wp.int32, device=device),
        **options,
    )


def race(
    query: str,
    tree: TriangleBvh,
    mesh: wp.Mesh,
    peers: Mapping[str, EmbreeScene],
    rays: Batch,
    repetitions: int,
    packets: bool = False,
) -> Row:
    """Return million rays a second of each contender and their ratios; agreement is of the hit or of the face."""
    device, count = tree.device, len(rays[0])
    runners: dict[str, Callable[[], np.ndarray]] = {
        "ours": lambda: trace(tree, query, *rays),
        "ours in order": lambda: in_order(tree, query, *rays),
    }
    runners |= {key: partial(scene.trace, query, *rays) for key, scene in peers.items()}
    if packets:
        runners["ours coherent"] = lambda: trace(tree, query, *rays, coherent=True)
    wide = [f"packets of {key}" for key in FAST if packets and key in peers]
    runners |= {key: partial(peers[key.removeprefix("packets of ")].trace, query, *rays, True) for key in wide}
    if np.ndim(rays[2]) == 0:
        runners["warp"] = lambda: warp_query(mesh, query, device, *rays[:2])
    turns = {name: _ignoring(run) for name, run in runners.items()}
    taken = take_turns(turns, repetitions, device.alias, 1, host=[*EMBREE, *wide])
    rates = {name: [count / seconds / 1e6 for seconds in one.counting] for name, one in taken.items()}
    if peers:
        rates["best"] = np.max([rates[name] for name in FAST], axis=0).tolist()
    if wide:
        rates["embree packets"] = np.max([rates.pop(name) for name in wide], axis=0).tolist()
    row: Row = {}
    for key, values in rates.items():
        if key != "best":
            row |= median_and_spread(f"{key} Mrays/s", values)
    if wide:
        row |= ratio_and_spread("coherent / embree packets", rates["ours coherent"], rates["embree packets"])
    if packets:
        row |= ratio_and_spread("coherent / ours", rates["ours coherent"], rates["ours in order"])
    for key in rates.keys() - {"ours", "ours in order", "ours coherent"}:
        row |= ratio_and_spread(f"ours / {key}", rates["ours"], rates[key])
        if key != "embree packets":
            row |= ratio_and_spread(f"in order / {key}", rates["ours in order"], rates[key])
    row["ours Mrays/wall s"] = count / taken["ours"].times[0] / 1e6
    if peers:
        row["agree"] = float((taken["embree"].results[0] == taken["ours"].results[0]).mean())
    return row


def in_order(tree: TriangleBvh, query: str, origins: np.ndarray, directions: np.ndarray, t_max: Any) -> np.ndarray:
    """Return ``trace`` of the rays as they come."""
    saved = bvh_module.ORDERED_RAYS
    bvh_module.ORDERED_RAYS = NEVER
    try:
        return trace(tree, query, origins, directions, t_max)
    finally:
        bvh_module.ORDERED_RAYS = saved


def presorted(query: str, tree: TriangleBvh, peers: Mapping[str, EmbreeScene], rays: Batch, repetitions: int) -> Row:
    """Return million rays a second where both get in Morton order what a batch brings into it; else nothing."""
    order = tree._rays(*rays).order
    if not peers or order is None or not len(order):
        return {}
    taking = order.numpy()
    given: Batch = (rays[0][taking], rays[1][taking], rays[2][taking] if np.ndim(rays[2]) else rays[2])
    runners = {"ours presorted": lambda: in_order(tree, query, *given)}
    runners |= {f"{key} presorted": partial(peers[key].trace, query, *given) for key in FAST}
    taken = take_turns({name: _ignoring(run) for name, run in runners.items()}, repetitions)
    rates = {name: [len(taking) / seconds / 1e6 for seconds in one.cpu] for name, one in taken.items()}
    best = np.max([rates.pop(f"{key} presorted") for key in FAST], axis=0).tolist()
    row = median_and_spread("ours presorted Mrays/s", rates["ours presorted"])
    row |= median_and_spread("embree presorted Mrays/s", best)
    return row | ratio_and_spread("presorted / best", rates["ours presorted"], best)


def warp_query(mesh: wp.Mesh, query: str, device: wp.Device, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return what Warp's own query finds, as ``trace``."""
    rays: list[wp.array] = [wp.array(x, dtype=wp.vec3, device=device, copy=False) for x in (origins, directions)]
    faces = wp.empty(len(origins), dtype=wp.int32, device=device)
    launch.launch(warp_any if query == "any" else warp_closest, len(origins), [mesh.id, *rays, faces], device)
    return faces.numpy()


def trace(
    tree: TriangleBvh,
    query: str,
    origins: np.ndarray,
    directions: np.ndarray,
    t_max: Any = np.inf,
    coherent: bool = False,
) -> np.ndarray:
    """Return 0 or 1 (any) or the face (closest) for each ray."""
    if query == "any":
        return tree.occluded(origins, directions, t_max, coherent).numpy()
    return tree.intersect(origins, directions, t_max, coherent).face.numpy()


def scaling(tree: TriangleBvh, query: str, rays: Batch, repetitions: int) -> Row:
    """Return what two threads do to wall time and to CPU time."""

    def with_threads(count: int, turn: int) -> None:
        launch.set_threads(count)
        trace(tree, query, *rays)

    taken = take_turns({str(count): partial(with_threads, count) for count in (1, 2)}, repetitions)
    launch.set_threads(1)
    row = ratio_and_spread("2 threads faster", taken["1"].wall, taken["2"].wall)
    return row | ratio_and_spread("2 threads cpu", taken["2"].cpu, taken["1"].cpu)


def load_triangles(place: Place) -> tuple[np.ndarray, np.ndarray]:
    """Return float32 [vertex, 3] points and int32 [triangle, 3] indices of a place's scene file, or built-in scene."""
    import trimesh

    if not place.files:
        geometry = place.scene().data("cpu").geometry
        return geometry.points.numpy(), geometry.indices.numpy().reshape(-1, 3)
    mesh: Any = trimesh.load(scenes.SCENES / place.files[0], force="mesh", process=False)
    return np.asarray(mesh.vertices, dtype=np.float32), np.asarray(mesh.faces, dtype=np.int32)


def diffuse_rays(points: np.ndarray, indices: np.ndarray, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return cosine-distributed rays from points spread evenly over the surface, on either side, just off it."""
    rng = np.random.default_rng(seed)
    a, b, c = (points[indices[:, k]].astype(np.float64) for k in range(3))
    normals = np.cross(b - a, c - a)
    areas = np.linalg.norm(normals, axis=1)
    face = np.searchsorted(np.cumsum(areas) / areas.sum(), rng.random(count)).clip(0, len(indices) - 1)
    root, along = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    origins = (1.0 - root) * a[face] + root * (1.0 - along) * b[face] + root * along * c[face]
    normal = normals[face] / areas[face, None] * rng.choice([-1.0, 1.0], (count, 1))
    sphere = rng.normal(size=(count, 3))
    directions = normal + sphere / np.linalg.norm(sphere, axis=1, keepdims=True)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    offset = 1e-5 * np.linalg.norm(points.max(axis=0) - points.min(axis=0))
    return (origins + offset * normal).astype(np.float32), directions.astype(np.float32)


def primary_rays(case: CameraKey, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return about ``count`` camera rays through pixel centres of a 3:2 picture, row by row."""
    height = round((count / 1.5) ** 0.5)
    width = height * 3 // 2
    right = np.tan(np.radians(case.hfov / 2.0))
    x, y = np.meshgrid((np.arange(width) + 0.5) / width * 2 - 1, 1 - (np.arange(height) + 0.5) / height * 2)
    forward = np.subtract(case.target, case.eye)
    forward /= np.linalg.norm(forward)
    side = np.cross(forward, (0.0, 1.0, 0.0))
    side /= np.linalg.norm(side)
    up = np.cross(side, forward)
    directions = forward + x[..., None] * right * side + y[..., None] * right * height / width * up
    directions = (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).reshape(-1, 3).astype(np.float32)
    return np.tile(np.asarray(case.eye, np.float32), (len(directions), 1)), directions


def shadow_rays(tree: TriangleBvh, camera: CameraKey, origins: np.ndarray, directions: np.ndarray) -> Batch:
    """Return rays from what camera rays hit to a point light, with limits, both ends just off.

    The light is half way from the camera to the mean of the hits, so that much of what is seen lies in its shadow.
    """
    t = tree.intersect(origins, directions).t.numpy()
    hit = np.isfinite(t)
    points = origins[hit] + t[hit, None].astype(np.float64) * directions[hit]
    light = (np.asarray(camera.eye) + points.mean(axis=0)) / 2.0
    away = light - points
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    away /= np.maximum(distance, 1e-30)
    start = points + 1e-4 * distance * away
    return start.astype(np.float32), away.astype(np.float32), (0.9998 * distance[:, 0]).astype(np.float32)
