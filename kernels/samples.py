"""The samples that paths leave behind, one at each vertex, and the regions (octree leaves) that they are learnt in.

Every path that is recorded owns the slots of its vertices, so that nothing depends on the order of threads. Of paths
beyond what the buffers are for, one in `stride` is recorded, whichever a hash says.
"""

import warp as wp

from warp_gi.kernels.bsdf import Bsdf
from warp_gi.kernels.emitters import LightChoice
from warp_gi.kernels.gbuffer import previous_position
from warp_gi.kernels.octree import EMPTY_CODE, Octree, cell_code, octree_leaf
from warp_gi.kernels.path_samplers import DirectionSample, Regions
from warp_gi.kernels.quadtree_adapt import quadtree_pack_direction
from warp_gi.kernels.sampling import hash_uint
from warp_gi.kernels.surface import Surface
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})

LIGHT_VISIBLE = wp.constant(wp.uint32(1 << 31))
LIGHT_BLOCKED = wp.constant(wp.uint32(1 << 30))  # something is between the point and the light
SURFACE_GLOSSY = wp.constant(wp.uint32(1 << 29))
LIGHT_EXPLORED = wp.constant(wp.uint32(1 << 28))
LIGHT_ALONE = wp.constant(wp.uint32(1 << 27))  # LightChoice.alone
LIGHT_ITEM = wp.constant(wp.uint32((1 << 27) - 1))  # mask of emitter + 1; 0: no light was sampled
GLOSSY_ALPHA = wp.constant(wp.float32(0.2))  # GGX alpha below which a surface counts as glossy
NO_DIRECTION = wp.constant(wp.float32(-1.0))
LEAST_PROBABILITY = wp.constant(wp.float32(1.0e-12))


# Kind of a surface, 1 if glossy; a region learns a share of the BSDF for each of the two kinds.
@wp.func
def is_glossy(b: Bsdf) -> wp.bool:
    return b.f90 > 0.0 and b.alpha < GLOSSY_ALPHA


# Part of one of two strategies in the density of a sample, and the probability of using it, 16 bits each.
@wp.func
def pack_mixture(posterior: wp.float32, share: wp.float32) -> wp.uint32:
    low = wp.uint32(wp.clamp(posterior, 0.0, 1.0) * 65535.0 + 0.5)
    return low | (wp.uint32(share * 65535.0 + 0.5) << wp.uint32(16))


# (density of that strategy, density of the other), each over that of the mixture.
@wp.func
def mixture_densities(word: wp.uint32) -> wp.vec2:
    share = wp.clamp(wp.float32(word >> wp.uint32(16)), 1.0, 65534.0) / 65535.0
    posterior = wp.float32(word & wp.uint32(0xFFFF)) / 65535.0
    return wp.vec2(posterior / share, (1.0 - posterior) / (1.0 - share))


# Samples of a frame, [slot]. The path that owns a slot writes it; kernels that learn only read.
@wp.struct
class SampleRecords:
    codes: wp.array(dtype=wp.uint32)  # octree cell of the point; EMPTY_CODE: no sample
    lights: wp.array(dtype=wp.uint32)  # LIGHT_*
    light_values: wp.array(dtype=wp.float32)  # luminance that the light sample brought to the picture
    # LIGHT_ALONE: probability of the light by the cache over that by exploring, below 0: unknown. Else estimates by how
    # much the second moment of both choices together exceeds that of exploring alone.
    rivals: wp.array(dtype=wp.float32)
    directions: wp.array(dtype=wp.uint32)  # quadtree_pack_direction
    contributions: wp.array(dtype=wp.float32)  # luminance of light reflected from there, without emitters it hit
    pdfs: wp.array(dtype=wp.float32)  # density of the direction, 1/sr
    carried: wp.array(dtype=wp.float32)  # luminance of the path's throughput up to the vertex
    nearness: wp.array(dtype=wp.float32)  # one over the distance to the point that the ray hit, 1/m; 0: the sky
    mixtures: wp.array(dtype=wp.uint32)  # pack_mixture of the BSDF
    vertices: wp.int32  # number of slots of a path
    stride: wp.int32
    seed: wp.uint32


# Samples by leaf.
@wp.struct
class LeafSamples:
    starts: wp.array(dtype=wp.int32)  # [leaf] first of its samples in `order`
    counts: wp.array(dtype=wp.int32)  # [leaf] number of its samples
    order: wp.array(dtype=wp.int32)  # slots, leaf by leaf
    most: wp.int32  # largest number of samples that are looked at in a leaf, evenly spread


@wp.struct
class SampleRegions:
    octree: Octree
    records: SampleRecords
    moves: wp.int32  # 1: points may have been elsewhere in the previous frame


# Leaf that knows about a point: the one at its place in the previous frame, in which samples were taken.
@wp.func
def sample_region(
    data: SampleRegions, scene: SceneData, s: Surface, face: wp.int32, u: wp.float32, v: wp.float32
) -> wp.int32:
    position = s.position
    if data.moves != 0:
        position = previous_position(scene.geometry, face, u, v)
    return octree_leaf(data.octree.nodes, cell_code(data.octree, position))


