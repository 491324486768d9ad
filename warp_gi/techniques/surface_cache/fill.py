"""Filling the cells of a surface cache by paths from the frames of a camera's path."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.baking import Setting
from warp_gi.color import LUMINANCE
from warp_gi.kernels import surface_cache_fill as kernels
from warp_gi.kernels.gbuffer import CameraData
from warp_gi.kernels.light_hierarchy import LightTree
from warp_gi.kernels.surface_cache import LARGEST_COORDINATE, MOST_OBJECTS, ObjectGrid, SurfaceCells
from warp_gi.scene.animation import world_matrices
from warp_gi.scene.camera import Camera
from warp_gi.scene.pinhole import camera_data
from warp_gi.scene.scene import Scene
from warp_gi.techniques.light_hierarchy.estimator import LightHierarchy
from warp_gi.techniques.shared.lamps import lit_data
from warp_gi.techniques.shared.ltc import ltc_table
from warp_gi.techniques.surface_cache.cells import NOTHING, Sums, with_table

FIRST_PASSES, FIRST_SHARE, FIRST_VERTICES = 4, 0.03, 3
"""Number of first passes, which are dropped, the share of the paths in each, and how many times as long these are. A
vertex has as many bounces behind it as the path goes on, so the light that a pass lacks is what the pass before lacked
times the mean of a^k over k = 1 to the number of vertices, where a is the albedo: .42 for .8 and 8 vertices, .17 for
24."""
FIRST_PATHS = 250
"""Smallest number of paths of a first pass: what later passes read behind their last vertices must not be a few cells.
Where first passes would take more than half of the paths that are asked for, others are traced beside them."""
LATER_PASSES = 3
"""Number of passes that share the other paths, and are kept."""
LAUNCH_RECORDS = 1 << 19
"""Largest number of records of a launch, paths times vertices, so that they need no more memory with more of both."""
SHARE_OF_DIAGONAL, LARGEST_SIDE = 0.01, 0.15
"""Side of a cell near the camera, unless told: a share of the diagonal of the scene, but at most so many metres, as a
cell must not reach through a wall."""
SMALLEST_VOLUME = 1e-18
"""Smallest volume of a unit cube of an object's own space, m^3, whose placement is inverted."""
LEAST_SCALE = 0.5
"""Scale of an object over that at time 0 down to which, and up to the inverse of which, it has a grid of its own."""
MOST_BOXES = 8
"""Largest number of pieces of the camera's path that have a box each."""


@dataclass(frozen=True)
class FillSettings:
    """What decides the cells; the fields of a SurfaceCache of these names."""

    paths: int
    """Number of paths."""
    vertices: int
    """Vertices of a path."""
    cell: float
    """Side of a cell near the camera, in metres; 0 follows from the scene."""
    growth: float
    """Side of a cell over its distance from the camera's path."""
    capacity: int
    """Largest number of cells."""

    def stored(self) -> dict[str, Setting]:
        """Return the settings that a bake stores and is checked by."""
        return asdict(self)


