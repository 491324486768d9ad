"""Pictures of what sample reuse knows: pixels against the leaves' data, light against closed forms, and mistakes."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from parallax_tools import seen_from_anchor
from PIL import Image
from scene_tools import quad
from statistics_tools import device, every_device  # noqa: F401

import warp_gi as gi
from warp_gi.cli import main as cli
from warp_gi.errors import OptionError
from warp_gi.launch import set_threads
from warp_gi.sequence.preview import magma
from warp_gi.techniques.light_field.ray import probe_color
from warp_gi.techniques.reuse import pictures
from warp_gi.techniques.shared.octahedral import decode

SIZE = (24, 16)
PIXEL = (12, 12)
SKY_PIXEL = (12, 0)
BLACK = gi.Material("black", (0.0, 0.0, 0.0), specular=0.0)
WALL = gi.Material("wall", (0.5, 0.5, 0.5), specular=0.0)
OCTREE = gi.SampleOctree(split=96, collapse=48)


def yard(moves=False):
    """A floor between two walls, with six lamps over it, of which a screen hides some from each point."""
    keys = [gi.Keyframe(0.0), gi.Keyframe(1.0, (0.5, 0.0, 0.0))] if moves else None
    glow = gi.Material("glow", (0.0, 0.0, 0.0), emission=(8.0, 7.0, 6.0))
    lamps = [quad((-1.7 + 0.6 * i, 1.5, -0.5), (0.2, 0, 0), (0, 0, 0.2), glow) for i in range(6)]
    walls = [
        quad((-2, 0, 2), (4, 0, 0), (0, 0, -4)),
        quad((-2, 0, -2), (4, 0, 0), (0, 1.6, 0)),
        quad((-2, 0, 2), (0, 0, -4), (0, 1.6, 0)),
        quad((0.1, 0.4, -2), (0, 0, 4), (0, 1.4, 0)),
    ]
    return gi.Scene([gi.Node("walls", walls), gi.Node("lamps", lamps, keyframes=keys)], environment=0.2)


def view(size=SIZE):
    return gi.Camera.look_at((-1.2, 1.3, 2.6), (0.1, 0.5, -1.0), hfov=70, resolution=size)


def learnt(scene=None, frames=4, camera=None, **settings):
    """Return a scheduler that has rendered some frames, and the last of them; its camera rays go through middles."""
    settings = {"emitters": gi.VisibilityLightCache(), "indirect": gi.GuidedPaths(max_depth=4), **settings}
    pipeline = gi.Pipeline(**{"spp": 8, "camera_samples": 1, "octree": OCTREE, **settings})
    scheduler = gi.FrameScheduler(scene or yard(), camera or view(), pipeline, device().alias, seed=3)
    for index in range(frames):
        frame = scheduler.frame(index)
    return scheduler, frame


@cache
def usual(name):
    """Return a scheduler and its frame, of the device of that name; its shares differ from leaf to leaf."""
    scheduler, frame = learnt()
    shares = scheduler.state("indirect").guides.shares
    shares.assign(np.random.default_rng(1).random((len(shares), 2)).astype(np.float32))
    return scheduler, frame


@pytest.fixture
def scheduler():
    return usual(device().alias)[0]


@pytest.fixture
def frame():
    return usual(device().alias)[1]


def read(path):
    return np.asarray(Image.open(path))


def leaf_of(tree, position):
    """Return the leaf of a point, found by halving boxes."""
    nodes = tree.nodes.numpy()
    low, edge, node = np.array(tree.low, np.float64), 1024 / tree.scale, 0
    while True:
        edge /= 2
        upper = position >= low + edge
        octant = int(upper @ (1, 2, 4))
        low = low + edge * upper
        mask = int(nodes[node]) & 255
        if mask >> octant & 1:
            return 8 * node + octant
        node = (int(nodes[node]) >> 8) + sum(not mask >> k & 1 for k in range(octant))


def leaves_of(scheduler, frame):
    """Return the leaf of each pixel, -1 for none, from the positions of the frame itself."""
    tree = scheduler.state("octree").octree
    positions, there = frame.numpy("position").astype(np.float64), np.isfinite(frame.numpy("depth"))
    leaves = [leaf_of(tree, p) if t else -1 for p, t in zip(positions.reshape(-1, 3), there.ravel(), strict=True)]
    return np.array(leaves).reshape(there.shape)


# ---- values on surfaces ----


@pytest.fixture
def scales(monkeypatch):
    """Return what legends say: (top, title) of each scale, and titles of keys."""
    told = []
    scale_bar, with_keys = pictures.scale_bar, pictures.with_keys
    monkeypatch.setattr(
        pictures, "scale_bar", lambda w, top, title: told.append((top, title)) or scale_bar(w, top, title)
    )
    monkeypatch.setattr(pictures, "with_keys", lambda *a: told.append(a[1:]) or with_keys(*a))
    return told


def scale_of(told, words):
    (found,) = [(top, title) for top, title in told if isinstance(top, int | float) and words in title]
    return found


def test_leaves_have_colours_of_their_own(scheduler, frame, tmp_path, scales):
    gi.reuse_pictures(scheduler, frame, tmp_path)
    leaves = leaves_of(scheduler, frame)
    assert 20 < len(np.unique(leaves)) and (leaves < 0).any()
    image = read(tmp_path / "leaves.png")[: SIZE[1], : SIZE[0]]
    assert (image[leaves < 0] == pictures.NOTHING_COLOR).all()
    normals = frame.numpy("normal")
    shades = {}
    for leaf, color, normal in zip(leaves.ravel(), image.reshape(-1, 3), normals.reshape(-1, 3), strict=True):
        if leaf >= 0:
            shade = color / np.array(probe_color(int(leaf)))
            assert np.ptp(shade) < 0.02 and 0.55 < shade.mean() < 1.01, (leaf, shade)
            shades.setdefault(tuple(np.round(normal, 3)), []).append(shade.mean())
    means = [np.mean(x) for x in shades.values()]
    assert max(np.ptp(x) for x in shades.values()) < 0.02 and np.ptp(means) > 0.1 and len(means) >= 3
    (title,) = [told[1] for told in scales if len(told) == 2 and "leaves" in str(told[1])]
    masks = scheduler.state("octree").octree.nodes.numpy() & 255
    count = sum(int(mask).bit_count() for mask in masks)
    total = int((scheduler.state("octree").spare.records.codes.numpy() != 0xFFFFFFFF).sum())
    seen = len(np.unique(leaves[leaves >= 0]))
    assert title == f"{count:,} leaves, {seen} of them in view, {total:,} samples of frame 3"


def test_heat_is_what_leaves_hold(scheduler, frame, tmp_path, scales):
    paths = gi.reuse_pictures(scheduler, frame, tmp_path)
    assert [path.name for path in paths] == [
        f"{name}.png" for name in ("leaves", "samples", "lights", "exploration", "bsdf_share")
    ]
    assert sorted(tmp_path.iterdir()) == sorted(paths)
    leaves = leaves_of(scheduler, frame)
    counts = np.zeros(8 * len(scheduler.state("octree").octree.nodes), int)
    low, codes = scheduler.state("octree"), scheduler.state("octree").spare.records.codes.numpy()
    for code in codes[codes != 0xFFFFFFFF]:
        at = [sum((int(code) >> (3 * bit + axis) & 1) << bit for bit in range(10)) for axis in range(3)]
        counts[leaf_of(low.octree, np.array(low.octree.low) + (np.array(at) + 0.5) / low.octree.scale)] += 1
    cache = scheduler.state("emitters")
    lights = cache.known.counts.numpy()  # far fewer than fit into buckets
    assert 1 <= lights[np.unique(leaves[leaves >= 0])].max() <= 12
    shown = {
        "samples": ("samples a leaf, frame 3", counts, None),
        "lights": ("lights in the cache", lights, None),
        "exploration": ("explore", cache.tables.exploration.numpy(), 1.0),
        "bsdf_share": ("BSDF", scheduler.state("indirect").guides.shares.numpy()[:, 0], 1.0),
    }
    for name, (words, values, wanted) in shown.items():
        here = values[leaves[leaves >= 0]]
        top, title = scale_of(scales, words)
        assert top == (here.max() if wanted is None else wanted), name
        assert title.endswith(f": {here.min():.4g} to {here.max():.4g} in view"), title
        assert len(np.unique(here)) > 1, name
        image = read(tmp_path / f"{name}.png")[: SIZE[1], : SIZE[0]]
        np.testing.assert_array_equal(image[leaves >= 0], magma((here / top)[None])[0], name)
        assert (image[leaves < 0] == pictures.NOTHING_COLOR).all()


def test_only_what_the_pipeline_has(tmp_path):
    common = ["leaves.png", "samples.png"]
    scene = yard()
    for name, settings, more in (
        ("cache", {"indirect": gi.BsdfPaths(max_depth=3)}, ["lights.png", "exploration.png"]),
        ("guides", {"emitters": gi.PowerLights()}, ["bsdf_share.png"]),
    ):
        paths = gi.reuse_pictures(*learnt(scene, 1, **settings), tmp_path / name)
        assert [path.name for path in paths] == common + more
    dark = gi.Scene([gi.Node("floor", [quad((-2, 0, 2), (4, 0, 0), (0, 0, -4))])], environment=1.0)
    paths = gi.reuse_pictures(*learnt(dark, 1), tmp_path / "dark", PIXEL)
    assert [path.name for path in paths] == [*common, "bsdf_share.png", "quadtree.png"]


# ---- a quadtree ----


def texel_directions(size):
    at = (np.arange(size) + 0.5) / size
    return decode(np.stack(np.meshgrid(at, at), axis=-1))


def met(origin, corner, u, v):
    """Return the share of each texel from which a parallelogram is seen, of many points all over it."""
    steps = np.linspace(0, 1, 9)
    at = (np.arange(pictures.MAP_TEXELS)[:, None] + np.clip(steps, 1e-4, 1 - 1e-4)) / pictures.MAP_TEXELS
    directions = decode(np.stack(np.meshgrid(at.ravel(), at.ravel()), axis=-1))
    normal = np.cross(u, v)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = ((corner - origin) @ normal) / (directions @ normal)
        at = origin + t[..., None] * directions - corner
        a, b = (at @ np.asarray(x) / np.dot(x, x) for x in (u, v))
    hits = (t > 0) & (np.minimum(a, b) > 0) & (np.maximum(a, b) < 1)
    return hits.reshape(pictures.MAP_TEXELS, 9, pictures.MAP_TEXELS, 9).mean((1, 3))


def wall_scene(environment=None, lamp=False):
    """A black floor before a wall that a distant light shines on."""
    parts = [
        quad((-9, 0, 9), (18, 0, 0), (0, 0, -18), BLACK),
        quad((-2, 0.5, -2), (4, 0, 0), (0, 3, 0), WALL),
    ]
    if lamp:  # shines at the floor, away from the wall
        glow = gi.Material("glow", (0.0, 0.0, 0.0), specular=0.0, emission=(50.0, 50.0, 50.0))
        parts.append(quad((-1, 3, -2), (2, 0, 0), (0, 0.0, 3), glow))
    sun = gi.PunctualLight("directional", (3.0, 5.0, 7.0), direction=(0.0, -0.6, -0.8))
    return gi.Scene([gi.Node("all", parts)], [sun], environment=environment)


def camera_above():
    return gi.Camera.look_at((0.0, 2.0, 3.0), (0.1, 0.0, 0.2), hfov=60, resolution=(9, 9))


@pytest.mark.parametrize("sky", [None, 0.25])
@pytest.mark.parametrize("sees_sky", [True, False])
def test_light_of_one_bright_wall(sky, sees_sky):
    """The wall reflects albedo / pi of what the sun and the sky send it; the floor sends nothing."""
    settings = {} if sees_sky else {"environment": None}
    scheduler, frame = learnt(wall_scene(sky), 1, camera_above(), **settings)
    origin, up = np.array([0.1, 0.0, 0.2]), np.array([0.0, 1.0, 0.0])
    light = pictures.incident_light(scheduler, frame, origin + 1e-4 * up, up)
    directions = texel_directions(pictures.MAP_TEXELS)
    share = met(origin, np.array([-2, 0.5, -2.0]), (4.0, 0, 0), (0, 3.0, 0))
    inside, outside = share == 1, (share == 0) & (directions[..., 1] > 0.1)
    assert inside.sum() > 100 and outside.sum() > 1000
    sun = float(np.array([3.0, 5.0, 7.0]) @ (0.2126, 0.7152, 0.0722)) * 0.8
    irradiance = sun + (sky or 0.0) * math.pi / 2  # the black floor hides half of the sky
    assert light[inside].mean() == pytest.approx(0.5 * irradiance / math.pi, rel=0.02)
    assert np.abs(light[inside] / light[inside].mean() - 1).max() < (0.1 if sky else 1e-4)
    above = (sky or 0.0) if sees_sky else 0.0
    np.testing.assert_allclose(light[outside], above, rtol=1e-5)
    assert (light[directions[..., 1] < -0.05] == 0).all()


def test_light_of_a_white_box_is_all_its_bounces():
    """Walls that emit 1 and reflect 0.8 send 0.8 + 0.64 + ... = 4 besides what they emit; roulette ends the paths."""
    glow = gi.Material("glow", (0.8, 0.8, 0.8), specular=0.0, emission=(1.0, 1.0, 1.0))
    corners = [
        [(-1, -1, -1), *edges] for edges in (((2, 0, 0), (0, 2, 0)), ((0, 2, 0), (0, 0, 2)), ((0, 0, 2), (2, 0, 0)))
    ]
    corners += [[(1, 1, 1), *(tuple(-x for x in edge) for edge in edges)] for _, *edges in corners]
    box = gi.Scene([gi.Node("box", [quad(*corner, glow) for corner in corners])])
    inside = gi.Camera.look_at((0.0, 0.5, 0.5), (0.1, -1.0, 0.2), hfov=60, resolution=(9, 9))
    scheduler, frame = learnt(box, 1, inside, indirect=gi.GuidedPaths())
    up = np.array([0.0, 1.0, 0.0])
    light = pictures.incident_light(scheduler, frame, np.array([0.1, -0.999, 0.2]), up)
    above = texel_directions(pictures.MAP_TEXELS)[..., 1] > 0.1
    assert light[above].mean() == pytest.approx(4.0, rel=0.02)


def test_what_comes_straight_from_emitters_is_left_out():
    scheduler, frame = learnt(wall_scene(lamp=True), 1, camera_above())
    origin, up = np.array([0.1, 0.0, 0.2]), np.array([0.0, 1.0, 0.0])
    light = pictures.incident_light(scheduler, frame, origin + 1e-4 * up, up)
    seen = met(origin, np.array([-1, 3, -2.0]), (2.0, 0, 0), (0, 0, 3.0)) == 1
    assert seen.sum() > 50 and (light[seen] == 0).all() and light.max() > 0.5
    # the sun on the wall, at a point that paths of two edges do not get to
    shallow = learnt(wall_scene(), 1, camera_above(), indirect=gi.GuidedPaths(max_depth=2))
    assert (pictures.incident_light(*shallow, origin + 1e-4 * up, up) == 0).all()


def cells_of(words, bits):
    """Return column, row and size of the leaves of a quadtree, by a walk down its bits in breadth-first order."""
    tree = sum(int(word) << (32 * k) for k, word in enumerate(words))
    inner, leaves, node = [(0.0, 0.0, 1.0)], [], 0
    for x, y, size in inner:  # grows
        for q in range(4):
            cell = (x + size / 2 * (q & 1), y + size / 2 * (q >> 1), size / 2)
            is_inner = node < bits and tree >> node & 1
            (inner if is_inner else leaves).append(cell)
            node += 1
    return leaves


def node_map(cells, directions):
    """Return which of the cells of a quadtree each direction [n, 3] is in."""
    q = directions / np.abs(directions).sum(-1, keepdims=True)
    x, z = q[:, 0], q[:, 2]
    fold = (q[:, 1] < 0)[:, None]
    sides = np.where(np.stack([x, z], -1) < 0, -1, 1)
    uv = (np.where(fold, sides * (1 - np.abs(np.stack([z, x], -1))), np.stack([x, z], -1)) + 1) / 2
    found = np.full(len(uv), -1)
    for k, (x, y, edge) in enumerate(cells):
        found[((uv >= (x, y)) & (uv < (x + edge, y + edge))).all(-1)] = k
    return found


def borders(nodes):
    """Return which pixels have another node to the left or above."""
    border = np.zeros(nodes.shape, bool)
    border[:, 1:] |= nodes[:, 1:] != nodes[:, :-1]
    border[1:] |= nodes[1:] != nodes[:-1]
    return border


def quadtree_map(scheduler, leaf, position):
    """Return density [1/sr] and number of the cell, by pixel, of a leaf's quadtree as a point sees it, in float64."""
    guides = scheduler.state("indirect").guides
    cells = cells_of(guides.trees.numpy()[leaf], 128)
    assert len(cells) == 97
    directions = texel_directions(pictures.MAP_PIXELS).reshape(-1, 3)
    seen, stretch = seen_from_anchor(guides.anchors.numpy()[leaf].astype(np.float64), position, directions)
    nodes = node_map(cells, seen)
    edges = np.array([edge for *_, edge in cells])
    # a map of side 1 seen from its octahedron: dw = 4 du dv / |p|^3 for p = d / (|x| + |y| + |z|)
    densities = stretch / (97 * edges[nodes] ** 2) / (4 * np.abs(seen).sum(-1) ** 3)
    return densities.reshape(2 * [pictures.MAP_PIXELS]), nodes.reshape(2 * [pictures.MAP_PIXELS])


