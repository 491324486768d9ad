"""Light field probes: a grid of octahedral maps of radiance, normal and distance, and irradiance between them.

A texel of a probe's map is a surfel: the radiance that leaves it towards the probe (in RGB9E5), its normal and its
radial distance, in 8 bytes (light_field_probes.txt, section 3). Beside them stand the least distance in blocks of
16 x 16 texels, for the march, and smaller maps of the irradiance about each direction with two moments of distance.
The cage of a point are the eight probes around it, or the nearest ones outside of the grid.
"""

import warp as wp

from warp_gi.kernels.octahedral import octahedral_decode, octahedral_encode, octahedral_taps, octahedral_texel

wp.set_module_options({"enable_backward": False})

BLOCK = wp.constant(16)  # texels along a side of a block of the coarse level
NOTHING = wp.constant(wp.float32(65536.0))  # distance of a texel that sees the sky, as surfel_distance returns it
SURFEL_EMITS = wp.constant(wp.uint32(0x8000))  # bit of a surfel whose texel is in LightField.emission_texels

PROBE_USABLE = wp.constant(0)
PROBE_COVERED = wp.constant(1)  # the probe is inside of something, and left out

MOMENT_REACH = wp.constant(wp.float32(2.0))  # largest distance in moments, in diagonals of a cage
WEIGHT_FLOOR = wp.constant(wp.float32(1.0e-3))
COSINE_FLOOR = wp.constant(wp.float32(1.0e-3))
OUTSIDE = wp.constant(wp.float32(1.0))  # distance from the grid that counts as outside, in distances between probes
SURFEL_TOLERANCE = wp.constant(wp.float32(8.0))  # slack of a surfel's plane in texels; 1.5 degrees at 256

_LARGEST_HALF = wp.constant(wp.float32(65504.0))
_LARGEST_SHARED = wp.constant(wp.float32(65408.0))  # 511 * 2^7, the largest number of RGB9E5
_HALF_SCALE = wp.constant(wp.float32(1.925929944387236e-34))  # 2^-112: moves a float's exponent to a half's
_FLOAT_SCALE = wp.constant(wp.float32(5.192296858534828e33))  # 2^112


@wp.struct
class LightField:
    low: wp.vec3  # position of probe (0, 0, 0) in the grid, metres
    spacing: wp.vec3  # metres between probes; above 0 also along an axis of one
    counts: wp.vec3i  # probe (x, y, z) has index (z counts.y + y) counts.x + x
    resolution: wp.int32  # texels along a side of a map, a multiple of BLOCK
    irradiance_resolution: wp.int32
    bias: wp.float32  # metres along the normal by which points leave their surface before visibility is asked for
    least_seen: wp.float32  # least share of the weights around a point of probes that see it, for its light to be known
    plain: wp.int32  # 1: interpolate as if every probe saw every point, as irradiance probes did before the paper
    bounds_low: wp.vec3  # bounds of the scene, metres; a ray that leaves them meets nothing
    bounds_high: wp.vec3
    positions: wp.array(dtype=wp.vec3)  # [probe] metres; in the grid, or moved out of a wall
    states: wp.array(dtype=wp.int32)  # [probe] PROBE_*
    radiance: wp.array(dtype=wp.uint32)  # [probe * resolution^2] RGB9E5: radiance the surfel reflects, or the sky's
    surfels: wp.array(dtype=wp.uint32)  # [probe * resolution^2] distance, normal and a bit: pack_surfel
    nearest: wp.array(dtype=wp.float32)  # [probe * (resolution / BLOCK)^2] metres to the nearest in or by a block
    irradiance: wp.array(dtype=wp.vec3)  # [probe * irradiance_resolution^2] irradiance by reflected light, W/m^2
    moments: wp.array(dtype=wp.vec2)  # [probe * irradiance_resolution^2] mean of distance [m] and of its square [m^2]
    emission_texels: wp.array(dtype=wp.int32)  # [emissive texel] index in `surfels`, ascending
    emission: wp.array(dtype=wp.uint32)  # [emissive texel] RGB9E5: radiance that the surfel emits


