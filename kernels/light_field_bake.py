"""Filling light field probes: rays through every texel, bounces of light between probes, and what is filtered of them.

The radiance of a texel is what its surfel reflects: of direct light, which is sampled once, and of the irradiance
between the probes, which grows by a bounce with every pass (light_field_probes.txt, section 3). Emission stays apart,
for a probe to be of use where emitters are sampled too. Every surface reflects as if it were Lambert with the whole
of its reflectance: what a glossy one sends to the probe is not what it sends anywhere else.
"""

import warp as wp

from warp_gi.kernels.bsdf import average_reflectance, lambert
from warp_gi.kernels.bvh import bvh_intersect
from warp_gi.kernels.environment import environment_radiance
from warp_gi.kernels.light_field import (
    BLOCK,
    NOTHING,
    SURFEL_EMITS,
    LightField,
    grid_position,
    irradiance_at,
    is_outside,
    pack_radiance,
    pack_surfel,
    surfel_distance,
    surfel_normal,
    texel_direction,
    unpack_radiance,
)
from warp_gi.kernels.light_field_place import PROBE_FACTOR, sees_back
from warp_gi.kernels.octahedral import octahedral_decode, octahedral_wrap
from warp_gi.kernels.path_trace import (
    NO_PATH,
    TERM_EMITTERS,
    TERM_ENVIRONMENT,
    TERM_INDIRECT,
    PathSamplers,
    PathSettings,
    trace_path,
)
from warp_gi.kernels.sampling import CAMERA_DIMENSION, hash_uint, morton_code, sample_2d
from warp_gi.kernels.surface import shading_normal, surface_emission, surface_shape, with_color
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})

LOBE = wp.constant(wp.float32(50.0))  # power of the cosine that distances are filtered with
LOBE_END = wp.constant(wp.float32(0.85))  # cosine below which its power, 3e-4, counts as 0
SAME_DISTANCE = wp.constant(wp.float32(0.1))  # relative difference of distances below which surfels share irradiance
SAME_NORMAL = wp.constant(wp.float32(0.9))  # cosine between normals above which they do
TEXEL_BACK = wp.constant(wp.uint8(1))  # the texel sees the back of a triangle
TEXEL_SAME = wp.constant(wp.uint8(2))  # the texel sees the surfel that it saw before


# What is known of the texels of some probes while they are filled, [slot * resolution^2] unless a field says otherwise;
# slot k holds probe probes[k]. trace_texels writes `direct`, `albedo`, `emission` and `back`, bounce writes `light`,
# reduce_distances writes `distances`; each thread writes its own items alone. Maps of LightField are written by
# trace_texels (surfels), bounce (radiance), filter_light, filter_distances and find_nearest, each its own probes'.
@wp.struct
class ProbeWork:
    probes: wp.array(dtype=wp.int32)  # [slot] index of the probe
    rays: wp.int32  # rays a texel: the first is through its middle, the others anywhere in it
    seed: wp.uint32
    sky_probability: wp.float32  # this and the next two are PathSettings of paths from surfels outside of the grid
    max_depth: wp.int32
    roulette_depth: wp.int32
    radius: wp.float32  # metres; distances count as no more than this in the moments
    hysteresis: wp.float32  # share of the old irradiance that is kept
    direct: wp.array(dtype=wp.uint32)  # RGB9E5: direct light that the surfel reflects, W/(m^2 sr)
    albedo: wp.array(dtype=wp.uint32)  # RGB9E5: reflectance for light from between the probes
    emission: wp.array(dtype=wp.uint32)  # RGB9E5: radiance that the surfel emits, W/(m^2 sr); or empty
    back: wp.array(dtype=wp.uint8)  # TEXEL_*
    is_last: wp.int32  # 1 in the last bounce, which sets the radiance of texels too; none reads it earlier
    light_low: wp.int32  # texels along a side of the maps that irradiance is filtered from
    light_directions: wp.array(dtype=wp.vec4)  # [light_low^2] unit direction and solid angle [sr] of their texels
    light: wp.array(dtype=wp.vec3)  # [slot * light_low^2] reflected radiance
    distance_low: wp.int32  # texels along a side of the maps that moments are filtered from
    distance_directions: wp.array(dtype=wp.vec4)  # [distance_low^2] as light_directions
    distances: wp.array(dtype=wp.vec2)  # [slot * distance_low^2] mean of distance [m] and of its square [m^2]


