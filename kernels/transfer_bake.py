"""Transfer at the slots of an atlas: rays of the bake, and the light that lamps send to each slot (prt_textures.txt).

A slot has one of 64 sets of directions about its shading normal, turned about it at random. Its first rays ask whether
it sees sky and surfaces both; only then do the others follow. The first of them also find from where light bounces.
"""

import warp as wp

from warp_gi.kernels.alias import alias_choice
from warp_gi.kernels.atlas import SurfaceAtlas, atlas_nearest, side_seen
from warp_gi.kernels.atlas_slots import AtlasSlots, slot_surface
from warp_gi.kernels.bvh import bvh_intersect, bvh_occluded
from warp_gi.kernels.emitters import LightChoice, hit_light_pdf, may_hit_emitter, sample_emitter
from warp_gi.kernels.light_connections import SHADOW_END
from warp_gi.kernels.sampling import (
    TRANSFER_DIRECTION_DIMENSION,
    TRANSFER_LAMP_DIMENSION,
    TRANSFER_POINT_DIMENSION,
    TRANSFER_RAY_DIMENSION,
    TRANSFER_TURN_DIMENSION,
    balance,
    circle,
    cosine_direction,
    hash_uint,
    random_1d,
    sample_1d,
    sample_2d,
)
from warp_gi.kernels.surface import Surface, ray_origin, shading_normal, surface_emission
from warp_gi.kernels.transfer_native import BLOCK_RAYS, Numbers, bit_count, harmonic_sums, open_transfer
from warp_gi.kernels.types import Bvh, SceneData

wp.set_module_options({"enable_backward": False})

SETS = wp.constant(64)  # of directions
SKY = wp.constant(-1)  # a ray that hits nothing
BLACK = wp.constant(-2)  # a ray that hits what keeps no transfer
BELOW = wp.constant(-3)  # a ray that starts below the surface


@wp.struct
class TransferRays:
    directions: wp.array2d(dtype=wp.float32)  # [axis, set * set_size + item] local, and eight items more
    set_size: wp.int32
    first_rays: wp.int32  # of every slot
    rays: wp.int32  # of slots that see sky and surfaces both; no fewer
    bounce_rays: wp.int32  # the first so many also find the slots that they hit; no more than first_rays
    order: wp.int32  # 5 or 6
    seed: wp.uint32
    faces: wp.array(dtype=wp.int32)  # [face of the tree] face of the scene; empty where they are the same


@wp.struct
class TransferResults:
    transfer: wp.array2d(dtype=wp.float16)  # [slot, order^2] sr
    hits: wp.array2d(dtype=wp.int32)  # [slot, bounce_rays] slot that the ray hits, SKY, BLACK or BELOW
    rays: wp.array(dtype=wp.int32)  # [slot] rays traced


# Thread: a direction of a set. Cosine-distributed about z; the first 2^k of a set are well spread for every k.
@wp.kernel
def draw_directions(first: wp.int32, rays: TransferRays):
    k = first + wp.tid()
    seed = hash_uint(rays.seed + wp.uint32(k / rays.set_size))
    d = cosine_direction(sample_2d(wp.uint32(k % rays.set_size), seed, TRANSFER_DIRECTION_DIMENSION))
    for axis in range(3):
        rays.directions[axis, k] = d[axis]


# First direction of a slot's set.
@wp.func
def set_start(rays: TransferRays, slot: wp.int32) -> wp.int32:
    return wp.int32(hash_uint(wp.uint32(slot) ^ hash_uint(rays.seed)) % wp.uint32(SETS)) * rays.set_size


# world_from_local of a slot's directions: its shading frame, turned about the normal.
@wp.func
def set_frame(rays: TransferRays, shading: wp.mat33, slot: wp.int32) -> wp.mat33:
    c = circle(random_1d(wp.uint32(slot), rays.seed, TRANSFER_TURN_DIMENSION))
    x = wp.vec3(shading[0, 0], shading[1, 0], shading[2, 0])
    y = wp.vec3(shading[0, 1], shading[1, 1], shading[2, 1])
    return wp.matrix_from_cols(
        x * c[0] + y * c[1], y * c[0] - x * c[1], wp.vec3(shading[0, 2], shading[1, 2], shading[2, 2])
    )


