"""Direct light from the sky with a visibility field (dvf.txt, Algorithm 2): only rays it cannot answer are traced.

Of a Lambert surface the light is (albedo / N) sum V(w) L(w) over cosine-weighted w: the density cos / pi cancels the
cosine and the BSDF's 1 / pi, so that sum is E / pi. Algorithm 2 subtracts it from E_unshad (Eq. 11), which has to be
divided by pi first; that and the albedo, which Eq. 9 explains but lacks, are what differs from the text here.
A sure ray of MODE_UNBIASED is also traced, with probability q, and (traced - sure) / q is added: the expectation is
q (sure + (traced - sure) / q) + (1 - q) sure = traced, whatever the field says.

A sky map is sampled two ways, by the BSDF and by radiance, and combined by the balance heuristic as in path_trace.py.
Light samples come from sets that are drawn anew each frame and shared by many pixels: they lie in the cache, in the
order that they are read, with their radiance beside them.
"""

import warp as wp

from warp_gi.kernels.bsdf import bsdf_evaluate, specular_probability
from warp_gi.kernels.bvh import bvh_occluded
from warp_gi.kernels.environment import environment_arrival, environment_lookup, environment_sample
from warp_gi.kernels.gbuffer import CameraData, PassSettings, PrimaryHits, tiled_pixel
from warp_gi.kernels.harmonics import Harmonics, cosine_harmonics, harmonics, vec9
from warp_gi.kernels.sampling import (
    FIELD_BSDF_DIMENSION,
    FIELD_LIGHT_DIMENSION,
    FIELD_LOBE_DIMENSION,
    FIELD_SET_DIMENSION,
    SET_SKY_DIGITS_DIMENSION,
    SET_SKY_DIMENSION,
    morton_code,
    pair_keys,
    pixel_sample_index,
    pixel_seed,
    random_1d,
    random_key,
    sample_2d,
)
from warp_gi.kernels.surface import Surface, ray_origin, shading_normal, surface_shape, with_color
from warp_gi.kernels.types import SceneData
from warp_gi.kernels.visibility_field import (
    MODE_PAPER,
    MODE_UNBIASED,
    NO_SLOT,
    SLOT_BOXED,
    SLOT_LABEL,
    FieldQuery,
    VisibilityGrid,
    bit_count,
    cosine_octet,
    direction_texel,
    harmonic_light,
    lowest_bit,
    meets_box,
    octet_bits,
    octet_direction,
    own_seed,
    pixel_set,
    pixel_turn,
    set_sample,
    slot_at,
    texel_state,
    turned_frame,
    vec33,
)
from warp_gi.kernels.visibility_field_lobes import (
    glossy_octet,
    octet_pdf,
    octet_sums,
    octet_weight,
    octet_weights,
    vec32,
)

wp.set_module_options({"enable_backward": False})

SKY_CONSTANT = wp.constant(0)
SKY_HARMONIC = wp.constant(1)
SKY_MAP = wp.constant(2)


# The sky as visibility fields sample it.
@wp.struct
class FieldSky:
    kind: wp.int32  # SKY_*
    radiance: wp.vec3  # radiance of SKY_CONSTANT, W/(m^2 sr)
    harmonics: Harmonics  # coefficients of SKY_HARMONIC, W/(m^2 sr)
    set_size: wp.int32  # samples in a set
    set_count: wp.int32  # a power of two
    directions: wp.array(dtype=wp.vec3)  # [set * set_size] unit, towards the sky
    radiances: wp.array(dtype=wp.vec3)  # [set * set_size] W/(m^2 sr)
    pdfs: wp.array(dtype=wp.float32)  # [set * set_size] 1/sr; 0 if there is nothing to sample


# All that a frame needs of a field.
@wp.struct
class Field:
    grid: VisibilityGrid
    query: FieldQuery
    sky: FieldSky


# Sums over samples, [height * width]; each thread adds to its own pixel's.
@wp.struct
class FieldBuffers:
    environment: wp.array(dtype=wp.vec3)
    moment1: wp.array(dtype=wp.vec3)  # sums of the samples of this term; and the next: of their squares
    moment2: wp.array(dtype=wp.vec3)
    transfer: wp.array(dtype=wp.float32)  # [pixel * 27] what each harmonic of a sky adds to red, green, blue; or empty


