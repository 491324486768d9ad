"""Adapting directional quadtrees to the light that arrives: leaves migrate to where most energy is.

Dittebrandt et al. 2020, section 5.1. Each leaf of an octree over the scene has a quadtree (``quadtree``) and a range
of records of the last frame: a direction and what it contributed. Squared contributions are summed over the
quadtree's leaves, and while one leaf has by far more than all children of some inner node together, those children
are given up and that leaf is split.
"""

import warp as wp

from warp_gi.kernels.octahedral import octahedral_encode
from warp_gi.kernels.quadtree import (
    QUADTREE_LEVELS,
    migrate_block,
    quadtree_children,
    quadtree_counts,
    quadtree_descend,
    quadtree_is_inner,
    quadtree_level_start,
    quadtree_migrated_children,
)

wp.set_module_options({"enable_backward": False})

LARGEST_FLOAT = wp.constant(wp.float32(3.402823466e38))


@wp.struct
class QuadtreeSamples:
    starts: wp.array(dtype=wp.int32)  # [leaf] first of its records in `order`
    counts: wp.array(dtype=wp.int32)  # [leaf] how many
    order: wp.array(dtype=wp.int32)  # record indices
    directions: wp.array(dtype=wp.uint32)  # [record] quadtree_pack_direction
    contributions: wp.array(dtype=wp.float32)  # [record] below 0: no sample


@wp.struct
class QuadtreeAdaptation:
    bits: wp.int32  # 32, 64, 96 or 128
    migrations: wp.int32  # most a frame
    significance: wp.float32  # a leaf's energy times this must exceed that of the children given up
    most_samples: wp.int32  # a leaf; taken evenly from its range
    trees: wp.array(dtype=wp.vec4ui)  # [leaf] in and out
    counts: wp.array(dtype=wp.uint32)  # [leaf * bits / 4] out: quadtree_counts
    energies: wp.array(dtype=wp.float32)  # [leaf * 4 * bits] scratch: of each quadrant of each node


# Octahedral coordinates of a direction, 16 bits each, x in the low half.
@wp.func
def quadtree_pack_direction(direction: wp.vec3) -> wp.uint32:
    uv = octahedral_encode(direction)
    x = wp.uint32(wp.clamp(uv[0] * 65536.0, 0.0, 65535.0))
    y = wp.uint32(wp.clamp(uv[1] * 65536.0, 0.0, 65535.0))
    return x | (y << wp.uint32(16))


# Sums squared contributions over quadrants of quadtree leaves; returns whether there was any sample.
@wp.func
def add_energies(samples: QuadtreeSamples, adaptation: QuadtreeAdaptation, item: wp.int32, base: wp.int32) -> wp.int32:
    tree = adaptation.trees[item]
    count = samples.counts[item]
    taken = wp.min(count, adaptation.most_samples)
    found = int(0)
    for i in range(taken):
        place = i
        if taken < count:
            place = wp.int32(wp.int64(i) * wp.int64(count) / wp.int64(taken))
        record = samples.order[samples.starts[item] + place]
        contribution = samples.contributions[record]
        if contribution >= 0.0:
            code = samples.directions[record]
            leaf = quadtree_descend(tree, code << wp.uint32(16), code >> wp.uint32(16) << wp.uint32(16))
            adaptation.energies[base + 4 * (leaf & 255) + (leaf >> 16)] += contribution * contribution
            found = 1
    return found


@wp.func
def sum_of_four(values: wp.array(dtype=wp.float32), i: wp.int32) -> wp.float32:
    return (values[i] + values[i + 1]) + (values[i + 2] + values[i + 3])


# Energy of four leaves, of which `child` is the first.
@wp.func
def energy_of_children(energies: wp.array(dtype=wp.float32), base: wp.int32, child: wp.int32) -> wp.float32:
    i = base + 4 * child
    return (sum_of_four(energies, i) + sum_of_four(energies, i + 4)) + (
        sum_of_four(energies, i + 8) + sum_of_four(energies, i + 12)
    )


