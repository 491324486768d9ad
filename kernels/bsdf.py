"""The glTF 2.0 metallic-roughness BSDF: Lambert under a GGX coat, or GGX metal.

glTF 2.0 Appendix B with KHR_materials_specular: D is GGX, V the height-correlated
Smith visibility, F Schlick's,

    f = (1 - F) c_diffuse / pi + F D V,   F = f0 + (f90 - f0) (1 - V.H)^5

Directions point away from the surface, in the shading frame (z is the normal).
Diffuse lobes are sampled by cosine, GGX by visible normals (Dupuy and Benyoub 2023,
"Sampling Visible GGX Normals with Spherical Caps").
"""

import warp as wp

from warp_gi.kernels.sampling import circle, cosine_direction

wp.set_module_options({"enable_backward": False})

SMALLEST_ALPHA = wp.constant(wp.float32(1.0e-3))


# What a material is at one point. f0 and f90 are zero for pure Lambert.
@wp.struct
class Bsdf:
    diffuse: wp.vec3  # c_diffuse
    f0: wp.vec3
    f90: wp.float32
    alpha: wp.float32


# f * cos(wi) [1/sr] and the solid-angle pdf of bsdf_sample.
@wp.struct
class BsdfValue:
    value: wp.vec3
    pdf: wp.float32


# weight = f * cos(wi) / pdf, but see bsdf_weight; pdf is 0 where sampling failed.
@wp.struct
class BsdfSample:
    wi: wp.vec3
    weight: wp.vec3
    pdf: wp.float32


# `reflectance` is that of the coat at normal incidence, before the factor `specular`.
@wp.func
def make_coated_bsdf(
    base: wp.vec3, metallic: wp.float32, roughness: wp.float32, specular: wp.float32, reflectance: wp.vec3
) -> Bsdf:
    b = Bsdf()
    b.diffuse = base * (1.0 - metallic)
    b.f0 = reflectance * specular * (1.0 - metallic) + base * metallic
    b.f90 = specular * (1.0 - metallic) + metallic
    b.alpha = wp.max(roughness * roughness, SMALLEST_ALPHA)
    return b


@wp.func
def make_bsdf(base: wp.vec3, metallic: wp.float32, roughness: wp.float32, specular: wp.float32) -> Bsdf:
    return make_coated_bsdf(base, metallic, roughness, specular, wp.vec3(0.04, 0.04, 0.04))


@wp.func
def luminance(c: wp.vec3) -> wp.float32:
    return 0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2]


@wp.func
def fresnel(b: Bsdf, cos_h: wp.float32) -> wp.vec3:
    m = wp.clamp(1.0 - cos_h, 0.0, 1.0)
    m2 = m * m
    s = m2 * m2 * m
    return b.f0 * (1.0 - s) + wp.vec3(b.f90 * s, b.f90 * s, b.f90 * s)


# Pure Lambert of a colour.
@wp.func
def lambert(color: wp.vec3) -> Bsdf:
    b = Bsdf()
    b.diffuse = color
    b.alpha = 1.0
    return b


# What the GGX lobe reflects of light from everywhere: its directional albedo, averaged over wo by cosine.
# f = (f0 (1 - s) + f90 s) D V with s = (1 - V.H)^5 is linear in f0 and f90, so the albedo is f0 A + f90 B, where A and
# B depend on the roughness r alone. Fitted to their integrals over r in [0, 1], with errors up to 0.0016 and 0.0004;
# A + B is below 1, because single scattering loses what microfacets reflect at each other (0.59 of it at r = 1). For a
# mirror they are means of 1 - (1 - cos)^5 and of (1 - cos)^5: A = 20/21, B = 1/21.
@wp.func
def average_specular(b: Bsdf) -> wp.vec3:
    r = wp.sqrt(b.alpha)
    scale = (((1.4419665 * r - 2.5984166) * r + 0.6431491) * r - 0.0300414) * r + 0.9512468
    offset = (((-0.2404349 * r + 0.5943225) * r - 0.4491881) * r + 0.0516552) * r + 0.0461039
    return b.f0 * scale + wp.vec3(b.f90, b.f90, b.f90) * offset


# Mean of 1 - F(V.H) over both directions by cosine: the share of its colour that the diffuse lobe reflects. It does
# not depend on the roughness, and is not 1 - average_specular: for two cosine-distributed directions the mean of
# (1 - V.H)^5, with V.H the cosine of half the angle between them, is 0.0036946.
@wp.func
def diffuse_share(b: Bsdf) -> wp.vec3:
    f90 = 0.0036946 * b.f90
    return wp.vec3(1.0 - f90, 1.0 - f90, 1.0 - f90) - b.f0 * (1.0 - 0.0036946)


# What a surface reflects of light from everywhere.
@wp.func
def average_reflectance(b: Bsdf) -> wp.vec3:
    return average_specular(b) + wp.cw_mul(diffuse_share(b), b.diffuse)


# Probability of sampling the GGX lobe: its share of the reflectance, looking from wo.
@wp.func
def specular_probability(b: Bsdf, cos_o: wp.float32) -> wp.float32:
    if b.f90 <= 0.0:
        return 0.0
    f = luminance(fresnel(b, cos_o))
    d = luminance(b.diffuse) * (1.0 - f)
    if d <= 0.0:
        return 1.0
    return wp.clamp(f / (f + d), 0.05, 1.0)