# The surface that a ray meets: direct light that it reflects back, W/(m^2 sr), and its reflectance for light from
# between the probes. For a surface outside of the grid, where no probe is near, `direct` is all light, found by a path,
# and `albedo` is 0.
@wp.struct
class TexelSample:
    face: wp.int32
    t: wp.float32
    u: wp.float32
    v: wp.float32
    normal: wp.vec3
    direct: wp.vec3
    albedo: wp.vec3


@wp.func
def sample_texel(
    scene: SceneData,
    field: LightField,
    work: ProbeWork,
    origin: wp.vec3,
    direction: wp.vec3,
    index: wp.uint32,
    seed: wp.uint32,
) -> TexelSample:
    r = TexelSample()
    hit = bvh_intersect(scene.bvh, origin, direction, float(wp.inf))
    r.face = hit.face
    r.t = hit.t
    r.u = hit.u
    r.v = hit.v
    if hit.face < 0:
        return r
    s = with_color(scene, surface_shape(scene, hit.face, hit.u, hit.v, -direction))
    r.normal = shading_normal(s)
    r.albedo = average_reflectance(s.bsdf)
    s.bsdf = lambert(r.albedo)
    paths = PathSettings()
    paths.terms = TERM_ENVIRONMENT | TERM_EMITTERS
    paths.max_depth = 2
    paths.roulette_depth = work.roulette_depth
    paths.sky_probability = work.sky_probability
    if is_outside(field, grid_position(field, s.position)):
        paths.terms = TERM_ENVIRONMENT | TERM_EMITTERS | TERM_INDIRECT
        paths.max_depth = work.max_depth
        r.albedo = wp.vec3(0.0, 0.0, 0.0)
    light = trace_path(scene, PathSamplers(), hit, s, -direction, paths, index, seed, NO_PATH)
    r.direct = light.environment + light.emitters + light.indirect
    return r


# Thread: a texel of a probe. Traces its rays, and writes its surfel and the direct light that this reflects.
@wp.kernel
def trace_texels(first: wp.int32, scene: SceneData, field: LightField, work: ProbeWork):
    item = first + wp.tid()
    size = field.resolution * field.resolution
    slot = item / size
    texel = item - slot * size
    probe = work.probes[slot]
    origin = field.positions[probe]
    row = texel / field.resolution
    column = texel - row * field.resolution
    seed = hash_uint(work.seed + wp.uint32(probe) * PROBE_FACTOR)
    index = morton_code(column, row) * wp.uint32(work.rays)
    direct = wp.vec3(0.0, 0.0, 0.0)
    albedo = wp.vec3(0.0, 0.0, 0.0)
    side = wp.uint8(0)
    surfel = pack_surfel(NOTHING, wp.vec3(0.0, 1.0, 0.0))
    emission = wp.vec3(0.0, 0.0, 0.0)
    sky = wp.vec3(0.0, 0.0, 0.0)
    for ray in range(work.rays):
        offset = wp.vec2(0.5, 0.5)
        if ray > 0:
            offset = sample_2d(index + wp.uint32(ray), seed, CAMERA_DIMENSION)
        uv = wp.vec2(wp.float32(column) + offset[0], wp.float32(row) + offset[1]) / wp.float32(field.resolution)
        direction = octahedral_decode(uv)
        s = sample_texel(scene, field, work, origin, direction, index + wp.uint32(ray), seed)
        direct = direct + s.direct
        albedo = albedo + s.albedo
        if ray == 0:
            if s.face < 0:
                sky = environment_radiance(scene.environment, direction)
                surfel = pack_surfel(NOTHING, -direction)
            else:
                surfel = pack_surfel(s.t, s.normal)
                emission = surface_emission(scene, s.face, s.u, s.v, -direction)
                if sees_back(scene, s.face, direction) != 0:
                    side = TEXEL_BACK
    if wp.max(emission) > 0.0:
        surfel = surfel | SURFEL_EMITS
    rays = wp.float32(work.rays)
    if field.surfels[probe * size + texel] == surfel:
        side = side | TEXEL_SAME
    field.surfels[probe * size + texel] = surfel
    work.back[item] = side
    if work.emission.shape[0] > 0:
        work.emission[item] = pack_radiance(emission)
    if surfel_distance(surfel) >= NOTHING:
        field.radiance[probe * size + texel] = pack_radiance(sky)
        work.direct[item] = wp.uint32(0)
        work.albedo[item] = wp.uint32(0)
    else:
        work.direct[item] = pack_radiance(direct / rays)
        work.albedo[item] = pack_radiance(albedo / rays)


