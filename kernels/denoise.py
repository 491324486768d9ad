"""Denoising of two kinds of light: an average over frames, then an edge-avoiding filter that variance guides.

Diffuse light is filtered as incident light (what leaves divided by the diffuse albedo) and glossy light
as radiance divided by the specular colour, so that no texture is blurred.

After Schied et al. 2017, "Spatiotemporal Variance-Guided Filtering", and Dammertz et al. 2010, "Edge-Avoiding A-Trous
Wavelet Transform". Unlike the former nothing that is filtered over pixels is remembered: that darkens and smears. Where
an average is short, differences of light are those of a wider mean, and not of the samples: dark samples are many and
bright ones few, so that weights by the samples themselves lose light.
"""

import warp as wp

from warp_gi.kernels.bsdf import luminance

wp.set_module_options({"enable_backward": False, "max_unroll": 4})  # compiles in less than two thirds, and is as fast

LEAST_SPECULAR = wp.constant(wp.float32(1.0e-3))  # glossy light is divided by no less
LEAST_REFLECTANCE = wp.constant(wp.float32(1.0e-6))  # where a surface is darker, no light to filter leaves it
LEAST_COSINE = wp.constant(wp.float32(0.85))  # between normals of one surface
FOOTPRINTS = wp.constant(wp.float32(3.0))  # of a pixel, from a plane, within which a point is of the same surface
BLOCK = wp.constant(8)  # pixels along a side of the blocks in which light is compared with what was
LEAST_CHANGE = wp.constant(wp.float32(0.1))  # share of the light that is no change, however sure
SMALLEST_DEVIATION = wp.constant(wp.float32(1.0e-3))  # share of a luminance below which differences are none
UNKNOWN = wp.constant(wp.float32(-1.0))  # Filtered: in place of a variance
SMALLEST = wp.constant(wp.float32(1.0e-20))  # keeps quotients finite
MOST_LIGHT = wp.constant(wp.float32(1.0e15))  # more, or what is no number, is no light
LARGEST_EXPONENT = wp.constant(wp.float32(12.0))  # of a tap's weight: what is farther off counts nothing
LEAST_AROUND = wp.constant(wp.float32(8.0))  # pixels around, fewer of which tell no outlier
MOST_ALIKE = wp.constant(
    wp.float32(0.125)
)  # share of the pixels around that may be outliers, too; more are other light
LEAST_KNOWN = wp.constant(wp.float32(256.0))  # frames of all pixels around, fewer of which know no mean square
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
    guide_alpha: wp.array(dtype=wp.float32)  # of GGX, 0 where it is not known
    guide_reflected: wp.array(dtype=wp.float32)  # metres to what a smooth surface reflects, 0 elsewhere


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
    lobe_apart: wp.array(dtype=wp.vec3)  # incident, of lights that are apart


# Light of a frame or an average over frames, [height * width].
@wp.struct
class Signals:
    diffuse: wp.array(dtype=wp.vec3)  # incident
    glossy: wp.array(dtype=wp.vec3)  # divided by the specular colour
    moments: wp.array(dtype=wp.vec2)  # means of the squared luminance of both
    length: wp.array(dtype=wp.vec2)  # frames of the pipeline's samples in both averages; 0: the light is not known


# Light on its way through the filter over pixels, [height * width]: colour, and the variance of its luminance, below 0
# where it is not known.
@wp.struct
class Filtered:
    diffuse: wp.array(dtype=wp.vec4)
    glossy: wp.array(dtype=wp.vec4)


# How far a block's new samples are from the average before, [blocks]: 0 as expected, 1 another light.
@wp.struct
class Changes:
    diffuse: wp.array(dtype=wp.float32)
    glossy: wp.array(dtype=wp.float32)
    columns: wp.int32  # of blocks


# Weighted sums over pixels of the frame before.
@wp.struct
class Gathered:
    weight: wp.vec2
    length: wp.vec2
    diffuse: wp.vec3
    glossy: wp.vec3
    moments: wp.vec2


