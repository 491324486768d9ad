"""The sky: radiance in a direction, sampling directions by it, and the pdf of doing so.

A map's texel (row i, column j) is a node at v = i / (height - 1), u = (j + 0.5) / width, and radiance
is bilinear between nodes; the first row is the zenith, the last the nadir. Sampling picks the cell around
a node (half way to its neighbours, so half a cell high at the poles) and is uniform in solid angle in it.
"""

import warp as wp

from warp_gi.kernels.alias import alias_choice, alias_prefetch
from warp_gi.kernels.sampling import circle
from warp_gi.kernels.types import ENVIRONMENT_CONSTANT, ENVIRONMENT_MAP, Environment

wp.set_module_options({"enable_backward": False})

PI = wp.constant(wp.float32(3.141592653589793))
TWO_PI = wp.constant(wp.float32(6.283185307179586))
UNIFORM_SPHERE_PDF = wp.constant(wp.float32(0.07957747154594767))  # 1 / (4 pi)


@wp.struct
class EnvironmentSample:
    direction: wp.vec3  # unit, world space, towards the sky
    pdf: wp.float32  # 1/sr; 0 if there is nothing to sample


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


# Inverse of lat_long_encode.
@wp.func
def lat_long_decode(uv: wp.vec2) -> wp.vec3:
    phi = uv[0] * TWO_PI
    theta = uv[1] * PI
    sin_theta = wp.sin(theta)
    return wp.vec3(sin_theta * wp.sin(phi), wp.cos(theta), -sin_theta * wp.cos(phi))


@wp.func
def bilinear_radiance(env: Environment, uv: wp.vec2) -> wp.vec3:
    x = wp.clamp(uv[0], 0.0, 1.0) * wp.float32(env.width) - 0.5
    y = wp.clamp(uv[1], 0.0, 1.0) * wp.float32(env.height - 1)
    column = wp.int32(wp.floor(x))
    row = wp.clamp(wp.int32(y), 0, env.height - 2)
    s = x - wp.float32(column)
    t = y - wp.float32(row)
    left = column
    if left < 0:
        left += env.width
    right = column + 1
    if right >= env.width:
        right -= env.width
    start = row * env.width
    upper = env.texels[start + left] * (1.0 - s) + env.texels[start + right] * s
    start += env.width
    lower = env.texels[start + left] * (1.0 - s) + env.texels[start + right] * s
    return wp.cw_mul(upper * (1.0 - t) + lower * t, env.radiance)


# Polar angles where a row's cells begin and end.
@wp.func
def row_bounds(row: wp.int32, height: wp.int32) -> wp.vec2:
    step = PI / wp.float32(height - 1)
    return wp.vec2(
        wp.max(wp.float32(row) - 0.5, 0.0) * step, wp.min(wp.float32(row) + 0.5, wp.float32(height - 1)) * step
    )


# Steradians of one cell of a row: 2 pi / width * (cos(begin) - cos(end)), without the cancellation.
@wp.func
def cell_solid_angle(bounds: wp.vec2, width: wp.int32) -> wp.float32:
    middle = 0.5 * (bounds[0] + bounds[1])
    half = 0.5 * (bounds[1] - bounds[0])
    return 2.0 * TWO_PI / wp.float32(width) * wp.sin(middle) * wp.sin(half)


# Radiance [W/(m^2 sr)] from a unit direction in world space.
@wp.func
def environment_radiance(env: Environment, direction: wp.vec3) -> wp.vec3:
    if env.kind == ENVIRONMENT_MAP:
        return bilinear_radiance(env, lat_long_encode(env.environment_from_world * direction))
    if env.kind == ENVIRONMENT_CONSTANT:
        return env.radiance
    return wp.vec3(0.0, 0.0, 0.0)


# Probability density [1/sr] of the cell that holds latitude-longitude coordinates.
@wp.func
def cell_pdf(env: Environment, uv: wp.vec2) -> wp.float32:
    column = wp.min(wp.int32(uv[0] * wp.float32(env.width)), env.width - 1)
    row = wp.min(wp.int32(uv[1] * wp.float32(env.height - 1) + 0.5), env.height - 1)
    return env.alias[row * env.width + column].pdf / cell_solid_angle(row_bounds(row, env.height), env.width)


# Probability density [1/sr] with which environment_sample yields a unit direction in world space.
@wp.func
def environment_pdf(env: Environment, direction: wp.vec3) -> wp.float32:
    if env.kind == ENVIRONMENT_MAP:
        return cell_pdf(env, lat_long_encode(env.environment_from_world * direction))
    if env.kind == ENVIRONMENT_CONSTANT:
        return UNIFORM_SPHERE_PDF
    return 0.0


# Radiance and pdf of a direction at the cost of one.
@wp.func
def environment_lookup(env: Environment, direction: wp.vec3) -> EnvironmentLookup:
    r = EnvironmentLookup()
    if env.kind == ENVIRONMENT_MAP:
        uv = lat_long_encode(env.environment_from_world * direction)
        r.radiance = bilinear_radiance(env, uv)
        r.pdf = cell_pdf(env, uv)
    else:
        r.radiance = environment_radiance(env, direction)
        r.pdf = environment_pdf(env, direction)
    return r


# A direction with a density close to the radiance from there (not looked up: most samples turn out to
# be occluded, and each lookup in a map waits for memory), from three uniform numbers in [0, 1):
# u[0] with further digits u[2] picks a cell and then the azimuth in it, u[1] the polar angle.
@wp.func
def environment_sample(env: Environment, u: wp.vec3) -> EnvironmentSample:
    result = EnvironmentSample()
    if env.kind == ENVIRONMENT_MAP:
        choice = alias_choice(env.alias, env.width * env.height, u[0], u[2])
        row = choice.item / env.width
        column = choice.item - row * env.width
        bounds = row_bounds(row, env.height)
        # Uniform in cos(theta) = 1 - 2 sin^2(theta / 2); measured from the nearer pole to keep its precision.
        below = bounds[0] + bounds[1] > PI
        begin = bounds[0]
        end = bounds[1]
        if below:
            begin = PI - bounds[0]
            end = PI - bounds[1]
        sin_begin = circle(begin / (2.0 * TWO_PI))[1]
        sin_end = circle(end / (2.0 * TWO_PI))[1]
        square = wp.lerp(sin_begin * sin_begin, sin_end * sin_end, u[1])
        cos_theta = 1.0 - 2.0 * square
        if below:
            cos_theta = -cos_theta
        around = circle((wp.float32(column) + choice.remainder) / wp.float32(env.width))
        around = around * (2.0 * wp.sqrt(square * (1.0 - square)))
        local = wp.vec3(around[1], cos_theta, -around[0])
        result.direction = wp.transpose(env.environment_from_world) * local
        result.pdf = choice.pdf / cell_solid_angle(bounds, env.width)
    elif env.kind == ENVIRONMENT_CONSTANT:
        z = 1.0 - 2.0 * u[1]
        r = wp.sqrt(wp.max(0.0, 1.0 - z * z))
        result.direction = wp.vec3(r * wp.cos(TWO_PI * u[0]), z, r * wp.sin(TWO_PI * u[0]))
        result.pdf = UNIFORM_SPHERE_PDF
    return result


# Starts fetching what environment_sample(env, u) will read first.
@wp.func
def environment_prefetch(env: Environment, u: wp.vec3):
    alias_prefetch(env.alias, env.width * env.height, u[0])
