"""Edges of a denoised picture: more camera samples where neighbouring pixels differ, and an average of pictures.

A camera sample has colours, emission and geometry of its own, and shares the filtered light of its pixel where it shows
the same surface, else that of the pixels around. So it costs a ray and no light. The average over frames (temporal
antialiasing) takes the last picture along the motion, limited to what the pixels around show now (Karis 2014, "High
Quality Temporal Supersampling"), in linear values: in squashed ones bright light would be lost. What shines by itself,
lamps and the sky, stays out of it: it has no noise, and a lamp narrower than a pixel, hundreds of times as bright as
the wall beside it, would light that wall up as the last picture moves by fractions of a pixel.
"""

import warp as wp

from warp_gi.kernels.denoise import (
    LEAST_REFLECTANCE,
    Changes,
    DenoiseSettings,
    Filtered,
    Guides,
    change_at,
    glossy_scale,
)
from warp_gi.kernels.environment import environment_radiance
from warp_gi.kernels.gbuffer import CameraData, camera_origin, camera_ray, tiled_pixel, view_distance
from warp_gi.kernels.layers import layers_along
from warp_gi.kernels.sampling import CAMERA_DIMENSION, circle, filter_offset, hash_uint, sample_1d, sample_2d
from warp_gi.kernels.surface import Surface, shading_normal, surface_at
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False, "max_unroll": 4})  # compiles in less than two thirds, and is as fast

LEAST_COSINE = wp.constant(wp.float32(0.9))  # between normals of pixels that do not differ
LEAST_CONTRAST = wp.constant(wp.float32(0.05))  # squared, between colours that differ
MOST_FOOTPRINTS = wp.constant(wp.float32(2.0))  # between a pixel's plane and a point of one that does not differ
BASE_WEIGHT = wp.constant(wp.float32(0.02))  # of a neighbour's light where a tent is 0
NORMAL_WEIGHT = wp.constant(wp.float32(16.0))  # of 1 - the cosine between normals, in the exponent
LEAST_LIGHT = wp.constant(wp.float32(1.0e-4))  # weight of all neighbours below which the likeliest one counts alone
MOST_ON_RING = wp.constant(4)  # further camera samples that lie on a circle around a pixel's middle
LESS_HISTORY = wp.constant(
    wp.float32(0.45)
)  # of the last picture's weight, where a pixel shows one surface among others
SMALLEST_DISTANCE = wp.constant(wp.float32(1.0e-9))  # metres


@wp.struct
class EdgeSettings:
    samples: wp.int32  # camera samples of a pixel
    own: wp.int32  # those of them that it has already, through its middle: 0 or 1
    seed: wp.uint32
    tent: wp.int32  # pixel filter, 1: tent, 0: box
    weight: wp.float32  # of a new picture in the average
    clip: wp.float32  # standard deviations of the pixels around, to which the last picture is limited


# Pictures, [height * width]. Beauty is the light that surfaces reflect plus what shines by itself.
@wp.struct
class Picture:
    beauty: wp.array(dtype=wp.vec3)
    shining: wp.array(dtype=wp.vec3)  # emission, and the sky
    alpha: wp.array(dtype=wp.float32)  # share of the camera samples that hit
    less: wp.array(dtype=wp.float32)  # share by which the last picture counts less


# What the primary saw at pixels' first camera samples, [height * width]: buffers of a frame.
@wp.struct
class Seen:
    depth: wp.array(dtype=wp.float32)
    motion: wp.array(dtype=wp.vec2)


# Filtered light at a point.
@wp.struct
class SharedLight:
    diffuse: wp.vec3
    glossy: wp.vec3
    seen: wp.bool  # whether a pixel around sees a surface


# Whether two colours differ: by a fifth in one channel, for bright ones.
@wp.func
def colors_differ(a: wp.vec3, b: wp.vec3) -> wp.bool:
    return wp.length_sq(a - b) > LEAST_CONTRAST * (0.05 + wp.dot(a, b))


# Whether a point of an object, with a shading normal, is elsewhere than on the surface of pixel i.
@wp.func
def is_elsewhere(
    settings: DenoiseSettings, guides: Guides, i: wp.int32, object: wp.int32, position: wp.vec3, normal: wp.vec3
) -> wp.bool:
    if guides.guide_object[i] != object or wp.dot(guides.guide_normal[i], normal) < LEAST_COSINE:
        return True
    away = wp.dot(guides.guide_plane[i], position - guides.guide_position[i])
    return wp.abs(away) > MOST_FOOTPRINTS * settings.footprint * guides.guide_distance[i]


