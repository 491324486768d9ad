"""Directions by the quadtree of a point's region, mixed with those of the BSDF (temporal_reuse.txt, section 5.2).

A share of directions, which each region learns for itself, comes from the BSDF; the density is that of the mixture
(the balance heuristic for one sample). Rough and glossy surfaces of a region have a share each.
"""

import warp as wp

from warp_gi.kernels.bsdf import Bsdf, average_reflectance, bsdf_evaluate, bsdf_sample
from warp_gi.kernels.parallax import seen_from_anchor, seen_from_point
from warp_gi.kernels.path_samplers import DirectionSample, DirectionSampler
from warp_gi.kernels.quadtree import quadtree_pdf, quadtree_sample_leaf, quadtree_sample_warp
from warp_gi.kernels.samples import is_glossy
from warp_gi.kernels.sampling import GUIDE_DIMENSIONS, random_1d, sample_1d, sample_2d
from warp_gi.kernels.surface import Surface

wp.set_module_options({"enable_backward": False})


@wp.struct
class GuidedDirections:
    bits: wp.int32  # size of a quadtree: 32, 64, 96 or 128
    stratified: wp.int32  # 1: warp two numbers, 0: pick a leaf by a third (the paper's way)
    trees: wp.array(dtype=wp.vec4ui)  # [leaf] quadtree
    counts: wp.array(dtype=wp.uint32)  # [leaf * bits / 4] quadtree_counts
    anchors: wp.array(dtype=wp.vec4)  # [leaf] see parallax.py
    shares: wp.array(dtype=wp.vec2)  # [leaf] share of the BSDF, for rough and for glossy surfaces


@wp.func
def bsdf_share(data: GuidedDirections, region: wp.int32, b: Bsdf) -> wp.float32:
    shares = data.shares[region]
    if is_glossy(b):
        return shares[1]
    return shares[0]


# Density of a direction by the region's tree at a point, 1/sr.
@wp.func
def tree_pdf(data: GuidedDirections, region: wp.int32, s: Surface, wi: wp.vec3) -> wp.float32:
    seen = seen_from_anchor(data.anchors[region], s.position, wi)
    return quadtree_pdf(data.trees[region], data.bits, seen.direction) * seen.stretch


@wp.func
def guided_direction(
    data: GuidedDirections,
    region: wp.int32,
    s: Surface,
    wo: wp.vec3,
    index: wp.uint32,
    seed: wp.uint32,
    dimension: wp.int32,
) -> DirectionSample:
    r = DirectionSample()
    r.bsdf_share = bsdf_share(data, region, s.bsdf)
    u = sample_1d(index, seed, dimension)
    u2 = sample_2d(index, seed, dimension + 1)
    value = wp.vec3(0.0, 0.0, 0.0)
    guide_pdf = float(0.0)
    if u < r.bsdf_share:
        b = bsdf_sample(s.bsdf, wo, u / r.bsdf_share, u2)
        if b.pdf <= 0.0:
            return r
        r.wi = s.shading * b.wi
        r.bsdf_pdf = b.pdf
        value = b.weight * b.pdf
        guide_pdf = tree_pdf(data, region, s, r.wi)
    else:
        tree_direction = wp.vec3()
        if data.stratified != 0:
            q = quadtree_sample_warp(data.trees[region], data.bits, data.counts, region * (data.bits / 4), u2)
            tree_direction = q.direction
            guide_pdf = q.pdf
        else:
            u_leaf = random_1d(index, seed, dimension + GUIDE_DIMENSIONS)
            q = quadtree_sample_leaf(data.trees[region], data.bits, u_leaf, u2)
            tree_direction = q.direction
            guide_pdf = q.pdf
        seen = seen_from_point(data.anchors[region], s.position, tree_direction)
        r.wi = seen.direction
        guide_pdf = guide_pdf * seen.stretch
        f = bsdf_evaluate(s.bsdf, wo, wp.transpose(s.shading) * r.wi)
        if f.pdf <= 0.0:
            return r
        r.bsdf_pdf = f.pdf
        value = f.value
    r.pdf = r.bsdf_share * r.bsdf_pdf + (1.0 - r.bsdf_share) * guide_pdf
    r.weight = value / r.pdf
    r.reflected = average_reflectance(s.bsdf)
    if s.bsdf.f90 <= 0.0:  # f cos / colour is the pdf of the BSDF
        weight = r.bsdf_pdf / r.pdf
        r.weight = wp.vec3(weight, weight, weight)
        r.reflected = wp.vec3(1.0, 1.0, 1.0)
    return r


@wp.func
def guided_direction_pdf(
    data: GuidedDirections, region: wp.int32, s: Surface, wi: wp.vec3, bsdf_pdf: wp.float32
) -> wp.float32:
    share = bsdf_share(data, region, s.bsdf)
    return share * bsdf_pdf + (1.0 - share) * tree_pdf(data, region, s, wi)


GUIDED_DIRECTIONS = DirectionSampler(
    "guided", GuidedDirections, guided_direction, guided_direction_pdf, uses_regions=True
)