@wp.func
def sample_slot(data: SampleRegions, path: wp.int64) -> wp.int32:
    group = path / wp.int64(data.records.stride)
    turn = hash_uint(wp.uint32(group) ^ data.records.seed) % wp.uint32(data.records.stride)
    if path - group * wp.int64(data.records.stride) != wp.int64(turn):
        return -1
    return wp.int32(group) * data.records.vertices


# Paths may go on for longer than there are slots.
@wp.func
def sample_vertex(data: SampleRegions, slot: wp.int32, vertex: wp.int32) -> wp.int32:
    if slot < 0 or vertex >= data.records.vertices:
        return -1
    return slot + vertex


@wp.func
def keep_vertex(data: SampleRegions, slot: wp.int32, s: Surface):
    data.records.codes[slot] = cell_code(data.octree, s.position)
    flags = wp.uint32(0)
    if is_glossy(s.bsdf):
        flags = SURFACE_GLOSSY
    data.records.lights[slot] = flags
    data.records.rivals[slot] = 0.0
    data.records.contributions[slot] = NO_DIRECTION


# Of two light samples the explored one, if it arrives and tells of a light that the cache does not offer.
@wp.func
def keep_light(data: SampleRegions, slot: wp.int32, choice: LightChoice, visible: wp.int32, light: wp.float32):
    if choice.item < 0:
        return
    before = data.records.lights[slot]
    if choice.alone != 0:
        data.records.rivals[slot] = choice.other / wp.max(choice.pdf, LEAST_PROBABILITY)
    elif visible > 0:
        # By exploring alone the light would be selected `other` / pdf times as often, and bring `brings` times as much:
        # the direction sampler, which may find it too, bounds that. Both choices are independent: their product
        # estimates that of their means, which a variance loses when one choice is made of both.
        other = wp.max(choice.other, LEAST_PROBABILITY) / choice.pdf
        brings = 1.0 / (choice.selected * other + 1.0 - choice.selected)
        excess = light * light * (1.0 - other * brings * brings / choice.weight)
        if choice.explores != 0 and (before & LIGHT_VISIBLE) != wp.uint32(0):
            excess += 2.0 * light * data.records.light_values[slot]
        data.records.rivals[slot] = data.records.rivals[slot] + excess
    if choice.explores > 1 or (choice.explores != 0 and visible <= 0):
        return
    word = (before & SURFACE_GLOSSY) | wp.uint32(choice.item + 1)
    if choice.alone != 0:
        word = word | LIGHT_ALONE
    if choice.explores != 0:
        word = word | LIGHT_EXPLORED
    if visible > 0:
        word = word | LIGHT_VISIBLE
    if visible < 0:
        word = word | LIGHT_BLOCKED
    data.records.lights[slot] = word
    data.records.light_values[slot] = light


# `light` is what the path had gathered before; `keep_end` makes a difference of it, over what the path `carried`.
@wp.func
def keep_direction(
    data: SampleRegions,
    slot: wp.int32,
    sample: DirectionSample,
    nearness: wp.float32,
    carried: wp.float32,
    light: wp.float32,
):
    data.records.nearness[slot] = nearness
    data.records.carried[slot] = carried
    data.records.directions[slot] = quadtree_pack_direction(sample.wi)
    posterior = sample.bsdf_share * sample.bsdf_pdf / sample.pdf
    data.records.mixtures[slot] = pack_mixture(posterior, sample.bsdf_share)
    data.records.contributions[slot] = light
    data.records.pdfs[slot] = sample.pdf


@wp.func
def keep_end(data: SampleRegions, slot: wp.int32, vertices: wp.int32, light: wp.float32):
    for vertex in range(wp.min(vertices, data.records.vertices)):
        before = data.records.contributions[slot + vertex]
        if before >= 0.0:
            carried = wp.max(data.records.carried[slot + vertex], 1.0e-6)
            data.records.contributions[slot + vertex] = wp.max(light - before, 0.0) / carried


SAMPLE_REGIONS = Regions(
    "octree",
    SampleRegions,
    sample_region,
    sample_slot,
    sample_vertex,
    keep_vertex,
    keep_light,
    keep_direction,
    keep_end,
)

CHUNK = wp.constant(1024)  # slots that one thread compacts


# Thread: a chunk of slots. Counts its samples.
@wp.kernel
def count_samples(first: wp.int32, records: SampleRecords, counts: wp.array(dtype=wp.int32)):
    chunk = first + wp.tid()
    end = wp.min((chunk + 1) * CHUNK, records.codes.shape[0])
    count = int(0)
    for slot in range(chunk * CHUNK, end):
        if records.codes[slot] != EMPTY_CODE:
            count += 1
    counts[chunk] = count


# Thread: a chunk of slots. Lists its samples, codes and slots, after those of the chunks before (`ends`: their
# running sum).
@wp.kernel
def list_samples(
    first: wp.int32,
    records: SampleRecords,
    ends: wp.array(dtype=wp.int32),
    codes: wp.array(dtype=wp.int32),
    slots: wp.array(dtype=wp.int32),
):
    chunk = first + wp.tid()
    end = wp.min((chunk + 1) * CHUNK, records.codes.shape[0])
    place = int(0)
    if chunk > 0:
        place = ends[chunk - 1]
    for slot in range(chunk * CHUNK, end):
        code = records.codes[slot]
        if code != EMPTY_CODE:
            codes[place] = wp.int32(code)
            slots[place] = slot
            place += 1
