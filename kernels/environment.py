"""The sky: radiance in a direction, sampling directions by it, and the pdf of doing so.

A map's texel (row i, column j) is a node at v = i / (height - 1), u = (j + 0.5) / width, and radiance
is bilinear between nodes; the first row is the zenith, the last the nadir. A bilinear luminance is a sum of tents
about nodes: sampling picks a node, then a point under its tent, and reads no texel for it. So the density per latitude
and longitude is the luminance, times the sine of the polar angle in the middle of the patch between four nodes; only
that sine, and colours, make samples differ in weight.
"""

import warp as wp

from warp_gi.kernels.alias import alias_choice, alias_prefetch
from warp_gi.kernels.bsdf import luminance
from warp_gi.kernels.sampling import circle
from warp_gi.kernels.types import ENVIRONMENT_CONSTANT, ENVIRONMENT_MAP, Environment

wp.set_module_options({"enable_backward": False})

PI = wp.constant(wp.float32(3.141592653589793))
TWO_PI = wp.constant(wp.float32(6.283185307179586))
UNIFORM_SPHERE_PDF = wp.constant(wp.float32(0.07957747154594767))  # 1 / (4 pi)


# A direction, and of a map where in it that is: `environment_arrival` knows the rest. Most samples lie behind the
# surface or in shadow, and need no more.
@wp.struct
class EnvironmentSample:
    direction: wp.vec3  # unit, world space, towards the sky; 0 if there is nothing to sample
    row: wp.int32  # of the patch's upper nodes
    column: wp.int32  # of its left nodes, may be -1
    s: wp.float32  # from left to right
    t: wp.float32  # from upper to lower


@wp.struct
class EnvironmentLookup:
    radiance: wp.vec3  # W/(m^2 sr)
    pdf: wp.float32  # 1/sr


# Latitude-longitude coordinates in [0, 1) x [0, 1] of a unit direction in environment space.
# The arc tangent keeps its precision near the poles, where acos(y) loses it.
@wp.func
def lat_long_encode(direction: wp.vec3) -> wp.vec2:
    u = wp.atan2(direction[0], -direction[2]) / TWO_PI
    v = wp.atan2(wp.sqrt(direction[0] * direction[0] + direction[2] * direction[2]), direction[1]) / PI
    return wp.vec2(u - wp.floor(u), v)


# Four nodes of the map around a point, in units of its texels, and where between them it is.
@wp.struct
class Patch:
    row: wp.int32
    column: wp.int32  # may be -1
    s: wp.float32  # from left to right
    t: wp.float32  # from upper to lower
    upper_left: wp.vec3
    upper_right: wp.vec3
    lower_left: wp.vec3
    lower_right: wp.vec3


# The patch whose left nodes stand in a column, which may be -1.
@wp.func
def patch_nodes(env: Environment, row: wp.int32, column: wp.int32) -> Patch:
    r = Patch()
    r.row = row
    r.column = column
    left = column
    if left < 0:
        left += env.width
    right = column + 1
    if right >= env.width:
        right -= env.width
    start = row * env.width
    r.upper_left = env.texels[start + left]
    r.upper_right = env.texels[start + right]
    r.lower_left = env.texels[start + env.width + left]
    r.lower_right = env.texels[start + env.width + right]
    return r


@wp.func
def patch_at(env: Environment, uv: wp.vec2) -> Patch:
    x = wp.clamp(uv[0], 0.0, 1.0) * wp.float32(env.width) - 0.5
    y = wp.clamp(uv[1], 0.0, 1.0) * wp.float32(env.height - 1)
    column = wp.int32(wp.floor(x))
    row = wp.clamp(wp.int32(y), 0, env.height - 2)
    r = patch_nodes(env, row, column)
    r.s = x - wp.float32(column)
    r.t = y - wp.float32(row)
    return r


@wp.func
def patch_texel(p: Patch) -> wp.vec3:
    upper = p.upper_left * (1.0 - p.s) + p.upper_right * p.s
    lower = p.lower_left * (1.0 - p.s) + p.lower_right * p.s
    return upper * (1.0 - p.t) + lower * p.t


# Cosine and sine of the polar angle `t` of a row below its nodes; measured from the nearer pole, for their precision.
@wp.func
def polar_angle(row: wp.int32, t: wp.float32, height: wp.int32) -> wp.vec2:
    last = height - 1
    if 2 * row < last:
        return circle(0.5 * (wp.float32(row) + t) / wp.float32(last))
    below = circle(0.5 * (wp.float32(last - row) - t) / wp.float32(last))
    return wp.vec2(-below[0], below[1])


