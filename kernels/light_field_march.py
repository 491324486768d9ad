"""World-space rays through light field probes (light_field_probes.txt, sections 4 to 4.2).

A ray is a line on a probe's map (octahedral_line.py). The march goes along it from border to border: first in blocks of
16 x 16 texels, then, where a block's least distance does not keep the ray in front of everything, texel by texel. The
distance from the probe is convex in t: its maximum is at an end of an interval.

The surfel of a texel, at r w with normal n, is the plane h(p) = n . (p - r w) = 0 within the texel's cone; h > 0 on
the probe's side. A ray that crosses it from that side hits it there, more precisely than a texel is wide. Where
- the ray is behind the plane already as it enters the cone, or
- the next texel, on the side of the crossing, does not continue the surface,
the ray has come to a silhouette, of which the probe knows no more than a texel: that is not an answer but a candidate
with a doubt, in texels. Other probes are asked; if those of the cage see no further, the candidate of least doubt is
the hit.
"""

import warp as wp

from warp_gi.kernels.light_field import (
    BLOCK,
    NOTHING,
    PROBE_USABLE,
    LightField,
    cage_of,
    cage_probe,
    grid_position,
    probe_index,
    surfel_distance,
    surfel_normal,
    texel_direction,
)
from warp_gi.kernels.octahedral import octahedral_encode, octahedral_texel
from warp_gi.kernels.octahedral_line import MapCell, MapLine, enter_cells, map_line, next_cell, side_texel

wp.set_module_options({"enable_backward": False})

MISS = wp.constant(0)  # nothing is in the way up to t_max or the scene's bounds
HIT = wp.constant(1)
UNKNOWN = wp.constant(2)  # no probe saw further: t, probe and texel are those of the last occluder
STOPPED = wp.constant(3)  # stopped after most_steps
_ON = wp.constant(-1)  # no answer yet

_TEXEL = wp.constant(wp.float32(3.0))  # half the diagonal of a texel in radians, times the resolution: 2.0 to 4.3
_STEEPEST = wp.constant(wp.float32(0.05))  # least cosine at which a probe sees a surfel
_HALF = wp.constant(wp.float32(4.9e-4))  # relative precision of distances, 2^-11
_NORMAL = wp.constant(wp.float32(0.01))  # precision of normals in radians
_GAP = wp.constant(wp.float32(0.5))  # texels between two planes that are no longer one surface
_SURE = wp.constant(wp.float32(0.1))  # doubt of a surfel's own middle; at most 0.25 at the border of its texel
_ACCEPTED = wp.constant(wp.float32(0.3))  # largest doubt of a hit that is believed
_MARGIN = wp.constant(wp.float32(0.02))  # margin of the scene's bounds, relative to their size
_TURNS = wp.constant(8 + 3 * 64)  # number of places of probe_in_turn
_MOST_PROBES = wp.constant(64)  # largest number of probes that one ray asks


@wp.struct
class MarchHit:
    result: wp.int32  # MISS, HIT, UNKNOWN or STOPPED
    t: wp.float32  # metres along the ray
    probe: wp.int32  # whose map holds the texel; -1 if the ray is outside of the bounds or no probe can be asked
    texel: wp.int32  # texel of the surfel hit, of the last occluder, or where the ray ends
    steps: wp.int32  # texels looked at
    blocks: wp.int32  # blocks looked at
    probes: wp.int32  # probes asked
    level: wp.int32  # level of the last look: 0 a texel, 1 a block
    last: wp.int32  # texel or block of the last look, -1 before a probe's first
    safe: wp.float32  # metres along the ray up to which it was in front of what the probe sees
    seen: wp.int32  # 1 if it was in front anywhere
    doubt: wp.float32  # of an UNKNOWN of one probe: how likely it is no hit, in texels; infinite if hidden for sure


