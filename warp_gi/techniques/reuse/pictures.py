"""Pictures of what is learnt from samples: the octree's leaves, cached lights, shares of samples, and a quadtree."""

from __future__ import annotations

import math
from numbers import Integral
from pathlib import Path

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.errors import OptionError
from warp_gi.frame import Frame
from warp_gi.kernels import reuse_pictures as kernels
from warp_gi.kernels import types
from warp_gi.kernels.light_cache import CacheTables
from warp_gi.kernels.octree import Octree
from warp_gi.paths import sky_probability
from warp_gi.scene.baked import whole_scene
from warp_gi.scene.camera import Camera
from warp_gi.scene.pinhole import camera_data
from warp_gi.scheduler import FrameScheduler
from warp_gi.sequence.preview import magma, to_bytes, write_pngs
from warp_gi.techniques.light_field.ray import probe_color
from warp_gi.techniques.light_field.state import low_directions
from warp_gi.techniques.paths.estimators import TracedEnvironment
from warp_gi.techniques.reuse.guided_paths import GuidedPaths
from warp_gi.techniques.reuse.light_cache import VisibilityLightCache
from warp_gi.techniques.reuse.sample_octree import OctreeState
from warp_gi.techniques.shared.legends import round_above, scale_bar, stacked, with_keys

MAP_TEXELS = 64
"""Texels along a side of the map of the light that comes to a point."""
MAP_RAYS = 128
"""Rays a texel of that map."""
MAP_PIXELS = 512
"""Pixels along a side of each map in the picture."""
LEAST_DENSITY = 1e-3
"""Density where the scale begins, 1/sr; the largest leaf of a quadtree of 128 bits has at least 0.002."""
NOTHING_COLOR = (255, 255, 255)
BORDER_COLOR = (0, 130, 130)  # dark turquoise, which magma does not have
SHADE = np.array([0.37, 0.84, 0.40])
"""Unit vector towards which surfaces are brightest where leaves are shown."""
GAP = 8  # pixels between two maps


def reuse_pictures(
    scheduler: FrameScheduler, frame: Frame, folder: str | Path, pixel: tuple[int, int] | None = None
) -> list[Path]:
    """Write pictures of what the pipeline has learnt after a frame, as PNG files; return the paths.

    Pixels show the surface in their middle. leaves.png: each leaf of the octree in a colour of its own. samples.png:
    number of the frame's samples in the leaf. With a VisibilityLightCache, lights.png: number of lights in the leaf's
    cache, and exploration.png: share of its samples that explore. With GuidedPaths, bsdf_share.png: share of directions
    by the BSDF, for rough surfaces; and with a pixel quadtree.png: octahedral maps of the light that comes to the point
    there, path traced, and of the density of its leaf's quadtree (temporal_reuse.txt, Fig. 10).

    Args:
        scheduler: Scheduler that rendered the frame, and no frame since.
        frame: Last frame of the scheduler.
        folder: Where pictures go; made if missing.
        pixel: Column and row, (0, 0) at the top left.

    Raises OptionError for a pipeline that learns nothing, or for a pixel outside of the picture or without a surface.
    """
    with scheduler.scene.lock:
        check_pictures(scheduler, frame.camera, pixel)
        scheduler.scene.update_sky(frame.time)
        scheduler.scene.update(frame.time, None, scheduler.device)  # others may have moved it since the frame
        return write_pngs(folder, _pictures(scheduler, frame, pixel))


