"""Light of suns and of lights without size: one ray tells nearly all, so it is averaged over few frames, and no pixels.

What a filter over pixels would blur is the edges of shadows. The average over frames, too, would, as it moves by
fractions of pixels: so it is short, and limited to what the pixels around show now.
"""

import warp as wp

from warp_gi.kernels.denoise import (
    LEAST_WEIGHT,
    DenoiseSettings,
    Filtered,
    Guides,
    kept_frames,
    known_light,
    same_surface,
    saw_surface,
)
from warp_gi.kernels.denoise_edges import catmull_rom

wp.set_module_options({"enable_backward": False})


# Diffuse light of lights that are apart, [height * width], as it comes in.
@wp.struct
class ApartLight:
    frames: wp.float32  # most frames in the average
    noisy: wp.array(dtype=wp.vec3)
    last: wp.array(dtype=wp.vec4)  # average of the frame before, and the number of frames in it; empty without one
    average: wp.array(dtype=wp.vec4)


# The range of light around a pixel, on its surface.
@wp.struct
class LightRange:
    low: wp.vec3
    high: wp.vec3


@wp.func
def range_around(
    settings: DenoiseSettings, now: Guides, noisy: wp.array(dtype=wp.vec3), i: wp.int32, light: wp.vec3
) -> LightRange:
    r = LightRange()
    r.low = light
    r.high = light
    y = i / settings.width
    x = i - y * settings.width
    for k in range(9):
        tx = x + k % 3 - 1
        ty = y + k / 3 - 1
        if tx >= 0 and tx < settings.width and ty >= 0 and ty < settings.height:
            j = ty * settings.width + tx
            if same_surface(settings, now, i, now.guide_position[i], now, j):
                r.low = wp.min(r.low, noisy[j])
                r.high = wp.max(r.high, noisy[j])
    return r


# Mean of the last frame's average, and of its length in frames, at the four pixels around the place where the surface
# of pixel i was; of those alone that saw it.
@wp.func
def last_average(
    settings: DenoiseSettings, now: Guides, before: Guides, last: wp.array(dtype=wp.vec4), i: wp.int32
) -> wp.vec4:
    row = i / settings.width
    x = wp.float32(i - row * settings.width) + now.guide_motion[i][0]
    y = wp.float32(row) + now.guide_motion[i][1]
    x0 = wp.int32(wp.floor(x))
    y0 = wp.int32(wp.floor(y))
    total = float(0.0)
    sums = wp.vec4(0.0, 0.0, 0.0, 0.0)
    low = wp.vec4(wp.inf, wp.inf, wp.inf, wp.inf)
    high = wp.vec4(-wp.inf, -wp.inf, -wp.inf, -wp.inf)
    for k in range(4):
        px = x0 + k % 2
        py = y0 + k / 2
        w = (1.0 - wp.abs(x - wp.float32(px))) * (1.0 - wp.abs(y - wp.float32(py)))
        if w > 0.0 and saw_surface(settings, now, before, i, px, py):
            value = last[py * settings.width + px]
            if value[3] > 0.0:
                total += w
                sums += w * value
                low = wp.min(low, value)
                high = wp.max(high, value)
    if total > 0.999 and x0 > 0 and y0 > 0 and x0 < settings.width - 2 and y0 < settings.height - 2:
        sharp = wp.vec4(0.0, 0.0, 0.0, 0.0)
        for k in range(16):
            column = k % 4 - 1
            row = k / 4 - 1
            w = catmull_rom(x - wp.float32(x0), column) * catmull_rom(y - wp.float32(y0), row)
            sharp += w * last[(y0 + row) * settings.width + x0 + column]
        return wp.min(wp.max(sharp, low), high)
    if total < LEAST_WEIGHT:
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    return sums / total


# Thread: a pixel. Averages its light over frames, and adds it to what the other diffuse light has been filtered to.
@wp.kernel
def average_apart(
    first: wp.int32, settings: DenoiseSettings, now: Guides, before: Guides, light: ApartLight, filtered: Filtered
):
    i = first + wp.tid()
    light.average[i] = wp.vec4(0.0, 0.0, 0.0, 0.0)
    if now.guide_object[i] == 0:
        return
    known = known_light(light.noisy[i], now.guide_diffuse[i])
    mean = wp.vec3(known[0], known[1], known[2])
    length = settings.worth * known[3]
    if light.last.shape[0] > 0 and light.frames > settings.worth:
        last = last_average(settings, now, before, light.last, i)
        if last[3] > 0.0:
            around = range_around(settings, now, light.noisy, i, mean)
            limited = wp.min(wp.max(wp.vec3(last[0], last[1], last[2]), around.low), around.high)
            kept = kept_frames(last[3], settings.worth, light.frames, 0.0) * known[3]
            length += kept
            mean += (limited - mean) * (kept / wp.max(length, 1.0e-6))
    light.average[i] = wp.vec4(mean[0], mean[1], mean[2], length)
    d = filtered.diffuse[i]
    filtered.diffuse[i] = wp.vec4(d[0] + mean[0], d[1] + mean[1], d[2] + mean[2], d[3])
