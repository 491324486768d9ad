"""Light that bounces between the slots of an atlas: gathered at each from the slots that its rays hit."""

import warp as wp

from warp_gi.kernels.atlas import BACK, SurfaceAtlas
from warp_gi.kernels.atlas_slots import AtlasSlots, slot_surface
from warp_gi.kernels.bsdf import average_reflectance
from warp_gi.kernels.surface import surface_at
from warp_gi.kernels.transfer_bake import TransferRays, ray_direction, set_frame, set_start
from warp_gi.kernels.transfer_native import Numbers, gather_row, harmonics_at
from warp_gi.kernels.transfer_snippets import LIGHT_NUMBERS, LIGHT_ORDER
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})

FOOTPRINT = wp.constant(4)  # lookups along a side of a texel


# What bounces keep of all slots. A row has three channels of 25 numbers, and five zeros.
@wp.struct
class BounceRows:
    hits: wp.array2d(dtype=wp.int32)  # [slot, ray] slot that it hits; below 0 for none
    transfer: wp.array2d(dtype=wp.float16)  # [slot, order^2] of the sky
    reflectance: wp.array(dtype=wp.vec3)  # [slot]
    rows: wp.array2d(dtype=wp.float16)  # [slot, 80] transfer of the light that each slot reflects
    next: wp.array2d(dtype=wp.float16)  # [slot, 80] the same, with one bounce more
    bounces: wp.array2d(dtype=wp.float16)  # [slot, 75] transfer of the light that bounced, over all bounces
    light: wp.array(dtype=wp.vec2)  # [slot] first numbers of the channels of bounces, added up: last change, and sum


# u and v of a face for a step of one texel along x and along y, by columns; 0 where there are none.
@wp.func
def texel_steps(atlas: SurfaceAtlas, face: wp.int32) -> wp.mat22:
    if atlas.corners.shape[0] == 0 or atlas.corner_slots.shape[0] > 0:
        return wp.mat22(0.0, 0.0, 0.0, 0.0)
    a = atlas.corners[face, 1] - atlas.corners[face, 0]
    b = atlas.corners[face, 2] - atlas.corners[face, 0]
    area = a[0] * b[1] - a[1] * b[0]
    if wp.abs(area) < 1.0e-12:
        return wp.mat22(0.0, 0.0, 0.0, 0.0)
    return wp.mat22(b[1], -b[0], -a[1], a[0]) / area


# Thread: a slot. What its surface reflects of light from everywhere, averaged over the part of its texel on its face.
@wp.kernel
def reflect_slots(
    first: wp.int32, scene: SceneData, atlas: SurfaceAtlas, slots: AtlasSlots, result: wp.array(dtype=wp.vec3)
):
    slot = first + wp.tid()
    face = slots.faces[slot]
    ids = scene.geometry.indices[face]
    p0 = scene.geometry.points[ids[0]]
    normal = wp.normalize(wp.cross(scene.geometry.points[ids[1]] - p0, scene.geometry.points[ids[2]] - p0))
    if wp.int32(slots.sides[slot]) == BACK:
        normal = -normal
    m = scene.materials[scene.geometry.materials[face]]
    side = int(1)
    textures = wp.max(m.base_color_texture, wp.max(m.metallic_roughness_texture, m.specular_texture))
    if textures >= 0 or m.reflectance_texture >= 0 or scene.geometry.colors.shape[0] > 0:
        side = FOOTPRINT
    steps = texel_steps(atlas, face)
    sum = wp.vec3()
    for k in range(side * side):
        x = (wp.float32(k % side) + 0.5) / wp.float32(side) - 0.5
        y = (wp.float32(k / side) + 0.5) / wp.float32(side) - 0.5
        p = slots.points[slot] + steps * wp.vec2(x, y)
        u = wp.max(p[0], 0.0)
        v = wp.max(p[1], 0.0)
        scale = 1.0 / wp.max(u + v, 1.0)
        sum += average_reflectance(surface_at(scene, face, u * scale, v * scale, normal).bsdf)
    result[slot] = sum / wp.float32(side * side)


# Thread: a slot. Transfer of the light that reached it after one bounce or more, S_(b+1) = mean of albedo times
# (T + S_b) over its hits: so S_b holds b bounces. The first `rays` hits count; with none of them S is 0.
@wp.kernel
def gather_bounces(first: wp.int32, rays: wp.int32, state: BounceRows):
    slot = first + wp.tid()
    mean = gather_row(
        slot,
        state.hits,
        rays,
        state.rows,
        state.transfer,
        state.reflectance[slot],
        state.bounces,
        state.next,
    )
    sum = mean[0] + mean[1] + mean[2]
    state.light[slot] = wp.vec2(sum - state.light[slot][1], sum)


# Thread: a slot. Mean over its hits of what each reflects.
@wp.kernel
def gather_light(
    first: wp.int32,
    hits: wp.array2d(dtype=wp.int32),
    reflected: wp.array(dtype=wp.vec3),
    result: wp.array(dtype=wp.vec3),
):
    slot = first + wp.tid()
    sum = wp.vec3()
    for i in range(hits.shape[1]):
        if hits[slot, i] >= 0:
            sum += reflected[hits[slot, i]]
    result[slot] = sum / wp.float32(hits.shape[1])


# Thread: a slot. Light from the surfaces around it by direction, I_k = int L cos(w) y_k(w) dw over its hits, for the
# radiance of each slot.
@wp.kernel
def gather_glossy(
    first: wp.int32,
    scene: SceneData,
    slots: AtlasSlots,
    rays: TransferRays,
    hits: wp.array2d(dtype=wp.int32),
    radiance: wp.array(dtype=wp.vec3),
    result: wp.array3d(dtype=wp.float32),
):
    slot = first + wp.tid()
    s = slot_surface(scene, slots, slot)
    frame = set_frame(rays, s.shading, slot)
    item = set_start(rays, slot)
    red = Numbers()
    green = Numbers()
    blue = Numbers()
    for i in range(hits.shape[1]):
        if hits[slot, i] >= 0:
            y = harmonics_at(ray_direction(rays, frame, item + i), LIGHT_ORDER)
            light = radiance[hits[slot, i]] * (wp.pi / wp.float32(hits.shape[1]))
            red += y * light[0]
            green += y * light[1]
            blue += y * light[2]
    for k in range(LIGHT_NUMBERS):
        result[slot, 0, k] = red[k]
        result[slot, 1, k] = green[k]
        result[slot, 2, k] = blue[k]