@wp.struct
class DenoiseSettings:
    width: wp.int32
    height: wp.int32
    footprint: wp.float32  # width of a pixel at a distance of 1
    diffuse_frames: wp.float32  # most frames in an average
    glossy_frames: wp.float32
    worth: wp.float32  # frames of the pipeline's samples that this frame is worth
    settled: wp.float32  # frames from which on an average knows its variance
    lag: wp.float32  # deviations from which on light is another; 0: it is never
    step: wp.int32  # pixels between the taps of this level
    normal: wp.float32  # exponents of the weights
    plane: wp.float32
    luminance: wp.float32
    filters_diffuse: wp.int32  # in this level
    filters_glossy: wp.int32
    settles: wp.int32  # 1: there is an average over frames; 0: this is the first one
    outliers: wp.float32  # times the light around above which light is shared out
    shift_x: wp.int32  # pixels by which this frame's blocks of shared light begin outside of the picture
    shift_y: wp.int32


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


# Light whose channels that a surface does not reflect, and that nobody knows, are the mean of the others. The fourth
# component is 0 where no channel is known.
@wp.func
def known_light(light: wp.vec3, reflectance: wp.vec3) -> wp.vec4:
    total = float(0.0)
    count = float(0.0)
    for k in range(3):
        if reflectance[k] > LEAST_REFLECTANCE:
            total += light[k]
            count += 1.0
    if count == 0.0 or not (wp.max(wp.abs(light)) < MOST_LIGHT):
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    r = wp.vec4(light[0], light[1], light[2], 1.0)
    for k in range(3):
        if reflectance[k] <= LEAST_REFLECTANCE:
            r[k] = total / count
    return r


# Thread: a pixel. Light that no estimator separated is shared out by reflectance: it is taken to have come
# in alike for both lobes, as much as their reflectances together need to give what left.
@wp.kernel
def separate_light(first: wp.int32, settings: DenoiseSettings, light: NoisyLight, guides: Guides, out: Signals):
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
    if light.lobe_apart.shape[0] > 0:
        rest = rest - wp.cw_mul(diffuse, light.lobe_apart[i])
    shared = divided(rest, diffuse + specular, LEAST_REFLECTANCE)
    a = known_light(incident + shared, diffuse)
    b = known_light(wp.cw_div(glossy + wp.cw_mul(specular, shared), glossy_scale(specular)), specular)
    out.diffuse[i] = wp.vec3(a[0], a[1], a[2])
    out.glossy[i] = wp.vec3(b[0], b[1], b[2])
    d = luminance(out.diffuse[i])
    g = luminance(out.glossy[i])
    out.moments[i] = wp.vec2(d * d, g * g)
    out.length[i] = wp.vec2(a[3], b[3]) * settings.worth


# Whether pixel j of a frame sees the surface of pixel i of `now`, which is at `place` in that frame.
@wp.func
def same_surface(
    settings: DenoiseSettings, now: Guides, i: wp.int32, place: wp.vec3, frame: Guides, j: wp.int32
) -> wp.bool:
    if frame.guide_object[j] != now.guide_object[i]:
        return False
    if wp.dot(now.guide_normal[i], frame.guide_normal[j]) < LEAST_COSINE:
        return False
    away = wp.dot(now.guide_plane[i], frame.guide_position[j] - place)
    return wp.abs(away) < FOOTPRINTS * settings.footprint * now.guide_distance[i]


# Whether pixel (x, y) of the frame before saw the surface that pixel i sees now.
@wp.func
def saw_surface(
    settings: DenoiseSettings, now: Guides, before: Guides, i: wp.int32, x: wp.int32, y: wp.int32
) -> wp.bool:
    if x < 0 or y < 0 or x >= settings.width or y >= settings.height:
        return False
    return same_surface(settings, now, i, now.guide_previous[i], before, y * settings.width + x)