def _pictures(scheduler: FrameScheduler, frame: Frame, pixel: tuple[int, int] | None) -> dict[str, np.ndarray]:
    """Return the pictures by name, uint8 [height, width, 3]."""
    width, height = frame.camera.resolution
    state = scheduler.state("octree")
    view = _view(frame.data, frame.camera, state.octree, frame.device)
    leaves = view.leaves.numpy().reshape(height, width)
    pictures = {
        "leaves": _draw_leaves(leaves, view.normals.numpy().reshape(height, width, 3), state, frame.index),
        "samples": _draw_counts(leaves, state.counts.numpy(), f"samples a leaf, frame {frame.index}"),
    }
    if isinstance(scheduler.pipeline.emitters, VisibilityLightCache):
        known = scheduler.state("emitters")
        if known is not None:
            shares, most = known.tables.exploration.numpy().copy(), 1.0
            shares[known.tables.buckets.numpy() == 0] = 1.0  # where nothing is known, all samples explore
            pictures["lights"] = _draw_counts(leaves, cached_lights(known.tables), "lights in the cache of a leaf")
            title = _about(leaves, shares, "share of samples that explore")
            pictures["exploration"] = _draw_values(leaves, shares, round_above(most), title)
    if isinstance(scheduler.pipeline.indirect, GuidedPaths):
        shares = scheduler.state("indirect").guides.shares.numpy()[:, 0]
        title = _about(leaves, shares, "share of directions by the BSDF, rough surfaces")
        pictures["bsdf_share"] = _draw_values(leaves, shares, 1.0, title)
    if pixel is not None:
        pictures["quadtree"] = _draw_quadtree(scheduler, frame, view, pixel)
    return pictures


def check_pictures(scheduler: FrameScheduler, camera: Camera, pixel: tuple[int, int] | None = None) -> None:
    """Raise OptionError where ``reuse_pictures`` would, as far as that is known before the frame.

    In a scene where nothing moves, that includes a pixel without a surface.
    """
    pipeline = scheduler.pipeline
    if "octree" not in pipeline.services():
        raise OptionError(
            "pictures of reuse show what is learnt from samples, and no estimator of this pipeline learns; the preset "
            '"reuse" does'
        )
    if pixel is None:
        return
    _guided_paths(scheduler)
    width, height = camera.resolution
    column, row = pixel
    if not (isinstance(column, Integral) and isinstance(row, Integral)):
        raise OptionError(f"pixel must be two whole numbers, column and row, got {pixel!r}")
    if not (0 <= column < width and 0 <= row < height):
        raise OptionError(f"pixel ({column}, {row}) is outside of the picture of {width} x {height} pixels")
    if not scheduler.scene.is_animated:
        cube = pipeline.octree.start(scheduler.scene, scheduler.device).octree
        data = scheduler.scene.data(scheduler.device)
        _check_surface(_view(data, camera, cube, scheduler.device, pixel).leaves.numpy()[0], pixel)


def _guided_paths(scheduler: FrameScheduler) -> GuidedPaths:
    """Return the estimator whose quadtrees are shown; raises OptionError for another one."""
    indirect = scheduler.pipeline.indirect
    if not isinstance(indirect, GuidedPaths):
        name = type(indirect).__name__
        raise OptionError(f"the picture of a pixel's quadtree needs GuidedPaths for the indirect light, not {name}")
    return indirect


def cached_lights(tables: CacheTables) -> np.ndarray:
    """Return how many lights are in the cache of each leaf, int32 [leaf]."""
    buckets, offsets, items = (getattr(tables, name).numpy() for name in ("buckets", "offsets", "items"))
    counts = np.zeros(len(buckets), np.int32)
    filled = buckets > 0
    counts[filled] = items[offsets[filled] + buckets[filled] - 1]
    return counts


# ---- what pixels see ----


def _view(
    data: types.SceneData, camera: Camera, octree: Octree, device: wp.Device, pixel: tuple[int, int] | None = None
) -> kernels.LeafView:
    """Return leaf, point and normal of the surface in the middle of every pixel, or of one."""
    width, height = camera.resolution
    begin, count = (0, width * height) if pixel is None else (pixel[1] * width + pixel[0], 1)
    view = kernels.LeafView()
    view.leaves = wp.empty(count, dtype=wp.int32, device=device)
    view.origins, view.normals = (wp.zeros(count, dtype=wp.vec3, device=device) for _ in range(2))
    launch.launch(kernels.view_leaves, count, [data, camera_data(camera), begin, octree, view], device)
    return view


def _check_surface(leaf: int, pixel: tuple[int, int]) -> None:
    """Raise OptionError for a pixel that sees no leaf, -1."""
    if leaf < 0:
        raise OptionError(f"pixel ({pixel[0]}, {pixel[1]}) sees no surface, so it is in no region; choose another")