def test_quadtree_beside_the_light(scheduler, frame, tmp_path):
    gi.reuse_pictures(scheduler, frame, tmp_path, PIXEL)
    image = read(tmp_path / "quadtree.png")
    size, gap = pictures.MAP_PIXELS, pictures.GAP
    leaf = leaves_of(scheduler, frame)[PIXEL[1], PIXEL[0]]
    position, normal = frame.numpy("position")[PIXEL[1], PIXEL[0]], frame.numpy("normal")[PIXEL[1], PIXEL[0]]
    expected, nodes = quadtree_map(scheduler, leaf, position.astype(np.float64))
    anchor = scheduler.state("indirect").guides.anchors.numpy()[leaf]
    assert 0.02 < np.linalg.norm(position - anchor[:3]) * anchor[3] < 0.8  # it sees other directions than its anchor
    densities, found = pictures.quadtree_densities(scheduler, leaf, position)
    same = np.isclose(densities, expected, rtol=1e-4)
    assert same.mean() > 0.999  # rounding, beside borders
    # the same cells, whatever their numbers
    pairs, counts = np.unique(np.stack([found.ravel(), nodes.ravel()], -1), axis=0, return_counts=True)
    assert len(np.unique(pairs[counts > 50][:, 0])) == (counts > 50).sum() > 80
    # pixels are small beside cells, so their mean is an integral
    lengths = 1 / np.abs(texel_directions(size)).sum(-1)
    assert np.mean(densities * 4 / lengths**3) == pytest.approx(1.0, rel=2e-3)
    border = borders(nodes)
    right = image[:size, 2 * (size + gap) : 3 * size + 2 * gap]
    marked = (right == pictures.BORDER_COLOR).all(-1)
    assert (marked == border).mean() > 0.999
    light = pictures.incident_light(scheduler, frame, position + 1e-5 * normal, normal)
    coarse = texel_directions(pictures.MAP_TEXELS)
    assert (light[coarse @ normal < -0.1] == 0).all() and (light[coarse @ normal > 0.1] > 0).mean() > 0.9
    angles = 4 / pictures.MAP_TEXELS**2 * np.abs(coarse).sum(-1) ** 3
    cosines = np.maximum(coarse @ normal, 0)
    true, best = light / (light * angles).sum(), light * cosines / (light * cosines * angles).sum()
    top = 10 ** math.ceil(math.log10(max(expected.max(), true.max(), best.max())))

    def heat(values):
        return magma((np.log10(np.maximum(values, 1e-3)) + 3) / (math.log10(top) + 3)).astype(int)

    plain = ~border & ~marked & same
    assert np.abs(right[plain] - heat(expected)[plain]).max() <= 1
    step = size // pictures.MAP_TEXELS
    for k, values in enumerate((true, best)):
        panel = image[:size, k * (size + gap) : k * (size + gap) + size]
        assert (
            panel.reshape(64, step, 64, step, 3) == panel[::step, None, ::step, None].reshape(64, 1, 64, 1, 3)
        ).all()
        differs = np.abs(panel[::step, ::step] - heat(values)).max(-1) > 3
        assert differs.mean() < 0.03, k  # the origin is not quite the same, which turns some paths
        assert len(np.unique(panel.reshape(-1, 3), axis=0)) > 50