# ---- texels ----


# Three numbers of at least 0 in 32 bits with a common exponent (EXT_texture_shared_exponent).
@wp.func
def pack_radiance(color: wp.vec3) -> wp.uint32:
    r = wp.clamp(color[0], 0.0, _LARGEST_SHARED)
    g = wp.clamp(color[1], 0.0, _LARGEST_SHARED)
    b = wp.clamp(color[2], 0.0, _LARGEST_SHARED)
    largest = wp.max(r, wp.max(g, b))
    # floor(log2(largest)) from its bits, no lower than -16
    exponent = wp.max(wp.int32(wp.cast(largest, wp.uint32) >> wp.uint32(23)) - 127, -16) + 16
    scale = wp.cast(wp.uint32(127 + 24 - exponent) << wp.uint32(23), wp.float32)  # 2^(9 + 15 - exponent)
    if wp.int32(largest * scale + 0.5) == 512:
        exponent += 1
        scale = scale * 0.5
    x = wp.uint32(r * scale + 0.5)
    y = wp.uint32(g * scale + 0.5)
    z = wp.uint32(b * scale + 0.5)
    return x | (y << wp.uint32(9)) | (z << wp.uint32(18)) | (wp.uint32(exponent) << wp.uint32(27))


@wp.func
def unpack_radiance(word: wp.uint32) -> wp.vec3:
    exponent = wp.int32(word >> wp.uint32(27))
    scale = wp.cast(wp.uint32(127 - 24 + exponent) << wp.uint32(23), wp.float32)
    mask = wp.uint32(511)
    return (
        wp.vec3(
            wp.float32(word & mask),
            wp.float32((word >> wp.uint32(9)) & mask),
            wp.float32((word >> wp.uint32(18)) & mask),
        )
        * scale
    )


# Bits of the half closest to a distance; infinite for NOTHING and above.
@wp.func
def pack_half(distance: wp.float32) -> wp.uint32:
    if distance >= NOTHING:
        return wp.uint32(0x7C00)
    bits = wp.cast(wp.min(distance, _LARGEST_HALF) * _HALF_SCALE, wp.uint32)
    return (bits + wp.uint32(0x0FFF) + ((bits >> wp.uint32(13)) & wp.uint32(1))) >> wp.uint32(13)


# The number in the low 15 bits; NOTHING for the infinite half.
@wp.func
def unpack_half(bits: wp.uint32) -> wp.float32:
    return wp.cast((bits & wp.uint32(0x7FFF)) << wp.uint32(13), wp.float32) * _FLOAT_SCALE


# Distance as a half in the low 16 bits, unit normal as octahedral coordinates in 8 bits each above. They have 254
# steps, so that the axes are among them.
@wp.func
def pack_surfel(distance: wp.float32, normal: wp.vec3) -> wp.uint32:
    uv = octahedral_encode(normal)
    x = wp.uint32(uv[0] * 254.0 + 0.5)
    y = wp.uint32(uv[1] * 254.0 + 0.5)
    return pack_half(distance) | (x << wp.uint32(16)) | (y << wp.uint32(24))


# Distance from the probe in metres, or NOTHING.
@wp.func
def surfel_distance(word: wp.uint32) -> wp.float32:
    return unpack_half(word)


@wp.func
def surfel_normal(word: wp.uint32) -> wp.vec3:
    x = wp.float32((word >> wp.uint32(16)) & wp.uint32(255))
    y = wp.float32(word >> wp.uint32(24))
    return octahedral_decode(wp.vec2(x, y) / 254.0)


# Direction of the middle of a texel, from its index in a map.
@wp.func
def texel_direction(texel: wp.int32, resolution: wp.int32) -> wp.vec3:
    row = texel / resolution
    size = wp.float32(resolution)
    return octahedral_decode(
        wp.vec2((wp.float32(texel - row * resolution) + 0.5) / size, (wp.float32(row) + 0.5) / size)
    )