@wp.func
def ray_direction(rays: TransferRays, frame: wp.mat33, item: wp.int32) -> wp.vec3:
    return frame * wp.vec3(rays.directions[0, item], rays.directions[1, item], rays.directions[2, item])


# The slot that a ray hits, SKY or BLACK.
@wp.func
def hit_slot(
    scene: SceneData, atlas: SurfaceAtlas, rays: TransferRays, origin: wp.vec3, direction: wp.vec3
) -> wp.int32:
    hit = bvh_intersect(scene.bvh, origin, direction, float(wp.inf))
    if hit.face < 0:
        return SKY
    face = hit.face
    if rays.faces.shape[0] > 0:
        face = rays.faces[face]
    slot = atlas_nearest(atlas, face, hit.u, hit.v, side_seen(scene, face, direction))
    if slot < 0:
        return BLACK
    return slot


# Traces `count` rays of a slot from number `begin` of its set on; returns a bit for each that reaches the sky.
@wp.func
def free_rays(
    scene: SceneData,
    atlas: SurfaceAtlas,
    rays: TransferRays,
    s: Surface,
    slot: wp.int32,
    begin: wp.int32,
    count: wp.int32,
    results: TransferResults,
) -> wp.uint64:
    frame = set_frame(rays, s.shading, slot)
    item = set_start(rays, slot) + begin
    origin = ray_origin(s)
    free = wp.uint64(0)
    for i in range(count):
        direction = ray_direction(rays, frame, item + i)
        target = int(BELOW)
        if wp.dot(direction, s.normal) > 0.0:
            if begin + i < rays.bounce_rays:
                target = hit_slot(scene, atlas, rays, origin, direction)
            elif bvh_occluded(scene.bvh, origin, direction, float(wp.inf)) == 0:
                target = SKY
        if begin + i < rays.bounce_rays:
            results.hits[slot, begin + i] = target
        if target == SKY:
            free = free | (wp.uint64(1) << wp.uint64(i))
    return free


# Thread: a slot, from slot `start` on. Its rays, and its transfer T_j = pi/N sum_visible y_j(w), with the control
# variate q (A_l y_j(n) - pi/N sum y_j(w)) of mean 0, where q is the share that is visible: where all is, T is exact.
@wp.kernel
def trace_transfer(
    first: wp.int32,
    start: wp.int32,
    scene: SceneData,
    atlas: SurfaceAtlas,
    slots: AtlasSlots,
    rays: TransferRays,
    results: TransferResults,
):
    slot = start + first + wp.tid()
    s = slot_surface(scene, slots, slot)
    frame = set_frame(rays, s.shading, slot)
    item = set_start(rays, slot)
    sums = Numbers()
    seen = int(0)
    done = int(0)
    goal = int(rays.first_rays)
    while done < goal:
        count = wp.min(goal - done, BLOCK_RAYS)
        free = free_rays(scene, atlas, rays, s, slot, done, count, results)
        sums = sums + harmonic_sums(rays.directions, item + done, count, free, frame, rays.order)
        seen += bit_count(free)
        done += count
        if done == rays.first_rays and seen > 0 and seen < done:
            goal = rays.rays
    results.rays[slot] = done
    numbers = rays.order * rays.order
    share = wp.float32(seen) / wp.float32(done)
    exact = Numbers()
    if seen > 0:
        exact = open_transfer(shading_normal(s), rays.order) * share
    if seen < done and seen > 0:
        every = Numbers()
        for block in range((done + BLOCK_RAYS - 1) / BLOCK_RAYS):
            count = wp.min(done - block * BLOCK_RAYS, BLOCK_RAYS)
            all = ~wp.uint64(0)
            every = every + harmonic_sums(rays.directions, item + block * BLOCK_RAYS, count, all, frame, rays.order)
        exact = exact + (sums - every * share) * (wp.pi / wp.float32(done))
    for k in range(numbers):
        results.transfer[slot, k] = wp.float16(exact[k])