# Irradiance [W/m^2] that neighbouring texels of a map share, and the surfel that it was looked up at.
@wp.struct
class SharedIrradiance:
    value: wp.vec3
    distance: wp.float32  # metres from the probe to that surfel; negative before the first lookup
    normal: wp.vec3  # unit normal of that surfel


# Irradiance at a surfel: that of a neighbour where both lie on about the same surface, else looked up. Irradiance is
# smooth, and looking it up costs more than all else here.
@wp.func
def shared_irradiance(
    field: LightField, origin: wp.vec3, texel: wp.int32, surfel: wp.uint32, known: SharedIrradiance
) -> SharedIrradiance:
    distance = surfel_distance(surfel)
    normal = surfel_normal(surfel)
    if wp.abs(distance - known.distance) < SAME_DISTANCE * distance and wp.dot(normal, known.normal) > SAME_NORMAL:
        return known
    position = origin + texel_direction(texel, field.resolution) * distance
    return SharedIrradiance(irradiance_at(field, position, normal), distance, normal)


# Thread: a texel of the maps that irradiance is filtered from. Computes the radiance of the texels of the large map in
# it from direct light and the irradiance between the probes, and writes its mean to `work.light`, in the last bounce
# also each texel's to `field.radiance`. Blocks of `side` x `side` texels share one lookup of irradiance.
@wp.kernel
def bounce(first: wp.int32, field: LightField, work: ProbeWork, side: wp.int32):
    item = first + wp.tid()
    low_size = work.light_low * work.light_low
    slot = item / low_size
    low_texel = item - slot * low_size
    probe = work.probes[slot]
    scale = field.resolution / work.light_low
    row = low_texel / work.light_low * scale
    column = low_texel * scale - row * work.light_low
    size = field.resolution * field.resolution
    origin = field.positions[probe]
    total = wp.vec3(0.0, 0.0, 0.0)
    known = SharedIrradiance()
    for k in range(scale * scale):
        if k % (side * side) == 0:
            known.distance = -1.0
        # along squares of side x side texels, one after the other
        square = k / (side * side)
        inside = k - square * side * side
        squares = scale / side
        j = square / squares * side + inside / side
        i = square % squares * side + inside % side
        texel = (row + j) * field.resolution + column + i
        surfel = field.surfels[probe * size + texel]
        if surfel_distance(surfel) < NOTHING:
            radiance = unpack_radiance(work.direct[slot * size + texel])
            albedo = unpack_radiance(work.albedo[slot * size + texel])
            if wp.max(albedo) > 0.0:
                known = shared_irradiance(field, origin, texel, surfel, known)
                radiance = radiance + wp.cw_mul(albedo, known.value) / wp.pi
            if work.is_last != 0:
                shown = radiance
                if work.hysteresis > 0.0 and (work.back[slot * size + texel] & TEXEL_SAME) != wp.uint8(0):
                    old = unpack_radiance(field.radiance[probe * size + texel])
                    shown = old * work.hysteresis + radiance * (1.0 - work.hysteresis)
                field.radiance[probe * size + texel] = pack_radiance(shown)
            total = total + radiance
    work.light[item] = total / wp.float32(scale * scale)


