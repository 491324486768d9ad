"""Edges of a denoised picture: more camera samples where neighbouring pixels differ, and an average of pictures.

A camera sample has colours, emission and geometry of its own, and shares the filtered light of the pixels around it. So
it costs a ray and no light. The average over frames (temporal antialiasing) takes the last picture along the motion,
limited to what the pixels around show now (Karis 2014, "High Quality Temporal Supersampling"), in linear values: in
squashed ones bright light would be lost.
"""

import warp as wp

from warp_gi.kernels.bsdf import average_specular
from warp_gi.kernels.bvh import bvh_intersect
from warp_gi.kernels.denoise import DenoiseSettings, Filtered, Guides, glossy_scale
from warp_gi.kernels.environment import environment_radiance
from warp_gi.kernels.gbuffer import CameraData, camera_ray, tiled_pixel
from warp_gi.kernels.sampling import CAMERA_DIMENSION, filter_offset, hash_uint, sample_2d
from warp_gi.kernels.surface import Surface, shading_normal, surface_at, surface_emission
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False, "max_unroll": 4})  # compiles in less than two thirds, and is as fast

LEAST_COSINE = wp.constant(wp.float32(0.9))  # between normals of pixels that do not differ
MOST_FOOTPRINTS = wp.constant(wp.float32(2.0))  # between a pixel's plane and a point of one that does not differ
BASE_WEIGHT = wp.constant(wp.float32(0.02))  # of a neighbour's light where a tent is 0
NORMAL_WEIGHT = wp.constant(wp.float32(16.0))  # of 1 - the cosine between normals, in the exponent
LEAST_LIGHT = wp.constant(wp.float32(1.0e-4))  # weight of all neighbours below which the likeliest one counts alone
SMALLEST_DISTANCE = wp.constant(wp.float32(1.0e-9))  # metres


@wp.struct
class EdgeSettings:
    samples: wp.int32  # camera samples of a pixel
    seed: wp.uint32
    tent: wp.int32  # pixel filter, 1: tent, 0: box
    weight: wp.float32  # of a new picture in the average
    clip: wp.float32  # standard deviations of the pixels around, to which the last picture is limited


# Filtered light at a point.
@wp.struct
class SharedLight:
    diffuse: wp.vec3
    glossy: wp.vec3
    seen: wp.bool  # whether a pixel around sees a surface


# Whether pixel j shows something else than pixel i: another surface, or another colour.
@wp.func
def differs(settings: DenoiseSettings, guides: Guides, i: wp.int32, j: wp.int32) -> wp.bool:
    if guides.guide_object[i] != guides.guide_object[j]:
        return True
    if guides.guide_object[i] == 0:
        return False
    if wp.dot(guides.guide_normal[i], guides.guide_normal[j]) < LEAST_COSINE:
        return True
    away = wp.dot(guides.guide_plane[i], guides.guide_position[j] - guides.guide_position[i])
    if wp.abs(away) > MOST_FOOTPRINTS * settings.footprint * guides.guide_distance[i]:
        return True
    a = guides.guide_diffuse[i] + guides.guide_specular[i]
    b = guides.guide_diffuse[j] + guides.guide_specular[j]
    return wp.length_sq(a - b) > 0.01 * (0.05 + wp.dot(a, b))


# Whether the picture needs more camera samples in pixel (x, y).
@wp.func
def is_edge(settings: DenoiseSettings, guides: Guides, x: wp.int32, y: wp.int32) -> wp.bool:
    i = y * settings.width + x
    for k in range(9):
        tx = x + k % 3 - 1
        ty = y + k / 3 - 1
        if tx >= 0 and tx < settings.width and ty >= 0 and ty < settings.height:
            if differs(settings, guides, i, ty * settings.width + tx):
                return True
    return False


@wp.func
def color(light: wp.vec4) -> wp.vec3:
    return wp.vec3(light[0], light[1], light[2])


