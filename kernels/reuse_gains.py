"""How much less a picture varies by what was learnt, from the samples of a frame.

Of light samples the excess of both choices over exploring alone is known of each (samples.keep_light). Of a direction
with light c, throughput t up to the vertex and density p, the BSDF alone would have the second moment
(c t)^2 p / p_bsdf, whose expectation is the integral of (f t)^2 / p_bsdf: so (c t)^2 (p / p_bsdf - 1) is by how much
guiding lowers it at this vertex. Means are the same, so differences of second moments are those of variances.
"""

import warp as wp

from warp_gi.kernels.bsdf import luminance
from warp_gi.kernels.octree import EMPTY_CODE
from warp_gi.kernels.quadtree_adapt import LARGEST_CONTRIBUTION
from warp_gi.kernels.samples import CHUNK, LIGHT_ALONE, SampleRecords, mixture_densities

wp.set_module_options({"enable_backward": False})

LEAST_DENSITY = wp.constant(wp.float32(1.0e-5))  # of the BSDF over that of the mixture; mixtures have 16 bits
SAME_PLANE = wp.constant(wp.float32(0.95))  # cosine between normals of neighbours that are compared


# By how much guiding lowers the second moment at the vertex of a slot.
@wp.func
def direction_gain(records: SampleRecords, slot: wp.int32) -> wp.float32:
    brought = records.contributions[slot] * records.carried[slot]
    if records.contributions[slot] <= 0.0 or brought >= LARGEST_CONTRIBUTION:
        return 0.0
    densities = mixture_densities(records.mixtures[slot])
    return brought * brought * (1.0 / wp.max(densities[0], LEAST_DENSITY) - 1.0)


# Thread: a chunk of slots. Writes by how much the cache and guiding lower the second moments of its samples, summed.
@wp.kernel
def sum_gains(first: wp.int32, records: SampleRecords, gains: wp.array(dtype=wp.vec2)):
    chunk = first + wp.tid()
    end = wp.min((chunk + 1) * CHUNK, records.codes.shape[0])
    sum = wp.vec2(0.0, 0.0)
    for slot in range(chunk * CHUNK, end):
        if records.codes[slot] != EMPTY_CODE:
            light = float(0.0)
            if (records.lights[slot] & LIGHT_ALONE) == wp.uint32(0):
                excess = records.rivals[slot]
                if wp.abs(excess) < LARGEST_CONTRIBUTION * LARGEST_CONTRIBUTION:
                    light = -excess
            sum = sum + wp.vec2(light, direction_gain(records, slot))
    gains[chunk] = sum


# Terms of a frame that vary, mean over samples, and what tells surfaces apart, [height * width].
@wp.struct
class VaryingTerms:
    environment: wp.array(dtype=wp.vec3)
    emitters: wp.array(dtype=wp.vec3)
    indirect: wp.array(dtype=wp.vec3)
    normal: wp.array(dtype=wp.vec3)
    object_id: wp.array(dtype=wp.int32)


@wp.func
def varying_luminance(terms: VaryingTerms, pixel: wp.int32) -> wp.float32:
    return luminance(terms.environment[pixel] + terms.emitters[pixel] + terms.indirect[pixel])


# Thread: a row of the picture. Writes the sum of squared differences of luminance between neighbours of one surface,
# the number of such pairs, and the number of pixels that see a surface.
@wp.kernel
def sum_differences(first: wp.int32, width: wp.int32, terms: VaryingTerms, sums: wp.array(dtype=wp.vec3)):
    row = first + wp.tid()
    sum = wp.vec3(0.0, 0.0, 0.0)
    for x in range(width):
        pixel = row * width + x
        if terms.object_id[pixel] >= 0:
            sum = sum + wp.vec3(0.0, 0.0, 1.0)
            if x > 0 and terms.object_id[pixel - 1] == terms.object_id[pixel]:
                if wp.dot(terms.normal[pixel - 1], terms.normal[pixel]) > SAME_PLANE:
                    difference = varying_luminance(terms, pixel) - varying_luminance(terms, pixel - 1)
                    sum = sum + wp.vec3(difference * difference, 1.0, 0.0)
    sums[row] = sum