# A pixel: where its rays start, its cell, and its samples.
@wp.struct
class FieldPixel:
    index: wp.int32
    origin: wp.vec3
    slot: wp.int32
    set: wp.int32  # first set of cosine directions that it takes
    turn: wp.float32  # turn of that set about the normal, in [0, 1)
    index_base: wp.uint32  # glossy samples in the path tracer's sequence; and the next: their seed
    index_seed: wp.uint32
    seed: wp.uint32
    first: wp.int32
    count: wp.int32


# Sums over the samples of a pixel. BSDF and light samples are independent, so their moments are kept apart.
@wp.struct
class FieldSums:
    bsdf: wp.vec3
    bsdf_square: wp.vec3
    light: wp.vec3
    light_square: wp.vec3


# What is known of a ray without tracing it: 1 visible, 0 occluded, -1 has to be traced. Glossy lobes of the paper's
# mode are traced inside the visibility mask whatever the label says (its section 6).
@wp.func
def sure_visibility(
    grid: VisibilityGrid, query: FieldQuery, p: FieldPixel, texel: wp.int32, direction: wp.vec3
) -> wp.int32:
    state = texel_state(grid, p.slot, texel)
    if query.mode == MODE_PAPER:
        if p.slot < 0 or (state & 1) != 0:
            return -1
        return 0
    if state == 2:
        return 0
    if state == 1 and not ((p.slot & SLOT_BOXED) != 0 and meets_box(query, p.origin, direction)):
        return 1
    return -1


# Share of the sky's light that comes through: 0 or 1; where a sure ray that was verified is wrong, a number that makes
# up for the wrong ones that were not verified.
@wp.func
def sky_visibility(
    scene: SceneData,
    grid: VisibilityGrid,
    query: FieldQuery,
    p: FieldPixel,
    direction: wp.vec3,
    sample: wp.int32,
    dimension: wp.int32,
) -> wp.float32:
    texel = direction_texel(grid, direction)
    sure = sure_visibility(grid, query, p, texel, direction)
    if sure >= 0:
        if query.mode != MODE_UNBIASED or random_1d(wp.uint32(sample), p.seed, dimension) >= query.verify:
            return wp.float32(sure)
    visible = float(1.0)
    if bvh_occluded(scene.bvh, p.origin, direction, float(wp.inf)):
        visible = 0.0
    if sure >= 0:
        return wp.float32(sure) + (visible - wp.float32(sure)) / query.verify
    return visible


# Lanes among `bits` of an octet that are drawn for verification.
@wp.func
def verified_lanes(query: FieldQuery, p: FieldPixel, bits: wp.int32, start: wp.int32) -> wp.int32:
    picked = int(0)
    todo = int(bits)
    while todo != 0:
        lane = lowest_bit(todo)
        todo = todo & (todo - 1)
        if random_1d(wp.uint32(start + lane), p.seed, FIELD_BSDF_DIMENSION) < query.verify:
            picked = picked | (1 << lane)
    return picked


# Lanes among `bits` of an octet whose rays may meet something that moves.
@wp.func
def boxed_lanes(query: FieldQuery, p: FieldPixel, octet: vec33, bits: wp.int32) -> wp.int32:
    met = int(0)
    todo = int(bits)
    while todo != 0:
        lane = lowest_bit(todo)
        todo = todo & (todo - 1)
        if meets_box(query, p.origin, octet_direction(octet, lane)):
            met = met | (1 << lane)
    return met


# Lanes among `bits` of an octet that are occluded, by tracing.
@wp.func
def occluded_lanes(scene: SceneData, p: FieldPixel, octet: vec33, bits: wp.int32) -> wp.int32:
    blocked = int(0)
    todo = int(bits)
    while todo != 0:
        lane = lowest_bit(todo)
        todo = todo & (todo - 1)
        if bvh_occluded(scene.bvh, p.origin, octet_direction(octet, lane), float(wp.inf)):
            blocked = blocked | (1 << lane)
    return blocked