# A ray in coordinates about a probe.
@wp.struct
class ProbeRay:
    origin: wp.vec3
    direction: wp.vec3
    map_start: wp.int32  # first texel of the probe in LightField.surfels
    blocks_start: wp.int32  # first block of the probe in LightField.nearest
    most_steps: wp.int32
    nearer: wp.float32  # share by which a surfel comes nearer within its texel than in its middle
    width: wp.float32  # side of a texel, in a map whose sides are 2


# Square of the greatest distance from the probe between two times.
@wp.func
def square_reach(ray: ProbeRay, t_in: wp.float32, t_out: wp.float32) -> wp.float32:
    a = ray.origin + ray.direction * t_in
    b = ray.origin + ray.direction * t_out
    return wp.max(wp.dot(a, a), wp.dot(b, b))


# Doubt that a point on a texel's surfel is on the surface: the further from the middle, the more, unless the next
# texel on that side is part of the same surface.
@wp.func
def gap_doubt(field: LightField, map_start: wp.int32, texel: wp.int32, point: wp.vec3) -> wp.float32:
    side = side_texel(texel, field.resolution, point)
    word = field.surfels[map_start + side.texel]
    h = wp.dot(surfel_normal(word), point - texel_direction(side.texel, field.resolution) * surfel_distance(word))
    if wp.abs(h) * wp.float32(field.resolution) < _GAP * _TEXEL * wp.length(point):
        return 0.0
    return 0.5 * side.away


# A miss of a ray that left the bounds: not believed if the texel where it did, and the next on its side, see surfaces.
# As these are within the bounds, the ray went through the second's in the cone of the first.
@wp.func
def check_miss(field: LightField, origin: wp.vec3, direction: wp.vec3, hit: MarchHit) -> MarchHit:
    map_start = hit.probe * field.resolution * field.resolution
    if surfel_distance(field.surfels[map_start + hit.texel]) >= NOTHING:
        return hit
    o = origin - field.positions[hit.probe]
    side = side_texel(hit.texel, field.resolution, o + direction * hit.t)
    word = field.surfels[map_start + side.texel]
    if surfel_distance(word) >= NOTHING:
        hit.texel = side.texel  # which tells of the sky
        return hit
    n = surfel_normal(word)
    before = wp.dot(n, o - texel_direction(side.texel, field.resolution) * surfel_distance(word))
    speed = wp.dot(n, direction)
    hit.result = UNKNOWN
    hit.texel = side.texel
    hit.doubt = 0.25
    if speed < 0.0:
        hit.t = wp.clamp(-before / speed, hit.safe, hit.t)
    return hit


# What the ray meets between t_in and t_out, where it is in the cone of `texel`.
@wp.func
def meet_surfel(
    field: LightField, ray: ProbeRay, texel: wp.int32, t_in: wp.float32, t_out: wp.float32, hit: MarchHit
) -> MarchHit:
    word = field.surfels[ray.map_start + texel]
    r = surfel_distance(word)
    size = 0.5 * _TEXEL * ray.width
    # within the texel's cone the plane comes no nearer than this
    near = r * ray.nearer
    if square_reach(ray, t_in, t_out) < near * near:
        hit.safe = t_in
        hit.seen = 1
        return hit
    w = texel_direction(texel, field.resolution)
    n = surfel_normal(word)
    cosine = -wp.dot(n, w)
    if cosine < _STEEPEST:
        n = n + w * (cosine - _STEEPEST)
        cosine = _STEEPEST
    # h(t) = before + speed t
    before = wp.dot(n, ray.origin) + cosine * r
    speed = wp.dot(n, ray.direction)
    h_in = before + speed * t_in
    h_out = before + speed * t_out
    precision = r * (_HALF * cosine + _NORMAL * size / cosine)
    if h_in < -precision:
        hit.result = UNKNOWN
        hit.t = t_in
        hit.texel = texel
        hit.doubt = wp.inf
        if speed < 0.0 and hit.seen != 0:
            hit.t = wp.clamp(-before / speed, hit.safe, t_in)
            hit.doubt = -h_in / (r * size)
    elif speed < 0.0 and h_out < -precision and (h_in >= 0.0 or hit.seen != 0):
        hit.t = wp.max(-before / speed, hit.safe)
        hit.texel = texel
        hit.doubt = gap_doubt(field, ray.map_start, texel, ray.origin + ray.direction * hit.t)
        hit.result = wp.where(hit.doubt > _SURE, UNKNOWN, HIT)
    elif h_out >= 0.0:
        hit.safe = t_in
        hit.seen = 1
    return hit


