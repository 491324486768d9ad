"""Adapting directional quadtrees to the light that arrives: leaves migrate to where most energy is.

Dittebrandt et al. 2020, section 5.1. Each leaf of an octree over the scene has a quadtree (``quadtree``) and a range
of records of the last frame: a direction, its density and what it contributed. Squared contributions are summed over
the quadtree's leaves, and while one leaf has more to gain from being split than all children of some inner node
together would lose by being given up, those children go and that leaf is split.

The paper compares sums of c^2. A sample of contribution c = f / p counts as c^2 p here, whose sum estimates the
integral of f^2 over a leaf however it was sampled, and with it sums of earlier frames, which fade, go on counting. All
leaves are equally likely, so the density in a leaf of area A is 1 / (n A), and the variance that it causes is
n A * integral of f^2: that product is what is evened out. (With sums of c^2 of one frame a rare bright sample drew all
migrations to where it was, and the tree forgot what it had found.)

Contributions are over the throughput of the path up to the vertex: it tells nothing about the light there, and varies.
Their directions are as seen from the region's anchor (parallax.py).
"""

import warp as wp

from warp_gi.kernels.octahedral import octahedral_decode, octahedral_encode
from warp_gi.kernels.octree import Octree, code_position
from warp_gi.kernels.parallax import seen_from_anchor
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
from warp_gi.kernels.sampling import spread_place

wp.set_module_options({"enable_backward": False})

LARGEST_CONTRIBUTION = wp.constant(wp.float32(1.0e15))  # samples beyond are left out: their squares would overflow
LARGEST_FLOAT = wp.constant(wp.float32(3.402823466e38))


@wp.struct
class QuadtreeSamples:
    starts: wp.array(dtype=wp.int32)  # [leaf] first of its records in `order`
    counts: wp.array(dtype=wp.int32)  # [leaf] number of its records
    order: wp.array(dtype=wp.int32)  # record indices
    codes: wp.array(dtype=wp.uint32)  # [record] octree code of the point's cell
    directions: wp.array(dtype=wp.uint32)  # [record] quadtree_pack_direction
    contributions: wp.array(dtype=wp.float32)  # [record] luminance; below 0: no sample
    pdfs: wp.array(dtype=wp.float32)  # [record] 1/sr


@wp.struct
class QuadtreeAdaptation:
    bits: wp.int32  # 32, 64, 96 or 128
    migrations: wp.int32  # largest number of leaves that move in a frame
    significance: wp.float32  # gain of a split times this must exceed the loss of a merge
    fading: wp.float32  # share that energies keep from frame to frame
    most_samples: wp.int32  # largest number of samples of a leaf; taken evenly from its range
    trees: wp.array(dtype=wp.vec4ui)  # [leaf] in and out
    counts: wp.array(dtype=wp.uint32)  # [leaf * bits / 4] out: quadtree_counts
    anchors: wp.array(dtype=wp.vec4)  # [leaf] see parallax.py
    octree: Octree
    energies: wp.array(dtype=wp.float32)  # [leaf * 4 * bits] in and out: squared light in each quadrant of each node


# Octahedral coordinates of a direction, 16 bits each, x in the low half.
@wp.func
def quadtree_pack_direction(direction: wp.vec3) -> wp.uint32:
    uv = octahedral_encode(direction)
    x = wp.uint32(wp.clamp(uv[0] * 65536.0, 0.0, 65535.0))
    y = wp.uint32(wp.clamp(uv[1] * 65536.0, 0.0, 65535.0))
    return x | (y << wp.uint32(16))


# Inverse of quadtree_pack_direction: the middle of what has the same code.
@wp.func
def quadtree_unpack_direction(code: wp.uint32) -> wp.vec3:
    x = (wp.float32(code & wp.uint32(0xFFFF)) + 0.5) / 65536.0
    y = (wp.float32(code >> wp.uint32(16)) + 0.5) / 65536.0
    return octahedral_decode(wp.vec2(x, y))


ENOUGH_SAMPLES = wp.constant(256)  # number of samples below which earlier frames fade less


# Density over the unit square of octahedral coordinates, of one over the sphere; see octahedral_density.
@wp.func
def square_density(code: wp.uint32, pdf: wp.float32) -> wp.float32:
    x = wp.abs(wp.float32(code & wp.uint32(0xFFFF)) / 32768.0 - 1.0)
    z = wp.abs(wp.float32(code >> wp.uint32(16)) / 32768.0 - 1.0)
    y = 1.0 - x - z
    if y < 0.0:  # folded out; the signs do not matter
        x += y
        z += y
    square = x * x + y * y + z * z
    return 4.0 * pdf / (square * wp.sqrt(square))


