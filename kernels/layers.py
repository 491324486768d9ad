"""Layers: all that a camera ray shows through blended surfaces and glass, of which ray queries draw one by chance.

What a picture's readers and denoisers go by is the mean over the layers, so it has no noise: albedo, normals, coverage,
emission. These kernels take a scene whose tree has `chance` 2: what lets rays pass by chance stops them all there.
"""

import warp as wp

from warp_gi.kernels.bsdf import average_specular
from warp_gi.kernels.bvh import BvhHit, bvh_intersect, coverage, is_masked, transmitted
from warp_gi.kernels.environment import environment_radiance
from warp_gi.kernels.gbuffer import (
    CameraData,
    PassSettings,
    PrimaryHits,
    SurfaceBuffers,
    camera_origin,
    keep_guides,
    keep_place,
    motion_of,
    previous_position,
    primary_sample,
    project,
    view_distance,
)
from warp_gi.kernels.panes import glass_tint, has_panes
from warp_gi.kernels.surface import Surface, shading_normal, surface_at, surface_emission
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})

PAST_HIT = wp.constant(wp.float32(1.0002))  # of the way to a layer, so that its own tint counts for what is behind
PAST_END = wp.constant(wp.float32(1.00001))  # of the way to what ends a ray, up to which layers lie before it
MOST_LAYERS = wp.constant(64)
LEAST_LEFT = wp.constant(wp.float32(1.0e-4))  # share of a ray that is not followed further


# Sums over the layers of a ray, each times its share of the ray; and the layer with the largest share.
@wp.struct
class Layers:
    left: wp.float32  # share that meets nothing
    tint: wp.vec3  # of what is behind the layers so far, over its luminance
    diffuse: wp.vec3
    specular: wp.vec3
    albedo: wp.vec3
    normal: wp.vec3
    emission: wp.vec3  # without the sky
    share: wp.float32  # the largest
    face: wp.int32  # -1: the ray meets nothing at all
    u: wp.float32
    v: wp.float32


# The sums with a layer that stops some share of the ray. What denoisers divide by has the tint that the light has, too.
@wp.func
def with_layer(
    layers: Layers, scene: SceneData, hit: BvhHit, s: Surface, direction: wp.vec3, share: wp.float32
) -> Layers:
    r = layers
    r.left = wp.max(r.left - share, 0.0)
    r.diffuse = r.diffuse + wp.cw_mul(s.bsdf.diffuse, r.tint) * share
    r.specular = r.specular + wp.cw_mul(average_specular(s.bsdf), r.tint) * share
    r.albedo = r.albedo + s.base_color * share
    r.normal = r.normal + shading_normal(s) * share
    r.emission = r.emission + wp.cw_mul(surface_emission(scene, hit.face, hit.u, hit.v, -direction), r.tint) * share
    if share > r.share:
        r.share = share
        r.face = hit.face
        r.u = hit.u
        r.v = hit.v
    return r


# All layers up to the closest surface that lets no ray pass, which is looked for first: so it is met however close a
# layer lies before it, as a decal on a wall, and whatever share is left after the last layer is its.
@wp.func
def layers_along(scene: SceneData, start: wp.vec3, direction: wp.vec3) -> Layers:
    r = Layers()
    r.left = 1.0
    r.tint = wp.vec3(1.0, 1.0, 1.0)
    r.face = -1
    tree = scene.bvh
    end = BvhHit()
    end.face = -1
    origin = start
    count = int(0)
    if scene.bvh.chance != 0:
        tree.chance = 3
    while count <= MOST_LAYERS:
        hit = bvh_intersect(tree, origin, direction, float(wp.inf))
        if count == 0:
            end = hit
            if tree.chance == 0:
                break
            tree.chance = 2
        else:
            if hit.face < 0 or hit.face == end.face or not is_masked(scene.bvh, hit.face):
                break
            s = surface_at(scene, hit.face, hit.u, hit.v, -direction)
            if end.face >= 0 and wp.dot(s.position - start, direction) > end.t * PAST_END:
                break
            stops = 1.0 - transmitted(scene.bvh, hit.face, hit.u, hit.v, direction)[0]
            r = with_layer(r, scene, hit, s, direction, r.left * stops * coverage(scene.bvh, hit.face, hit.u, hit.v))
            if has_panes(scene.panes):
                r.tint = wp.cw_mul(r.tint, glass_tint(scene, origin, direction, hit.t * PAST_HIT))
            if r.left < LEAST_LEFT:
                break
            origin = s.position - s.normal * s.offset
        count += 1
    if end.face >= 0 and r.left > 0.0:
        s = surface_at(scene, end.face, end.u, end.v, -direction)
        r = with_layer(r, scene, end, s, direction, r.left)
    return r