# Density [1/sr] of a direction that is `sine` away from the poles' axis, in a patch's row.
@wp.func
def patch_pdf(env: Environment, row: wp.int32, texel: wp.vec3, sine: wp.float32) -> wp.float32:
    return luminance(texel) * env.row_pdfs[row + 1] / wp.max(sine, 1.0e-12)


# Radiance [W/(m^2 sr)] from a unit direction in world space.
@wp.func
def environment_radiance(env: Environment, direction: wp.vec3) -> wp.vec3:
    if env.kind == ENVIRONMENT_MAP:
        texel = patch_texel(patch_at(env, lat_long_encode(env.environment_from_world * direction)))
        return wp.cw_mul(texel, env.radiance)
    if env.kind == ENVIRONMENT_CONSTANT:
        return env.radiance
    return wp.vec3(0.0, 0.0, 0.0)


# Radiance from a unit direction in world space, and the density [1/sr] with which environment_sample yields it.
@wp.func
def environment_lookup(env: Environment, direction: wp.vec3) -> EnvironmentLookup:
    r = EnvironmentLookup()
    if env.kind == ENVIRONMENT_MAP:
        local = env.environment_from_world * direction
        patch = patch_at(env, lat_long_encode(local))
        texel = patch_texel(patch)
        r.radiance = wp.cw_mul(texel, env.radiance)
        r.pdf = patch_pdf(env, patch.row, texel, wp.sqrt(local[0] * local[0] + local[2] * local[2]))
    elif env.kind == ENVIRONMENT_CONSTANT:
        r.radiance = env.radiance
        r.pdf = UNIFORM_SPHERE_PDF
    return r


# A direction under the tent of a node of the map, by two uniform numbers in [0, 1): azimuth and polar angle.
@wp.func
def node_sample(env: Environment, node: wp.int32, across: wp.float32, down: wp.float32) -> EnvironmentSample:
    r = EnvironmentSample()
    r.row = node / env.width
    r.column = node - r.row * env.width
    if across < 0.5:
        r.column -= 1
        r.s = wp.sqrt(2.0 * across)
    else:
        r.s = 1.0 - wp.sqrt(2.0 - 2.0 * across)
    above = env.row_pdfs[r.row]
    share = above / (above + env.row_pdfs[r.row + 1])
    if down < share:
        r.row -= 1
        r.t = wp.sqrt(down / share)
    else:
        r.t = 1.0 - wp.sqrt((1.0 - down) / (1.0 - share))
    polar = polar_angle(r.row, r.t, env.height)
    around = circle((wp.float32(r.column) + 0.5 + r.s) / wp.float32(env.width)) * polar[1]
    local = wp.vec3(around[1], polar[0], -around[0])
    r.direction = wp.transpose(env.environment_from_world) * local
    return r


# A direction by the luminance from there, from three uniform numbers in [0, 1): u[0] with further digits u[2] picks a
# node and then the azimuth under its tent, u[1] the polar angle.
@wp.func
def environment_sample(env: Environment, u: wp.vec3) -> EnvironmentSample:
    r = EnvironmentSample()
    if env.kind == ENVIRONMENT_MAP:
        choice = alias_choice(env.alias, env.width * env.height, u[0], u[2])
        return node_sample(env, choice.item, choice.remainder, u[1])
    if env.kind == ENVIRONMENT_CONSTANT:
        z = 1.0 - 2.0 * u[1]
        ring = wp.sqrt(wp.max(0.0, 1.0 - z * z))
        r.direction = wp.vec3(ring * wp.cos(TWO_PI * u[0]), z, ring * wp.sin(TWO_PI * u[0]))
    return r


# What comes from the direction of a sample, and the density of such samples: as environment_lookup says of it.
@wp.func
def environment_arrival(env: Environment, drawn: EnvironmentSample) -> EnvironmentLookup:
    r = EnvironmentLookup()
    if env.kind == ENVIRONMENT_MAP:
        patch = patch_nodes(env, drawn.row, drawn.column)
        patch.s = drawn.s
        patch.t = drawn.t
        texel = patch_texel(patch)
        r.radiance = wp.cw_mul(texel, env.radiance)
        r.pdf = patch_pdf(env, drawn.row, texel, polar_angle(drawn.row, drawn.t, env.height)[1])
    elif env.kind == ENVIRONMENT_CONSTANT:
        r.radiance = env.radiance
        r.pdf = UNIFORM_SPHERE_PDF
    return r


# Starts fetching what environment_sample(env, u) will read first.
@wp.func
def environment_prefetch(env: Environment, u: wp.vec3):
    alias_prefetch(env.alias, env.width * env.height, u[0])