# What pixel j shows other than pixel i: 0 nothing, 1 another colour of its surface, 2 another surface.
@wp.func
def difference(settings: DenoiseSettings, guides: Guides, i: wp.int32, j: wp.int32) -> wp.int32:
    if guides.guide_object[i] != guides.guide_object[j]:
        return 2
    if guides.guide_object[i] == 0:
        return 0
    if is_elsewhere(settings, guides, i, guides.guide_object[j], guides.guide_position[j], guides.guide_normal[j]):
        return 2
    a = guides.guide_diffuse[i] + guides.guide_specular[i]
    if colors_differ(a, guides.guide_diffuse[j] + guides.guide_specular[j]):
        return 1
    return 0


# The most that the pixels around pixel (x, y) show other than that one.
@wp.func
def edge_of(settings: DenoiseSettings, guides: Guides, x: wp.int32, y: wp.int32) -> wp.int32:
    i = y * settings.width + x
    most = int(0)
    for k in range(9):
        tx = x + k % 3 - 1
        ty = y + k / 3 - 1
        if most < 2 and tx >= 0 and tx < settings.width and ty >= 0 and ty < settings.height:
            most = wp.max(most, difference(settings, guides, i, ty * settings.width + tx))
    return most


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


# Light of pixel i at a surface that it shows, of these reflectances; not seen where the pixel does not know it.
@wp.func
def own_light(light: Filtered, i: wp.int32, diffuse: wp.vec3, specular: wp.vec3) -> SharedLight:
    d = light.diffuse[i]
    g = light.glossy[i]
    r = SharedLight()
    r.diffuse = color(d)
    r.glossy = color(g)
    known = d[3] >= 0.0 or wp.max(diffuse) <= LEAST_REFLECTANCE
    r.seen = known and (g[3] >= 0.0 or wp.max(specular) <= LEAST_REFLECTANCE)
    return r


# Offset in pixels from the middle of further camera sample k of `more`. Few lie evenly on a circle, turned at random:
# with the pixel's own in the middle they show a ramp as it is. Its radius gives all the variance of the pixel filter.
@wp.func
def sample_offset(edges: EdgeSettings, more: wp.int32, k: wp.int32, seed: wp.uint32) -> wp.vec2:
    if more > MOST_ON_RING or edges.own == 0:
        u = sample_2d(wp.uint32(k), seed, CAMERA_DIMENSION)
        return wp.vec2(filter_offset(edges.tent, u[0]), filter_offset(edges.tent, u[1]))
    turn = sample_1d(wp.uint32(0), seed, CAMERA_DIMENSION) + wp.float32(k) / wp.float32(more)
    variance = wp.where(edges.tent != 0, 1.0 / 6.0, 1.0 / 12.0)
    all = wp.float32(more + edges.own) / wp.float32(more)
    return circle(turn - wp.floor(turn)) * wp.sqrt(2.0 * variance * all)


# Sums over camera samples of a pixel.
@wp.struct
class EdgeSums:
    reflected: wp.vec3
    shining: wp.vec3
    count: wp.float32
    hits: wp.float32
    differ: wp.bool  # whether one of them shows something else than the pixel did


# The sums with the camera sample in them that goes through picture coordinates (px, py).
@wp.func
def with_sample(
    scene: SceneData,
    camera: CameraData,
    settings: DenoiseSettings,
    guides: Guides,
    light: Filtered,
    pixel: wp.int32,
    at: wp.vec2,
    sums: EdgeSums,
) -> EdgeSums:
    r = sums
    direction = camera_ray(camera, at[0], at[1])
    origin = camera_origin(camera, at[0], at[1])
    seen = layers_along(scene, origin, direction)
    if seen.face < 0:
        r.differ = r.differ or guides.guide_object[pixel] != 0
        r.shining += environment_radiance(scene.environment, direction)
        r.count += 1.0
        return r
    s = surface_at(scene, seen.face, seen.u, seen.v, -direction)
    object = scene.geometry.objects[seen.face] + 1
    elsewhere = is_elsewhere(settings, guides, pixel, object, s.position, shading_normal(s))
    own_color = guides.guide_diffuse[pixel] + guides.guide_specular[pixel]
    r.differ = r.differ or elsewhere or colors_differ(own_color, seen.diffuse + seen.specular)
    known = SharedLight()
    if not elsewhere and settings.settles != 0:
        known = own_light(light, pixel, seen.diffuse, seen.specular)
    if not known.seen:
        t = view_distance(camera, wp.length(s.position - origin))
        known = shared_light(settings, guides, light, s, t, at[0], at[1])
    if known.seen:
        r.reflected += wp.cw_mul(seen.diffuse, known.diffuse) + wp.cw_mul(glossy_scale(seen.specular), known.glossy)
        r.shining += seen.emission
        if seen.left > 0.0:
            r.shining += wp.cw_mul(environment_radiance(scene.environment, direction), seen.tint) * seen.left
        r.count += 1.0
        r.hits += 1.0 - seen.left
    return r