# The texels of one block between t_in and t_out.
@wp.func
def march_block(
    field: LightField, ray: ProbeRay, line: MapLine, block: MapCell, t_in: wp.float32, t_out: wp.float32, hit: MarchHit
) -> MarchHit:
    x = block.x * BLOCK
    y = block.y * BLOCK
    cell = enter_cells(line, t_in, t_out, ray.width, x, y, BLOCK)
    t = t_in
    while t < t_out and cell.x >= x and cell.y >= y and cell.x < x + BLOCK and cell.y < y + BLOCK:
        t_next = wp.min(wp.min(cell.next_x, cell.next_y), t_out)
        if t_next > t:
            if hit.steps + hit.blocks >= ray.most_steps:
                hit.result = STOPPED
                hit.t = t
                return hit
            hit.steps += 1
            hit.level = 0
            hit.last = cell.y * field.resolution + cell.x
            hit = meet_surfel(field, ray, hit.last, t, t_next, hit)
            if hit.result != _ON:
                return hit
            t = t_next
        cell = next_cell(line, cell, ray.width)
    return hit


# One face of the octahedron, block by block, between t_in and t_out.
@wp.func
def march_face(field: LightField, ray: ProbeRay, t_in: wp.float32, t_out: wp.float32, hit: MarchHit) -> MarchHit:
    blocks = field.resolution / BLOCK
    width = ray.width * wp.float32(BLOCK)
    line = map_line(ray.origin, ray.direction, 0.5 * (t_in + t_out))
    cell = enter_cells(line, t_in, t_out, width, 0, 0, blocks)
    # a surfel seen at a slant of 4 to 1 comes nearer by this within its texel
    slack = 1.0 / (1.0 + 2.0 * _TEXEL * ray.width)
    t = t_in
    while t < t_out and cell.x >= 0 and cell.y >= 0 and cell.x < blocks and cell.y < blocks:
        t_next = wp.min(wp.min(cell.next_x, cell.next_y), t_out)
        if t_next > t:
            if hit.steps + hit.blocks >= ray.most_steps:
                hit.result = STOPPED
                hit.t = t
                return hit
            hit.blocks += 1
            hit.level = 1
            hit.last = cell.y * blocks + cell.x
            near = field.nearest[ray.blocks_start + hit.last] * slack
            if square_reach(ray, t, t_next) < near * near:
                hit.safe = t_next
                hit.seen = 1
            else:
                hit = march_block(field, ray, line, cell, t, t_next, hit)
                if hit.result != _ON:
                    return hit
            t = t_next
        cell = next_cell(line, cell, width)
    return hit


# When a coordinate is zero; never if that is before `t`.
@wp.func
def plane_time(origin: wp.float32, direction: wp.float32, t: wp.float32) -> wp.float32:
    if direction == 0.0:
        return wp.inf
    crossing = -origin / direction
    return wp.where(crossing > t, crossing, wp.inf)


