"""Primary visibility: camera rays, first hits, and the buffers read off them."""

import warp as wp

from warp_gi.kernels.bsdf import average_specular
from warp_gi.kernels.environment import environment_radiance
from warp_gi.kernels.sampling import CAMERA_DIMENSION, filter_offset, pixel_sample_index, pixel_seed, sample_2d
from warp_gi.kernels.surface import Surface, shading_normal, surface_at, surface_emission
from warp_gi.kernels.types import Geometry, SceneData

wp.set_module_options({"enable_backward": False})

TILE = 8  # pixels; items run through square tiles, so that neighbours in time are neighbours in the picture


# `right` and `up` are scaled so that forward + x right + y up with x, y in [-1, 1] spans the picture, once `center` is
# added to x and y: where its middle is on that plane. It is zero without a lens shift. Rays of an orthographic camera
# are parallel to `forward` and begin on the plane through `position`, at right x + up y from it.
@wp.struct
class CameraData:
    position: wp.vec3
    right: wp.vec3
    up: wp.vec3
    forward: wp.vec3
    center: wp.vec2
    spread: wp.float32  # 1: rays part from `position`; 0: orthographic
    width: wp.int32
    height: wp.int32


# One camera sample of every pixel, [height * width] in rows from the top.
@wp.struct
class PrimaryHits:
    direction: wp.array(dtype=wp.vec3)  # unit
    t: wp.array(dtype=wp.float32)
    u: wp.array(dtype=wp.float32)
    v: wp.array(dtype=wp.float32)
    face: wp.array(dtype=wp.int32)  # -1 on a miss


# Which samples a pass draws.
@wp.struct
class PassSettings:
    seed: wp.uint32  # of the frame
    camera_sample: wp.int32
    camera_samples: wp.int32
    camera_bits: wp.int32  # ceil(log2(camera_samples))
    first_sample: wp.int32  # samples [first_sample, first_sample + sample_count) of each pixel
    sample_count: wp.int32
    sample_bits: wp.int32  # ceil(log2(spp))
    tent: wp.int32  # 1: tent filter, 0: box


# Running sums over camera samples, [height * width].
@wp.struct
class SurfaceBuffers:
    emission: wp.array(dtype=wp.vec3)
    alpha: wp.array(dtype=wp.float32)  # number of samples that hit
    albedo: wp.array(dtype=wp.vec3)
    normal: wp.array(dtype=wp.vec3)
    position: wp.array(dtype=wp.vec3)  # this and the following: of the first camera sample
    depth: wp.array(dtype=wp.float32)
    motion: wp.array(dtype=wp.vec2)
    object_id: wp.array(dtype=wp.int32)
    material_id: wp.array(dtype=wp.int32)
    guide_diffuse: wp.array(dtype=wp.vec3)  # this and the following: kernels.denoise.Guides, empty without a denoiser
    guide_specular: wp.array(dtype=wp.vec3)
    guide_distance: wp.array(dtype=wp.float32)
    guide_position: wp.array(dtype=wp.vec3)
    guide_previous: wp.array(dtype=wp.vec3)
    guide_motion: wp.array(dtype=wp.vec2)
    guide_normal: wp.array(dtype=wp.vec3)
    guide_plane: wp.array(dtype=wp.vec3)
    guide_object: wp.array(dtype=wp.int32)
    guide_alpha: wp.array(dtype=wp.float32)
    guide_ratio: wp.array(dtype=wp.vec3)  # of this camera sample, see layers.py; empty without blended surfaces


# Pixel of an item, in tiles; y may lie outside the picture.
@wp.func
def tiled_pixel(item: wp.int32, width: wp.int32) -> wp.vec2i:
    per_row = (width + TILE - 1) / TILE
    tile = item / (TILE * TILE)
    inside = item - tile * (TILE * TILE)
    row = tile / per_row
    y = inside / TILE
    return wp.vec2i((tile - row * per_row) * TILE + inside - y * TILE, row * TILE + y)


# Where a point of the picture is on the camera's plane at 1 m, from the middle of that plane; pixel coordinates.
@wp.func
def on_plane(camera: CameraData, x: wp.float32, y: wp.float32) -> wp.vec3:
    sx = 2.0 * x / wp.float32(camera.width) - 1.0 + camera.center[0]
    sy = 1.0 - 2.0 * y / wp.float32(camera.height) + camera.center[1]
    return camera.right * sx + camera.up * sy


@wp.func
def camera_origin(camera: CameraData, x: wp.float32, y: wp.float32) -> wp.vec3:
    return camera.position + on_plane(camera, x, y) * (1.0 - camera.spread)


@wp.func
def camera_ray(camera: CameraData, x: wp.float32, y: wp.float32) -> wp.vec3:
    return wp.normalize(camera.forward + on_plane(camera, x, y) * camera.spread)


# Distance at which a pixel is as wide as it is at a hit: `t` along the ray, and 1 in an orthographic camera.
@wp.func
def view_distance(camera: CameraData, t: wp.float32) -> wp.float32:
    return t * camera.spread + (1.0 - camera.spread)


# Pixel coordinates of a point relative to the camera's position; for a perspective camera of a direction, too.
@wp.func
def project(camera: CameraData, direction: wp.vec3) -> wp.vec2:
    z = wp.max(wp.dot(direction, camera.forward), 1.0e-9) * camera.spread + (1.0 - camera.spread)
    x = wp.dot(direction, camera.right) / (wp.length_sq(camera.right) * z) - camera.center[0]
    y = wp.dot(direction, camera.up) / (wp.length_sq(camera.up) * z) - camera.center[1]
    return wp.vec2(0.5 * (x + 1.0) * wp.float32(camera.width), 0.5 * (1.0 - y) * wp.float32(camera.height))