def test_the_map_does_not_depend_on_the_picture_s_size(tmp_path):
    scene = yard()
    shapes = {
        read(gi.reuse_pictures(*learnt(scene, 1, view(size)), tmp_path, (2, 7))[-1]).shape
        for size in ((9, 9), (30, 20))
    }
    assert len(shapes) == 1


def test_same_files_from_any_number_of_threads(scheduler, frame, tmp_path):
    files = []
    for threads in (1, 3):
        set_threads(threads)
        try:
            paths = gi.reuse_pictures(scheduler, frame, tmp_path / str(threads), PIXEL)
        finally:
            set_threads(None)
        files.append([path.read_bytes() for path in paths])
    assert len(files[0]) == 6 and files[0] == files[1]


# ---- mistakes, and the command ----


def test_mistakes_in_python(scheduler, frame, tmp_path):
    plain = gi.FrameScheduler(yard(), view(), gi.Pipeline(spp=1), device().alias)
    for which, pixel, words in (
        ((plain, plain.frame(0)), None, "learns"),
        ((scheduler, frame), (24, 0), r"pixel \(24, 0\) is outside of the picture of 24 x 16 pixels"),
        ((scheduler, frame), (0, -1), "outside"),
        ((scheduler, frame), (1.5, 2), "whole numbers"),
        ((scheduler, frame), SKY_PIXEL, r"pixel \(12, 0\) sees no surface"),
        (learnt(frames=1, indirect=gi.BsdfPaths()), PIXEL, "needs GuidedPaths for the indirect light, not BsdfPaths"),
        (learnt(yard(True), frames=1), SKY_PIXEL, "sees no surface"),
    ):
        with pytest.raises(OptionError, match=words):
            gi.reuse_pictures(*which, tmp_path, pixel)
    assert list(tmp_path.iterdir()) == []