# Radiance of the sky for a BSDF sample of density `pdf`, times its weight against light samples.
@wp.func
def weighted_sky(scene: SceneData, sky: FieldSky, direction: wp.vec3, pdf: wp.float32) -> wp.vec3:
    if sky.kind == SKY_MAP:
        beyond = environment_lookup(scene.environment, direction)
        return beyond.radiance * (pdf / (pdf + beyond.pdf))
    if sky.kind == SKY_HARMONIC:
        return sky.harmonics * harmonics(direction)
    return sky.radiance


# Adds to `sums` `factor` times the light of the lanes in `bits`, as a Lambert surface of albedo 1 reflects it.
@wp.func
def add_lanes(
    scene: SceneData, sky: FieldSky, octet: vec33, bits: wp.int32, factor: wp.float32, normal: wp.vec3, sums: FieldSums
) -> FieldSums:
    r = sums
    if sky.kind == SKY_CONSTANT:
        n = wp.float32(bit_count(bits)) * factor
        r.bsdf = r.bsdf + sky.radiance * n
        r.bsdf_square = r.bsdf_square + wp.cw_mul(sky.radiance, sky.radiance) * (n * factor)
    elif sky.kind == SKY_HARMONIC:
        lit = harmonic_light(sky.harmonics, octet, bits)
        r.bsdf = r.bsdf + wp.vec3(lit[0], lit[1], lit[2]) * factor
        r.bsdf_square = r.bsdf_square + wp.vec3(lit[3], lit[4], lit[5]) * (factor * factor)
    else:
        todo = int(bits)
        while todo != 0:
            lane = lowest_bit(todo)
            todo = todo & (todo - 1)
            direction = octet_direction(octet, lane)
            light = weighted_sky(scene, sky, direction, wp.dot(direction, normal) / wp.pi) * factor
            r.bsdf = r.bsdf + light
            r.bsdf_square = r.bsdf_square + wp.cw_mul(light, light)
    return r


@wp.func
def add_transfer(transfer: vec9, octet: vec33, bits: wp.int32, factor: wp.float32) -> vec9:
    r = transfer
    todo = int(bits)
    while todo != 0:
        lane = lowest_bit(todo)
        todo = todo & (todo - 1)
        r = r + harmonics(octet_direction(octet, lane)) * factor
    return r


# BSDF samples of a Lambert surface, eight at a time. Adds their light per unit of albedo to `sums`, and to the pixel's
# transfers where the frame keeps them.
@wp.func
def lambert_samples(
    scene: SceneData,
    grid: VisibilityGrid,
    query: FieldQuery,
    sky: FieldSky,
    p: FieldPixel,
    s: Surface,
    transfer: wp.array(dtype=wp.float32),
) -> FieldSums:
    sums = FieldSums()
    t = vec9()
    normal = shading_normal(s)
    subtracts = query.mode == MODE_PAPER and p.slot >= 0 and (p.slot & SLOT_LABEL) == 0  # Eq. 11
    frame = turned_frame(s.shading, p.turn)
    for done in range(0, p.count, 8):
        start = p.first + done
        octet = cosine_octet(grid, query.cosines, p.slot, set_sample(query, p.set, start), frame, s.normal)
        bits = octet_bits(octet)
        lanes = int(255)
        if p.count - done < 8:
            lanes = (1 << (p.count - done)) - 1
        above = (bits >> 16) & lanes
        visible = bits & above
        occluded = (bits >> 8) & above
        sure = int(0)
        verified = int(0)
        todo = int(above)
        if query.mode == MODE_PAPER:
            if p.slot >= 0:  # a cell without samples traces all
                todo = visible
            if subtracts:
                todo = occluded
                if (p.slot & SLOT_BOXED) != 0:
                    todo = todo | boxed_lanes(query, p, octet, above & ~occluded)
        else:
            sure = visible ^ occluded
            if (p.slot & SLOT_BOXED) != 0 and p.slot >= 0:
                sure = sure & ~boxed_lanes(query, p, octet, sure & visible)
            if query.mode == MODE_UNBIASED:
                verified = verified_lanes(query, p, sure, start)
            todo = (above & ~sure) | verified
        blocked = int(0)
        if todo != 0:
            blocked = occluded_lanes(scene, p, octet, todo)  # one call, which is inlined: two are not
        if query.mode == MODE_PAPER:
            if subtracts:
                gone = blocked | (lanes & ~above)
                sums = add_lanes(scene, sky, octet, gone, -1.0, normal, sums)
                if transfer.shape[0] > 0:
                    t = add_transfer(t, octet, gone, -1.0)
            else:
                sums = add_lanes(scene, sky, octet, todo & ~blocked, 1.0, normal, sums)
                if transfer.shape[0] > 0:
                    t = add_transfer(t, octet, todo & ~blocked, 1.0)
        else:
            leaked = verified & visible & blocked
            lost = verified & ~visible & ~blocked
            seen = ((sure & visible) & ~leaked) | (todo & ~verified & ~blocked)
            if seen != 0:
                sums = add_lanes(scene, sky, octet, seen, 1.0, normal, sums)
            if (leaked | lost) != 0:
                sums = add_lanes(scene, sky, octet, leaked, 1.0 - 1.0 / query.verify, normal, sums)
                sums = add_lanes(scene, sky, octet, lost, 1.0 / query.verify, normal, sums)
            if transfer.shape[0] > 0:
                t = add_transfer(t, octet, seen, 1.0)
                t = add_transfer(t, octet, leaked, 1.0 - 1.0 / query.verify)
                t = add_transfer(t, octet, lost, 1.0 / query.verify)
    if subtracts:
        whole = cosine_harmonics(normal) * wp.float32(p.count)
        t = t + whole
        sums.bsdf = sums.bsdf + sky.harmonics * whole  # the paper's mode has no other sky
    if transfer.shape[0] > 0:
        diffuse = with_color(scene, s).bsdf.diffuse
        for channel in range(3):
            for i in range(9):
                at = p.index * 27 + channel * 9 + i
                transfer[at] = transfer[at] + t[i] * diffuse[channel]
    return sums