# Sums squared contributions over quadrants of quadtree leaves; returns whether there was any sample.
@wp.func
def add_energies(samples: QuadtreeSamples, adaptation: QuadtreeAdaptation, item: wp.int32, base: wp.int32) -> wp.int32:
    tree = adaptation.trees[item]
    count = samples.counts[item]
    taken = wp.min(count, adaptation.most_samples)
    found = int(0)
    weight = (1.0 - adaptation.fading) * wp.min(wp.float32(taken) / wp.float32(ENOUGH_SAMPLES), 1.0)
    for i in range(base, base + 4 * adaptation.bits):
        adaptation.energies[i] = adaptation.energies[i] * (1.0 - weight)
    weight = weight / wp.float32(taken)
    for i in range(taken):
        record = samples.order[samples.starts[item] + spread_place(i, taken, count)]
        contribution = samples.contributions[record]
        if contribution >= 0.0:
            found = 1
        if contribution > 0.0 and contribution < LARGEST_CONTRIBUTION:
            code = samples.directions[record]
            position = code_position(adaptation.octree, samples.codes[record])
            seen = seen_from_anchor(adaptation.anchors[item], position, quadtree_unpack_direction(code))
            if adaptation.anchors[item][3] > 0.0:
                code = quadtree_pack_direction(seen.direction)
            leaf = quadtree_descend(tree, code << wp.uint32(16), code >> wp.uint32(16) << wp.uint32(16))
            density = square_density(code, samples.pdfs[record] / seen.stretch)
            energy = weight * contribution * contribution * density
            adaptation.energies[base + 4 * (leaf & 255) + (leaf >> 16)] += energy
    return found


@wp.func
def sum_of_four(values: wp.array(dtype=wp.float32), i: wp.int32) -> wp.float32:
    return (values[i] + values[i + 1]) + (values[i + 2] + values[i + 3])


# End of the level that begins with node k: where the children of its first inner node begin.
@wp.func
def level_end(tree: wp.vec4ui, bits: wp.int32, k: wp.int32) -> wp.int32:
    return wp.min(quadtree_children(tree, k), bits)


# Energy of four leaves, of which `child` is the first.
@wp.func
def energy_of_children(energies: wp.array(dtype=wp.float32), base: wp.int32, child: wp.int32) -> wp.float32:
    i = base + 4 * child
    return (sum_of_four(energies, i) + sum_of_four(energies, i + 4)) + (
        sum_of_four(energies, i + 8) + sum_of_four(energies, i + 12)
    )


# A leaf, and the gain of splitting it.
@wp.struct
class Leaf:
    node: wp.int32  # -1: there is none
    gain: wp.float32


# The leaf whose split gains most, among those that may be split; the first of equals.
@wp.func
def brightest_leaf(tree: wp.vec4ui, bits: wp.int32, energies: wp.array(dtype=wp.float32), base: wp.int32) -> Leaf:
    best = Leaf()
    best.node = -1
    best.gain = -1.0
    area = float(1.0)
    end = int(0)
    for k in range(quadtree_level_start(tree, bits, QUADTREE_LEVELS)):
        if k == end:
            area = area * 0.25
            end = level_end(tree, bits, k)
        if quadtree_is_inner(tree, k) == 0:
            gain = area * sum_of_four(energies, base + 4 * k)
            if gain > best.gain:
                best.gain = gain
                best.node = k
    return best


# Inner node k whose four children, the first of which is `child`, are leaves, and the loss of merging them.
@wp.struct
class Twig:
    node: wp.int32  # -1: there is none
    loss: wp.float32


# The inner node whose merge loses least, among those with only leaves as children, `leaf` not among them.
@wp.func
def darkest_twig(
    tree: wp.vec4ui, bits: wp.int32, energies: wp.array(dtype=wp.float32), base: wp.int32, leaf: wp.int32
) -> Twig:
    best = Twig()
    best.node = -1
    best.loss = LARGEST_FLOAT
    area = float(1.0)
    end = int(0)
    child = int(4)  # first child of the next inner node
    for k in range(bits):
        if k == end:
            area = area * 0.25
            end = level_end(tree, bits, k)
        if quadtree_is_inner(tree, k) != 0:
            inner_children = (
                quadtree_is_inner(tree, child)
                + quadtree_is_inner(tree, child + 1)
                + quadtree_is_inner(tree, child + 2)
                + quadtree_is_inner(tree, child + 3)
            )
            if inner_children == 0 and child != (leaf & ~3):
                loss = area * energy_of_children(energies, base, child)
                if loss < best.loss:
                    best.loss = loss
                    best.node = k
            child += 4
    return best


# Moves energies to where quadtree_migrate moves nodes. A new leaf gets the energy that was known at its place.
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


# Thread: a leaf of the octree. Adapts its quadtree, and writes its own items of `trees`, `counts` and `energies`.
@wp.kernel
def adapt_quadtrees(first: wp.int32, samples: QuadtreeSamples, adaptation: QuadtreeAdaptation):
    item = first + wp.tid()
    bits = adaptation.bits
    base = 4 * bits * item
    if samples.counts[item] > 0 and add_energies(samples, adaptation, item, base) != 0:
        tree = adaptation.trees[item]
        for _i in range(adaptation.migrations):
            leaf = brightest_leaf(tree, bits, adaptation.energies, base)
            twig = darkest_twig(tree, bits, adaptation.energies, base, leaf.node)
            if leaf.node < 0 or twig.node < 0 or not leaf.gain * adaptation.significance > twig.loss:
                break
            removed = quadtree_children(tree, twig.node)
            inserted = quadtree_migrated_children(tree, leaf.node, twig.node)
            migrate_energies(adaptation.energies, base, leaf.node, twig.node, removed, inserted)
            tree = migrate_block(tree, leaf.node, twig.node, removed, inserted)
        adaptation.trees[item] = tree
    quadtree_counts(adaptation.trees[item], bits, adaptation.counts, (bits >> 2) * item)