# ---- values on surfaces ----


def _draw_leaves(leaves: np.ndarray, normals: np.ndarray, state: OctreeState, index: int) -> np.ndarray:
    """Return a picture of the leaves, each in its colour, a little shaded."""
    masks = state.octree.nodes.numpy() & 255
    is_leaf = (masks[:, None] >> np.arange(8, dtype=np.uint32) & 1).astype(bool).ravel()
    seen, where = np.unique(leaves, return_inverse=True)
    colors = np.array([probe_color(int(leaf)) for leaf in seen]) / 255
    shade = 0.8 + 0.2 * normals @ SHADE
    image = to_bytes(colors[where.reshape(leaves.shape)] * shade[..., None])
    counts = state.counts.numpy()[is_leaf]
    title = f"{len(counts):,} leaves, {int((seen >= 0).sum()):,} of them in view, {int(counts.sum()):,} samples of"
    return _with_nothing(image, leaves, f"{title} frame {index}")


def _draw_counts(leaves: np.ndarray, counts: np.ndarray, title: str) -> np.ndarray:
    """Return a picture of counts by leaf."""
    most = int(counts[leaves[leaves >= 0]].max(initial=0))
    return _draw_values(leaves, counts, max(most, 1), _about(leaves, counts, title))


def _about(leaves: np.ndarray, values: np.ndarray, title: str) -> str:
    """Return the title with the range of the values of leaves in view."""
    seen = values[np.unique(leaves[leaves >= 0])]
    return f"{title}: {seen.min():.4g} to {seen.max():.4g} in view" if seen.size else title


def _draw_values(leaves: np.ndarray, values: np.ndarray, top: float, title: str) -> np.ndarray:
    """Return a picture of values by leaf, with their scale from 0 to ``top``."""
    image = magma(values[np.maximum(leaves, 0)].astype(np.float32) / top)
    return stacked(_with_nothing(image, leaves), scale_bar(leaves.shape[1], top, title))


def _with_nothing(image: np.ndarray, leaves: np.ndarray, title: str = "") -> np.ndarray:
    """Return a picture of leaves in which pixels without a leaf have a colour of their own, with a legend for it."""
    image = np.where(leaves[..., None] < 0, np.array(NOTHING_COLOR, np.uint8), image)
    keys = ((NOTHING_COLOR, "no surface"),) if (leaves < 0).any() else ()
    return with_keys(image, keys, title) if keys or title else image


# ---- a quadtree ----


