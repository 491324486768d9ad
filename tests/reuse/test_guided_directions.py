"""Directions by BSDF and quadtree together, and what regions learn for them: shares of each, and how far light is."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import warp as wp
from parallax_tools import has_parallax, seen_from_anchor
from scipy.stats import norm
from statistics_tools import (  # noqa: F401
    chi_squared,
    device,
    every_device,
    sphere_expectation,
    sphere_histogram,
)

from warp_gi.kernels import guided_directions, guided_shares, octree, quadtree, quadtree_adapt, samples
from warp_gi.kernels.bsdf import average_reflectance, bsdf_evaluate, make_bsdf
from warp_gi.kernels.path_samplers import sample_weight
from warp_gi.kernels.sampling import frame_of
from warp_gi.kernels.surface import Surface
from warp_gi.launch import launch, set_threads

wp.set_module_options({"enable_backward": False})

MATERIALS = {  # base colour, metallic, roughness, specular
    "lambert": ((0.8, 0.5, 0.2), 0.0, 1.0, 0.0),
    "coated": ((0.8, 0.5, 0.2), 0.0, 0.6, 1.0),
    "metal": ((0.9, 0.6, 0.3), 1.0, 0.5, 1.0),
    "glossy": ((0.9, 0.6, 0.3), 1.0, 0.4, 1.0),  # alpha 0.16, below GLOSSY_ALPHA
    "glossy_coat": ((0.3, 0.5, 0.7), 0.0, 0.4, 1.0),
}
GLOSSY = ("glossy", "glossy_coat")
NORMAL = np.array([0.48, 0.6, -0.64])
VIEW = np.array([0.7, 0.1, -0.5]) / np.linalg.norm([0.7, 0.1, -0.5])
POSITION = np.array([0.3, -0.2, 0.5])
AWAY = (0.0, 0.25, 0.6, 0.9, 1.3)  # of the regions' anchors from it over their spheres' radii; 0: there is no sphere
REGIONS = len(AWAY)


# ---- kernels ----


@wp.func
def surface_of(material: wp.array(dtype=wp.float32), position: wp.vec3, normal: wp.vec3) -> Surface:
    s = Surface()
    s.position = position
    s.normal = normal
    s.shading = frame_of(normal)
    s.bsdf = make_bsdf(wp.vec3(material[0], material[1], material[2]), material[3], material[4], material[5])
    return s


# Thread: a sample, of a sequence of its own. `vectors`: position, normal and direction of view, in rows.
@wp.kernel
def draw_directions(
    first: wp.int32,
    data: guided_directions.GuidedDirections,
    material: wp.array(dtype=wp.float32),
    vectors: wp.mat33,
    region: wp.int32,
    directions: wp.array(dtype=wp.vec3),
    values: wp.array2d(dtype=wp.float32),
):
    i = first + wp.tid()
    s = surface_of(material, vectors[0], vectors[1])
    view = vectors[2]
    wo = wp.transpose(s.shading) * view
    r = guided_directions.guided_direction(data, region, s, wo, wp.uint32(0), wp.uint32(2 * i + 1), 5)
    directions[i] = r.wi
    weight = sample_weight(s.bsdf, r.weight)
    reflected = sample_weight(s.bsdf, r.reflected)
    for k in range(3):
        values[i, k] = weight[k]
        values[i, 3 + k] = reflected[k]
    values[i, 6] = r.pdf
    values[i, 7] = r.bsdf_pdf
    values[i, 8] = r.bsdf_share


# Thread: a direction. What the mixture and its parts say of it: f cos (3), the BSDF's pdf, the tree's, the mixture's.
@wp.kernel
def evaluate_directions(
    first: wp.int32,
    data: guided_directions.GuidedDirections,
    material: wp.array(dtype=wp.float32),
    vectors: wp.mat33,
    region: wp.int32,
    directions: wp.array(dtype=wp.vec3),
    values: wp.array2d(dtype=wp.float32),
):
    i = first + wp.tid()
    s = surface_of(material, vectors[0], vectors[1])
    view = vectors[2]
    f = bsdf_evaluate(s.bsdf, wp.transpose(s.shading) * view, wp.transpose(s.shading) * directions[i])
    for k in range(3):
        values[i, k] = f.value[k]
    values[i, 3] = f.pdf
    values[i, 4] = guided_directions.tree_pdf(data, region, s, directions[i])
    values[i, 5] = guided_directions.guided_direction_pdf(data, region, s, directions[i], f.pdf)


# Thread: a direction. What a quadtree says of it, without an anchor.
@wp.kernel
def evaluate_tree(
    first: wp.int32,
    tree: wp.vec4ui,
    bits: wp.int32,
    directions: wp.array(dtype=wp.vec3),
    pdfs: wp.array(dtype=wp.float32),
):
    i = first + wp.tid()
    pdfs[i] = quadtree.quadtree_pdf(tree, bits, directions[i])


@wp.kernel
def ask_reflectance(first: wp.int32, material: wp.array(dtype=wp.float32), out: wp.array(dtype=wp.vec3)):
    s = surface_of(material, wp.vec3(), wp.vec3(0.0, 0.0, 1.0))
    out[first + wp.tid()] = average_reflectance(s.bsdf)


@wp.kernel
def list_candidates(first: wp.int32, shares: wp.array(dtype=wp.float32)):
    k = first + wp.tid()
    shares[k] = guided_shares.candidate_share(k)


@wp.kernel
def choose_shares(
    first: wp.int32,
    moments: wp.array(dtype=guided_shares.ShareMoments),
    otherwise: wp.float32,
    shares: wp.array(dtype=wp.float32),
):
    i = first + wp.tid()
    shares[i] = guided_shares.best_share(moments[i], otherwise)


# ---- the kernels on arrays ----


def on_device(values, dtype):
    return wp.array(values, dtype=dtype, device=device())


def empty(shape, dtype):
    return wp.zeros(shape, dtype=dtype, device=device())


def grown_tree(bits, rng, deepest=5):
    """Words of a tree that grew by splitting leaves, every second one towards a point."""
    tree, target = {(0, 0, 0)}, rng.random(2)
    leaves = [(1, x, y) for y in range(2) for x in range(2)]
    while len(tree) < bits // 4:
        near = [c for c in leaves if c[0] < deepest and c[1:] == tuple((target * 2 ** c[0]).astype(int))]
        cell = near[0] if near and rng.random() < 0.5 else leaves[rng.integers(len(leaves))]
        if cell[0] < deepest:
            leaves.remove(cell)
            tree.add(cell)
            level, x, y = cell
            leaves += [(level + 1, 2 * x + (q & 1), 2 * y + (q >> 1)) for q in range(4)]
    number, place, queue = 0, 0, [(0, 0, 0)]
    for level, x, y in queue:
        for q in range(4):
            child = (level + 1, 2 * x + (q & 1), 2 * y + (q >> 1))
            if child in tree:
                number |= 1 << place
                queue.append(child)
            place += 1
    return [number >> 32 * k & 0xFFFFFFFF for k in range(4)]


def anchors_of(rng):
    """Anchors float32 [region, 4] that are AWAY from POSITION."""
    radii = rng.uniform(0.5, 3, REGIONS)
    away = rng.standard_normal((REGIONS, 3))
    away *= (np.where(np.array(AWAY) > 0, AWAY, 0.5) * radii / np.linalg.norm(away, axis=1))[:, None]
    return np.column_stack([POSITION - away, np.where(np.array(AWAY) > 0, 1 / radii, 0)]).astype(np.float32)


def guides_of(bits=128, stratified=1, seed=1):
    """Random trees, shares and anchors, and the shares as an array [region, glossy]."""
    rng = np.random.default_rng([bits, seed])
    trees = np.array([grown_tree(bits, rng) for _ in range(REGIONS)], np.uint32)
    shares = rng.uniform(0.1, 0.9, (REGIONS, 2)).astype(np.float32)
    data = guided_directions.GuidedDirections()
    data.bits, data.stratified = bits, stratified
    data.trees, data.shares = on_device(trees, wp.vec4ui), on_device(shares, wp.vec2)
    data.anchors = on_device(anchors_of(rng), wp.vec4)
    # adapting to no samples writes the counts
    none, adaptation = quadtree_adapt.QuadtreeSamples(), quadtree_adapt.QuadtreeAdaptation()
    none.starts = none.counts = empty(REGIONS, wp.int32)
    adaptation.bits, adaptation.trees, adaptation.anchors = bits, data.trees, data.anchors
    adaptation.counts = data.counts = empty(REGIONS * bits // 4, wp.uint32)
    launch(quadtree_adapt.adapt_quadtrees, REGIONS, [none, adaptation], device())
    return data, shares


def parameters(name):
    base, *rest = MATERIALS[name]
    return on_device(np.array([*base, *rest], np.float32), wp.float32)


def situation(data, name, region):
    return [data, parameters(name), wp.mat33(*POSITION, *NORMAL, *VIEW), region]


class Drawn:
    """Samples of guided_direction."""

    def __init__(self, data, name, region, count):
        directions, values = empty(count, wp.vec3), empty((count, 9), wp.float32)
        launch(draw_directions, count, [*situation(data, name, region), directions, values], device())
        values = values.numpy()
        self.directions, self.weight, self.reflected = directions.numpy(), values[:, :3], values[:, 3:6]
        self.pdf, self.bsdf_pdf, self.share = values[:, 6:9].T
        self.kept = self.pdf > 0


def evaluated(data, name, region, directions):
    """f cos [i, 3] and pdfs of the BSDF, of the tree and of both."""
    values = empty((len(directions), 6), wp.float32)
    inputs = [*situation(data, name, region), on_device(np.asarray(directions, np.float32), wp.vec3), values]
    launch(evaluate_directions, len(directions), inputs, device())
    values = values.numpy()
    return values[:, :3], values[:, 3], values[:, 4], values[:, 5]


@cache
def candidates():
    shares = wp.zeros(guided_shares.SHARES, dtype=wp.float32, device="cpu")
    launch(list_candidates, guided_shares.SHARES, [shares], wp.get_device("cpu"))
    return shares.numpy().astype(np.float64)


# ---- directions ----


def test_anchors_are_where_they_should_be():
    anchors = guides_of()[0].anchors.numpy().astype(np.float64)
    assert has_parallax(anchors, POSITION).tolist() == [False, True, True, True, False]
    distances = np.linalg.norm(anchors[:, :3] - POSITION, axis=1) * anchors[:, 3]
    assert np.allclose(distances, AWAY, atol=1e-5)


@pytest.mark.parametrize("bits", [32, 128])
def test_a_tree_s_density_is_that_of_the_anchor(bits):
    """Against a ray that meets the anchor's sphere, in float64."""
    data, _ = guides_of(bits)
    directions = np.random.default_rng(bits).standard_normal((5000, 3))
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    for region, anchor in enumerate(data.anchors.numpy().astype(np.float64)):
        seen, stretch = seen_from_anchor(anchor, POSITION, directions)
        pdfs = empty(len(seen), wp.float32)
        tree = wp.vec4ui(*map(int, data.trees.numpy()[region]))
        launch(evaluate_tree, len(seen), [tree, bits, on_device(seen.astype(np.float32), wp.vec3), pdfs], device())
        got = evaluated(data, "lambert", region, directions)[2]
        # beside the border of a leaf, rounding may yield the neighbour's
        assert np.isclose(got, pdfs.numpy() * stretch, rtol=2e-4).mean() > 0.999
        parallax = np.abs(seen - directions).max()
        assert parallax > 0.2 if 0 < AWAY[region] < 0.95 else parallax == 0


