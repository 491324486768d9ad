"""The sky's diffuse light at pixels by three integrals, as was done before what corners see was blended.

Each corner of a triangle has its polygons seen from the pixel, by parallax, and integrated; their light is blended
(visibility_correspondence.txt, Eq. 19, after Ho et al.). Kept to compare with.
"""

import warp as wp

from warp_gi.kernels.gbuffer import PassSettings, PrimaryHits, tiled_pixel
from warp_gi.kernels.surface import shading_normal, surface_at
from warp_gi.kernels.types import SceneData
from warp_gi.kernels.visibility_polygons import (
    MATCHED,
    PolygonLists,
    PolygonSets,
    record_normal,
    record_point,
    synthesized,
)
from warp_gi.kernels.visibility_polygons_sky import EdgeSum, PolygonSky, not_negative, polygon_light, with_edge
from warp_gi.kernels.visibility_polygons_trace import PolygonBuffers, add_equal, diffuse_value, needs_rays, seen_record

wp.set_module_options({"enable_backward": False})


# Direction of a point of a contour, `away` metres from the vertex; the horizon turns from normal a to b.
@wp.func
def corner_direction(q: wp.vec4, away: wp.vec3, a: wp.vec3, b: wp.vec3) -> wp.vec3:
    if q[3] > 0.0:
        return synthesized(q, away)
    d = wp.vec3(q[0], q[1], q[2])
    axis = wp.cross(a, b)
    turned = wp.cross(axis, d)
    return d + turned + wp.cross(axis, turned) / wp.max(1.0 + wp.dot(a, b), 1.0e-6)


# Irradiance [W/m^2] of a point of a record by the sky that the polygons of its corners show from there, blended.
@wp.func
def corners_light(
    sets: PolygonSets, lists: PolygonLists, sky: PolygonSky, record: wp.int32, weights: wp.vec3, normal: wp.vec3
) -> wp.vec3:
    light = wp.vec3(0.0, 0.0, 0.0)
    corners = lists.corner_sets[record]
    point = record_point(sets, corners, weights)
    up = record_normal(sets, corners, weights)
    for k in range(3):
        set = corners[k]
        away = sets.positions[set] - point
        sum = EdgeSum()
        sum.normal = sky.sky_from_world * normal
        sum.center = sky.sky_from_world * up
        for contour in range(sets.contour_starts[set], sets.contour_starts[set + 1]):
            begin = sets.point_starts[contour]
            end = sets.point_starts[contour + 1]
            last = corner_direction(sets.points[end - 1], away, sets.normals[set], up)
            before = sky.sky_from_world * last
            for i in range(begin, end):
                next = sky.sky_from_world * corner_direction(sets.points[i], away, sets.normals[set], up)
                sum = with_edge(sky, sum, before, next)
                before = next
        light = light + not_negative(polygon_light(sky, sum)) * weights[k]
    return light


# Thread: a pixel. As shade_polygons of visibility_polygons_shade, by three integrals.
@wp.kernel
def shade_corners(
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
    light = wp.cw_mul(share, corners_light(sets, lists, sky, record, wp.vec3(1.0 - u - v, u, v), normal))
    if needs_rays(s.bsdf):
        buffers.known[pixel] = light
    else:
        add_equal(buffers, pixel, light, wp.float32(settings.sample_count))