# What one probe says about a ray between `t_start` and `t_end`.
@wp.func
def march_probe(
    field: LightField,
    probe: wp.int32,
    origin: wp.vec3,
    direction: wp.vec3,
    t_start: wp.float32,
    t_end: wp.float32,
    most_steps: wp.int32,
    hit: MarchHit,
) -> MarchHit:
    texels = field.resolution * field.resolution
    o = origin - field.positions[probe]
    ray = ProbeRay()
    ray.origin = o
    ray.direction = direction
    ray.map_start = probe * texels
    ray.blocks_start = probe * (texels / (BLOCK * BLOCK))
    ray.most_steps = most_steps
    ray.width = 2.0 / wp.float32(field.resolution)
    ray.nearer = 1.0 / (1.0 + 0.5 * _TEXEL * ray.width / _STEEPEST)
    hit.result = _ON
    hit.probe = probe
    hit.probes += 1
    hit.safe = t_start
    hit.last = -1
    t = t_start
    while t < t_end and hit.result == _ON:
        t_next = wp.min(
            wp.min(plane_time(o[0], direction[0], t), plane_time(o[1], direction[1], t)),
            wp.min(plane_time(o[2], direction[2], t), t_end),
        )
        hit = march_face(field, ray, t, t_next, hit)
        t = t_next
    if hit.result == _ON:
        hit.result = MISS
        hit.t = t_end
        hit.texel = octahedral_texel(octahedral_encode(o + direction * t_end), field.resolution)
    return hit


# Where a ray enters and leaves the scene's bounds, with a margin, within t_min and t_max.
@wp.func
def clip_ray(field: LightField, origin: wp.vec3, direction: wp.vec3, t_min: wp.float32, t_max: wp.float32) -> wp.vec2:
    size = field.bounds_high - field.bounds_low
    margin = wp.max(size[0], wp.max(size[1], size[2])) * _MARGIN
    t_in = t_min
    t_out = t_max
    for axis in range(3):
        low = field.bounds_low[axis] - margin - origin[axis]
        high = field.bounds_high[axis] + margin - origin[axis]
        if direction[axis] != 0.0:
            a = low / direction[axis]
            b = high / direction[axis]
            t_in = wp.max(t_in, wp.min(a, b))
            t_out = wp.min(t_out, wp.max(a, b))
        elif low > 0.0 or high < 0.0:
            t_out = t_min
    return wp.vec2(t_in, t_out)


# Corner of a cage whose probe, of those that may be used, is nearest to a ray's line; the first if none may.
@wp.func
def first_corner(field: LightField, cage: wp.vec3i, origin: wp.vec3, direction: wp.vec3) -> wp.int32:
    best = int(0)
    least = float(wp.inf)
    for corner in range(8):
        probe = cage_probe(field, cage, corner)
        offset = field.positions[probe] - origin
        off_line = wp.cross(offset, direction)
        distance = wp.dot(off_line, off_line)
        if distance < least and field.states[probe] == PROBE_USABLE:
            least = distance
            best = corner
    return best


# Probe of the 4 x 4 x 4 around a cage, in an order that jumps about: `index` is 0 to 63 for those next to its faces,
# 64 to 127 to its edges, 128 to 191 to its corners; -1 for all others and outside of the grid.
@wp.func
def outer_probe(field: LightField, cage: wp.vec3i, index: wp.int32) -> wp.int32:
    k = index * 37 + 21
    x = (k & 3) - 1
    y = ((k >> 2) & 3) - 1
    z = ((k >> 4) & 3) - 1
    inside = wp.where((x >> 1) == 0, 1, 0) + wp.where((y >> 1) == 0, 1, 0) + wp.where((z >> 1) == 0, 1, 0)
    if inside + (index >> 6) != 2:
        return -1
    x += cage[0]
    y += cage[1]
    z += cage[2]
    if x < 0 or y < 0 or z < 0 or x >= field.counts[0] or y >= field.counts[1] or z >= field.counts[2]:
        return -1
    return probe_index(field, x, y, z)


