"""Light at a point from transfer textures: of the sky directly, over other surfaces, and of suns by a shadow ray each.

Diffuse light is exact for a sky of 25 numbers a channel: T has the cosine in it, so a Lambert surface reflects
albedo / pi times the sum of L_j T_j. Glossy lobes F are zonal about a fitted direction (transfer_lobes.py); what they
reflect is the sum of F_k M_kj T_j with the sky's matrix M (TPFL of the paper).
"""

import warp as wp

from warp_gi.kernels.atlas import SlotFetch, SurfaceAtlas, atlas_fetch, side_seen
from warp_gi.kernels.bsdf import Bsdf, average_reflectance, bsdf_evaluate, diffuse_share
from warp_gi.kernels.bvh import BvhHit, bvh_occluded
from warp_gi.kernels.path_samplers import KnownRadiance, PathCache
from warp_gi.kernels.sampling import circle, frame_of
from warp_gi.kernels.surface import Surface, ray_origin, shading_normal
from warp_gi.kernels.transfer_lobes import (
    LobeTable,
    PrefilteredSky,
    lobe_at,
    table_entry,
    table_place,
    unshaded_radiance,
)
from warp_gi.kernels.transfer_products import LIGHT_WIDTH, bounced_product, environment_product, glossy_product
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})

MEAN_OF_FIRST = wp.constant(wp.float32(0.2820948))  # a sky's mean over its first coefficient
FIRST_OF_WHITE = wp.constant(wp.float32(3.5449077))  # first coefficient of a sky of radiance 1
LEAST_OF_MEAN = wp.constant(wp.float32(0.05))  # what the light of an open lobe counts as at least, in means of the sky
BROAD = wp.constant(wp.float32(0.7))  # roughness of the lobe, at least, by which occlusion is told
MOST_SHARE = wp.constant(wp.float32(1.5))  # of the light of an open lobe


# What a bake holds, and where it is kept. Rows are padded (transfer_products.py).
@wp.struct
class TransferRows:
    atlas: SurfaceAtlas
    transfer: wp.array2d(dtype=wp.float16)  # [slot, width], of width 32 or 40
    bounces: wp.array2d(dtype=wp.float16)  # [slot, 3 * 32]; empty without bounces
    lamps: wp.array(dtype=wp.vec3)  # [slot] W/m^2 by lamps over other surfaces; empty without


# The present sky.
@wp.struct
class TransferSky:
    light: wp.array(dtype=wp.float32)  # [3, width] without suns: direct light
    whole_light: wp.array(dtype=wp.float32)  # [3, 32] with suns: light over other surfaces
    matrix: wp.array(dtype=wp.float32)  # [order^2, 3, width] of light without suns: sum_i C_ijk L_i, for lobes
    lobes: LobeTable
    prefiltered: PrefilteredSky  # without suns
    least: wp.vec3  # radiance of the darkest part of the sky
    most: wp.vec3  # of the brightest part, without suns
    scale: wp.float32  # of its radiance
    environment_from_world: wp.mat33
    sun_count: wp.int32
    sun_directions: wp.array(dtype=wp.vec3)
    sun_irradiances: wp.array(dtype=wp.vec3)  # W/m^2 perpendicular to the direction
    sun_discs: wp.array(dtype=wp.float32)  # cosines of their half-angles as even discs; 1: a point


# Where transfer of the point of a hit is kept, seen from the side of `s.normal`.
@wp.func
def surface_slots(
    rows: TransferRows, scene: SceneData, s: Surface, face: wp.int32, u: wp.float32, v: wp.float32
) -> SlotFetch:
    return atlas_fetch(rows.atlas, face, u, v, side_seen(scene, face, -s.normal))


# Irradiance [W/m^2] of the sky, without suns, that nothing reflected before; within what the sky can bring where a sky
# of radiance 1 brings `white`. The harmonics of a sky with a few bright parts swing far about the others.
@wp.func
def sky_irradiance(rows: TransferRows, sky: TransferSky, at: SlotFetch) -> wp.vec3:
    light = environment_product(rows.transfer, at.slots, at.shares, sky.light)
    white = float(0.0)
    for k in range(4):
        white += wp.float32(rows.transfer[at.slots[k], 0]) * at.shares[k]
    white = wp.max(white, 0.0) * FIRST_OF_WHITE
    return wp.min(wp.max(light, sky.least * white), sky.most * white)


# Irradiance [W/m^2] of light that was reflected before.
@wp.func
def bounced_irradiance(rows: TransferRows, sky: TransferSky, at: SlotFetch) -> wp.vec3:
    light = wp.vec3(0.0, 0.0, 0.0)
    if rows.bounces.shape[0] > 0:
        white = wp.vec3(0.0, 0.0, 0.0)
        for k in range(4):
            for c in range(3):
                white[c] = white[c] + wp.float32(rows.bounces[at.slots[k], c * LIGHT_WIDTH]) * at.shares[k]
        white = wp.max(white, light) * FIRST_OF_WHITE
        light = bounced_product(rows.bounces, at.slots, at.shares, sky.whole_light)
        light = wp.max(light, wp.cw_mul(sky.least, white))
    if rows.lamps.shape[0] > 0:
        for k in range(4):
            light = light + rows.lamps[at.slots[k]] * at.shares[k]
    return light