# The leaf of most energy among those that may be split, or -1; the first of equals.
@wp.func
def brightest_leaf(tree: wp.vec4ui, bits: wp.int32, energies: wp.array(dtype=wp.float32), base: wp.int32) -> wp.int32:
    best = int(-1)
    most = float(-1.0)
    for k in range(quadtree_level_start(tree, bits, QUADTREE_LEVELS)):
        energy = sum_of_four(energies, base + 4 * k)
        if quadtree_is_inner(tree, k) == 0 and energy > most:
            most = energy
            best = k
    return best


# The inner node with only leaves as children, but not `leaf`, whose children have least energy, or -1.
@wp.func
def darkest_twig(
    tree: wp.vec4ui, bits: wp.int32, energies: wp.array(dtype=wp.float32), base: wp.int32, leaf: wp.int32
) -> wp.int32:
    best = int(-1)
    least = float(LARGEST_FLOAT)
    child = int(4)  # first child of the next inner node
    for k in range(bits):
        if quadtree_is_inner(tree, k) != 0:
            inner_children = (
                quadtree_is_inner(tree, child)
                + quadtree_is_inner(tree, child + 1)
                + quadtree_is_inner(tree, child + 2)
                + quadtree_is_inner(tree, child + 3)
            )
            if inner_children == 0 and child != (leaf & ~3):
                energy = energy_of_children(energies, base, child)
                if energy < least:
                    least = energy
                    best = k
            child += 4
    return best


# Moves energies to where quadtree_migrate moves nodes. A new leaf has what was there, as fine as it is known.
@wp.func
def migrate_energies(
    energies: wp.array(dtype=wp.float32),
    base: wp.int32,
    leaf: wp.int32,
    inner: wp.int32,
    removed: wp.int32,
    inserted: wp.int32,
):
    split = wp.vec4()
    merged = wp.vec4()
    for q in range(4):
        split[q] = energies[base + 4 * leaf + q]
        merged[q] = sum_of_four(energies, base + 4 * (removed + q))
    for q in range(4):
        energies[base + 4 * inner + q] = merged[q]
    if inserted >= removed:
        for i in range(base + 4 * removed, base + 4 * inserted):
            energies[i] = energies[i + 16]
    else:
        for i in range(base + 4 * removed - 1, base + 4 * inserted - 1, -1):
            energies[i + 16] = energies[i]
    for i in range(16):
        energies[base + 4 * inserted + i] = 0.25 * split[i >> 2]


# A thread is a leaf of the octree, and adapts its quadtree.
@wp.kernel
def adapt_quadtrees(first: wp.int32, samples: QuadtreeSamples, adaptation: QuadtreeAdaptation):
    item = first + wp.tid()
    bits = adaptation.bits
    base = 4 * bits * item
    if samples.counts[item] > 0:
        for i in range(4 * bits):
            adaptation.energies[base + i] = 0.0
        if add_energies(samples, adaptation, item, base) != 0:
            tree = adaptation.trees[item]
            for _i in range(adaptation.migrations):
                leaf = brightest_leaf(tree, bits, adaptation.energies, base)
                inner = darkest_twig(tree, bits, adaptation.energies, base, leaf)
                if leaf < 0 or inner < 0:
                    break
                energy = sum_of_four(adaptation.energies, base + 4 * leaf)
                removed = quadtree_children(tree, inner)
                if not energy * adaptation.significance > energy_of_children(adaptation.energies, base, removed):
                    break
                inserted = quadtree_migrated_children(tree, leaf, inner)
                migrate_energies(adaptation.energies, base, leaf, inner, removed, inserted)
                tree = migrate_block(tree, leaf, inner, removed, inserted)
            adaptation.trees[item] = tree
    quadtree_counts(adaptation.trees[item], bits, adaptation.counts, (bits >> 2) * item)
