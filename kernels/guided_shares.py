"""Learning how often to ask the BSDF rather than the quadtree: the share whose samples would have varied least.

A sample of light c drawn with density p is c^2 p / p_a of the second moment that the mixture with share a would have,
p_a = a p_bsdf + (1 - a) p_guide: its expectation is the integral of f^2 / p_a. A few shares are tried on the same
samples, and the one with the least sum is taken. Sums of earlier frames fade.

The same pass over the samples finds how far away the light comes from, which each region's anchor needs (parallax.py).
"""

import warp as wp

from warp_gi.kernels.octree import Octree, OctreeNodes, leaf_cell
from warp_gi.kernels.quadtree_adapt import LARGEST_CONTRIBUTION
from warp_gi.kernels.samples import SURFACE_GLOSSY, LeafSamples, SampleRecords, mixture_densities
from warp_gi.kernels.sampling import spread_place

wp.set_module_options({"enable_backward": False})

SHARES = 6
ShareMoments = wp.types.vector(length=SHARES, dtype=wp.float32)
FADING = wp.constant(wp.float32(0.8))  # share of what is known that stays from frame to frame
NEAREST_ANCHOR = wp.constant(wp.float32(0.5))  # largest radius of a cell over that of its anchor's sphere
CORRECTION = wp.constant(wp.float32(0.2))  # relative change of an anchor's nearness below which it stays


# Share number k of those that are tried. A direction that the quadtree hardly proposes has a weight of up to 1 / share.
@wp.func
def candidate_share(k: wp.int32) -> wp.float32:
    if k == 0:
        return 0.1
    if k == 1:
        return 0.2
    if k == 2:
        return 0.35
    if k == 3:
        return 0.5
    if k == 4:
        return 0.75
    return 0.97


# The share with the least second moment; `otherwise` where nothing is known.
@wp.func
def best_share(moments: ShareMoments, otherwise: wp.float32) -> wp.float32:
    best = float(otherwise)
    least = float(wp.inf)
    for k in range(SHARES):
        if moments[k] > 0.0 and moments[k] < least:
            least = moments[k]
            best = candidate_share(k)
    return best


@wp.struct
class GuideKnowledge:
    trees: wp.array(dtype=wp.vec4ui)  # [leaf] quadtree, up to 128 bits
    shares: wp.array(dtype=wp.vec2)  # [leaf] share of the BSDF, for rough and for glossy surfaces
    moments: wp.array(dtype=ShareMoments)  # [2 * leaf + is glossy] second moments by share
    anchors: wp.array(dtype=wp.vec4)  # [leaf] sphere that directions are seen from, see parallax.py
    nearness: wp.array(dtype=wp.vec2)  # [leaf] sums of light, and of light over the distance it came from
    energies: wp.array(dtype=wp.float32)  # [leaf * 4 * bits] QuadtreeAdaptation.energies


# Thread: a leaf. Takes over what the leaf of the previous tree knew; `first_tree` where there was none.
@wp.kernel
def take_over_guides(
    first: wp.int32,
    origins: wp.array(dtype=wp.int32),
    known: GuideKnowledge,
    guides: GuideKnowledge,
    first_tree: wp.vec4ui,
    first_share: wp.float32,
    octree: Octree,
    tree: OctreeNodes,
):
    leaf = first + wp.tid()
    origin = origins[leaf]
    size = guides.energies.shape[0] / guides.trees.shape[0]
    for i in range(size):
        energy = float(0.0)
        if origin >= 0:
            energy = known.energies[origin * size + i]
        guides.energies[leaf * size + i] = energy
    cell = leaf_cell(octree, tree, leaf)
    guides.anchors[leaf] = wp.vec4(cell[0], cell[1], cell[2], 0.0)
    guides.nearness[leaf] = wp.vec2(0.0, 0.0)
    if origin < 0:
        guides.trees[leaf] = first_tree
        guides.shares[leaf] = wp.vec2(first_share, first_share)
        guides.moments[2 * leaf] = ShareMoments()
        guides.moments[2 * leaf + 1] = ShareMoments()
        return
    nearness = wp.min(known.anchors[origin][3], NEAREST_ANCHOR / cell[3])
    guides.anchors[leaf] = wp.vec4(cell[0], cell[1], cell[2], nearness)
    guides.nearness[leaf] = known.nearness[origin]
    guides.trees[leaf] = known.trees[origin]
    guides.shares[leaf] = known.shares[origin]
    guides.moments[2 * leaf] = known.moments[2 * origin]
    guides.moments[2 * leaf + 1] = known.moments[2 * origin + 1]


# Thread: a leaf. Adds its samples to the moments of every share, chooses the best share, and moves the sphere of its
# anchor to where light comes from. Writes its own leaf's items of `guides`.
@wp.kernel
def adapt_shares(
    first: wp.int32,
    samples: LeafSamples,
    records: SampleRecords,
    guides: GuideKnowledge,
    octree: Octree,
    tree: OctreeNodes,
    first_share: wp.float32,
    adapts: wp.int32,
):
    leaf = first + wp.tid()
    count = samples.counts[leaf]
    if count == 0:
        return
    rough = guides.moments[2 * leaf] * FADING
    glossy = guides.moments[2 * leaf + 1] * FADING
    looks = wp.min(count, samples.most)
    nearness = guides.nearness[leaf] * FADING
    cell = leaf_cell(octree, tree, leaf)
    nearest = NEAREST_ANCHOR / cell[3]  # of each sample too: a corner is a millimetre away, and would outweigh the rest
    for k in range(looks):
        slot = samples.order[samples.starts[leaf] + spread_place(k, looks, count)]
        contribution = records.contributions[slot]
        if contribution > 0.0 and contribution < LARGEST_CONTRIBUTION:
            nearness = nearness + contribution * wp.vec2(1.0, wp.min(records.nearness[slot], nearest))
            densities = mixture_densities(records.mixtures[slot])
            square = contribution * contribution
            is_glossy = (records.lights[slot] & SURFACE_GLOSSY) != wp.uint32(0)
            for c in range(SHARES):
                a = candidate_share(c)
                moment = square / wp.max(a * densities[0] + (1.0 - a) * densities[1], 1.0e-6)
                if is_glossy:
                    glossy[c] = glossy[c] + moment
                else:
                    rough[c] = rough[c] + moment
    guides.moments[2 * leaf] = rough
    guides.moments[2 * leaf + 1] = glossy
    if adapts != 0:
        guides.shares[leaf] = wp.vec2(best_share(rough, first_share), best_share(glossy, first_share))
    guides.nearness[leaf] = nearness
    if nearness[0] > 0.0:
        anchor = guides.anchors[leaf]
        found = wp.min(nearness[1] / nearness[0], nearest)
        # small corrections would only unsettle the tree
        if wp.abs(found - anchor[3]) > CORRECTION * wp.max(found, anchor[3]):
            anchor[3] = found
            guides.anchors[leaf] = anchor