# Light at a surface that is seen at picture coordinates (px, py), from the pixels around: weighed by a tent in pixels,
# the distance to the surface's plane and normals. Where none is like it, as on a rod between two pixels, that of the
# pixel nearest to its plane.
@wp.func
def shared_light(
    settings: DenoiseSettings,
    guides: Guides,
    light: Filtered,
    s: Surface,
    distance: wp.float32,
    px: wp.float32,
    py: wp.float32,
) -> SharedLight:
    r = SharedLight()
    normal = shading_normal(s)
    by_plane = 1.0 / wp.max(settings.footprint * distance, SMALLEST_DISTANCE)
    totals = wp.vec2(0.0, 0.0)
    diffuse_at = int(-1)
    glossy_at = int(-1)
    diffuse_away = float(wp.inf)
    glossy_away = float(wp.inf)
    x0 = wp.int32(wp.floor(px)) - 1
    y0 = wp.int32(wp.floor(py)) - 1
    for k in range(9):
        x = x0 + k % 3
        y = y0 + k / 3
        j = y * settings.width + x
        if x >= 0 and x < settings.width and y >= 0 and y < settings.height:
            if guides.guide_object[j] > 0:
                away = wp.abs(wp.dot(s.normal, guides.guide_position[j] - s.position)) * by_plane
                turned = 1.0 - wp.dot(normal, guides.guide_normal[j])
                across = wp.max(1.0 - wp.abs(px - wp.float32(x) - 0.5), 0.0)
                down = wp.max(1.0 - wp.abs(py - wp.float32(y) - 0.5), 0.0)
                w = (across * down + BASE_WEIGHT) * wp.exp(-away - NORMAL_WEIGHT * turned)
                r.seen = True
                if light.diffuse[j][3] >= 0.0:
                    totals[0] = totals[0] + w
                    r.diffuse += w * color(light.diffuse[j])
                    if away < diffuse_away:
                        diffuse_away = away
                        diffuse_at = j
                if light.glossy[j][3] >= 0.0:
                    totals[1] = totals[1] + w
                    r.glossy += w * color(light.glossy[j])
                    if away < glossy_away:
                        glossy_away = away
                        glossy_at = j
    if totals[0] >= LEAST_LIGHT:
        r.diffuse = r.diffuse / totals[0]
    elif diffuse_at >= 0:
        r.diffuse = color(light.diffuse[diffuse_at])
    if totals[1] >= LEAST_LIGHT:
        r.glossy = r.glossy / totals[1]
    elif glossy_at >= 0:
        r.glossy = color(light.glossy[glossy_at])
    return r


# Thread: a pixel, in tiles. Where neighbours differ its colour becomes the mean of several camera samples.
@wp.kernel
def sample_edges(
    first: wp.int32,
    scene: SceneData,
    camera: CameraData,
    settings: DenoiseSettings,
    edges: EdgeSettings,
    guides: Guides,
    light: Filtered,
    beauty: wp.array(dtype=wp.vec3),
):
    p = tiled_pixel(first + wp.tid(), camera.width)
    if p[0] >= camera.width or p[1] >= camera.height:
        return
    if not is_edge(settings, guides, p[0], p[1]):
        return
    pixel = p[1] * camera.width + p[0]
    seed = hash_uint(edges.seed ^ wp.uint32(pixel))
    total = wp.vec3(0.0, 0.0, 0.0)
    count = float(0.0)
    for k in range(edges.samples):
        u = sample_2d(wp.uint32(k), seed, CAMERA_DIMENSION)
        px = wp.float32(p[0]) + 0.5 + filter_offset(edges.tent, u[0])
        py = wp.float32(p[1]) + 0.5 + filter_offset(edges.tent, u[1])
        direction = camera_ray(camera, px, py)
        hit = bvh_intersect(scene.bvh, camera.position, direction, float(wp.inf))
        if hit.face < 0:
            total += environment_radiance(scene.environment, direction)
            count += 1.0
        else:
            s = surface_at(scene, hit.face, hit.u, hit.v, -direction)
            known = shared_light(settings, guides, light, s, hit.t, px, py)
            if known.seen:
                lit = wp.cw_mul(s.bsdf.diffuse, known.diffuse)
                lit += wp.cw_mul(glossy_scale(average_specular(s.bsdf)), known.glossy)
                total += lit + surface_emission(scene, hit.face, hit.u, hit.v, -direction)
                count += 1.0
    if count > 0.0:
        beauty[pixel] = total / count