# Mean of the average before, over the pixels within `reach` of (x, y) that saw the surface of pixel i, by a
# tent; bilinear for a reach of 1.
@wp.func
def gather_history(
    settings: DenoiseSettings,
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
        across = 1.0 - wp.abs(x - wp.float32(px)) / wp.float32(reach)
        down = 1.0 - wp.abs(y - wp.float32(py)) / wp.float32(reach)
        w = wp.max(across, 0.0) * wp.max(down, 0.0)
        if w > 0.0 and saw_surface(settings, now, before, i, px, py):
            j = py * settings.width + px
            length = history.length[j]
            a = wp.where(length[0] > 0.0, w, 0.0)
            b = wp.where(length[1] > 0.0, w, 0.0)
            both = wp.vec2(a, b)
            r.weight += both
            r.length += wp.cw_mul(both, length)
            r.diffuse += a * history.diffuse[j]
            r.glossy += b * history.glossy[j]
            r.moments += wp.cw_mul(both, history.moments[j])
    return r


# Thread: a pixel. Moves the average of the frames before to where its surface is now. If none of the four nearest
# pixels saw the surface, one next to them may have: at an outline camera samples hit now the one surface and now the
# other.
@wp.kernel
def reproject(first: wp.int32, settings: DenoiseSettings, now: Guides, before: Guides, history: Signals, out: Signals):
    i = first + wp.tid()
    h = Gathered()
    if now.guide_object[i] > 0:
        row = i / settings.width
        x = wp.float32(i - row * settings.width) + now.guide_motion[i][0]
        y = wp.float32(row) + now.guide_motion[i][1]
        h = gather_history(settings, now, before, history, i, x, y, 1)
        if wp.max(h.weight[0], h.weight[1]) < LEAST_WEIGHT:
            h = gather_history(settings, now, before, history, i, x, y, 2)
    length = wp.vec2(0.0, 0.0)
    moments = wp.vec2(0.0, 0.0)
    if h.weight[0] >= LEAST_WEIGHT:
        out.diffuse[i] = h.diffuse / h.weight[0]
        length[0] = h.length[0] / h.weight[0]
        moments[0] = h.moments[0] / h.weight[0]
    if h.weight[1] >= LEAST_WEIGHT:
        out.glossy[i] = h.glossy / h.weight[1]
        length[1] = h.length[1] / h.weight[1]
        moments[1] = h.moments[1] / h.weight[1]
    out.length[i] = length
    out.moments[i] = moments


# By how much a block's light has changed, from sums over its pixels of: the new light less the average before, the
# variance of that, and the larger of the two lights.
@wp.func
def change_of(difference: wp.float32, variance: wp.float32, light: wp.float32, lag: wp.float32) -> wp.float32:
    off = wp.abs(difference)
    if off <= LEAST_CHANGE * light or variance <= 0.0:
        return 0.0
    return wp.clamp(off / (wp.sqrt(variance) * lag) - 1.0, 0.0, 1.0)


# Thread: a block of pixels. Compares their new light with the average before, pixel by pixel. One outlier is no change:
# it counts as much for the variance.
@wp.kernel
def find_changes(first: wp.int32, settings: DenoiseSettings, noisy: Signals, history: Signals, changes: Changes):
    b = first + wp.tid()
    x0 = (b % changes.columns) * BLOCK
    y0 = (b / changes.columns) * BLOCK
    difference = wp.vec2(0.0, 0.0)
    variance = wp.vec2(0.0, 0.0)
    light = wp.vec2(0.0, 0.0)
    for y in range(y0, wp.min(y0 + BLOCK, settings.height)):
        for x in range(x0, wp.min(x0 + BLOCK, settings.width)):
            i = y * settings.width + x
            length = history.length[i]
            fresh = noisy.length[i]
            counts = wp.vec2(
                wp.where(length[0] >= 1.0 and fresh[0] > 0.0, 1.0, 0.0),
                wp.where(length[1] >= 1.0 and fresh[1] > 0.0, 1.0, 0.0),
            )
            if counts[0] + counts[1] > 0.0:
                new = wp.vec2(luminance(noisy.diffuse[i]), luminance(noisy.glossy[i]))
                old = wp.vec2(luminance(history.diffuse[i]), luminance(history.glossy[i]))
                off = new - old
                spread = wp.max(history.moments[i] - wp.cw_mul(old, old), wp.vec2(0.0, 0.0))
                spread_of_mean = wp.cw_div(spread, wp.max(length, wp.vec2(1.0, 1.0)))
                difference += wp.cw_mul(counts, off)
                variance += wp.cw_mul(counts, wp.max(wp.cw_mul(off, off), spread) + spread_of_mean)
                light += wp.cw_mul(counts, wp.max(new, old))
    changes.diffuse[b] = change_of(difference[0], variance[0], light[0], settings.lag)
    changes.glossy[b] = change_of(difference[1], variance[1], light[1], settings.lag)


# Change at a pixel, between the middles of blocks.
@wp.func
def change_at(
    values: wp.array(dtype=wp.float32), columns: wp.int32, rows: wp.int32, x: wp.int32, y: wp.int32
) -> wp.float32:
    u = wp.clamp((wp.float32(x) + 0.5) / wp.float32(BLOCK) - 0.5, 0.0, wp.float32(columns - 1))
    v = wp.clamp((wp.float32(y) + 0.5) / wp.float32(BLOCK) - 0.5, 0.0, wp.float32(rows - 1))
    i = wp.min(wp.int32(u), wp.max(columns - 2, 0))
    j = wp.min(wp.int32(v), wp.max(rows - 2, 0))
    i1 = wp.min(i + 1, columns - 1)
    j1 = wp.min(j + 1, rows - 1)
    fu = u - wp.float32(i)
    fv = v - wp.float32(j)
    top = values[j * columns + i] * (1.0 - fu) + values[j * columns + i1] * fu
    bottom = values[j1 * columns + i] * (1.0 - fu) + values[j1 * columns + i1] * fu
    return top * (1.0 - fv) + bottom * fv


# Changes of both lobes at a pixel; 0 where light is never forgotten.
@wp.func
def changes_at(settings: DenoiseSettings, changes: Changes, x: wp.int32, y: wp.int32) -> wp.vec2:
    if settings.lag <= 0.0:
        return wp.vec2(0.0, 0.0)
    rows = changes.diffuse.shape[0] / changes.columns
    return wp.vec2(
        change_at(changes.diffuse, changes.columns, rows, x, y), change_at(changes.glossy, changes.columns, rows, x, y)
    )


# Pixels of a block that a pixel's light is compared with and shared among: those of its surface whose light of the lobe
# is known.
@wp.func
def is_around(
    settings: DenoiseSettings,
    guides: Guides,
    length: wp.array(dtype=wp.vec2),
    lobe: wp.int32,
    i: wp.int32,
    x: wp.int32,
    y: wp.int32,
) -> wp.bool:
    if x < 0 or y < 0 or x >= settings.width or y >= settings.height:
        return False
    j = y * settings.width + x
    if j == i or length[j][lobe] <= 0.0:
        return False
    return same_surface(settings, guides, i, guides.guide_position[i], guides, j)


# Share out what the light of pixel i has above a limit among it and the pixels around in the block from (x0, y0).
# The limit is a multiple of the root of the mean square of earlier light there; from an outlier no pixel gets more than
# that root itself, so that no block is seen. What is left is lost. Where many pixels are above it, or all was dark, the
# light is another one, and stays.
@wp.func
def share_outlier(
    settings: DenoiseSettings,
    guides: Guides,
    noisy: Signals,
    history: Signals,
    lobe: wp.int32,
    i: wp.int32,
    x0: wp.int32,
    y0: wp.int32,
):
    light = noisy.diffuse
    if lobe == 1:
        light = noisy.glossy
    count = float(0.0)
    frames = float(0.0)
    square = float(0.0)
    for k in range(BLOCK * BLOCK):
        x = x0 + k % BLOCK
        y = y0 + k / BLOCK
        if is_around(settings, guides, noisy.length, lobe, i, x, y):
            j = y * settings.width + x
            count += 1.0
            frames += history.length[j][lobe]
            square += history.length[j][lobe] * history.moments[j][lobe]
    if count < LEAST_AROUND or frames < LEAST_KNOWN:
        return
    own = luminance(light[i])
    typical = wp.sqrt(square / frames)
    limit = settings.outliers * typical
    if own <= limit or typical <= 0.0:
        return
    alike = float(0.0)
    for k in range(BLOCK * BLOCK):
        x = x0 + k % BLOCK
        y = y0 + k / BLOCK
        if is_around(settings, guides, noisy.length, lobe, i, x, y):
            if noisy.moments[y * settings.width + x][lobe] > limit * limit:
                alike += 1.0
    if alike > MOST_ALIKE * count:
        return
    part = light[i] * (wp.min((own - limit) / (count + 1.0), typical) / own)
    light[i] = light[i] * (limit / own) + part
    for k in range(BLOCK * BLOCK):
        x = x0 + k % BLOCK
        y = y0 + k / BLOCK
        if is_around(settings, guides, noisy.length, lobe, i, x, y):
            j = y * settings.width + x
            light[j] = light[j] + part


# Thread: a block of pixels, with its pixels one after the other. Light that a single ray found, and hardly any before
# or around, is shared out: averages over frames keep it for long as a dot. Squares stay as they were, for the filter:
# the light is as uncertain as before.
@wp.kernel
def share_outliers(
    first: wp.int32, settings: DenoiseSettings, guides: Guides, noisy: Signals, history: Signals, changes: Changes
):
    b = first + wp.tid()
    columns = (settings.width + settings.shift_x + BLOCK - 1) / BLOCK
    x0 = (b % columns) * BLOCK - settings.shift_x
    y0 = (b / columns) * BLOCK - settings.shift_y
    for y in range(wp.max(y0, 0), wp.min(y0 + BLOCK, settings.height)):
        for x in range(wp.max(x0, 0), wp.min(x0 + BLOCK, settings.width)):
            i = y * settings.width + x
            change = changes_at(settings, changes, x, y)
            for lobe in range(2):
                square = noisy.moments[i][lobe]
                known = settings.outliers * settings.outliers * history.moments[i][lobe]
                if square > 0.0 and square > known and change[lobe] == 0.0:
                    share_outlier(settings, guides, noisy, history, lobe, i, x0, y0)


# Frames of an average that are kept when a frame is added that is worth `new` of them; there are at most `most`.
@wp.func
def kept_frames(length: wp.float32, new: wp.float32, most: wp.float32, change: wp.float32) -> wp.float32:
    return wp.min(length, wp.max(most - new, 0.0)) * (1.0 - change)


# An average with new light of a weight in it; of the weight 1 nothing is read of the average, which may not be there.
@wp.func
def with_new(average: wp.vec3, light: wp.vec3, weight: wp.float32) -> wp.vec3:
    if weight >= 1.0:
        return light
    return average * (1.0 - weight) + light * weight


# Thread: a pixel. Adds the new frame to the average; `out` is it, and may be the average before.
@wp.kernel
def add_frame(
    first: wp.int32, settings: DenoiseSettings, noisy: Signals, history: Signals, changes: Changes, out: Signals
):
    i = first + wp.tid()
    length = history.length[i]
    fresh = noisy.length[i]
    moments = history.moments[i]
    change = wp.vec2(0.0, 0.0)
    if length[0] + length[1] > 0.0:
        y = i / settings.width
        change = changes_at(settings, changes, i - y * settings.width, y)
    if fresh[0] > 0.0:
        kept = kept_frames(length[0], fresh[0], settings.diffuse_frames, change[0])
        a = fresh[0] / (kept + fresh[0])
        out.diffuse[i] = with_new(history.diffuse[i], noisy.diffuse[i], a)
        moments[0] = moments[0] * (1.0 - a) + noisy.moments[i][0] * a
        length[0] = kept + fresh[0]
    if fresh[1] > 0.0:
        kept = kept_frames(length[1], fresh[1], settings.glossy_frames, change[1])
        b = fresh[1] / (kept + fresh[1])
        out.glossy[i] = with_new(history.glossy[i], noisy.glossy[i], b)
        moments[1] = moments[1] * (1.0 - b) + noisy.moments[i][1] * b
        length[1] = kept + fresh[1]
    if length[0] <= 0.0:
        out.diffuse[i] = wp.vec3(0.0, 0.0, 0.0)
    if length[1] <= 0.0:
        out.glossy[i] = wp.vec3(0.0, 0.0, 0.0)
    out.moments[i] = moments
    out.length[i] = length


# Sums over pixels around one, of one lobe.
@wp.struct
class Spread:
    count: wp.float32
    luminance: wp.float32
    square: wp.float32
    variance: wp.float32  # of a frame, by moments


@wp.func
def add_spread(sums: Spread, light: wp.vec3, moment: wp.float32) -> Spread:
    r = sums
    l = luminance(light)
    r.count = r.count + 1.0
    r.luminance = r.luminance + l
    r.square = r.square + l * l
    r.variance = r.variance + wp.max(moment - l * l, 0.0)
    return r


# Luminance that tells lights apart, and the variance of the mean, of an average of so many frames.
@wp.func
def told_by(sums: Spread, settings: DenoiseSettings, length: wp.float32, own: wp.float32) -> wp.vec2:
    if length <= 0.0:
        return wp.vec2(0.0, UNKNOWN)
    if length < settings.settled:
        mean = sums.luminance / sums.count
        spread = wp.max(sums.square / sums.count - mean * mean, 0.0)
        return wp.vec2(mean, spread * wp.max(settings.settled / length, 1.0))
    return wp.vec2(own, sums.variance / sums.count / wp.max(length - 1.0, 1.0))


# Thread: a pixel. Writes the light with the variance of its mean, and the luminances by which the first level tells
# lights apart: of a long average its own; of a short one the mean of the pixels around, whose differences are its
# variance, too.
@wp.kernel
def estimate_variance(
    first: wp.int32,
    settings: DenoiseSettings,
    guides: Guides,
    average: Signals,
    out: Filtered,
    tells: wp.array(dtype=wp.vec2),
):
    i = first + wp.tid()
    d = average.diffuse[i]
    g = average.glossy[i]
    length = average.length[i]
    diffuse = Spread()
    glossy = Spread()
    if guides.guide_object[i] > 0:
        y = i / settings.width
        x = i - y * settings.width
        reach = int(1)
        for k in range(2):
            if length[k] > 0.0 and length[k] < settings.settled:
                reach = 3
        for ty in range(wp.max(y - reach, 0), wp.min(y + reach + 1, settings.height)):
            for tx in range(wp.max(x - reach, 0), wp.min(x + reach + 1, settings.width)):
                j = ty * settings.width + tx
                if same_surface(settings, guides, i, guides.guide_position[i], guides, j):
                    known = average.length[j]
                    if known[0] > 0.0:
                        diffuse = add_spread(diffuse, average.diffuse[j], average.moments[j][0])
                    if known[1] > 0.0:
                        glossy = add_spread(glossy, average.glossy[j], average.moments[j][1])
    by_diffuse = told_by(diffuse, settings, length[0], luminance(d))
    by_glossy = told_by(glossy, settings, length[1], luminance(g))
    out.diffuse[i] = wp.vec4(d[0], d[1], d[2], by_diffuse[1])
    out.glossy[i] = wp.vec4(g[0], g[1], g[2], by_glossy[1])
    tells[i] = wp.vec2(by_diffuse[0], by_glossy[0])


# Luminances that tell lights apart: those handed over, or where there are none the light's own.
@wp.func
def telling(tells: wp.array(dtype=wp.vec2), light: Filtered, i: wp.int32) -> wp.vec2:
    if tells.shape[0] > 0:
        return tells[i]
    d = light.diffuse[i]
    g = light.glossy[i]
    return wp.vec2(luminance(wp.vec3(d[0], d[1], d[2])), luminance(wp.vec3(g[0], g[1], g[2])))


# Mean variances of a pixel and of those around it that are of its object.
@wp.func
def variance_around(settings: DenoiseSettings, guides: Guides, light: Filtered, i: wp.int32) -> wp.vec2:
    y = i / settings.width
    x = i - y * settings.width
    totals = wp.vec2(0.0, 0.0)
    sums = wp.vec2(0.0, 0.0)
    for row in range(-1, 2):
        for column in range(-1, 2):
            ty = y + row
            tx = x + column
            j = ty * settings.width + tx
            if ty >= 0 and ty < settings.height and tx >= 0 and tx < settings.width:
                if guides.guide_object[j] == guides.guide_object[i]:
                    w = 1.0 / wp.float32(1 + row * row) / wp.float32(1 + column * column)
                    both = wp.vec2(light.diffuse[j][3], light.glossy[j][3])
                    known = wp.vec2(wp.where(both[0] >= 0.0, w, 0.0), wp.where(both[1] >= 0.0, w, 0.0))
                    totals += known
                    sums += wp.cw_mul(known, both)
    return wp.cw_div(sums, wp.max(totals, wp.vec2(LEAST_REFLECTANCE, LEAST_REFLECTANCE)))


# Light times a weight; its variance by the square of it.
@wp.func
def tap(light: wp.vec4, weight: wp.float32) -> wp.vec4:
    return wp.vec4(light[0] * weight, light[1] * weight, light[2] * weight, light[3] * weight * weight)


# Thread: a pixel. One level of the filter over pixels: nine taps, `step` pixels apart, weighed by the distance to the
# pixel's tangent plane, by normals, and by luminance over its deviation.
@wp.kernel
def filter_level(
    first: wp.int32,
    settings: DenoiseSettings,
    guides: Guides,
    light: Filtered,
    tells: wp.array(dtype=wp.vec2),
    out: Filtered,
):
    i = first + wp.tid()
    if guides.guide_object[i] == 0:
        out.diffuse[i] = light.diffuse[i]
        out.glossy[i] = light.glossy[i]
        return
    y = i / settings.width
    x = i - y * settings.width
    variance = variance_around(settings, guides, light, i)
    mine = telling(tells, light, i)  # may be below 0, where one camera sample's colour met another one's light
    by_diffuse = 1.0 / (settings.luminance * wp.sqrt(variance[0]) + SMALLEST_DEVIATION * wp.abs(mine[0]) + SMALLEST)
    by_glossy = 1.0 / (settings.luminance * wp.sqrt(variance[1]) + SMALLEST_DEVIATION * wp.abs(mine[1]) + SMALLEST)
    by_plane = 1.0 / (settings.plane * settings.footprint * guides.guide_distance[i])
    d = light.diffuse[i]
    g = light.glossy[i]
    d_total = float(1.0)
    g_total = float(1.0)
    for k in range(9):
        row = k / 3 - 1
        column = k % 3 - 1
        ty = y + row * settings.step
        tx = x + column * settings.step
        j = ty * settings.width + tx
        if k != 4 and ty >= 0 and ty < settings.height and tx >= 0 and tx < settings.width:
            if guides.guide_object[j] > 0:
                away = wp.dot(guides.guide_plane[i], guides.guide_position[j] - guides.guide_position[i])
                turned = 1.0 - wp.dot(guides.guide_normal[i], guides.guide_normal[j])
                e = wp.abs(away) * by_plane + turned * settings.normal
                if e < LARGEST_EXPONENT:
                    other = telling(tells, light, j)
                    w = 1.0 / wp.float32((1 + row * row) * (1 + column * column))
                    if settings.filters_diffuse != 0 and d[3] >= 0.0 and light.diffuse[j][3] >= 0.0:
                        a = w * wp.exp(-e - wp.abs(other[0] - mine[0]) * by_diffuse)
                        d = d + tap(light.diffuse[j], a)
                        d_total += a
                    if settings.filters_glossy != 0 and g[3] >= 0.0 and light.glossy[j][3] >= 0.0:
                        b = w * wp.exp(-e - wp.abs(other[1] - mine[1]) * by_glossy)
                        g = g + tap(light.glossy[j], b)
                        g_total += b
    out.diffuse[i] = d
    out.glossy[i] = g
    if d[3] >= 0.0:
        out.diffuse[i] = tap(d, 1.0 / d_total)
    if g[3] >= 0.0:
        out.glossy[i] = tap(g, 1.0 / g_total)


# Thread: a pixel. Puts the filtered light back on its surface. What was not filtered stays as it was.
@wp.kernel
def put_back(first: wp.int32, light: NoisyLight, guides: Guides, filtered: Filtered, beauty: wp.array(dtype=wp.vec3)):
    i = first + wp.tid()
    if guides.guide_object[i] == 0:
        beauty[i] = light.noisy[i]
        return
    d = filtered.diffuse[i]
    g = filtered.glossy[i]
    diffuse = wp.cw_mul(guides.guide_diffuse[i], wp.vec3(d[0], d[1], d[2]))
    glossy = wp.cw_mul(glossy_scale(guides.guide_specular[i]), wp.vec3(g[0], g[1], g[2]))
    beauty[i] = light.emission[i] + diffuse + glossy