@wp.func
def ggx_distribution(alpha: wp.float32, cos_h: wp.float32, sin2_h: wp.float32) -> wp.float32:
    # sin2_h is passed in: 1 - cos^2 loses all digits near the peak of a smooth lobe
    a2 = alpha * alpha
    d = sin2_h + a2 * cos_h * cos_h
    return a2 / (wp.pi * d * d)


@wp.func
def smith_root(alpha: wp.float32, cos_theta: wp.float32) -> wp.float32:
    a2 = alpha * alpha
    return wp.sqrt(a2 + (1.0 - a2) * cos_theta * cos_theta)


@wp.func
def bsdf_evaluate(b: Bsdf, wo: wp.vec3, wi: wp.vec3) -> BsdfValue:
    r = BsdfValue()
    cos_o = wo[2]
    cos_i = wi[2]
    if cos_o <= 0.0 or cos_i <= 0.0:
        return r
    if b.f90 <= 0.0:
        r.pdf = cos_i / wp.pi
        r.value = b.diffuse * r.pdf
        return r
    h = wp.normalize(wo + wi)
    f = fresnel(b, wp.dot(wo, h))
    d = ggx_distribution(b.alpha, h[2], h[0] * h[0] + h[1] * h[1])
    root_o = smith_root(b.alpha, cos_o)
    visibility = 0.5 / (cos_o * smith_root(b.alpha, cos_i) + cos_i * root_o)
    r.value = (wp.cw_mul(wp.vec3(1.0, 1.0, 1.0) - f, b.diffuse) / wp.pi + f * (d * visibility)) * cos_i
    p = specular_probability(b, cos_o)
    r.pdf = p * d / (2.0 * (cos_o + root_o)) + (1.0 - p) * cos_i / wp.pi
    return r


# Share of what bsdf_evaluate gives that the diffuse lobe reflects, by colour.
@wp.func
def diffuse_part(b: Bsdf, wo: wp.vec3, wi: wp.vec3) -> wp.vec3:
    if b.f90 <= 0.0:
        return wp.vec3(1.0, 1.0, 1.0)
    whole = bsdf_evaluate(b, wo, wi).value
    f = fresnel(b, wp.dot(wo, wp.normalize(wo + wi)))
    diffuse = wp.cw_mul(wp.vec3(1.0, 1.0, 1.0) - f, b.diffuse) * (wi[2] / wp.pi)
    part = wp.vec3(0.0, 0.0, 0.0)
    for k in range(3):
        if whole[k] > 0.0:
            part[k] = wp.clamp(diffuse[k] / whole[k], 0.0, 1.0)
    return part


# Visible normal of GGX seen from wo.
@wp.func
def ggx_visible_normal(alpha: wp.float32, wo: wp.vec3, u: wp.vec2) -> wp.vec3:
    w = wp.normalize(wp.vec3(alpha * wo[0], alpha * wo[1], wo[2]))
    z = (1.0 - u[1]) * (1.0 + w[2]) - w[2]
    s = wp.sqrt(wp.clamp(1.0 - z * z, 0.0, 1.0))
    c = circle(u[0]) * s
    h = wp.vec3(c[0], c[1], z) + w
    return wp.normalize(wp.vec3(alpha * h[0], alpha * h[1], wp.max(h[2], 1.0e-6)))


# u_lobe chooses the lobe, u the direction in it.
@wp.func
def bsdf_sample(b: Bsdf, wo: wp.vec3, u_lobe: wp.float32, u: wp.vec2) -> BsdfSample:
    r = BsdfSample()
    if wo[2] <= 0.0:
        return r
    if b.f90 <= 0.0:
        r.wi = cosine_direction(u)
        r.pdf = r.wi[2] / wp.pi
        r.weight = b.diffuse
        return r
    if u_lobe < specular_probability(b, wo[2]):
        h = ggx_visible_normal(b.alpha, wo, u)
        r.wi = h * (2.0 * wp.dot(wo, h)) - wo
    else:
        r.wi = cosine_direction(u)
    value = bsdf_evaluate(b, wo, r.wi)
    if value.pdf > 0.0:
        r.pdf = value.pdf
        r.weight = value.value / value.pdf
    return r


# Direction of the GGX lobe alone, and F D V cos(wi) / pdf.
@wp.func
def specular_sample(b: Bsdf, wo: wp.vec3, u: wp.vec2) -> BsdfSample:
    r = BsdfSample()
    if wo[2] <= 0.0 or b.f90 <= 0.0:
        return r
    h = ggx_visible_normal(b.alpha, wo, u)
    cos_h = wp.dot(wo, h)
    r.wi = h * (2.0 * cos_h) - wo
    cos_i = r.wi[2]
    if cos_i <= 0.0:
        return r
    root_o = smith_root(b.alpha, wo[2])
    # D cancels: pdf = D / (2 (cos_o + root_o)), f cos = F D cos_i / (2 (cos_o root_i + cos_i root_o))
    share = cos_i * (wo[2] + root_o) / (wo[2] * smith_root(b.alpha, cos_i) + cos_i * root_o)
    r.weight = fresnel(b, cos_h) * share
    r.pdf = ggx_distribution(b.alpha, h[2], h[0] * h[0] + h[1] * h[1]) / (2.0 * (wo[2] + root_o))
    return r


# f * cos(wi) / pdf of a sample. That of a Lambert material is its colour now, whatever it was when the
# sample was drawn: the direction does not depend on it.
@wp.func
def bsdf_weight(b: Bsdf, sample: BsdfSample) -> wp.vec3:
    if b.f90 <= 0.0:
        return b.diffuse
    return sample.weight