# Radiance of the suns that a BSDF at a surface reflects towards wo, which is in the frame of its shading. A point of
# the unit square is the place on a sun's disc; (0, 0) is its middle.
@wp.func
def sun_radiance(scene: SceneData, sky: TransferSky, s: Surface, b: Bsdf, wo: wp.vec3, u: wp.vec2) -> wp.vec3:
    sum = wp.vec3(0.0, 0.0, 0.0)
    for k in range(sky.sun_count):
        away = u[0] * (1.0 - sky.sun_discs[k])  # one minus the cosine of the angle to the middle
        around = circle(u[1]) * wp.sqrt(away * (2.0 - away))
        direction = frame_of(sky.sun_directions[k]) * wp.vec3(around[0], around[1], 1.0 - away)
        if wp.dot(direction, s.normal) > 0.0:
            f = bsdf_evaluate(b, wo, wp.transpose(s.shading) * direction)
            if wp.max(f.value) > 0.0 and not bvh_occluded(scene.bvh, ray_origin(s), direction, float(wp.inf)):
                sum = sum + wp.cw_mul(f.value, sky.sun_irradiances[k])
    return sum


# Radiance of the sky, without suns, that a diffuse lobe reflects.
@wp.func
def diffuse_radiance(rows: TransferRows, sky: TransferSky, s: Surface, at: SlotFetch) -> wp.vec3:
    diffuse = wp.cw_mul(diffuse_share(s.bsdf), s.bsdf.diffuse)
    return wp.cw_mul(diffuse, sky_irradiance(rows, sky, at)) / wp.pi


# Radiance of the sky, without suns, that the glossy lobe reflects towards the unit direction `view`: by transfer alone
# or, below a roughness, of the prefiltered sky the share that transfer says the occluders let through. That share is
# a broader lobe's, which 25 numbers can hold: in a court of rough metal errors at roughness .5 are half of those with
# the lobe itself. The sky of 25 numbers may come near 0 or below it where the real one does not, so the share is
# bounded, and what it divides by.
@wp.func
def glossy_radiance(
    rows: TransferRows, sky: TransferSky, ratio_below: wp.float32, s: Surface, at: SlotFetch, view: wp.vec3
) -> wp.vec3:
    normal = shading_normal(s)
    roughness = wp.sqrt(s.bsdf.alpha)
    place = table_place(sky.lobes, roughness, wp.dot(normal, view))
    shading = place
    if roughness < ratio_below:
        shading = table_place(sky.lobes, wp.max(roughness, BROAD), wp.dot(normal, view))
    lobe = lobe_at(sky.lobes, shading, normal, view)
    products = glossy_product(
        rows.transfer,
        at.slots,
        at.shares,
        sky.matrix,
        lobe.direction,
        lobe.factors,
        normal,
        lobe.normal_factors,
    )
    light = wp.vec3(products[0], products[1], products[2])
    if roughness < ratio_below:
        open = unshaded_radiance(sky.lobes, sky.prefiltered, sky.environment_from_world, place, normal, view)
        for c in range(3):
            least = LEAST_OF_MEAN * MEAN_OF_FIRST * sky.light[c * rows.transfer.shape[1]]
            share = wp.clamp(light[c] / wp.max(products[3 + c], wp.max(least, 1.0e-20)), 0.0, MOST_SHARE)
            light[c] = open[c] * sky.scale * share
    offset = s.bsdf.f90 * table_entry(sky.lobes.entries, place, 3)
    reflected = s.bsdf.f0 * table_entry(sky.lobes.entries, place, 2) + wp.vec3(offset, offset, offset)
    return wp.cw_mul(reflected, light)


# What a surface reflects of the same light from everywhere towards the unit direction `view`.
@wp.func
def view_reflectance(sky: TransferSky, s: Surface, view: wp.vec3) -> wp.vec3:
    diffuse = wp.cw_mul(diffuse_share(s.bsdf), s.bsdf.diffuse)
    if s.bsdf.f90 <= 0.0:
        return diffuse
    place = table_place(sky.lobes, wp.sqrt(s.bsdf.alpha), wp.dot(shading_normal(s), view))
    scale = table_entry(sky.lobes.entries, place, 2)
    offset = s.bsdf.f90 * table_entry(sky.lobes.entries, place, 3)
    return diffuse + s.bsdf.f0 * scale + wp.vec3(offset, offset, offset)


# Whether transfer is kept around a point.
@wp.func
def is_kept(at: SlotFetch) -> wp.bool:
    return at.shares[0] + at.shares[1] + at.shares[2] + at.shares[3] > 0.0


# A radiance cache of what transfer textures know, which all of a path may end in.
@wp.struct
class TransferCache:
    rows: TransferRows
    sky: TransferSky


@wp.func
def transfer_lookup(
    data: TransferCache, scene: SceneData, s: Surface, wo: wp.vec3, hit: BvhHit, pdf: wp.float32, u: wp.vec2
) -> KnownRadiance:
    at = surface_slots(data.rows, scene, s, hit.face, hit.u, hit.v)
    known = KnownRadiance()
    if is_kept(at):
        irradiance = bounced_irradiance(data.rows, data.sky, at)
        known.radiance = wp.cw_mul(average_reflectance(s.bsdf), irradiance) / wp.pi
        known.validity = 1.0
    return known


TRANSFER_CACHE = PathCache("transfer", TransferCache, transfer_lookup)
