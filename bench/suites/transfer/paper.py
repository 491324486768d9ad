"""The paper's tables 1 and 2 on stand-ins: glossy products at vertices and by textures, in time and memory.

All forms share rows, hits and lobe, and differ in the product alone. At vertices the paper evaluates a colour each and
interpolates those; the library interpolates transfer, so that is done here by kernels of the suite. The time of primary
rays is not in it, as the paper's is mostly that of shaders.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import warp as wp

import warp_gi as gi
from warp_gi.bench.harness.measure import Row, attempt, ratios
from warp_gi.bench.harness.stages import Stage, race
from warp_gi.bench.suites.transfer import kernels
from warp_gi.bench.suites.transfer.shapes import STAND_INS, StandIn
from warp_gi.bench.suites.transfer.views import BIG, SMALL, smooth_sky
from warp_gi.kernels.transfer_products import LIGHT_WIDTH, vec6
from warp_gi.launch import on_device
from warp_gi.scene.baked import whole_scene
from warp_gi.techniques.radiance_transfer import products
from warp_gi.techniques.radiance_transfer.lobes import phong
from warp_gi.techniques.radiance_transfer.textures import transfer_textures
from warp_gi.techniques.shared.atlas.atlas import Atlas

TABLE = "paper, table 1: stand-ins"
QUOTED = "paper, table 1: RTX 3090"
MEMORY = "paper, table 2: stand-ins"
QUOTED_MEMORY = "paper, table 2: its own"
FORMS = {"TP": kernels.TP, "TP reordered": kernels.REORDERED, "TPFL": kernels.TPFL}
EXPONENT = 4.0
"""Exponent of the Phong lobe: about the sharpest that 25 numbers hold."""
RAYS = 64
"""Rays a slot: times depend on the rows' places, not on what is in them."""
LEAST_GAIN = 8.0
"""Target: how many times faster TPFL is than TP by textures."""
TEXTURE_MB = 100.0


def paper_rows(quick: bool, device: str) -> list[Row]:
    """Return rows of all stand-ins: time, memory, and the paper's own."""
    rows: list[Row] = []
    for one in STAND_INS:
        size = one.quick if quick else one.size
        if quick and not size:
            continue
        said = {"table": TABLE, "case": one.name}
        if one.missing:
            rows.append(said | {"skipped": one.missing})
            continue
        resolution = 128 if quick else 1024
        work = partial(stand_in_rows, one, size, resolution, SMALL if quick else BIG, 1 if quick else 3, device)
        rows += attempt(said, work)
    return [*rows, *(row for one in STAND_INS for row in quoted(one))]


def quoted(one: StandIn) -> list[Row]:
    """Return what the paper says of its scene; milliseconds are of its frames a second."""
    rows: list[Row] = []
    for k, (storage, form) in enumerate((s, f) for s in ("vertices", "texture") for f in ("TP", "TPFL")):
        row: Row = {"table": QUOTED, "case": one.name, "storage": storage, "form": form, "pixels": "1920x1080"}
        rows.append(row | {"paper triangles": one.paper_triangles, "paper ms": 1000.0 / one.paper_fps[k]})
    for storage, mb in (("vertices", one.paper_vertex_mb), ("texture", TEXTURE_MB)):
        rows.append({"table": QUOTED_MEMORY, "case": one.name, "storage": storage, "paper MB": mb})
    return rows


def stand_in_rows(
    one: StandIn, size: int, resolution: int, pixels: tuple[int, int], turns: int, device: str
) -> list[Row]:
    """Return the rows of one stand-in."""
    scene = one.build(size)
    scene.environment = smooth_sky()
    camera, works, memory = one.camera(pixels), dict[str, Callable[[], None]](), list[Row]()
    said: Row = {"case": one.name, "triangles": scene.triangle_count}
    for storage in ("vertices", "texture"):
        estimator = gi.RadianceTransfer(
            storage=storage,
            resolution=resolution,
            first_rays=RAYS,
            rays=RAYS,
            bounces=0,
            chart_seconds=0.0,
            glossy="transfer",
        )
        bake = gi.bake(scene, estimator, device)
        stage = Stage(scene, camera, estimator, 1, device, bake)
        for form in FORMS:
            works[f"{storage}, {form}"] = Shader(stage, bake, form)
        slots, rows_mb = bake.counts["slots"], 2e-6 * stage.state.rows.transfer.size
        if storage == "vertices":
            slots, rows_mb = slots // 2, rows_mb / 2  # fronts alone, as in the paper
        row: Row = {"table": MEMORY, **said, "storage": storage, "slots": slots, "MB": rows_mb}
        memory.append(row | {"charts cpu s": bake.counts["charts_cpu_seconds"]})
    taken = race(works, turns, device)
    rows: list[Row] = []
    for name in works:
        storage, form = name.split(", ")
        row = {"table": TABLE, **said, "storage": storage, "form": form, "pixels": "{}x{}".format(*pixels)}
        row |= {"wall ms": taken[name].times[0] * 1e3, "cpu ms": taken[name].times[1] * 1e3}
        row["ns a pixel"] = taken[name].cost / (pixels[0] * pixels[1]) * 1e9
        row |= ratios("times TP, {}", taken[f"{storage}, TP"], taken[name])
        rows.append(row | {"target": LEAST_GAIN if (storage, form) == ("texture", "TPFL") else 0.0})
    return rows + memory