# Thread: a pixel, in tiles. Where neighbours differ its colour becomes the mean of several camera samples. One of them
# may be its own.
@wp.kernel
def sample_edges(
    first: wp.int32,
    scene: SceneData,
    camera: CameraData,
    settings: DenoiseSettings,
    edges: EdgeSettings,
    guides: Guides,
    light: Filtered,
    picture: Picture,
):
    p = tiled_pixel(first + wp.tid(), camera.width)
    if p[0] >= camera.width or p[1] >= camera.height:
        return
    edge = edge_of(settings, guides, p[0], p[1])
    if edge == 0:
        return
    pixel = p[1] * camera.width + p[0]
    seed = hash_uint(edges.seed ^ wp.uint32(pixel))
    own = wp.float32(edges.own)
    sums = EdgeSums()
    sums.reflected = (picture.beauty[pixel] - picture.shining[pixel]) * own
    sums.shining = picture.shining[pixel] * own
    sums.count = own
    sums.hits = picture.alpha[pixel] * own
    more = edges.samples - edges.own
    if edge == 1:
        more = wp.max(2 * more / 3, 1)
    for k in range(more):
        at = wp.vec2(wp.float32(p[0]) + 0.5, wp.float32(p[1]) + 0.5) + sample_offset(edges, more, k, seed)
        sums = with_sample(scene, camera, settings, guides, light, pixel, at, sums)
    if sums.count > 0.0:
        picture.beauty[pixel] = (sums.reflected + sums.shining) / sums.count
        picture.shining[pixel] = sums.shining / sums.count
        picture.alpha[pixel] = sums.hits / sums.count
    if not sums.differ:
        picture.less[pixel] = wp.max(picture.less[pixel], LESS_HISTORY)


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


# Thread: a pixel. The last picture counts less where light has changed.
@wp.kernel
def mark_changes(first: wp.int32, settings: DenoiseSettings, changes: Changes, less: wp.array(dtype=wp.float32)):
    i = first + wp.tid()
    y = i / settings.width
    x = i - y * settings.width
    rows = changes.diffuse.shape[0] / changes.columns
    diffuse = change_at(changes.diffuse, changes.columns, rows, x, y)
    less[i] = wp.max(diffuse, change_at(changes.glossy, changes.columns, rows, x, y))


# Thread: a pixel. Averages reflected light with that of the last picture, which moves as the nearest of the surfaces
# around does, and counts less where all samples of a pixel at an edge show the same: there it is what others beside it
# left as it moved by fractions of a pixel. Writes the beauty, and the reflected light for the next frame. Of a weight
# of 1 there is no last picture.
@wp.kernel
def average_pictures(
    first: wp.int32,
    settings: DenoiseSettings,
    edges: EdgeSettings,
    seen: Seen,
    picture: Picture,
    last: wp.array(dtype=wp.vec3),
    kept: wp.array(dtype=wp.vec3),
    beauty: wp.array(dtype=wp.vec3),
):
    i = first + wp.tid()
    own = picture.beauty[i] - picture.shining[i]
    kept[i] = own
    beauty[i] = picture.beauty[i]
    if edges.weight >= 1.0:
        return
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
            if seen.depth[j] < seen.depth[nearest]:
                nearest = j
            light = picture.beauty[j] - picture.shining[j]
            total += light
            squares += wp.cw_mul(light, light)
            count += 1.0
    px = wp.float32(x) + seen.motion[nearest][0]
    py = wp.float32(y) + seen.motion[nearest][1]
    inside = px >= 0.0 and px <= wp.float32(settings.width - 1) and py >= 0.0 and py <= wp.float32(settings.height - 1)
    if inside:
        mean = total / count
        spread = wp.max(squares / count - wp.cw_mul(mean, mean), wp.vec3(0.0, 0.0, 0.0))
        margin = edges.clip * wp.vec3(wp.sqrt(spread[0]), wp.sqrt(spread[1]), wp.sqrt(spread[2]))
        before = sharp_value(last, settings.width, settings.height, px, py)
        before = wp.min(wp.max(before, mean - margin), mean + margin)
        weight = edges.weight + (1.0 - edges.weight) * picture.less[i]
        kept[i] = before * (1.0 - weight) + own * weight
        beauty[i] = kept[i] + picture.shining[i]
