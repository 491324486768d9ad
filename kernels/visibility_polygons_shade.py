"""The sky's diffuse light at pixels, through polygons: an integral along edges a pixel, and no ray."""

import warp as wp

from warp_gi.kernels.gbuffer import PassSettings, PrimaryHits, tiled_pixel
from warp_gi.kernels.surface import shading_normal, surface_at
from warp_gi.kernels.types import SceneData
from warp_gi.kernels.visibility_polygons import MATCHED, PolygonLists, PolygonSets
from warp_gi.kernels.visibility_polygons_sky import PolygonSky, not_negative, record_light
from warp_gi.kernels.visibility_polygons_trace import PolygonBuffers, add_equal, diffuse_value, needs_rays, seen_record

wp.set_module_options({"enable_backward": False})


# Thread: a pixel. Adds the diffuse light of the current camera sample where polygons know it; where rays add to that,
# `known` has it instead, and is not clamped where their mean has to be right.
@wp.kernel
def shade_polygons(
    first: wp.int32,
    scene: SceneData,
    settings: PassSettings,
    sets: PolygonSets,
    lists: PolygonLists,
    sky: PolygonSky,
    hits: PrimaryHits,
    buffers: PolygonBuffers,
):
    p = tiled_pixel(first + wp.tid(), buffers.width)
    if p[0] >= buffers.width or p[1] >= buffers.height:
        return
    pixel = p[1] * buffers.width + p[0]
    buffers.known[pixel] = wp.vec3(0.0, 0.0, 0.0)
    face = hits.face[pixel]
    if face < 0:
        return
    u = hits.u[pixel]
    v = hits.v[pixel]
    record = seen_record(scene.geometry, face, hits.direction[pixel])
    if lists.states[record] != wp.uint8(MATCHED):
        return
    s = surface_at(scene, face, u, v, -hits.direction[pixel])
    normal = shading_normal(s)
    share = diffuse_value(s.bsdf)
    light = wp.cw_mul(share, record_light(sets, lists, sky, record, wp.vec3(1.0 - u - v, u, v), normal))
    if buffers.unbiased != 0:
        buffers.known[pixel] = light
        return
    light = not_negative(light)
    if needs_rays(s.bsdf):
        buffers.known[pixel] = light
    else:
        add_equal(buffers, pixel, light, wp.float32(settings.sample_count))