# Value of a picture at coordinates in units of pixels from the first pixel's middle: Catmull-Rom, within the range of
# the four nearest pixels. Coordinates must lie inside of the picture.
@wp.func
def sharp_value(
    picture: wp.array(dtype=wp.vec3), width: wp.int32, height: wp.int32, x: wp.float32, y: wp.float32
) -> wp.vec3:
    i = wp.int32(wp.floor(x))
    j = wp.int32(wp.floor(y))
    fx = x - wp.float32(i)
    fy = y - wp.float32(j)
    value = wp.vec3(0.0, 0.0, 0.0)
    low = wp.vec3(wp.inf, wp.inf, wp.inf)
    high = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
    for k in range(16):
        column = k % 4 - 1
        row = k / 4 - 1
        at = wp.clamp(j + row, 0, height - 1) * width + wp.clamp(i + column, 0, width - 1)
        value += picture[at] * (catmull_rom(fx, column) * catmull_rom(fy, row))
        if (column == 0 or column == 1) and (row == 0 or row == 1):
            low = wp.min(low, picture[at])
            high = wp.max(high, picture[at])
    return wp.min(wp.max(value, low), high)


# Weight of the sample `number` (-1 to 2) at a fraction from sample 0 to sample 1.
@wp.func
def catmull_rom(f: wp.float32, number: wp.int32) -> wp.float32:
    if number == -1:
        return f * (-0.5 + f * (1.0 - 0.5 * f))
    if number == 0:
        return 1.0 + f * f * (-2.5 + 1.5 * f)
    if number == 1:
        return f * (0.5 + f * (2.0 - 1.5 * f))
    return f * f * (-0.5 + 0.5 * f)


# Thread: a pixel. Averages the picture with the last one, which moves as the nearest of the surfaces around does.
@wp.kernel
def average_pictures(
    first: wp.int32,
    settings: DenoiseSettings,
    edges: EdgeSettings,
    depth: wp.array(dtype=wp.float32),
    motion: wp.array(dtype=wp.vec2),
    picture: wp.array(dtype=wp.vec3),
    last: wp.array(dtype=wp.vec3),
    out: wp.array(dtype=wp.vec3),
):
    i = first + wp.tid()
    y = i / settings.width
    x = i - y * settings.width
    nearest = int(i)
    total = wp.vec3(0.0, 0.0, 0.0)
    squares = wp.vec3(0.0, 0.0, 0.0)
    count = float(0.0)
    for k in range(9):
        tx = x + k % 3 - 1
        ty = y + k / 3 - 1
        if tx >= 0 and tx < settings.width and ty >= 0 and ty < settings.height:
            j = ty * settings.width + tx
            if depth[j] < depth[nearest]:
                nearest = j
            total += picture[j]
            squares += wp.cw_mul(picture[j], picture[j])
            count += 1.0
    px = wp.float32(x) + motion[nearest][0]
    py = wp.float32(y) + motion[nearest][1]
    inside = px >= 0.0 and px <= wp.float32(settings.width - 1) and py >= 0.0 and py <= wp.float32(settings.height - 1)
    out[i] = picture[i]
    if inside:
        mean = total / count
        spread = wp.max(squares / count - wp.cw_mul(mean, mean), wp.vec3(0.0, 0.0, 0.0))
        margin = edges.clip * wp.vec3(wp.sqrt(spread[0]), wp.sqrt(spread[1]), wp.sqrt(spread[2]))
        before = sharp_value(last, settings.width, settings.height, px, py)
        before = wp.min(wp.max(before, mean - margin), mean + margin)
        out[i] = before * (1.0 - edges.weight) + picture[i] * edges.weight
