"""Checking a visibility field against traced rays."""

import warp as wp

from warp_gi.kernels.bvh import bvh_occluded
from warp_gi.kernels.gbuffer import CameraData, PassSettings, PrimaryHits, tiled_pixel
from warp_gi.kernels.sampling import frame_of, morton_code
from warp_gi.kernels.surface import ray_origin, surface_shape
from warp_gi.kernels.types import SceneData
from warp_gi.kernels.visibility_field import (
    FieldQuery,
    VisibilityGrid,
    cosine_octet,
    lowest_bit,
    octet_bits,
    octet_direction,
    own_seed,
    pixel_set,
    pixel_turn,
    set_sample,
    slot_at,
    turned_frame,
)

wp.set_module_options({"enable_backward": False})


# Counts of cosine-weighted rays, [pixel]: how many are in each state, and how many of the sure ones are wrong.
@wp.struct
class AuditBuffers:
    visible: wp.array(dtype=wp.int32)  # surely visible
    occluded: wp.array(dtype=wp.int32)  # surely occluded
    mixed: wp.array(dtype=wp.int32)
    unknown: wp.array(dtype=wp.int32)
    lost: wp.array(dtype=wp.int32)  # called occluded, but visible
    leaked: wp.array(dtype=wp.int32)  # called visible, but occluded
    label: wp.array(dtype=wp.int32)  # slot of the pixel's cell with flags, -1 where there is none


# Thread: a pixel. Traces every ray, and writes its own counts.
@wp.kernel
def audit_field(
    first: wp.int32,
    scene: SceneData,
    camera: CameraData,
    settings: PassSettings,
    grid: VisibilityGrid,
    query: FieldQuery,
    hits: PrimaryHits,
    audit: AuditBuffers,
):
    p = tiled_pixel(first + wp.tid(), camera.width)
    if p[0] >= camera.width or p[1] >= camera.height:
        return
    pixel = p[1] * camera.width + p[0]
    face = hits.face[pixel]
    audit.label[pixel] = -1
    if face < 0:
        return
    s = surface_shape(scene, face, hits.u[pixel], hits.v[pixel], -hits.direction[pixel])
    origin = ray_origin(s)
    slot = slot_at(grid, origin)
    morton = morton_code(p[0], p[1])
    frame = turned_frame(frame_of(s.normal), pixel_turn(morton, settings.seed))
    chosen = pixel_set(query, own_seed(morton, settings.seed))
    for start in range(0, settings.sample_count, 8):
        octet = cosine_octet(grid, query.cosines, slot, set_sample(query, chosen, start), frame, s.normal)
        bits = octet_bits(octet)
        todo = (bits >> 16) & 255
        while todo != 0:
            lane = lowest_bit(todo)
            todo = todo & (todo - 1)
            state = ((bits >> lane) & 1) + 2 * ((bits >> (8 + lane)) & 1)
            blocked = bvh_occluded(scene.bvh, origin, octet_direction(octet, lane), float(wp.inf))
            if state == 0:
                audit.unknown[pixel] = audit.unknown[pixel] + 1
            elif state == 1:
                audit.visible[pixel] = audit.visible[pixel] + 1
                if blocked:
                    audit.leaked[pixel] = audit.leaked[pixel] + 1
            elif state == 2:
                audit.occluded[pixel] = audit.occluded[pixel] + 1
                if not blocked:
                    audit.lost[pixel] = audit.lost[pixel] + 1
            else:
                audit.mixed[pixel] = audit.mixed[pixel] + 1
    audit.label[pixel] = slot