# Probe to ask in place `turn` about a point in a cage: its eight corners, each three on from the last, which is far
# from it (section 4.1), then those around the cage; -1 for none. Along an axis of one probe both corners are the same.
@wp.func
def probe_in_turn(field: LightField, cage: wp.vec3i, corner: wp.int32, turn: wp.int32) -> wp.int32:
    probe = int(-1)
    if turn < 8:
        next = (corner + 3 * turn) & 7
        counts = field.counts
        repeats = wp.where(counts[0] == 1, 1, 0) + wp.where(counts[1] == 1, 2, 0) + wp.where(counts[2] == 1, 4, 0)
        if (next & repeats) == 0:
            probe = cage_probe(field, cage, next)
    else:
        probe = outer_probe(field, cage, turn - 8)
    if probe >= 0:
        if field.states[probe] != PROBE_USABLE:
            return -1
    return probe


# Traces a ray of unit direction between t_min and t_max, looking at no more than `most_steps` blocks and texels.
# More than the paper does: where a cage has no answer, the probes around it are asked (many a point near a floor is
# seen by none of its cage, whose lower half is below), and all once more if the ray was seen any further.
@wp.func
def march(
    field: LightField, origin: wp.vec3, direction: wp.vec3, t_min: wp.float32, t_max: wp.float32, most_steps: wp.int32
) -> MarchHit:
    span = clip_ray(field, origin, direction, t_min, t_max)
    t = span[0]
    hit = MarchHit()
    hit.result = MISS
    hit.t = t
    hit.probe = -1
    hit.texel = -1
    hit.last = -1
    if span[0] >= span[1]:
        return hit
    best = hit
    best.doubt = wp.inf
    cage = cage_of(field, grid_position(field, origin + direction * t))
    corner = first_corner(field, cage, origin, direction)
    turn = int(0)
    t_round = t
    while hit.probes < _MOST_PROBES:
        if turn == 8 and best.doubt < _ACCEPTED:
            break
        if turn == _TURNS:
            if t <= t_round:
                break
            t_round = t
            turn = 0
        probe = probe_in_turn(field, cage, corner, turn)
        turn += 1
        if probe >= 0:
            hit.seen = wp.where(t > span[0], 1, 0)
            hit = march_probe(field, probe, origin, direction, t, span[1], most_steps, hit)
            if hit.result == MISS and span[1] < t_max:
                hit = check_miss(field, origin, direction, hit)
            if hit.result != UNKNOWN:
                return hit
            if hit.safe > t:
                t = hit.safe
                if t > best.t:
                    best.doubt = wp.inf
            if best.probe < 0 or hit.doubt < best.doubt:
                best = hit
            at = cage_of(field, grid_position(field, origin + direction * t))
            if at[0] != cage[0] or at[1] != cage[1] or at[2] != cage[2]:
                cage = at
                corner = first_corner(field, cage, origin, direction)
                turn = 0
                t_round = t
    hit.result = wp.where(best.doubt < _ACCEPTED, HIT, UNKNOWN)
    hit.t = best.t
    hit.probe = best.probe
    hit.texel = best.texel
    return hit


@wp.struct
class MarchHits:
    results: wp.array(dtype=wp.int32)  # [ray], as the fields of MarchHit
    t: wp.array(dtype=wp.float32)
    probes: wp.array(dtype=wp.int32)
    texels: wp.array(dtype=wp.int32)
    counts: wp.array(dtype=wp.vec3i)  # steps, blocks, probes
    stops: wp.array(dtype=wp.vec2i)  # level, texel or block


# One ray from t = 0 to t_max, of unit direction.
@wp.kernel
def march_rays(
    first: wp.int32,
    field: LightField,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    t_max: wp.float32,
    most_steps: wp.int32,
    hits: MarchHits,
):
    i = first + wp.tid()
    hit = march(field, origins[i], directions[i], 0.0, t_max, most_steps)
    hits.results[i] = hit.result
    hits.t[i] = hit.t
    hits.probes[i] = hit.probe
    hits.texels[i] = hit.texel
    hits.counts[i] = wp.vec3i(hit.steps, hit.blocks, hit.probes)
    hits.stops[i] = wp.vec2i(hit.level, hit.last)