class Shader:
    """Evaluates one form of the product for a frame, by textures or at vertices."""

    def __init__(self, stage: Stage, bake: gi.Bake, form: str) -> None:
        self.frame, self.rows = stage.frame, stage.state.rows
        device = self.frame.device
        self.width, self.height = self.frame.camera.resolution
        scene = whole_scene(self.frame.scene)
        self.query = product_query(scene.environment or gi.Environment(), form, device)
        self.colors = wp.zeros(self.width * self.height, dtype=wp.vec3, device=device)
        atlas = transfer_textures(bake).atlas
        self.vertices = None
        if len(atlas.corner_slots):
            self.vertices = vertex_places(scene, atlas, self.frame.camera, device)
            self.at_vertices = wp.zeros(self.vertices.points.shape[0], dtype=wp.vec3, device=device)

    def __call__(self) -> None:
        """Shade the frame once."""
        if self.vertices is None:
            self.by_textures()
        else:
            self.by_vertices(self.vertices)
        wp.synchronize_device(self.frame.device)

    def by_textures(self) -> None:
        """Evaluate the product at each pixel."""
        frame = self.frame
        inputs = [frame.data, self.rows, self.query, frame.hits, self.width, self.height, self.colors]
        frame.launch_tiled(kernels.evaluate_pixels, inputs)

    def by_vertices(self, vertices: kernels.ProductVertices) -> None:
        """Evaluate the product at each vertex, and interpolate."""
        inputs = [self.rows.transfer, self.query, vertices, self.at_vertices]
        self.frame.launch(kernels.evaluate_vertices, inputs, vertices.points.shape[0])
        inputs = [self.rows.atlas, self.at_vertices, self.frame.hits, self.width, self.height, self.colors]
        self.frame.launch_tiled(kernels.interpolate_vertices, inputs)

    @property
    def picture(self) -> np.ndarray:
        """What was shaded, float32 [height, width, 3]."""
        return self.colors.numpy().reshape(self.height, self.width, 3)


def vertex_places(scene: gi.Scene, atlas: Atlas, camera: gi.Camera, device: wp.Device) -> kernels.ProductVertices:
    """Return places and normals of the fronts of an atlas of vertices."""
    geometry = scene.data(device).geometry
    fronts = atlas.slot_sides == 0
    ids = geometry.indices.numpy().reshape(-1, 3)[atlas.slot_faces[fronts]]
    points, normals = geometry.points.numpy()[ids], geometry.normals.numpy()[ids]
    u, v = atlas.slot_points[fronts].T
    weights = np.stack([1 - u - v, u, v], axis=1)[:, :, None]
    flat = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    smooth = (normals * weights).sum(axis=1)
    found = np.where(np.linalg.norm(smooth, axis=1, keepdims=True) > 1e-6, smooth, flat)
    result = kernels.ProductVertices()
    result.points = on_device((points * weights).sum(axis=1).astype(np.float32), wp.vec3, device)
    result.normals = on_device(
        (found / np.linalg.norm(found, axis=1, keepdims=True)).astype(np.float32), wp.vec3, device
    )
    result.eye = wp.vec3(*map(float, camera.position))
    return result


def product_query(sky: gi.Environment, form: str, device: wp.Device) -> kernels.ProductQuery:
    """Return a sky of 25 numbers and a Phong lobe as kernels read them."""
    light, table = sky.harmonics_of(5), products.tripling(5)
    k, j, i = np.nonzero(table)  # symmetric; i in turn, so that a sum does not wait for the one before
    if form == "TP":
        i, k = k, i
    padded = np.zeros((3, LIGHT_WIDTH), np.float32)
    padded[:, :25] = light
    matrix = np.zeros((25, 3, LIGHT_WIDTH), np.float32)
    matrix[:, :, :25] = products.light_matrix(light, 5).transpose(1, 0, 2)
    query = kernels.ProductQuery()
    query.light, query.matrix = (on_device(one.reshape(-1), wp.float32, device) for one in (padded, matrix))
    query.terms = on_device((i | j << 8 | k << 16).astype(np.int32), wp.int32, device)
    query.values = on_device(table[i, j, k].astype(np.float32), wp.float32, device)
    query.lobe = vec6(*phong(EXPONENT, 5), 0.0)
    query.form = int(FORMS[form])
    return query
