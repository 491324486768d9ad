"""Tints of coloured glass: what is left of light that goes straight through panes, by colour.

Rays pass glass by chance, with a probability that goes by the luminance of its tint (bvh_native.py). So a ray that has
passed carries the tint over its luminance. Panes of coloured glass have a tree of boxes of their own.
"""

import warp as wp

from warp_gi.kernels.bsdf import luminance
from warp_gi.kernels.bvh import coverage, transmitted, triangle_hit
from warp_gi.kernels.surface import texture_lookup, triangle_uv
from warp_gi.kernels.types import Panes, SceneData

wp.set_module_options({"enable_backward": False})

BEFORE_HIT = wp.constant(wp.float32(0.9999))  # share of the way to a hit on which panes count: not what was hit


# Whether there are panes of coloured glass. Most scenes have none, and code for them stands aside on the CPU.
@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    return panes.count > 0;
#else
    return __builtin_expect(panes.count > 0, 0);
#endif
"""
)
def has_panes(panes: Panes) -> wp.bool: ...


# Tint of glass at a point of a triangle, over its luminance.
@wp.func
def pane_color(scene: SceneData, face: wp.int32, u: wp.float32, v: wp.float32) -> wp.vec3:
    m = scene.materials[scene.geometry.materials[face]]
    color = m.base_color
    if m.base_color_texture >= 0:
        texel = texture_lookup(scene, m.base_color_texture, triangle_uv(scene, face, u, v))
        color = wp.cw_mul(color, wp.vec3(texel[0], texel[1], texel[2]))
    return color / wp.max(luminance(color), 1.0e-9)


# What a ray that has come as far as `t_max` is multiplied with, for the colours of the panes that it went through. A
# pane with holes, or a blended one, is passed without its tint, too: the mean of both.
@wp.func
def glass_tint(scene: SceneData, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.vec3:
    tint = wp.vec3(1.0, 1.0, 1.0)
    query = wp.bvh_query_ray(scene.panes.bvh, origin, direction)
    item = int(0)
    while wp.bvh_query_next(query, item, t_max):
        face = scene.panes.faces[item]
        ids = scene.geometry.indices[face]
        points = scene.geometry.points
        hit = triangle_hit(origin, direction, points[ids[0]], points[ids[1]], points[ids[2]])
        if hit[0] > 0.0 and hit[0] < t_max * BEFORE_HIT:
            there = coverage(scene.bvh, face, hit[1], hit[2])
            through = there * transmitted(scene.bvh, face, hit[1], hit[2], direction)[0]
            color = pane_color(scene, face, hit[1], hit[2])
            white = wp.vec3(1.0, 1.0, 1.0)
            tint = wp.cw_mul(tint, (white * (1.0 - there) + color * through) / wp.max(1.0 - there + through, 1.0e-9))
    return tint