# Thread: a texel of a probe's irradiance map, which it writes. Weights sum to one, so that a constant stays constant.
@wp.kernel
def filter_light(first: wp.int32, field: LightField, work: ProbeWork):
    item = first + wp.tid()
    size = field.irradiance_resolution * field.irradiance_resolution
    slot = item / size
    texel = item - slot * size
    direction = texel_direction(texel, field.irradiance_resolution)
    light = wp.vec3(0.0, 0.0, 0.0)
    weight = float(0.0)
    low_size = work.light_low * work.light_low
    start = slot * low_size
    for k in range(low_size):
        d = work.light_directions[k]
        w = wp.max(direction[0] * d[0] + direction[1] * d[1] + direction[2] * d[2], 0.0) * d[3]
        light = light + work.light[start + k] * w
        weight = weight + w
    to = work.probes[slot] * size + texel
    arriving = light * (wp.pi / weight)
    field.irradiance[to] = field.irradiance[to] * work.hysteresis + arriving * (1.0 - work.hysteresis)


# Thread: a texel of the maps that moments are filtered from. Writes the mean of distance and of its square in it.
@wp.kernel
def reduce_distances(first: wp.int32, field: LightField, work: ProbeWork):
    item = first + wp.tid()
    low_size = work.distance_low * work.distance_low
    slot = item / low_size
    low_texel = item - slot * low_size
    scale = field.resolution / work.distance_low
    row = low_texel / work.distance_low * scale
    column = low_texel * scale - row * work.distance_low
    start = work.probes[slot] * field.resolution * field.resolution
    moments = wp.vec2(0.0, 0.0)
    for j in range(scale):
        for i in range(scale):
            distance = surfel_distance(field.surfels[start + (row + j) * field.resolution + column + i])
            distance = wp.min(distance, work.radius)
            moments = moments + wp.vec2(distance, distance * distance)
    work.distances[item] = moments / wp.float32(scale * scale)


# Thread: a texel of a probe's map of moments. Writes it, filtered by a power of the cosine (section 5.2).
@wp.kernel
def filter_distances(first: wp.int32, field: LightField, work: ProbeWork):
    item = first + wp.tid()
    size = field.irradiance_resolution * field.irradiance_resolution
    slot = item / size
    texel = item - slot * size
    direction = texel_direction(texel, field.irradiance_resolution)
    moments = wp.vec2(0.0, 0.0)
    weight = float(0.0)
    low_size = work.distance_low * work.distance_low
    start = slot * low_size
    for k in range(low_size):
        d = work.distance_directions[k]
        cosine = direction[0] * d[0] + direction[1] * d[1] + direction[2] * d[2]
        if cosine > LOBE_END:
            w = wp.pow(cosine, LOBE) * d[3]
            moments = moments + work.distances[start + k] * w
            weight = weight + w
    field.moments[work.probes[slot] * size + texel] = moments / weight


# Thread: a block of a probe's map. Writes the least distance in it and in the texels around it, which may reach in.
@wp.kernel
def find_nearest(first: wp.int32, field: LightField, work: ProbeWork):
    item = first + wp.tid()
    blocks = field.resolution / BLOCK
    slot = item / (blocks * blocks)
    block = item - slot * blocks * blocks
    row = block / blocks * BLOCK
    column = block * BLOCK - row * blocks
    probe = work.probes[slot]
    least = float(NOTHING)
    for j in range(-1, BLOCK + 1):
        for i in range(-1, BLOCK + 1):
            texel = octahedral_wrap(column + i, row + j, field.resolution)
            least = wp.min(least, surfel_distance(field.surfels[probe * field.resolution * field.resolution + texel]))
    field.nearest[probe * blocks * blocks + block] = least
