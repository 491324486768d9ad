"""The end of a frame: sums become means, and terms add up to beauty."""

import warp as wp

wp.set_module_options({"enable_backward": False})


# [height * width]; sums on entry, means on exit.
@wp.struct
class FrameSums:
    emission: wp.array(dtype=wp.vec3)
    environment: wp.array(dtype=wp.vec3)
    emitters: wp.array(dtype=wp.vec3)
    indirect: wp.array(dtype=wp.vec3)
    alpha: wp.array(dtype=wp.float32)  # over camera samples
    albedo: wp.array(dtype=wp.vec3)
    normal: wp.array(dtype=wp.vec3)
    moment1: wp.array(dtype=wp.vec3)
    moment2: wp.array(dtype=wp.vec3)
    environment_moment1: wp.array(dtype=wp.vec3)  # of a term that was not path traced with the rest, or empty
    environment_moment2: wp.array(dtype=wp.vec3)
    emitters_moment1: wp.array(dtype=wp.vec3)
    emitters_moment2: wp.array(dtype=wp.vec3)
    indirect_moment1: wp.array(dtype=wp.vec3)
    indirect_moment2: wp.array(dtype=wp.vec3)
    guide_diffuse: wp.array(dtype=wp.vec3)  # over camera samples, as albedo; empty without a denoiser
    guide_specular: wp.array(dtype=wp.vec3)
    lobe_diffuse: wp.array(dtype=wp.vec3)  # what estimators handed over apart, or empty
    lobe_glossy: wp.array(dtype=wp.vec3)
    lobe_apart: wp.array(dtype=wp.vec3)
    beauty: wp.array(dtype=wp.vec3)
    variance: wp.array(dtype=wp.vec3)  # of the mean


# From the sums of n samples and of their squares.
@wp.func
def variance_of_mean(sum: wp.vec3, squares: wp.vec3, n: wp.float32) -> wp.vec3:
    mean = sum / n
    return wp.max(squares / n - wp.cw_mul(mean, mean), wp.vec3(0.0, 0.0, 0.0)) / (n - 1.0)


# Thread: a pixel. beauty = ((emission + environment) + emitters) + indirect, to the last bit.
# variance = (E[x^2] - E[x]^2) / (n - 1), as if samples were independent: too much where they are
# stratified, too little where many share a camera sample and camera samples differ (edges). Terms of other launches are
# independent of the path tracer's, so their variance adds.
@wp.kernel
def compose_frame(first: wp.int32, camera_samples: wp.int32, samples: wp.int32, b: FrameSums):
    i = first + wp.tid()
    views = wp.float32(camera_samples)
    n = wp.float32(samples)
    emission = b.emission[i] / views
    environment = b.environment[i] / n
    emitters = b.emitters[i] / n
    indirect = b.indirect[i] / n
    b.emission[i] = emission
    b.environment[i] = environment
    b.emitters[i] = emitters
    b.indirect[i] = indirect
    b.alpha[i] = b.alpha[i] / views
    b.albedo[i] = b.albedo[i] / views
    b.normal[i] = b.normal[i] / views
    if b.guide_diffuse.shape[0] > 0:
        b.guide_diffuse[i] = b.guide_diffuse[i] / views
        b.guide_specular[i] = b.guide_specular[i] / views
    if b.lobe_diffuse.shape[0] > 0:
        b.lobe_diffuse[i] = b.lobe_diffuse[i] / n
        b.lobe_glossy[i] = b.lobe_glossy[i] / n
    if b.lobe_apart.shape[0] > 0:
        b.lobe_apart[i] = b.lobe_apart[i] / n
    b.beauty[i] = emission + environment + emitters + indirect
    if samples > 1:
        b.variance[i] = variance_of_mean(b.moment1[i], b.moment2[i], n)
        if b.environment_moment1.shape[0] > 0:
            b.variance[i] = b.variance[i] + variance_of_mean(b.environment_moment1[i], b.environment_moment2[i], n)
        if b.emitters_moment1.shape[0] > 0:
            b.variance[i] = b.variance[i] + variance_of_mean(b.emitters_moment1[i], b.emitters_moment2[i], n)
        if b.indirect_moment1.shape[0] > 0:
            b.variance[i] = b.variance[i] + variance_of_mean(b.indirect_moment1[i], b.indirect_moment2[i], n)