# Adds to `sums` the light of the lanes in `bits` times `factor`, by weights of the BSDF.
@wp.func
def add_weighted(
    scene: SceneData, sky: FieldSky, octet: vec33, weights: vec32, bits: wp.int32, factor: wp.float32, sums: FieldSums
) -> FieldSums:
    r = sums
    if sky.kind == SKY_CONSTANT:
        of = octet_sums(weights, bits)
        light = sky.radiance * factor
        r.bsdf = r.bsdf + wp.cw_mul(light, wp.vec3(of[0], of[1], of[2]))
        r.bsdf_square = r.bsdf_square + wp.cw_mul(wp.cw_mul(light, light), wp.vec3(of[3], of[4], of[5]))
    else:
        todo = int(bits)
        while todo != 0:
            lane = lowest_bit(todo)
            todo = todo & (todo - 1)
            arrives = weighted_sky(scene, sky, octet_direction(octet, lane), octet_pdf(weights, lane))
            light = wp.cw_mul(octet_weight(weights, lane), arrives) * factor
            r.bsdf = r.bsdf + light
            r.bsdf_square = r.bsdf_square + wp.cw_mul(light, light)
    return r


# Adds what the lanes in `bits` bring of each harmonic of a sky to a pixel's transfers.
@wp.func
def add_weighted_transfer(
    transfer: wp.array(dtype=wp.float32),
    index: wp.int32,
    octet: vec33,
    weights: vec32,
    bits: wp.int32,
    factor: wp.float32,
):
    todo = int(bits)
    while todo != 0:
        lane = lowest_bit(todo)
        todo = todo & (todo - 1)
        y = harmonics(octet_direction(octet, lane)) * factor
        weight = octet_weight(weights, lane)
        for channel in range(3):
            for i in range(9):
                at = index * 27 + channel * 9 + i
                transfer[at] = transfer[at] + y[i] * weight[channel]