# How lamps are sampled at a slot.
@wp.struct
class LampSamples:
    count: wp.int32
    each: wp.int32  # 1: a sample is the emitter of its number; 0: emitters are drawn by power
    seed: wp.uint32
    bvh: Bvh  # of what rests
    faces: wp.array(dtype=wp.int32)  # [face of the tree] face of the scene; empty where they are the same


# Sample k of a slot.
@wp.func
def lamp_choice(scene: SceneData, lamps: LampSamples, index: wp.uint32, k: wp.int32) -> LightChoice:
    choice = LightChoice()
    choice.item = k
    choice.pdf = 1.0
    choice.weight = 1.0
    if lamps.each == 0:
        u = sample_1d(index, lamps.seed, TRANSFER_LAMP_DIMENSION)
        digits = random_1d(index, lamps.seed, TRANSFER_LAMP_DIMENSION)
        a = alias_choice(scene.emitters.alias, scene.emitters.count, u, digits)
        choice.item = a.item
        choice.pdf = a.pdf
    return choice


# What a ray of cosine density brings of the emissive surface that it hits, over that density and balanced against a
# light sample. Close to a lamp, points on it vary without bound, and such rays do not.
@wp.func
def lamp_by_ray(
    scene: SceneData, lamps: LampSamples, origin: wp.vec3, direction: wp.vec3, cosine: wp.float32
) -> wp.vec3:
    if cosine <= 0.0 or not may_hit_emitter(scene.emitters, origin, direction):
        return wp.vec3()
    hit = bvh_intersect(lamps.bvh, origin, direction, float(wp.inf))
    face = hit.face
    if face >= 0 and lamps.faces.shape[0] > 0:
        face = lamps.faces[face]
    if face < 0 or scene.geometry.emitters[face] < 0:
        return wp.vec3()
    emitter = scene.geometry.emitters[face]
    pdf = hit_light_pdf(scene, emitter, face, hit.u, hit.v, direction, hit.t) * scene.emitters.alias[emitter].pdf
    light = surface_emission(scene, face, hit.u, hit.v, -direction)
    return light * (wp.pi * balance(cosine / wp.pi, pdf))


# Thread: a slot, from slot `start` on. Irradiance by the scene's emitters: of each of them where all have no size, else
# of light samples and rays. `scene` has all that moves, and its tree numbers faces as the emitters do.
@wp.kernel
def light_slots(
    first: wp.int32,
    start: wp.int32,
    scene: SceneData,
    slots: AtlasSlots,
    lamps: LampSamples,
    result: wp.array(dtype=wp.vec3),
):
    slot = start + first + wp.tid()
    s = slot_surface(scene, slots, slot)
    origin = ray_origin(s)
    n = shading_normal(s)
    sum = wp.vec3()
    for k in range(lamps.count):
        index = wp.uint32(slot) * wp.uint32(lamps.count) + wp.uint32(k)
        choice = lamp_choice(scene, lamps, index, k)
        drawn = sample_emitter(scene, origin, choice, sample_2d(index, lamps.seed, TRANSFER_POINT_DIMENSION))
        cosine = wp.dot(drawn.direction, n)
        if drawn.pdf > 0.0 and cosine > 0.0 and wp.dot(drawn.direction, s.normal) > 0.0:
            if bvh_occluded(lamps.bvh, origin, drawn.direction, drawn.distance * SHADOW_END) == 0:
                if drawn.delta == 0:
                    cosine = cosine / drawn.pdf * balance(drawn.pdf, cosine / wp.pi)
                sum += drawn.radiance * cosine
        if lamps.each == 0:
            local = cosine_direction(sample_2d(index, lamps.seed, TRANSFER_RAY_DIMENSION))
            direction = s.shading * local
            if wp.dot(direction, s.normal) > 0.0:
                sum += lamp_by_ray(scene, lamps, origin, direction, local[2])
    if lamps.each == 0:
        sum = sum / wp.float32(lamps.count)
    result[slot] = sum