def fill(
    scene: Scene,
    settings: FillSettings,
    grid: SurfaceCells,
    cameras: Sequence[Camera],
    device: wp.Device,
    seed: int,
    progress: Callable[[float], None] | None = None,
) -> tuple[Sums, int]:
    """Return the smallest cells that paths from ``cameras`` fill, and the number of vertices of all paths.

    ``cameras`` are the frames of a camera's path, or one of them. The scene is seen in its pose now.

    Paths come in passes. Each pass reads behind its last vertices what the passes before left. What the first passes
    left is dropped when the next one is done, but for cells that it did not meet, as their paths ended in too little
    light. ``grid`` tells the places of cells; what is in its table is not read.
    """
    first = [max(int(settings.paths * FIRST_SHARE), FIRST_PATHS)] * FIRST_PASSES
    left = max(settings.paths - sum(first), settings.paths // 2)
    counts = [*first, *(left * (k + 1) // LATER_PASSES - left * k // LATER_PASSES for k in range(LATER_PASSES))]
    longer = replace(settings, vertices=settings.vertices * FIRST_VERTICES)
    total, vertices, done, lights = NOTHING, 0, 0, fill_lights(scene, device)
    for number, count in enumerate(counts):
        cells = table_of(grid, total, settings.capacity, device)
        chosen = longer if number < FIRST_PASSES else settings
        found = add_pass(scene, chosen, cells, cameras, done, count, seed, device, lights)
        vertices += int(found.counts.sum())
        if number < FIRST_PASSES:
            total = found + total.without(found)
        else:
            total = total + found if number > FIRST_PASSES else found
        done += count
        if progress is not None:
            progress(done / sum(counts))
    return total, vertices


def fill_lights(scene: Scene, device: wp.Device) -> LightTree | None:
    """Return the hierarchy over a scene's lights in their pose now; None where they are picked by power."""
    state = LightHierarchy().start(scene, device.alias)
    return None if state is None else state.data


def table_of(grid: SurfaceCells, sums: Sums, capacity: int, device: wp.Device, tells: bool = False) -> SurfaceCells:
    """Return a grid whose table holds the smallest cells ``sums`` and the levels above them.

    Warns of cells without a place if ``tells``.
    """
    known, over = sums.with_levels().most_sampled(capacity)
    if tells:
        tell_over(over, capacity)
    return with_table(grid, known.keys, known.means(), device)


def tell_over(over: int, capacity: int) -> None:
    """Warn of cells that found no place, if there are any."""
    if over:
        warnings.warn(
            f"the surface cache is full: it keeps {capacity:,} cells, and {over:,} with fewer samples "
            "found no place; light is blurred over larger cells there, and may leak through walls: "
            "raise capacity, cell or growth",
            stacklevel=3,
        )


def add_pass(
    scene: Scene,
    settings: FillSettings,
    cells: SurfaceCells,
    cameras: Sequence[Camera],
    done: int,
    count: int,
    seed: int,
    device: wp.Device,
    lights: LightTree | None,
) -> Sums:
    """Return the sums of a pass of ``count`` paths, whose random numbers come after those of ``done`` others.

    The scene is seen in its pose now. Behind their last vertices paths read ``cells``; ``lights`` are ``fill_lights``.
    """
    total = NOTHING
    query, data, table = kernels.FillSettings(), lit_data(scene, device), ltc_table(device)
    query.cameras = wp.array([camera_data(camera) for camera in cameras], dtype=CameraData, device=device)
    query.pass_paths, query.index = count, done & 0xFFFFFFFF
    if lights is not None:
        query.by_tree, query.tree = 1, lights
    query.seed, query.vertices = seed & 0xFFFFFFFF, settings.vertices
    most = max(LAUNCH_RECORDS // settings.vertices, 1)
    for start in range(0, count, most):
        paths = min(most, count - start)
        size = paths * settings.vertices
        query.first_path = start
        records = kernels.FillRecords()
        records.keys = wp.empty(size, dtype=wp.uint64, device=device)
        for name in ("irradiance", "exitance", "diffuse", "along"):
            setattr(records, name, wp.empty(size, dtype=wp.vec3, device=device))
        launch.launch(kernels.fill_cells, paths, [data, table, cells, query, records], device)
        keys = records.keys.numpy()
        kept = np.flatnonzero(keys)
        irradiance, exitance = records.irradiance.numpy()[kept], records.exitance.numpy()[kept]
        squares = (irradiance.astype(np.float64) @ LUMINANCE) ** 2
        light = np.concatenate([irradiance, exitance, squares[:, None]], axis=1)
        total = total + Sums.of(keys[kept], light)
    return total


def empty_grid(scene: Scene, settings: FillSettings, boxes: np.ndarray, device: wp.Device) -> SurfaceCells:
    """Return the grid of cells over a scene, without a cell in its table."""
    low, high = scene.bounds.astype(np.float64)
    extent = float(np.linalg.norm(high - low))
    side = settings.cell or min(SHARE_OF_DIAGONAL * extent, LARGEST_SIDE)
    side = max(side, 2.0 * extent / int(LARGEST_COORDINATE), 1e-12)
    return grid_at(low - side, side, settings.growth, boxes, device)


def holds(grid: SurfaceCells, scene: Scene) -> bool:
    """Return whether all of a scene lies in a grid."""
    low, (lowest, highest) = np.array(grid.low, np.float64), scene.bounds.astype(np.float64)
    return bool((low <= lowest).all() and (highest < low + grid.side * int(LARGEST_COORDINATE)).all())


def grid_at(low: np.ndarray, side: float, growth: float, boxes: np.ndarray, device: wp.Device) -> SurfaceCells:
    """Return a grid without a cell in its table: its corner and side, and boxes float32 [box, 2, 3], in metres."""
    grid = SurfaceCells()
    grid.low, grid.side, grid.growth = wp.vec3(*map(float, low)), side, growth
    grid.boxes = wp.array(boxes.reshape(-1, 3).astype(np.float32), dtype=wp.vec3, device=device)
    grid.objects = wp.zeros(0, dtype=ObjectGrid, device=device)
    return with_table(grid, np.zeros(0, np.uint64), np.zeros((0, 8), np.float32), device)


def object_grids(scene: Scene, time: float, device: wp.Device) -> wp.array:
    """Return the grids of a scene's objects in their pose at ``time`` [s], ObjectGrid [object]; none if nothing moves.

    An object that is far larger or smaller than at time 0 takes the grid of all that is at rest: in its own one cells
    would be as much larger or smaller. The cells of one that changes its shape are its own, and rest in the world: its
    surface moves through them.
    """
    moving, objects = scene.moving_objects, len(scene.object_names)
    rows = np.zeros(objects if moving else 0, ObjectGrid.numpy_dtype())
    rest, now = (world_matrices(scene.nodes, at) if moving else [] for at in (0.0, time))
    for number, index in moving.items():
        if scene.nodes[index].skin is not None:
            rows[number]["number"], rows[number]["rest_from_world"] = 1 + number % int(MOST_OBJECTS), np.eye(4)
            continue
        volume = abs(np.linalg.det(now[index][:3, :3]))
        grown = abs(np.linalg.det(rest[index][:3, :3])) / volume if volume > SMALLEST_VOLUME else 0.0
        if LEAST_SCALE**3 < grown < LEAST_SCALE**-3:
            rows[number]["number"] = 1 + number % int(MOST_OBJECTS)
            rows[number]["rest_from_world"] = rest[index] @ np.linalg.inv(now[index])
    return launch.on_device(rows, ObjectGrid, device)


def camera_boxes(cameras: Sequence[Camera], scene: Scene) -> np.ndarray:
    """Return boxes around the positions of cameras, float32 [box, 2, 3] in metres, each of a piece of their path.

    Those of orthographic cameras hold all that is seen of the scene: it is as large in the picture wherever it is.
    """
    places = [_places(camera, scene) for camera in cameras]
    pieces = [np.concatenate(places[piece[0] : piece[-1] + 1]) for piece in _pieces(len(places))]
    return np.unique(np.array([[piece.min(axis=0), piece.max(axis=0)] for piece in pieces]), axis=0)


def _pieces(count: int) -> list[np.ndarray]:
    return np.array_split(np.arange(count), min(count, MOST_BOXES))


def _places(camera: Camera, scene: Scene) -> np.ndarray:
    """Return the camera's position, or the corners of what an orthographic camera sees; float32 [n, 3] in metres."""
    if not camera.is_orthographic:
        return np.array([camera.position], np.float32)
    width, height = camera.resolution
    near = camera.origins(np.array([(x, y) for x in (0, width) for y in (0, height)]))
    ahead = -camera.world_from_camera[:3, 2]
    corners = np.array(list(product(*scene.bounds.astype(np.float64).T)))
    reach = max(float(((corners - camera.position) @ ahead).max()), 0.0)
    return np.concatenate([near, near + reach * ahead]).astype(np.float32)