# Picture coordinates of the camera ray of a pixel; jittered unless there is only one camera sample.
@wp.func
def primary_sample(settings: PassSettings, p: wp.vec2i) -> wp.vec2:
    offset = wp.vec2(0.0, 0.0)
    if settings.camera_samples > 1:
        index = pixel_sample_index(p[0], p[1], settings.camera_sample, settings.camera_bits)
        seed = pixel_seed(p[0], p[1], settings.camera_bits, settings.seed)
        u = sample_2d(index, seed, CAMERA_DIMENSION)
        offset = wp.vec2(filter_offset(settings.tent, u[0]), filter_offset(settings.tent, u[1]))
    return wp.vec2(wp.float32(p[0]) + 0.5 + offset[0], wp.float32(p[1]) + 0.5 + offset[1])


# Where the point (u, v) of a triangle was in the previous frame.
@wp.func
def previous_position(geometry: Geometry, face: wp.int32, u: wp.float32, v: wp.float32) -> wp.vec3:
    ids = geometry.indices[face]
    old = geometry.previous_points
    return old[ids[0]] * (1.0 - u - v) + old[ids[1]] * u + old[ids[2]] * v


# Adds what a denoiser goes by to the means, and keeps the rest of the first camera sample that hits. (The
# nearest sample instead would be the same surface in more frames, but too much of it at outlines: more error.)
@wp.func
def add_guides(
    buffers: SurfaceBuffers,
    pixel: wp.int32,
    s: Surface,
    distance: wp.float32,
    was: wp.vec3,
    motion: wp.vec2,
    object_id: wp.int32,
):
    buffers.guide_diffuse[pixel] = buffers.guide_diffuse[pixel] + s.bsdf.diffuse
    buffers.guide_specular[pixel] = buffers.guide_specular[pixel] + average_specular(s.bsdf)
    keep_guides(buffers, pixel, s, distance, was, motion, object_id)


# Sets the guides that are those of the first camera sample that hits.
@wp.func
def keep_guides(
    buffers: SurfaceBuffers,
    pixel: wp.int32,
    s: Surface,
    distance: wp.float32,
    was: wp.vec3,
    motion: wp.vec2,
    object_id: wp.int32,
):
    if buffers.guide_object[pixel] == 0:
        buffers.guide_distance[pixel] = distance
        buffers.guide_position[pixel] = s.position
        buffers.guide_previous[pixel] = was
        buffers.guide_motion[pixel] = motion
        buffers.guide_normal[pixel] = shading_normal(s)
        buffers.guide_plane[pixel] = s.normal
        buffers.guide_object[pixel] = object_id + 1
        buffers.guide_alpha[pixel] = s.bsdf.alpha


# Motion of a point that the ray of a direction shows, in pixels: where it was, minus where it is.
@wp.func
def motion_of(
    camera: CameraData, previous_camera: CameraData, direction: wp.vec3, position: wp.vec3, was: wp.vec3
) -> wp.vec2:
    seen = wp.where(camera.spread > 0.0, direction, position - camera.position)
    return project(previous_camera, was - previous_camera.position) - project(camera, seen)


# Sets what is of the first camera sample alone; `face` is -1 where nothing is seen.
@wp.func
def keep_place(
    scene: SceneData,
    buffers: SurfaceBuffers,
    settings: PassSettings,
    pixel: wp.int32,
    position: wp.vec3,
    depth: wp.float32,
    motion: wp.vec2,
    face: wp.int32,
):
    if settings.camera_sample != 0:
        return
    buffers.position[pixel] = position
    buffers.depth[pixel] = depth
    buffers.motion[pixel] = motion
    buffers.object_id[pixel] = -1
    buffers.material_id[pixel] = -1
    if face >= 0:
        buffers.object_id[pixel] = scene.geometry.objects[face]
        buffers.material_id[pixel] = scene.geometry.materials[face]


# Thread: a pixel. Adds what the first hit shows: emission, coverage, albedo, normal; the first camera
# sample sets position, depth (along the view axis, inf on a miss), ids, and motion: where the
# point was in the previous frame, minus where it is now, in pixels, x right and y down.
@wp.kernel
def shade_primary(
    first: wp.int32,
    scene: SceneData,
    camera: CameraData,
    previous_camera: CameraData,
    settings: PassSettings,
    hits: PrimaryHits,
    buffers: SurfaceBuffers,
):
    pixel = first + wp.tid()
    direction = hits.direction[pixel]
    face = hits.face[pixel]
    u = hits.u[pixel]
    v = hits.v[pixel]
    motion = project(previous_camera, direction) - project(camera, direction)
    position = wp.vec3(0.0, 0.0, 0.0)
    depth = float(wp.inf)
    if face < 0:
        buffers.emission[pixel] = buffers.emission[pixel] + environment_radiance(scene.environment, direction)
    else:
        s = surface_at(scene, face, u, v, -direction)
        buffers.emission[pixel] = buffers.emission[pixel] + surface_emission(scene, face, u, v, -direction)
        buffers.alpha[pixel] = buffers.alpha[pixel] + 1.0
        buffers.albedo[pixel] = buffers.albedo[pixel] + s.base_color
        buffers.normal[pixel] = buffers.normal[pixel] + shading_normal(s)
        was = previous_position(scene.geometry, face, u, v)
        motion = motion_of(camera, previous_camera, direction, s.position, was)
        position = s.position
        depth = wp.dot(position - camera.position, camera.forward)
        if buffers.guide_object.shape[0] > 0:
            distance = view_distance(camera, hits.t[pixel])
            add_guides(buffers, pixel, s, distance, was, motion, scene.geometry.objects[face])
    keep_place(scene, buffers, settings, pixel, position, depth, motion, face)
