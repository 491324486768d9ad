"""The kernels that a pipeline will launch, known before it renders: they compile while the scene is loaded."""

from __future__ import annotations

from typing import TYPE_CHECKING

from warp_gi.kernels import bvh_build, checksum, compose, path_samplers
from warp_gi.kernels.path_trace import path_tracer
from warp_gi.scene.panes import has_colored_tint

if TYPE_CHECKING:
    import warp as wp

    from warp_gi.pipeline import Pipeline
    from warp_gi.scene.baked import BakedScene
    from warp_gi.scene.scene import Scene


def kernels_of(pipeline: Pipeline, scene: Scene | BakedScene | None = None) -> list[wp.Kernel]:
    """Return a kernel of each module that frames of a pipeline launch, in the order in which they are waited for.

    They are the scene's own, and those that the pipeline's parts name (``Stateful.kernels``). The path tracer is the
    one of the samplers that they name (``Stateful.samplers``). ``scene`` None is not known yet.
    """
    parts = pipeline.parts()
    last = {place: parts.pop(place) for place in ("denoise",) if place in parts}
    _, primary = pipeline.primary()
    found = [bvh_build.bound_triangles, checksum.sum_chunks]
    for part in (*parts.values(), primary):
        found += part.kernels(scene)
    if not primary.is_whole:
        found += [*_tracer(pipeline, scene), compose.compose_frame]
    for part in last.values():
        found += part.kernels(scene)
    return found


def _tracer(pipeline: Pipeline, scene: Scene | BakedScene | None) -> list[wp.Kernel]:
    """Return the kernel of the path tracer with the samplers that the parts name; none where that needs the scene."""
    given = [part.samplers(scene) for part in pipeline.parts().values()]
    if any(one is None for one in given):
        return []
    named = {type(one): one for samplers in given for one in samplers or ()}
    caches = [one for _, part in pipeline.radiance_caches() for one in part.samplers(scene) or ()]
    lights = named.get(path_samplers.LightSampler, path_samplers.ALIAS_LIGHTS)
    directions = named.get(path_samplers.DirectionSampler, path_samplers.BSDF_DIRECTIONS)
    uses_regions = lights.uses_regions or directions.uses_regions
    regions = named.get(path_samplers.Regions) if uses_regions else None
    cache = next((one for one in caches if isinstance(one, path_samplers.PathCache)), path_samplers.NO_CACHE)
    sky = named.get(path_samplers.Sky, path_samplers.SCENE_SKY)
    tints = any(has_colored_tint(material) for material in getattr(scene, "materials", ()))
    return [path_tracer(lights, directions, regions or path_samplers.NO_REGIONS, sky, cache, tints).trace_paths]
