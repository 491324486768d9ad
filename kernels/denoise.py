"""Denoising after light_field_probes.txt, section 5.1: two kinds of light, a temporal and a spatial filter for each.

Diffuse light is filtered as incident light (what leaves divided by the diffuse albedo) and glossy light
as radiance divided by the specular colour, so that no texture is blurred.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

LEAST_SPECULAR = wp.constant(wp.float32(1.0e-3))  # glossy light is divided by no less
LEAST_REFLECTANCE = wp.constant(wp.float32(1.0e-6))  # where a surface is darker, no light to filter leaves it
LEAST_COSINE = wp.constant(wp.float32(0.9))  # between normals of one surface in two frames
LEAST_WEIGHT = wp.constant(wp.float32(1.0e-2))  # of history: less is a neighbour's light, which a pixel hardly touches


# What is known without noise of each pixel, [height * width]. The two colours are means over the
# camera samples, misses black; all else is of the first camera sample that hit.
@wp.struct
class Guides:
    guide_diffuse: wp.array(dtype=wp.vec3)  # diffuse albedo
    guide_specular: wp.array(dtype=wp.vec3)  # what the glossy lobe reflects of light from everywhere
    guide_distance: wp.array(dtype=wp.float32)  # metres from the camera, along the ray
    guide_position: wp.array(dtype=wp.vec3)
    guide_previous: wp.array(dtype=wp.vec3)  # where that point was in the previous frame
    guide_motion: wp.array(dtype=wp.vec2)  # as the motion buffer: pixels, previous minus now
    guide_normal: wp.array(dtype=wp.vec3)  # of shading
    guide_plane: wp.array(dtype=wp.vec3)  # geometric normal
    guide_object: wp.array(dtype=wp.int32)  # 1 + object, 0 on a miss


# Means of a frame, [height * width]. The lobes are what estimators handed over apart; empty where none did.
@wp.struct
class NoisyLight:
    emission: wp.array(dtype=wp.vec3)
    environment: wp.array(dtype=wp.vec3)
    emitters: wp.array(dtype=wp.vec3)
    indirect: wp.array(dtype=wp.vec3)
    noisy: wp.array(dtype=wp.vec3)
    lobe_diffuse: wp.array(dtype=wp.vec3)  # incident
    lobe_glossy: wp.array(dtype=wp.vec3)


# Light on its way through the filters, [height * width].
@wp.struct
class Signals:
    diffuse: wp.array(dtype=wp.vec3)  # incident
    glossy: wp.array(dtype=wp.vec3)  # divided by the specular colour
    length: wp.array(dtype=wp.float32)  # frames in the average


# Weighted sums over pixels of the frame before.
@wp.struct
class Gathered:
    weight: wp.float32
    length: wp.float32
    diffuse: wp.vec3
    glossy: wp.vec3


@wp.struct
class TemporalSettings:
    width: wp.int32
    height: wp.int32
    diffuse_weight: wp.float32  # of a new frame in a long average: 1 - hysteresis
    glossy_weight: wp.float32
    plane_distance: wp.float32  # beyond it is another surface; a share of the distance to the camera


@wp.struct
class SpatialSettings:
    width: wp.int32
    height: wp.int32
    radius: wp.int32  # pixels
    stride: wp.int32  # pixels
    deviation: wp.float32  # pixels, of the gaussian, for a single sample
    plane_distance: wp.float32  # standard deviation, as a share of the distance to the camera
    normal_power: wp.float32  # exponent of the cosine between normals
    samples: wp.float32  # in a frame
    longest: wp.float32  # frames of independent samples that a long average is worth
    shrink: wp.float32  # the deviation falls with this power of the samples in the average


# a / b where b is above nothing.
@wp.func
def divided(a: wp.vec3, b: wp.vec3, least: wp.float32) -> wp.vec3:
    r = wp.vec3(0.0, 0.0, 0.0)
    for k in range(3):
        if b[k] > least:
            r[k] = a[k] / b[k]
    return r


@wp.func
def glossy_scale(specular: wp.vec3) -> wp.vec3:
    return wp.max(specular, wp.vec3(LEAST_SPECULAR, LEAST_SPECULAR, LEAST_SPECULAR))


# Thread: a pixel. Light that no estimator separated is shared out by reflectance: it is taken to have come
# in alike for both lobes, as much as their reflectances together need to give what left.
@wp.kernel
def separate_light(first: wp.int32, light: NoisyLight, guides: Guides, out: Signals):
    i = first + wp.tid()
    diffuse = guides.guide_diffuse[i]
    specular = guides.guide_specular[i]
    rest = light.environment[i] + light.emitters[i] + light.indirect[i]
    incident = wp.vec3(0.0, 0.0, 0.0)
    glossy = wp.vec3(0.0, 0.0, 0.0)
    if light.lobe_diffuse.shape[0] > 0:
        incident = light.lobe_diffuse[i]
        glossy = light.lobe_glossy[i]
        rest = rest - wp.cw_mul(diffuse, incident) - glossy
    shared = divided(rest, diffuse + specular, LEAST_REFLECTANCE)
    out.diffuse[i] = incident + shared
    out.glossy[i] = wp.cw_div(glossy + wp.cw_mul(specular, shared), glossy_scale(specular))
    out.length[i] = 1.0


# Whether pixel (x, y) of the frame before saw the surface that pixel i sees now.
@wp.func
def saw_surface(
    settings: TemporalSettings, now: Guides, before: Guides, i: wp.int32, x: wp.int32, y: wp.int32
) -> wp.bool:
    if x < 0 or y < 0 or x >= settings.width or y >= settings.height:
        return False
    j = y * settings.width + x
    if before.guide_object[j] != now.guide_object[i]:
        return False
    if wp.dot(now.guide_normal[i], before.guide_normal[j]) < LEAST_COSINE:
        return False
    away = wp.dot(now.guide_plane[i], before.guide_position[j] - now.guide_previous[i])
    return wp.abs(away) < settings.plane_distance * now.guide_distance[i]


# Mean of the average before, over the pixels within `reach` of (x, y) that saw the surface of pixel i, by a
# tent; bilinear for a reach of 1.
@wp.func
def gather_history(
    settings: TemporalSettings,
    now: Guides,
    before: Guides,
    history: Signals,
    i: wp.int32,
    x: wp.float32,
    y: wp.float32,
    reach: wp.int32,
) -> Gathered:
    r = Gathered()
    x0 = wp.int32(wp.floor(x)) + 1 - reach
    y0 = wp.int32(wp.floor(y)) + 1 - reach
    for k in range(4 * reach * reach):
        px = x0 + k % (2 * reach)
        py = y0 + k / (2 * reach)
        if saw_surface(settings, now, before, i, px, py):
            j = py * settings.width + px
            across = 1.0 - wp.abs(x - wp.float32(px)) / wp.float32(reach)
            down = 1.0 - wp.abs(y - wp.float32(py)) / wp.float32(reach)
            w = wp.max(across, 0.0) * wp.max(down, 0.0)
            r.weight += w
            r.length += w * history.length[j]
            r.diffuse += w * history.diffuse[j]
            r.glossy += w * history.glossy[j]
    return r


# Thread: a pixel. Moves the average of the frames before to where its surface is now, and adds the new frame;
# until the average is long every frame weighs the same. If none of the four nearest pixels saw the surface,
# one next to them may have: at an outline camera samples hit now the one surface and now the other.
@wp.kernel
def accumulate_frames(
    first: wp.int32,
    settings: TemporalSettings,
    now: Guides,
    before: Guides,
    noisy: Signals,
    history: Signals,
    out: Signals,
):
    i = first + wp.tid()
    h = Gathered()
    if now.guide_object[i] > 0:
        row = i / settings.width
        x = wp.float32(i - row * settings.width) + now.guide_motion[i][0]
        y = wp.float32(row) + now.guide_motion[i][1]
        h = gather_history(settings, now, before, history, i, x, y, 1)
        if h.weight < LEAST_WEIGHT:
            h = gather_history(settings, now, before, history, i, x, y, 2)
    if h.weight < LEAST_WEIGHT:
        out.diffuse[i] = noisy.diffuse[i]
        out.glossy[i] = noisy.glossy[i]
        out.length[i] = 1.0
    else:
        length = h.length / h.weight + 1.0
        a = wp.max(settings.diffuse_weight, 1.0 / length)
        b = wp.max(settings.glossy_weight, 1.0 / length)
        out.diffuse[i] = h.diffuse / h.weight * (1.0 - a) + noisy.diffuse[i] * a
        out.glossy[i] = h.glossy / h.weight * (1.0 - b) + noisy.glossy[i] * b
        out.length[i] = length


# Thread: a pixel. The cross-bilateral mean of its neighbourhood: gaussian in pixels and in the distance to
# its tangent plane, and a power of the cosine between normals.
@wp.kernel
def filter_neighbourhood(
    first: wp.int32,
    settings: SpatialSettings,
    guides: Guides,
    source: wp.array(dtype=wp.vec3),
    length: wp.array(dtype=wp.float32),
    out: wp.array(dtype=wp.vec3),
):
    i = first + wp.tid()
    if guides.guide_object[i] == 0:
        out[i] = source[i]
        return
    y = i / settings.width
    x = i - y * settings.width
    samples = wp.min(length[i], settings.longest) * settings.samples
    deviation = settings.deviation * wp.pow(samples, -settings.shrink)
    steps = wp.min(settings.radius, wp.int32(3.0 * deviation)) / settings.stride
    by_pixels = 0.5 / (deviation * deviation)
    plane = settings.plane_distance * guides.guide_distance[i]
    by_plane = 0.5 / (plane * plane)
    position = guides.guide_position[i]
    face = guides.guide_plane[i]
    normal = guides.guide_normal[i]
    total = float(0.0)
    mean = wp.vec3(0.0, 0.0, 0.0)
    for row in range(-steps, steps + 1):
        ty = y + row * settings.stride
        if ty >= 0 and ty < settings.height:
            for column in range(-steps, steps + 1):
                tx = x + column * settings.stride
                j = ty * settings.width + tx
                if tx >= 0 and tx < settings.width and guides.guide_object[j] > 0:
                    squared = wp.float32((row * row + column * column) * settings.stride * settings.stride)
                    away = wp.dot(face, guides.guide_position[j] - position)
                    turned = 1.0 - wp.dot(normal, guides.guide_normal[j])
                    e = squared * by_pixels + away * away * by_plane + turned * settings.normal_power
                    if row == 0 and column == 0:
                        e = float(0.0)  # the pixel itself, whatever rounding makes of its normal
                    if e < 12.0:
                        w = wp.exp(-e)
                        total += w
                        mean += w * source[j]
    out[i] = mean / total


# Thread: a pixel. Puts the filtered light back on its surface. What was not filtered stays as it was.
@wp.kernel
def put_back(first: wp.int32, light: NoisyLight, guides: Guides, filtered: Signals, beauty: wp.array(dtype=wp.vec3)):
    i = first + wp.tid()
    if guides.guide_object[i] == 0:
        beauty[i] = light.noisy[i]
        return
    diffuse = guides.guide_diffuse[i]
    specular = guides.guide_specular[i]
    both = wp.cw_mul(diffuse, filtered.diffuse[i]) + wp.cw_mul(glossy_scale(specular), filtered.glossy[i])
    beauty[i] = light.emission[i] + both