VIEW = [
    "cornell_box",
    "--resolution=18x12",
    "--spp=2",
    "--eye",
    "0",
    "1",
    "3.4",
    "--target",
    "0",
    "1",
    "0",
    "--hfov=50",
]
REUSE = ["--pipeline=reuse", "--reuse-pictures=pictures"]


@pytest.mark.parametrize(
    "more, words",
    [
        (["--pipeline=path", "--reuse-pictures=pictures"], "no estimator of this pipeline learns"),
        (["--pipeline=reuse", "--reuse-pixel", "1", "1"], "--reuse-pixel goes with --reuse-pictures"),
        ([*REUSE, "--reuse-pixel", "18", "1"], "pixel (18, 1) is outside of the picture of 18 x 12 pixels"),
        ([*REUSE, "--reuse-pixel", "9", "6", "--target", "0", "1", "9"], "pixel (9, 6) sees no surface"),
        ([*REUSE, "--pipeline=reuse,indirect=BsdfPaths", "--reuse-pixel", "9", "6"], "needs GuidedPaths"),
        (["--pipeline=reuse", "--reuse-pictures=/dev/null/a"], "/dev/null"),
    ],
)
def test_mistakes_are_one_line_before_any_frame(more, words, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["render", *VIEW, *more, "--quiet", "-o", "a.exr"]) == 2
    error = capfd.readouterr().err
    assert error.startswith("warp-gi: error: ") and error.count("\n") == 1 and words in error
    assert list(tmp_path.iterdir()) == []


def test_the_command_writes_pictures_of_the_last_frame(capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ["render", *VIEW, *REUSE, "--reuse-pixel", "9", "9", "--frames=0-2", "-o", "a.####.exr"]
    assert cli.main(command) == 0
    assert "pictures: pictures\n" in capfd.readouterr().out
    camera = gi.CameraPath.still(gi.Camera.look_at((0, 1, 3.4), (0, 1, 0), hfov=50, resolution=(18, 12)))
    scheduler = gi.FrameScheduler(gi.builtin_scene("cornell_box"), camera, gi.Pipeline.preset("reuse", spp=2), seed=1)
    for index in range(3):
        frame = scheduler.frame(index)
    paths = gi.reuse_pictures(scheduler, frame, "own", (9, 9))
    assert {path.name for path in (tmp_path / "pictures").iterdir()} == {path.name for path in paths}
    for path in paths:
        assert path.read_bytes() == (tmp_path / "pictures" / path.name).read_bytes(), path.name
    assert cli.main([*command, "--resume"]) == 2
    assert "all are there already" in capfd.readouterr().err