# Radiance that a texel's surfel emits, by its index in LightField.surfels.
@wp.func
def texel_emission(field: LightField, index: wp.int32) -> wp.vec3:
    if (field.surfels[index] & SURFEL_EMITS) == wp.uint32(0):
        return wp.vec3(0.0, 0.0, 0.0)
    low = int(0)
    high = field.emission_texels.shape[0]
    while low < high:
        middle = (low + high) / 2
        if field.emission_texels[middle] < index:
            low = middle + 1
        else:
            high = middle
    if low >= field.emission_texels.shape[0] or field.emission_texels[low] != index:
        return wp.vec3(0.0, 0.0, 0.0)
    return unpack_radiance(field.emission[low])


# ---- the grid ----


@wp.func
def probe_index(field: LightField, x: wp.int32, y: wp.int32, z: wp.int32) -> wp.int32:
    return (z * field.counts[1] + y) * field.counts[0] + x


# Position in units of the grid: probe (x, y, z) is at (x, y, z), unless it was moved.
@wp.func
def grid_position(field: LightField, position: wp.vec3) -> wp.vec3:
    return wp.cw_div(position - field.low, field.spacing)


# Lowest probe of the cage around a point in units of the grid; the nearest cage outside of it.
@wp.func
def cage_of(field: LightField, at: wp.vec3) -> wp.vec3i:
    return wp.vec3i(
        wp.clamp(wp.int32(wp.floor(at[0])), 0, wp.max(field.counts[0] - 2, 0)),
        wp.clamp(wp.int32(wp.floor(at[1])), 0, wp.max(field.counts[1] - 2, 0)),
        wp.clamp(wp.int32(wp.floor(at[2])), 0, wp.max(field.counts[2] - 2, 0)),
    )


# Probe at corner i of a cage: bits 0, 1 and 2 of i are steps along x, y and z. Along an axis of one probe both ends
# are the same.
@wp.func
def cage_probe(field: LightField, cage: wp.vec3i, corner: wp.int32) -> wp.int32:
    x = wp.min(cage[0] + (corner & 1), field.counts[0] - 1)
    y = wp.min(cage[1] + ((corner >> 1) & 1), field.counts[1] - 1)
    z = wp.min(cage[2] + ((corner >> 2) & 1), field.counts[2] - 1)
    return probe_index(field, x, y, z)


# ---- irradiance between probes ----


@wp.func
def probe_irradiance(field: LightField, probe: wp.int32, uv: wp.vec2) -> wp.vec3:
    start = probe * field.irradiance_resolution * field.irradiance_resolution
    t = octahedral_taps(uv, field.irradiance_resolution)
    upper = field.irradiance[start + t.texels[0]] * (1.0 - t.x) + field.irradiance[start + t.texels[1]] * t.x
    lower = field.irradiance[start + t.texels[2]] * (1.0 - t.x) + field.irradiance[start + t.texels[3]] * t.x
    return upper * (1.0 - t.y) + lower * t.y


@wp.func
def probe_moments(field: LightField, probe: wp.int32, uv: wp.vec2) -> wp.vec2:
    start = probe * field.irradiance_resolution * field.irradiance_resolution
    t = octahedral_taps(uv, field.irradiance_resolution)
    upper = field.moments[start + t.texels[0]] * (1.0 - t.x) + field.moments[start + t.texels[1]] * t.x
    lower = field.moments[start + t.texels[2]] * (1.0 - t.x) + field.moments[start + t.texels[3]] * t.x
    return upper * (1.0 - t.y) + lower * t.y


# Chance that a probe sees a point at this distance: Chebyshev's inequality for what its moments say (section 5.2),
# cubed, for a bound that is reached nowhere is too kind to what is hidden.
@wp.func
def chebyshev_visibility(moments: wp.vec2, distance: wp.float32) -> wp.float32:
    behind = distance - moments[0]
    if behind <= 0.0:
        return 1.0
    variance = wp.abs(moments[0] * moments[0] - moments[1])
    p = variance / (variance + behind * behind)
    return p * p * p