@pytest.mark.parametrize("name", MATERIALS)
@pytest.mark.parametrize("bits", [32, 128])
def test_mixture_integrates_to_one(bits, name):
    data, shares = guides_of(bits)
    for region in range(REGIONS):

        def pdfs(directions, region=region):
            return np.stack(evaluated(data, name, region, directions)[1:], axis=-1)

        bsdf, tree, both = (sphere_expectation(lambda d, k=k: pdfs(d)[:, k], 1, 24, 24, 32).sum() for k in range(3))
        share = float(shares[region, int(name in GLOSSY)])  # rough and glossy surfaces have shares of their own
        # GGX loses what it reflects below the horizon; nothing else is lost
        assert np.isclose(bsdf, 1, atol=2e-3) if name == "lambert" else 0.8 < bsdf < 1.002
        assert np.isclose(tree, 1, atol=4e-3) and np.isclose(both, share * bsdf + 1 - share, atol=4e-3)
        directions = np.random.default_rng(region).standard_normal((2000, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        _, bsdf, tree, both = evaluated(data, name, region, directions)
        assert np.allclose(both, share * bsdf + (1 - share) * tree, rtol=1e-5)


@pytest.mark.parametrize("name", MATERIALS)
@pytest.mark.parametrize("bits, stratified", [(32, 1), (128, 0), (128, 1)])
def test_directions_follow_their_pdf(bits, stratified, name):
    """Directions below the horizon, and only they, are rejected."""
    count = 100_000
    data, shares = guides_of(bits, stratified, seed=2)
    for region in range(REGIONS):
        drawn = Drawn(data, name, region, count)

        def pdf(directions, region=region):
            _, bsdf, _, both = evaluated(data, name, region, directions)
            return np.where(bsdf > 0, both, 0)

        expected = sphere_expectation(pdf, count, 24, 24, 32)
        assert chi_squared(sphere_histogram(drawn.directions[drawn.kept], 24, 24), expected, count) > 1e-4
        assert (drawn.share == shares[region, int(name in GLOSSY)]).all()
        assert not drawn.weight[~drawn.kept].any() and not drawn.reflected[~drawn.kept].any()
        assert (drawn.directions[drawn.kept] @ NORMAL > 0).all()


@pytest.mark.parametrize("name", MATERIALS)
@pytest.mark.parametrize("stratified", [0, 1])
def test_samples_say_what_evaluation_says(stratified, name):
    """pdf is guided_direction_pdf of the direction; weight is f cos / pdf; so its mean is the albedo."""
    count = 100_000
    data, _ = guides_of(64, stratified, seed=3)
    # the albedo by numbers of another kind
    area = sphere_expectation(lambda d: evaluated(data, name, 1, d)[0][:, 0], 1, 24, 24, 40).sum()
    for region in range(REGIONS):
        drawn = Drawn(data, name, region, count)
        kept = drawn.kept
        assert np.abs(np.linalg.norm(drawn.directions[kept], axis=1) - 1).max() < 1e-6
        value, bsdf, _, both = evaluated(data, name, region, drawn.directions[kept])
        # beside the border of a leaf, the tree's pdf may be that of the neighbour, by rounding
        near = np.isclose(drawn.pdf[kept], both, rtol=5e-4)
        assert near.mean() > 0.9995
        assert np.allclose(drawn.bsdf_pdf[kept], bsdf, rtol=5e-4)
        assert np.allclose(drawn.weight[kept] * drawn.pdf[kept, None], value, rtol=1e-3, atol=1e-7)
        red = drawn.weight[:, 0].astype(np.float64)
        z = (red.mean() - area) / np.hypot(red.std() / np.sqrt(count), 1e-3 * area)
        assert 2 * norm.sf(abs(z)) > 1e-4


@pytest.mark.parametrize("name", MATERIALS)
def test_roulette_gets_what_the_bsdf_reflects(name):
    """Not the weight, which is low wherever light was expected."""
    data, _ = guides_of(128)
    drawn = Drawn(data, name, 2, 1000)
    out = empty(1, wp.vec3)
    launch(ask_reflectance, 1, [parameters(name), out], device())
    assert np.allclose(drawn.reflected[drawn.kept], out.numpy(), rtol=1e-6)
    if name == "lambert":
        assert np.allclose(out.numpy(), MATERIALS[name][0])


# ---- shares ----


def words_of(posterior, share):
    """SampleRecords.mixtures."""
    low, high = ((np.asarray(x) * 65535 + 0.5).astype(np.uint32) for x in (posterior, share))
    return low | high << 16


class Records:
    """Samples of `leaves` leaves, in no order."""

    def __init__(self, rng, lengths):
        n = int(np.sum(lengths))
        self.lengths, self.order = np.asarray(lengths, np.int32), rng.permutation(n).astype(np.int32)
        self.starts = np.cumsum(self.lengths) - self.lengths
        self.contributions = np.where(rng.random(n) < 0.3, rng.choice([-1, 0], n), rng.exponential(size=n))
        self.contributions = self.contributions.astype(np.float32)
        # what would be best differs from leaf to leaf, and between rough and glossy
        self.glossy = rng.random(n) < 0.5
        leaf = np.empty(n, int)
        leaf[self.order] = np.repeat(np.arange(len(lengths)), lengths)
        power = rng.choice([0.05, 0.3, 1, 3, 20], (len(lengths), 2))[leaf, self.glossy.astype(int)]
        self.mixtures = words_of(rng.random(n) ** power, rng.uniform(0.1, 0.97, n))
        # of each leaf light comes from another distance, or from the sky
        nearness = rng.choice([0, 0.1, 0.3, 1, 3], len(lengths))[leaf] * rng.uniform(0.5, 2, n)
        self.nearness = np.where(rng.random(n) < 0.3, 0, nearness).astype(np.float32)

    def slots(self, leaf, most):
        count = int(self.lengths[leaf])
        looks = min(count, most)
        return self.order[self.starts[leaf] + np.arange(looks) * count // max(looks, 1)]

    def moments(self, leaf, most):
        """Second moments [glossy, candidate] in float64."""
        out = np.zeros((2, len(candidates())))
        for slot in self.slots(leaf, most):
            c = float(self.contributions[slot])
            if c > 0:
                share, posterior = (int(self.mixtures[slot]) >> 16) / 65535, (int(self.mixtures[slot]) & 0xFFFF) / 65535
                bsdf, guide = posterior / share, (1 - posterior) / (1 - share)
                out[int(self.glossy[slot])] += c**2 / (candidates() * bsdf + (1 - candidates()) * guide)
        return out

    def light(self, leaf, most, nearest):
        """Sums of light, and of light over the distance that it came from (at least 1 / ``nearest``), in float64."""
        out = np.zeros(2)
        for slot in self.slots(leaf, most):
            c = float(self.contributions[slot])
            if c > 0:
                out += c, c * min(float(self.nearness[slot]), nearest)
        return out

    def on_device(self, most):
        grouped, records = samples.LeafSamples(), samples.SampleRecords()
        grouped.starts, grouped.counts = on_device(self.starts, wp.int32), on_device(self.lengths, wp.int32)
        grouped.order, grouped.most = on_device(self.order, wp.int32), most
        records.contributions = on_device(self.contributions, wp.float32)
        records.mixtures = on_device(self.mixtures, wp.uint32)
        records.nearness = on_device(self.nearness, wp.float32)
        # flags beside the light, all of which may be set
        lights = np.random.default_rng(1).integers(0, 1 << 28, len(self.order), dtype=np.uint32) | np.uint32(3 << 30)
        records.lights = on_device(lights | self.glossy.astype(np.uint32) << 29, wp.uint32)
        return grouped, records


LOW, SCALE = np.array([-3.0, 1.0, 10.0]), 100.0  # corner of the octree's cube, its finest cells per metre


def cells_of(leaves, seed=1):
    """An octree's cells, of any size and anywhere, and middle and half of the diagonal of those of leaves [leaf, 4]."""
    nodes = -(-leaves // 8)
    rng = np.random.default_rng(seed)
    cube, tree = octree.Octree(), octree.OctreeNodes()
    cube.low, cube.scale = wp.vec3(*LOW), SCALE
    levels = rng.integers(0, 10, nodes).astype(np.int32)  # the root's is 0
    edges = 512 >> levels  # of a node's children, finest cells
    corners = rng.integers(0, 1 << levels[:, None], (nodes, 3)) * 2 * edges[:, None]
    prefixes = sum((corners[:, axis] >> bit & 1) << (3 * bit + axis) for bit in range(10) for axis in range(3))
    tree.levels, tree.prefixes = on_device(levels, wp.int32), on_device(prefixes.astype(np.uint32), wp.uint32)
    octants = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)])
    middles = corners[:, None] + (octants + 0.5) * edges[:, None, None]
    diagonals = np.repeat(edges * np.sqrt(3) / 2, 8)[:, None]
    cells = np.concatenate([middles.reshape(-1, 3) / SCALE + LOW, diagonals / SCALE], axis=1)[:leaves]
    return cube, tree, cells


def knowledge(moments, shares, trees=None, energies=None, anchors=None, nearness=None):
    guides = guided_shares.GuideKnowledge()
    leaves = len(shares)
    anchors = np.zeros((leaves, 4)) if anchors is None else anchors
    nearness = np.zeros((leaves, 2)) if nearness is None else nearness
    guides.anchors = on_device(np.asarray(anchors, np.float32), wp.vec4)
    guides.nearness = on_device(np.asarray(nearness, np.float32), wp.vec2)
    trees = np.zeros((leaves, 4), np.uint32) if trees is None else trees
    energies = np.zeros((leaves, 0), np.float32) if energies is None else energies
    guides.trees, guides.shares = on_device(trees, wp.vec4ui), on_device(shares, wp.vec2)
    guides.moments = on_device(
        np.asarray(moments, np.float32).reshape(-1, guided_shares.SHARES), guided_shares.ShareMoments
    )
    guides.energies = on_device(energies.ravel(), wp.float32)
    return guides


def guides_after(records, most, guides, first_share=0.5, adapts=1):
    """What is known after a frame: the same, and cells [leaf, 4]."""
    leaves = len(guides.shares)
    cube, tree, cells = cells_of(leaves)
    inputs = [*records.on_device(most), guides, cube, tree, first_share, adapts]
    launch(guided_shares.adapt_shares, leaves, inputs, device(), 1)
    return guides, cells


def learnt(records, most, moments, shares, first_share=0.5):
    """Moments [leaf, glossy, candidate] and shares [leaf, glossy] after a frame."""
    guides, _ = guides_after(records, most, knowledge(moments, shares), first_share)
    return guides.moments.numpy().reshape(len(shares), 2, -1), guides.shares.numpy()


def test_candidates():
    assert len(candidates()) == guided_shares.SHARES == len(np.unique(candidates()))
    assert (np.diff(candidates()) > 0).all()
    assert np.allclose(candidates()[[0, -1]], [0.1, 0.97])


def test_best_share():
    moments = np.full((9, guided_shares.SHARES), 2.0)
    moments[np.arange(6), np.arange(6)] = 1.0
    moments[6] = 0  # nothing is known
    moments[8] = [0, 3, 2, 2, 3, 3]  # 0 is nothing known too; the first of equals
    shares = empty(len(moments), wp.float32)
    inputs = [on_device(moments.astype(np.float32), guided_shares.ShareMoments), 0.42, shares]
    launch(choose_shares, len(moments), inputs, device())
    assert np.allclose(shares.numpy(), [*candidates(), 0.42, candidates()[0], candidates()[2]])


@pytest.mark.parametrize("most", [50, 1 << 30])
def test_shares_are_those_of_least_moment(most):
    """Over five frames, against NumPy in float64; rough and glossy apart; an empty leaf keeps what it knows."""
    leaves = 60
    rng = np.random.default_rng(1)
    moments, shares = np.zeros((leaves, 2, guided_shares.SHARES)), rng.uniform(0.3, 0.6, (leaves, 2)).astype(np.float32)
    expected = moments.copy()
    met = set()
    for _ in range(5):
        lengths = rng.integers(0, 200, leaves)
        lengths[rng.random(leaves) < 0.2] = 0
        records, before = Records(rng, lengths), shares
        moments, shares = learnt(records, most, moments, shares)
        for leaf in np.nonzero(lengths)[0]:
            expected[leaf] = float(guided_shares.FADING) * expected[leaf] + records.moments(leaf, most)
        assert np.allclose(moments, expected, rtol=1e-4)
        best = candidates()[np.argmin(expected, axis=2)]
        best = np.where(expected.any(axis=2), best, 0.5)
        least = np.sort(expected, axis=2)
        clear = (least[..., 1] > least[..., 0] * (1 + 1e-3)) | ~expected.any(axis=2)
        assert clear.mean() > 0.95
        used = lengths > 0
        assert np.allclose(shares[used][clear[used]], best[used][clear[used]])
        assert np.array_equal(shares[~used], before[~used])
        met |= set(np.round(best[used].ravel(), 3))
    assert len(met) >= 5  # also the largest and the smallest
    assert {round(candidates()[0], 3), round(candidates()[-1], 3)} <= met


def test_rough_and_glossy_samples_learn_apart():
    rng = np.random.default_rng(2)
    both = Records(rng, [4000])
    both.mixtures = words_of(np.where(both.glossy, 0.99, 0.01), np.full(4000, 0.5))
    both.contributions[:] = 1
    _, shares = learnt(both, 1 << 30, np.zeros((1, 2, guided_shares.SHARES)), np.full((1, 2), 0.5, np.float32))
    # light came from where the tree looks, or where the BSDF does
    assert np.allclose(shares[0], [candidates()[0], candidates()[-1]])
    for glossy in (False, True):
        both.glossy[:] = glossy
        moments, shares = learnt(
            both, 1 << 30, np.zeros((1, 2, guided_shares.SHARES)), np.full((1, 2), 0.4, np.float32), 0.37
        )
        assert not moments[0, 1 - int(glossy)].any() and np.isclose(shares[0, 1 - int(glossy)], 0.37)


def test_moments_are_those_of_other_shares():
    """What samples of one mixture say of the second moment under another share is its integral, on a line:
    BSDF 2 x, guide 2 (1 - x), light x^2."""
    n, share = 200_000, 0.5
    rng = np.random.default_rng(3)
    x = np.sqrt(rng.random(n))
    x = np.where(rng.random(n) < share, x, 1 - x)
    mixed = share * 2 * x + (1 - share) * 2 * (1 - x)
    records = Records(rng, [n])
    records.glossy[:] = False
    records.contributions = (x**2 / mixed).astype(np.float32)
    records.mixtures = words_of(share * 2 * x / mixed, np.full(n, share))
    moments, shares = learnt(records, 1 << 30, np.zeros((1, 2, guided_shares.SHARES)), np.full((1, 2), 0.5, np.float32))
    nodes, weights = np.polynomial.legendre.leggauss(400)
    t = (nodes + 1) / 2
    integrals = [(weights / 2 * t**4 / (a * 2 * t + (1 - a) * 2 * (1 - t))).sum() for a in candidates()]
    assert np.allclose(moments[0, 0] / n, integrals, rtol=0.01)
    assert np.isclose(shares[0, 0], candidates()[np.argmin(integrals)])


NEAREST_ANCHOR, CORRECTION = 0.5, 0.2


@pytest.mark.parametrize("adapts", [0, 1])
@pytest.mark.parametrize("most", [50, 1 << 30])
def test_the_sphere_is_where_light_comes_from(most, adapts):
    """Over eight frames, against NumPy in float64: one over its radius is the mean of that over distances, weighted by
    light, but what is nearer than two radii of the cell counts as that far; small corrections are left out, and so is
    an empty leaf."""
    leaves = 60
    rng = np.random.default_rng(6)
    guides = knowledge(np.zeros((leaves, 2, guided_shares.SHARES)), np.full((leaves, 2), 0.3, np.float32))
    anchors, sums = np.zeros((leaves, 4)), np.zeros((leaves, 2))
    guides.anchors = on_device(rng.random((leaves, 4)).astype(np.float32) * [1, 1, 1, 0], wp.vec4)
    anchors[:] = guides.anchors.numpy()
    clamped = kept = moved = 0
    for _ in range(8):
        lengths = rng.integers(0, 40, leaves)
        lengths[rng.random(leaves) < 0.2] = 0
        records, before = Records(rng, lengths), anchors.copy()
        guides, cells = guides_after(records, most, guides, adapts=adapts)
        for leaf in np.nonzero(lengths)[0]:
            nearest = NEAREST_ANCHOR / cells[leaf, 3]
            sums[leaf] = 0.8 * sums[leaf] + records.light(leaf, most, nearest)
            clamped += (records.light(leaf, most, np.inf) > records.light(leaf, most, nearest)).any()
            if sums[leaf, 0] > 0:
                found = sums[leaf, 1] / sums[leaf, 0]
                change = abs(found - anchors[leaf, 3]) / max(found, anchors[leaf, 3], 1e-30)
                assert abs(change - CORRECTION) > 1e-5, "a correction that depends on rounding"
                if change > CORRECTION:
                    anchors[leaf, 3] = found
                kept += 0 < change < CORRECTION
        moved += (anchors != before).sum()
        assert np.allclose(guides.nearness.numpy(), sums, rtol=1e-5)
        assert np.allclose(guides.anchors.numpy(), anchors, rtol=1e-5)
    assert min(clamped, kept, moved) > 20
    assert (np.ptp(guides.shares.numpy()) > 0) == bool(adapts)


def test_nearness_is_weighted_by_light():
    """Much light from 2 m away, little from 0.1 m, none from 0.01 m."""
    rng = np.random.default_rng(7)
    records = Records(rng, [0, 0, 300])
    distances = rng.choice([2.0, 0.1, 0.01], 300, p=[0.3, 0.3, 0.4])
    records.nearness = (1 / distances).astype(np.float32)
    records.contributions = np.select([distances == 2, distances == 0.1], [5.0, 0.01], 0.0).astype(np.float32)
    empty_handed = np.zeros((3, 2, guided_shares.SHARES)), np.full((3, 2), 0.5, np.float32)
    guides, cells = guides_after(records, 1 << 30, knowledge(*empty_handed))
    near, far = (distances == 0.1).sum() * 0.01, (distances == 2).sum() * 5.0
    nearest = NEAREST_ANCHOR / cells[2, 3]
    found = (0.5 * far + min(10, nearest) * near) / (far + near)
    assert 0.5 < found < 0.55 and nearest > found
    assert np.isclose(guides.anchors.numpy()[2, 3], found, rtol=1e-5)
    assert not guides.anchors.numpy()[:2].any()


def test_guides_are_taken_over():
    rng = np.random.default_rng(4)
    bits, size = 32, 4 * 32
    anchors = np.column_stack([rng.uniform(-5, 5, (7, 3)), [0, 0.01, 0.1, 1, 10, 0.1, 1]])
    known = (
        rng.random((7, 2, guided_shares.SHARES)).astype(np.float32),
        rng.random((7, 2)).astype(np.float32),
        rng.integers(0, 1 << 32, (7, 4), dtype=np.uint32),
        rng.random((7, size)).astype(np.float32),
        anchors.astype(np.float32),
        rng.random((7, 2)).astype(np.float32),
    )
    origins = np.array([3, -1, 0, 6, 6, -1, 2, 3, 5, 4, -1, 1, 4, 1], np.int32)
    n = len(origins)
    junk = (np.full((n, 2, guided_shares.SHARES), 9.0), np.full((n, 2), 9, np.float32), np.full((n, 4), 9, np.uint32))
    guides = knowledge(*junk, np.full((n, size), 9, np.float32), np.full((n, 4), 9), np.full((n, 2), 9))
    tree = quadtree.quadtree_uniform(bits)
    cube, nodes, cells = cells_of(n, seed=2)
    inputs = [on_device(origins, wp.int32), knowledge(*known), guides, wp.vec4ui(*tree), 0.35, cube, nodes]
    launch(guided_shares.take_over_guides, n, inputs, device(), 1)
    new = origins < 0
    first = (0, 0.35, np.array(tree, np.uint32), 0, 0)
    got = [
        guides.moments.numpy().reshape(n, 2, guided_shares.SHARES),
        guides.shares.numpy(),
        guides.trees.numpy(),
        guides.energies.numpy().reshape(n, size),
        guides.nearness.numpy(),
    ]
    for values, before, otherwise in zip(got, (*known[:4], known[5]), first, strict=True):
        assert np.array_equal(values[~new], before[origins[~new]])
        assert np.allclose(values[new], otherwise)
    # anchors move to the middle of the new cell, and spheres are as large as before, or as its size demands
    found, most = guides.anchors.numpy(), NEAREST_ANCHOR / cells[:, 3]
    before = np.where(new, 0, anchors[origins, 3])
    assert np.allclose(found[:, :3], cells[:, :3], atol=1e-4)
    assert np.allclose(found[:, 3], np.minimum(before, most), rtol=1e-6)
    assert (before > most).any() and ((before > 0) & (before < most)).any()


def test_shares_do_not_depend_on_threads():
    rng = np.random.default_rng(5)
    records = Records(rng, rng.integers(0, 100, 200))
    start = np.zeros((200, 2, guided_shares.SHARES)), np.full((200, 2), 0.5, np.float32)
    results = []
    try:
        for threads in (1, 2, 3):
            set_threads(threads)
            results.append(learnt(records, 1 << 30, *start))
    finally:
        set_threads(None)
    assert len(np.unique(results[0][1])) > 3
    for result in results[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(result, results[0], strict=True))