# What the diffuse light of a drawn surface is multiplied with, so that times the mean albedo it is what was reflected.
@wp.func
def albedo_ratio(drawn: wp.vec3, mean: wp.vec3) -> wp.vec3:
    r = wp.vec3(0.0, 0.0, 0.0)
    for k in range(3):
        if mean[k] > 0.0:
            r[k] = drawn[k] / mean[k]
    return r


# Thread: a pixel. As gbuffer.shade_primary, for means over layers; what is of one surface is that of the layer with the
# largest share. `emission` is that of this camera sample alone, of which moments of its light are made.
@wp.kernel
def shade_layers(
    first: wp.int32,
    scene: SceneData,
    camera: CameraData,
    previous_camera: CameraData,
    settings: PassSettings,
    hits: PrimaryHits,
    buffers: SurfaceBuffers,
    emission: wp.array(dtype=wp.vec3),
):
    pixel = first + wp.tid()
    direction = hits.direction[pixel]
    at = primary_sample(settings, wp.vec2i(pixel % camera.width, pixel / camera.width))
    origin = camera_origin(camera, at[0], at[1])
    r = layers_along(scene, origin, direction)
    sky = environment_radiance(scene.environment, direction)
    emission[pixel] = r.emission + wp.cw_mul(sky, r.tint) * r.left
    buffers.emission[pixel] = buffers.emission[pixel] + emission[pixel]
    buffers.alpha[pixel] = buffers.alpha[pixel] + 1.0 - r.left
    buffers.albedo[pixel] = buffers.albedo[pixel] + r.albedo
    buffers.normal[pixel] = buffers.normal[pixel] + r.normal
    motion = project(previous_camera, direction) - project(camera, direction)
    if r.face < 0:
        keep_place(scene, buffers, settings, pixel, wp.vec3(0.0, 0.0, 0.0), float(wp.inf), motion, -1)
        return
    s = surface_at(scene, r.face, r.u, r.v, -direction)
    was = previous_position(scene.geometry, r.face, r.u, r.v)
    motion = motion_of(camera, previous_camera, direction, s.position, was)
    depth = wp.dot(s.position - camera.position, camera.forward)
    keep_place(scene, buffers, settings, pixel, s.position, depth, motion, r.face)
    if buffers.guide_object.shape[0] == 0:
        return
    buffers.guide_diffuse[pixel] = buffers.guide_diffuse[pixel] + r.diffuse
    buffers.guide_specular[pixel] = buffers.guide_specular[pixel] + r.specular
    distance = view_distance(camera, wp.length(s.position - origin))
    keep_guides(buffers, pixel, s, distance, was, motion, scene.geometry.objects[r.face])
    if hits.face[pixel] >= 0:
        drawn = surface_at(scene, hits.face[pixel], hits.u[pixel], hits.v[pixel], -direction)
        buffers.guide_ratio[pixel] = albedo_ratio(drawn.bsdf.diffuse, r.diffuse)


# Light that a denoiser divides by albedo, [height * width]: before this camera sample, and with it. Empty: not wanted.
@wp.struct
class LobeSums:
    ratio: wp.array(dtype=wp.vec3)
    diffuse_before: wp.array(dtype=wp.vec3)
    diffuse: wp.array(dtype=wp.vec3)
    apart_before: wp.array(dtype=wp.vec3)
    apart: wp.array(dtype=wp.vec3)


# Thread: a pixel. Makes what a camera sample added the light of the layers' mean albedo.
@wp.kernel
def share_lobes(first: wp.int32, sums: LobeSums):
    i = first + wp.tid()
    before = sums.diffuse_before[i]
    sums.diffuse[i] = before + wp.cw_mul(sums.diffuse[i] - before, sums.ratio[i])
    if sums.apart.shape[0] > 0:
        was = sums.apart_before[i]
        sums.apart[i] = was + wp.cw_mul(sums.apart[i] - was, sums.ratio[i])