# Whether the surfel that a probe sees in the direction of a point (relative to the probe) leaves it in view: the point
# is nearer, or on the same side of the surfel's plane. Moments say little where the probe looks along a wall.
@wp.func
def surfel_visibility(field: LightField, probe: wp.int32, point: wp.vec3, distance: wp.float32) -> wp.float32:
    texel = octahedral_texel(octahedral_encode(point), field.resolution)
    surfel = field.surfels[probe * field.resolution * field.resolution + texel]
    r = surfel_distance(surfel)
    if distance <= r:
        return 1.0
    tolerance = r * SURFEL_TOLERANCE / wp.float32(field.resolution)
    at = texel_direction(texel, field.resolution) * r
    behind = -wp.dot(surfel_normal(surfel), point - at)
    return wp.clamp(2.0 - behind / tolerance, 0.0, 1.0)


# Weight of the probe at a corner of the cage for a point with a normal, whether it sees the point or not: trilinear,
# times the cosine towards the probe (section 5.2). `at` is the point in units of the grid.
@wp.func
def blend_weight(
    field: LightField, cage: wp.vec3i, corner: wp.int32, at: wp.vec3, position: wp.vec3, normal: wp.vec3
) -> wp.float32:
    weight = float(1.0)
    for axis in range(3):
        f = wp.clamp(at[axis] - wp.float32(cage[axis]), 0.0, 1.0)
        if ((corner >> axis) & 1) == 0:
            f = 1.0 - f
        weight = weight * f
    probe = cage_probe(field, cage, corner)
    if field.plain != 0:
        return weight
    if field.states[probe] != PROBE_USABLE:
        return 0.0
    to_probe = field.positions[probe] - position
    distance = wp.length(to_probe)
    if distance < 1.0e-6:
        return weight
    cosine = wp.dot(to_probe, normal) / distance
    # a probe in the way of no ray but at the far end of the cage still counts where no nearer one sees the point
    return (weight + WEIGHT_FLOOR) * wp.max(cosine, COSINE_FLOOR)


# How much a probe sees of a point with a normal, in [0, 1], by what its maps say.
@wp.func
def map_visibility(field: LightField, probe: wp.int32, position: wp.vec3, normal: wp.vec3) -> wp.float32:
    if field.plain != 0:
        return 1.0
    biased = position + normal * field.bias - field.positions[probe]
    distance = wp.length(biased)
    if distance < 1.0e-6:
        return 1.0
    seen = surfel_visibility(field, probe, biased, distance)
    if seen <= 0.0:
        return 0.0
    far = MOMENT_REACH * wp.length(field.spacing)
    moments = probe_moments(field, probe, octahedral_encode(biased))
    return seen * chebyshev_visibility(moments, wp.min(distance, far))


# Whether a point, in units of the grid, is so far outside of it that the nearest probes say nothing of its light.
@wp.func
def is_outside(field: LightField, at: wp.vec3) -> wp.bool:
    outside = bool(False)
    for axis in range(3):
        if at[axis] < -OUTSIDE or at[axis] > wp.float32(field.counts[axis] - 1) + OUTSIDE:
            outside = True
    return outside


# Irradiance [W/m^2] by light that surfaces reflect, at a point with a unit normal, from the eight probes around it.
@wp.func
def irradiance_at(field: LightField, position: wp.vec3, normal: wp.vec3) -> wp.vec3:
    at = grid_position(field, position)
    cage = cage_of(field, at)
    uv = octahedral_encode(normal)
    total = wp.vec3(0.0, 0.0, 0.0)
    weights = float(0.0)
    corners = int(8)
    for corner in range(corners):
        probe = cage_probe(field, cage, corner)
        weight = blend_weight(field, cage, corner, at, position, normal)
        if weight > 0.0:
            weight = weight * map_visibility(field, probe, position, normal)
        if weight > 0.0:
            total = total + probe_irradiance(field, probe, uv) * weight
            weights = weights + weight
    if weights <= 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    return total / weights