# Lanes of a glossy octet whose light arrives: as it is (bits 0 to 7), as 1 - 1 / verify of it (8 to 15), and as
# 1 / verify of it (16 to 23). The field is asked as sure_visibility does.
@wp.func
def lit_lanes(
    scene: SceneData, query: FieldQuery, p: FieldPixel, octet: vec33, lanes: wp.int32, start: wp.int32
) -> wp.int32:
    bits = octet_bits(octet)
    above = (bits >> 16) & lanes
    visible = bits & above
    occluded = (bits >> 8) & above
    sure = int(0)
    verified = int(0)
    todo = int(above)
    if query.mode == MODE_PAPER:
        if p.slot >= 0:
            todo = visible
    else:
        sure = visible ^ occluded
        if (p.slot & SLOT_BOXED) != 0 and p.slot >= 0:
            sure = sure & ~boxed_lanes(query, p, octet, sure & visible)
        if query.mode == MODE_UNBIASED:
            verified = verified_lanes(query, p, sure, start)
        todo = (above & ~sure) | verified
    blocked = int(0)
    if todo != 0:
        blocked = occluded_lanes(scene, p, octet, todo)
    leaked = verified & visible & blocked
    lost = verified & ~visible & ~blocked
    seen = ((sure & visible) & ~leaked) | (todo & ~verified & ~blocked)
    return seen | (leaked << 8) | (lost << 16)


# BSDF samples of any surface, eight at a time.
@wp.func
def glossy_samples(
    scene: SceneData,
    grid: VisibilityGrid,
    query: FieldQuery,
    sky: FieldSky,
    p: FieldPixel,
    s: Surface,
    wo: wp.vec3,
    transfer: wp.array(dtype=wp.float32),
) -> FieldSums:
    sums = FieldSums()
    if wo[2] <= 0.0:
        return sums
    specular = specular_probability(s.bsdf, wo[2])
    keys = pair_keys(p.index_seed, FIELD_BSDF_DIMENSION)
    lobe = random_key(p.seed, FIELD_LOBE_DIMENSION)
    for done in range(0, p.count, 8):
        start = p.first + done
        index = p.index_base + wp.uint32(start)
        octet = glossy_octet(grid, p.slot, s.bsdf, specular, wo, s.shading, s.normal, keys, index, lobe, start)
        lanes = int(255)
        if p.count - done < 8:
            lanes = (1 << (p.count - done)) - 1
        lit = lit_lanes(scene, query, p, octet, lanes, start)
        if lit != 0:
            weights = octet_weights(octet, s.bsdf, specular, wo, s.shading)
            sums = add_weighted(scene, sky, octet, weights, lit & 255, 1.0, sums)
            if transfer.shape[0] > 0:
                add_weighted_transfer(transfer, p.index, octet, weights, lit & 255, 1.0)
            if lit > 255:
                leaked = (lit >> 8) & 255
                lost = lit >> 16
                sums = add_weighted(scene, sky, octet, weights, leaked, 1.0 - 1.0 / query.verify, sums)
                sums = add_weighted(scene, sky, octet, weights, lost, 1.0 / query.verify, sums)
                if transfer.shape[0] > 0:
                    add_weighted_transfer(transfer, p.index, octet, weights, leaked, 1.0 - 1.0 / query.verify)
                    add_weighted_transfer(transfer, p.index, octet, weights, lost, 1.0 / query.verify)
    return sums


# Light samples of a sky map, from the sets of the frame.
@wp.func
def light_samples(
    scene: SceneData,
    grid: VisibilityGrid,
    query: FieldQuery,
    sky: FieldSky,
    p: FieldPixel,
    s: Surface,
    wo: wp.vec3,
    sums: FieldSums,
) -> FieldSums:
    r = sums
    normal = shading_normal(s)
    chosen = wp.int32(random_1d(wp.uint32(0), p.seed, FIELD_SET_DIMENSION) * wp.float32(sky.set_count))
    for i in range(p.first, p.first + p.count):
        k = (chosen + i / sky.set_size) % sky.set_count * sky.set_size + i % sky.set_size
        direction = sky.directions[k]
        pdf = sky.pdfs[k]
        if pdf > 0.0 and wp.dot(direction, s.normal) > 0.0 and wp.dot(direction, normal) > 0.0:
            passed = sky_visibility(scene, grid, query, p, direction, i, FIELD_LIGHT_DIMENSION)
            if passed != 0.0:
                f = bsdf_evaluate(s.bsdf, wo, wp.transpose(s.shading) * direction)
                if f.pdf > 0.0:
                    light = wp.cw_mul(f.value, sky.radiances[k]) * (passed / (pdf + f.pdf))
                    r.light = r.light + light
                    r.light_square = r.light_square + wp.cw_mul(light, light)
    return r