def _draw_quadtree(
    scheduler: FrameScheduler, frame: Frame, view: kernels.LeafView, pixel: tuple[int, int]
) -> np.ndarray:
    """Return octahedral maps side by side: of the light that comes to a pixel's point, and of its leaf's quadtree."""
    item = pixel[1] * frame.camera.resolution[0] + pixel[0]
    leaf = int(view.leaves.numpy()[item])
    _check_surface(leaf, pixel)
    origin, normal = view.origins.numpy()[item], view.normals.numpy()[item].astype(np.float64)
    light = incident_light(scheduler, frame, origin, normal)
    densities, cells = quadtree_densities(scheduler, leaf, origin)
    directions = low_directions(MAP_TEXELS).astype(np.float64)
    angles = directions[:, 3].reshape(light.shape)
    reflected = light * np.maximum(directions[:, :3] @ normal, 0.0).reshape(light.shape)
    total, scale = float((light * angles).sum()), float((reflected * angles).sum())
    maps = [light / max(total, 1e-30), reflected / max(scale, 1e-30), densities]  # all 1/sr, of integral 1
    top = 10.0 ** math.ceil(math.log10(max(float(values.max()) for values in maps)))
    panels = [_heat(values, top) for values in maps]
    for k in range(2):
        panels[k] = panels[k].repeat(MAP_PIXELS // MAP_TEXELS, axis=0).repeat(MAP_PIXELS // MAP_TEXELS, axis=1)
    border = np.zeros(cells.shape, bool)
    border[:, 1:] |= cells[:, 1:] != cells[:, :-1]
    border[1:] |= cells[1:] != cells[:-1]
    panels[2][border] = BORDER_COLOR
    keys = []
    for decade in range(round(math.log10(top / LEAST_DENSITY)) + 1):
        density = LEAST_DENSITY * 10.0**decade
        (color,) = _heat(np.full((1, 1), density), top)[0].tolist()
        keys.append((tuple(color), f"{'up to ' * (decade == 0)}{density:g} /sr, {density * total:.2g} W/(m2 sr)"))
    title = (
        f"Pixel ({pixel[0]}, {pixel[1]}), frame {frame.index}. Left: luminance of the light that comes to its point, "
        "path traced, but for what comes straight from emitters. Middle: best density for a Lambert surface there, "
        f"that light times the cosine. Right: density of its leaf's quadtree, {len(np.unique(cells))} cells in sight. "
        "All directions, seen from above: +y in the middle, x right, z down."
    )
    gap = np.full((MAP_PIXELS, GAP, 3), NOTHING_COLOR, np.uint8)
    return with_keys(np.concatenate([panels[0], gap, panels[1], gap, panels[2]], axis=1), tuple(keys), title)


def _heat(densities: np.ndarray, top: float) -> np.ndarray:
    """Return densities [1/sr] in the magma colours, on a logarithmic scale from ``LEAST_DENSITY`` to ``top``."""
    share = np.log(np.maximum(densities, LEAST_DENSITY) / LEAST_DENSITY) / math.log(top / LEAST_DENSITY)
    return magma(share.astype(np.float32))


def incident_light(scheduler: FrameScheduler, frame: Frame, origin: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the luminance [W/(m^2 sr)] that comes to a point, float64 [MAP_TEXELS, MAP_TEXELS], an octahedral map.

    Light straight from emitters is left out, and light from below the surface of the ``normal``. Light from the sky is
    in it if paths find the sky, and not another estimator.
    """
    indirect, scene = _guided_paths(scheduler), whole_scene(scheduler.scene)
    data = launch.copied(frame.data, types.SceneData)
    data.emitters = launch.copied(data.emitters, types.Emitters)
    if scene.emitter_count:
        data.emitters.alias = scene.light_table(frame.device)
    incident = kernels.IncidentMap()
    incident.origin, incident.normal = wp.vec3(*origin.tolist()), wp.vec3(*normal.tolist())
    incident.resolution, incident.rays, incident.seed = MAP_TEXELS, MAP_RAYS, frame.seed
    incident.max_depth = indirect.max_depth - 1
    incident.roulette_depth = max(indirect.roulette_depth - 1, 2)
    incident.sky_probability = sky_probability(scene)
    incident.sees_sky = int(isinstance(scheduler.pipeline.environment, TracedEnvironment))
    incident.light = wp.empty(MAP_TEXELS**2, dtype=wp.float32, device=frame.device)
    launch.launch(kernels.map_incident_light, MAP_TEXELS**2, [data, incident], frame.device, 16)
    return incident.light.numpy().reshape(MAP_TEXELS, MAP_TEXELS).astype(np.float64)


def quadtree_densities(scheduler: FrameScheduler, leaf: int, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two octahedral maps [MAP_PIXELS, MAP_PIXELS] of a leaf's quadtree, as it is at a position [m].

    They are its density [1/sr], float32, and the node of its cell in each direction, int32.
    """
    guides = scheduler.state("indirect").guides
    tree, anchor = guides.trees.numpy()[leaf], guides.anchors.numpy()[leaf]
    densities = wp.empty(MAP_PIXELS**2, dtype=wp.float32, device=scheduler.device)
    nodes = wp.empty(MAP_PIXELS**2, dtype=wp.int32, device=scheduler.device)
    settings: list[object] = [wp.vec4ui(*tree.tolist()), _guided_paths(scheduler).bits]
    settings += [wp.vec4(*anchor.tolist()), wp.vec3(*position.tolist()), MAP_PIXELS]
    launch.launch(kernels.map_quadtree, MAP_PIXELS**2, [*settings, densities, nodes], scheduler.device)
    shape = (MAP_PIXELS, MAP_PIXELS)
    return densities.numpy().reshape(shape), nodes.numpy().reshape(shape)