# Thread: a pixel. Adds the sky's light on the current camera sample to its own items of `buffers`.
@wp.kernel
def trace_field(
    first: wp.int32,
    scene: SceneData,
    camera: CameraData,
    settings: PassSettings,
    field: Field,
    hits: PrimaryHits,
    buffers: FieldBuffers,
):
    grid = field.grid
    query = field.query
    sky = field.sky
    at = tiled_pixel(first + wp.tid(), camera.width)
    if at[0] >= camera.width or at[1] >= camera.height:
        return
    pixel = at[1] * camera.width + at[0]
    face = hits.face[pixel]
    if face < 0:
        return
    s = surface_shape(scene, face, hits.u[pixel], hits.v[pixel], -hits.direction[pixel])
    p = FieldPixel()
    p.index = pixel
    p.origin = ray_origin(s)
    p.slot = slot_at(grid, p.origin)
    if (p.slot & SLOT_BOXED) != 0 and query.moving.shape[0] > 0:
        if query.moving[scene.geometry.objects[face]] != 0:
            p.slot = NO_SLOT
    morton = morton_code(at[0], at[1])
    p.seed = own_seed(morton, settings.seed)
    p.set = pixel_set(query, p.seed)
    p.turn = pixel_turn(morton, settings.seed)
    p.first = settings.first_sample
    p.count = settings.sample_count
    wo = -(wp.transpose(s.shading) * hits.direction[pixel])
    sums = FieldSums()
    if s.bsdf.f90 <= 0.0:
        sums = lambert_samples(scene, grid, query, sky, p, s, buffers.transfer)
        s = with_color(scene, s)  # now that its texels have had the time to arrive
        sums.bsdf = wp.cw_mul(sums.bsdf, s.bsdf.diffuse)
        sums.bsdf_square = wp.cw_mul(sums.bsdf_square, wp.cw_mul(s.bsdf.diffuse, s.bsdf.diffuse))
    else:
        p.index_base = pixel_sample_index(at[0], at[1], 0, settings.sample_bits)
        p.index_seed = pixel_seed(at[0], at[1], settings.sample_bits, settings.seed)
        sums = glossy_samples(scene, grid, query, sky, p, s, wo, buffers.transfer)
    if sky.kind == SKY_MAP:
        sums = light_samples(scene, grid, query, sky, p, s, wo, sums)
    buffers.environment[pixel] = buffers.environment[pixel] + sums.bsdf + sums.light
    # the second moment of a sum of two independent numbers: E a^2 + E b^2 + 2 E a E b
    both = wp.cw_mul(sums.bsdf, sums.light) * (2.0 / wp.float32(p.count))
    buffers.moment1[pixel] = buffers.moment1[pixel] + sums.bsdf + sums.light
    buffers.moment2[pixel] = buffers.moment2[pixel] + sums.bsdf_square + sums.light_square + both


# Thread: a light sample. Draws it from the sky map, and writes its own items of `sky`.
@wp.kernel
def sample_sky(first: wp.int32, scene: SceneData, seed: wp.uint32, sky: FieldSky):
    k = first + wp.tid()
    u = sample_2d(wp.uint32(k), seed, SET_SKY_DIMENSION)
    digits = random_1d(wp.uint32(k), seed, SET_SKY_DIGITS_DIMENSION)
    drawn = environment_sample(scene.environment, wp.vec3(u[0], u[1], digits))
    source = environment_arrival(scene.environment, drawn)
    sky.directions[k] = drawn.direction
    sky.pdfs[k] = source.pdf
    sky.radiances[k] = source.radiance


# Thread: a pixel. Writes its light under a low-frequency sky, from its transfers; no ray is traced.
@wp.kernel
def relight(
    first: wp.int32,
    sky: Harmonics,
    transfer: wp.array(dtype=wp.float32),
    environment: wp.array(dtype=wp.vec3),
):
    pixel = first + wp.tid()
    light = wp.vec3(0.0, 0.0, 0.0)
    for channel in range(3):
        for i in range(9):
            light[channel] = light[channel] + sky[channel, i] * transfer[pixel * 27 + channel * 9 + i]
    environment[pixel] = light
