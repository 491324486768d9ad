"""RadianceTransfer in a pipeline: terms that share a bake, skies that change, paths that end in it, what moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import statistics_tools as st
from scene_tools import quad, sphere
from truth_tools import sky_nodes, sky_of

import warp_gi as gi
from warp_gi import launch
from warp_gi.bench.harness.court import court, court_camera
from warp_gi.techniques.radiance_transfer.sky import radiance_range

BAKE = {"resolution": 96, "rays": 256, "first_rays": 64}
DIRECT = gi.RadianceTransfer(**BAKE)
INDIRECT = replace(DIRECT, term="indirect")
GREY = gi.Material("grey", (0.6, 0.5, 0.4), specular=0.0)
RED = gi.Material("red", (0.7, 0.1, 0.1), specular=0.0)


def corner(sky: object = None, *more: gi.Node) -> gi.Scene:
    """Return a floor, a red wall and a ball."""
    meshes = [
        quad((-1, 0, 1), (2, 0, 0), (0, 0, -2), GREY, "floor"),
        quad((-1, 0, -1), (2, 0, 0), (0, 1, 0), RED, "wall"),
        sphere((0.4, 0.3, 0.2), 0.3, GREY, rows=8),
    ]
    return gi.Scene([gi.Node("corner", meshes), *more], environment=sky, name="corner")


def view(resolution: tuple[int, int] = (48, 32)) -> gi.Camera:
    return gi.Camera.look_at((0.5, 1.2, 2.2), (0.0, 0.25, -0.2), hfov=50, resolution=resolution)


def slope(directions: np.ndarray) -> np.ndarray:
    """Return a smooth sky: bright above and to one side, red there."""
    x, y, z = directions.T
    return np.stack([1.2 + 0.8 * y + 0.5 * x, 1.0 + 0.8 * y - 0.2 * x * z, 1.0 + 0.6 * y * y], axis=-1)


def pipeline(**settings: object) -> gi.Pipeline:
    return gi.Pipeline.preset("transfer", **{"environment": DIRECT, "indirect": INDIRECT, "spp": 4, **settings})


def rendered(scene: gi.Scene, used: gi.Pipeline, **more: object) -> gi.Frame:
    return next(gi.render(scene, view(), used, device=st.device().alias, **more))


def test_it_agrees_with_paths_under_a_smooth_sky():
    scene = corner(sky_of(slope))
    frame, truth = rendered(scene, pipeline()), rendered(scene, gi.Pipeline(spp=1024))
    hit = truth.numpy("object_id") >= 0
    for term, bound in (("environment", 0.03), ("indirect", 0.12)):
        mine, known = frame.numpy(term)[hit], truth.numpy(term)[hit]
        assert mine.mean() == pytest.approx(known.mean(), rel=0.02), term
        assert np.sqrt(((mine - known) ** 2).mean()) / known.mean() < bound, term


def test_a_turned_sky_is_the_sky_of_a_turned_map():
    """The bake is the same; the picture under a turned sky is that of its own map's, and others differ."""
    bake = gi.bake(corner(), DIRECT, st.device().alias)
    sky = sky_of(slope)
    angle = np.radians(70.0)
    turned = sky_of(
        lambda d: slope(
            d @ np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        )
    )
    one = rendered(corner(sky.rotated(70.0)), pipeline(), bakes=[bake]).numpy("beauty")
    other = rendered(corner(turned), pipeline(), bakes=[bake]).numpy("beauty")
    still = rendered(corner(sky), pipeline(), bakes=[bake]).numpy("beauty")
    hit = rendered(corner(sky), pipeline(), bakes=[bake]).numpy("object_id") >= 0
    np.testing.assert_allclose(one[hit], other[hit], rtol=2e-3)
    assert abs(one - still)[hit].mean() > 0.01 * still[hit].mean()


def test_terms_with_other_bakes_are_refused():
    with pytest.raises(gi.OptionError, match="resolution 64 for indirect and 96 for environment: make them"):
        gi.FrameScheduler(corner(1.0), view(), pipeline(indirect=replace(INDIRECT, resolution=64)))


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"term": "emitters"}, "unknown term 'emitters'"),
        ({"order": 4}, "order must be 5 or 6, got 4"),
        ({"rays": 16}, r"rays must be at least first_rays \(128\), got 16"),
        ({"resolution": 8}, "resolution must be a whole number from 16 to 16384, got 8"),
        ({"sun": float("nan")}, "sun must be a finite number that is not negative, got nan"),
        ({"storage": "voxels"}, "unknown storage 'voxels'"),
        ({"storage": 3}, "unknown storage 3"),
        ({"texel_sets": "toy"}, 'texel_sets must be "auto", "one", or "NAME=FACTOR,..."'),
        ({"texel_sets": "toy=2,toy=3"}, "texel_sets names 'toy' twice"),
        ({"texel_sets": {"toy": 2}}, "texel_sets must be text"),
        ({"sun": "bright"}, "sun must be a finite number that is not negative, got 'bright'"),
        ({"chart_seconds": None}, "chart_seconds must be a finite number that is not negative, got None"),
    ],
)
def test_settings_out_of_range(settings, told):
    with pytest.raises(gi.OptionError, match=told):
        gi.RadianceTransfer(**settings)


def test_threads_saving_and_one_launch_change_no_bit(tmp_path, monkeypatch):
    scene = corner(sky_of(slope))
    used = pipeline(emitters=None)
    bake = gi.bake(scene, DIRECT, st.device().alias)
    first = rendered(scene, used, bakes=[bake])
    loaded = gi.Bake.load(bake.save(tmp_path / "a.safetensors"))
    again = rendered(scene, used, bakes=[loaded])
    monkeypatch.setattr(launch, "thread_count", lambda: 1)
    alone = rendered(scene, used)
    apart = [rendered(scene, replace(used, **{term: None}), bakes=[bake]) for term in ("environment", "indirect")]
    for name in ("environment", "indirect", "beauty", "variance"):
        assert (first.numpy(name) == again.numpy(name)).all() and (first.numpy(name) == alone.numpy(name)).all(), name
    assert (apart[1].numpy("environment") == first.numpy("environment")).all()
    assert (apart[0].numpy("indirect") == first.numpy("indirect")).all()


def test_one_bake_serves_both_terms_in_one_piece_of_memory():
    scheduler = gi.FrameScheduler(corner(1.0), view(), pipeline(), st.device().alias)
    assert scheduler.state("environment").rows is scheduler.state("indirect").rows
    assert pipeline().dependence(corner(1.0)).kind == "independent"


def test_paths_end_in_it():
    """A traced first bounce that ends in the textures has the light of long paths, and less noise."""
    scene, camera = court(sky_of(slope)), court_camera((48, 32))
    ends = gi.Pipeline(environment=None, emitters=None, indirect=gi.BsdfPaths(ends_in=DIRECT), spp=16)
    plain = replace(ends, indirect=gi.BsdfPaths())
    truth = next(gi.render(scene, camera, replace(plain, spp=2048), device=st.device().alias)).numpy("indirect")
    errors = {}
    for name, used in (("ends", ends), ("plain", plain)):
        picture = next(gi.render(scene, camera, used, device=st.device().alias)).numpy("indirect")
        assert picture.mean() == pytest.approx(truth.mean(), rel=0.03), name
        errors[name] = ((picture - truth) ** 2).mean()
    assert errors["ends"] < 0.92 * errors["plain"], errors


@pytest.mark.parametrize("term", ["environment", "indirect"])
def test_a_term_and_the_cache_of_another_go_together(term):
    """The cache stands for no term, whatever its own is; the sky's term is as without it."""
    scene = corner(1.0)
    bake = gi.bake(scene, DIRECT, st.device().alias)
    cached = gi.BsdfPaths(ends_in=replace(DIRECT, term=term))
    both = rendered(scene, gi.Pipeline(environment=DIRECT, emitters=None, indirect=cached), bakes=[bake])
    alone = rendered(scene, gi.Pipeline(environment=DIRECT, emitters=None, indirect=None), bakes=[bake])
    paths = rendered(scene, gi.Pipeline(environment=None, emitters=None, indirect=cached), bakes=[bake])
    assert alone.numpy("environment").mean() > 0.1
    np.testing.assert_allclose(both.numpy("environment"), alone.numpy("environment"), rtol=1e-6)
    np.testing.assert_array_equal(both.numpy("indirect"), paths.numpy("indirect"))


def flying(sky: object) -> gi.Scene:
    """Return the corner with a card above it that moves."""
    card = gi.Node("card", [quad((-0.4, 0, 0.4), (0.8, 0, 0), (0, 0, -0.8), RED, "card")])
    scene = corner(sky, card)
    scene.animate("card", [gi.Keyframe(0.0, (0, 0.8, 0)), gi.Keyframe(1.0, (0, 0.8, 0.4))])
    return scene


def test_what_moves_receives_light():
    """Its own light is path traced; it is not in the bake, and a warning says so."""
    scene = flying(sky_of(slope))
    with pytest.warns(UserWarning, match="knows nothing of what moves: 'card'"):
        frame = rendered(scene, pipeline(spp=256))
    truth = rendered(scene, gi.Pipeline(spp=4096))
    card = (truth.numpy("object_id") == 1) & (frame.numpy("object_id") == 1)
    assert card.sum() > 20
    for term, bound in (
        ("environment", 0.02),
        ("indirect", 0.08),
    ):  # its paths end in textures, which are 5 % too bright here
        assert frame.numpy(term)[card].mean() == pytest.approx(truth.numpy(term)[card].mean(), rel=bound), term


@pytest.mark.parametrize("roughness", [0.1, 0.4])
def test_sharp_lobes_are_traced(roughness):
    """By rays, so without bias in direct light; what rays meet is lit by the textures."""
    shiny = gi.Material("shiny", (0.9, 0.8, 0.7), metallic=1.0, roughness=roughness)
    mirror = gi.Node("mirror", [quad((-0.9, 0.02, 0.9), (0.8, 0, 0), (0, 0, -0.8), shiny, "mirror")])
    scene = corner(sky_of(slope), mirror)
    frame, truth = rendered(scene, pipeline(spp=256)), rendered(scene, gi.Pipeline(spp=2048))
    seen = (truth.numpy("object_id") == 1) & (frame.numpy("object_id") == 1)
    assert seen.sum() > 40
    for term, bound in (("environment", 0.02), ("indirect", 0.06)):
        assert frame.numpy(term)[seen].mean() == pytest.approx(truth.numpy(term)[seen].mean(), rel=bound), term


@pytest.mark.filterwarnings("ignore:environment. 1 small lamps")
def test_mirrored_suns_are_as_soft():
    """A mirror shows the penumbra of a wide sun, as paths do; with points for suns it shows a hard shadow."""
    pixels = np.full((32, 64, 3), 0.1, np.float32)
    pixels[5:8, 9:12] = 200.0
    mirror = gi.Material("mirror", (0.9, 0.9, 0.9), metallic=1.0, roughness=0.02)
    meshes = [
        quad((-2, 0, 2), (4, 0, 0), (0, 0, -4), GREY, "floor"),
        quad((-0.5, 1, 0.5), (1, 0, 0), (0, 0, -1), GREY, "card"),
        quad((-2, 0, -2), (4, 0, 0), (0, 2, 0), mirror, "mirror"),
    ]
    scene = gi.Scene([gi.Node(mesh.name, [mesh]) for mesh in meshes], environment=gi.Environment(pixels=pixels))
    bake = gi.bake(scene, DIRECT, st.device().alias)
    truth = rendered(scene, gi.Pipeline(spp=1024, emitters=None)).numpy("indirect")
    pictures = []
    for soft in (True, False):
        direct, indirect = (replace(one, soft_suns=soft) for one in (DIRECT, INDIRECT))
        frame = rendered(scene, pipeline(environment=direct, indirect=indirect, spp=64), bakes=[bake])
        pictures.append(frame.numpy("indirect"))
    mirrored = (frame.numpy("object_id") == 2)[..., None]
    penumbra = mirrored & (abs(pictures[0] - pictures[1]) > 0.15)
    errors = [abs(picture - truth)[penumbra].mean() for picture in pictures]
    assert penumbra.sum() > 40 and errors[0] < 0.5 * errors[1], (penumbra.sum(), errors)


@pytest.mark.parametrize("lost", ["pages", "texels"])
def test_surfaces_without_slots_are_traced(lost):
    """Matt and at rest, with nothing else in the scene that needs a ray."""
    scene = corner(sky_of(slope))
    bake = gi.bake(scene, DIRECT, st.device().alias)
    assert not DIRECT.start(scene, st.device().alias, bake).needs_rays
    wall = np.flatnonzero(scene._flat.materials == [one.name for one in scene.materials].index("red"))
    arrays = {name: array.copy() for name, array in bake.arrays.items()}
    if lost == "pages":
        arrays["atlas_face_pages"][wall] = -1
    else:
        slots = arrays["atlas_slots"]
        slots[(slots >= 0) & np.isin(arrays["atlas_slot_faces"][slots], wall)] = -1
    without = gi.Bake(bake.technique, bake.scene_key, bake.settings, arrays, bake.counts, bake.scene_name)
    frame, truth = rendered(scene, pipeline(spp=64), bakes=[without]), rendered(scene, gi.Pipeline(spp=512))
    seen = truth.numpy("material_id") == frame.numpy("material_id")
    seen &= truth.numpy("albedo")[..., 0] > 5 * truth.numpy("albedo")[..., 1]
    assert seen.sum() > 100
    for term in ("environment", "indirect"):
        assert frame.numpy(term)[seen].mean() == pytest.approx(truth.numpy(term)[seen].mean(), rel=0.03), term


@pytest.mark.parametrize(("roughness", "bound"), [(0.8, 0.06), (0.6, 0.12)])
def test_glossy_lobes_by_transfer(roughness, bound):
    """Under a sky of few numbers, direct light of a rough metal is near the truth."""
    shiny = gi.Material("shiny", (0.9, 0.8, 0.7), metallic=1.0, roughness=roughness)
    scene = gi.Scene([gi.Node("ball", [sphere((0.0, 0.5, 0.0), 0.5, shiny, rows=12)])], environment=sky_of(slope))
    frame = rendered(scene, pipeline(environment=replace(DIRECT, rays=256), indirect=None))
    truth = rendered(scene, gi.Pipeline(spp=1024, indirect=None))
    seen = truth.numpy("object_id") >= 0
    mine, known = frame.numpy("environment")[seen], truth.numpy("environment")[seen]
    assert np.sqrt(((mine - known) ** 2).mean()) < bound * known.mean()


def test_phong_is_its_integral():
    """An open floor of the paper's lobe reflects the integral of L (s + 2) / (2 pi) cos^s(r, w) cos(n, w)."""
    roughness = 0.9
    shiny = gi.Material("shiny", (1.0, 1.0, 1.0), metallic=1.0, roughness=roughness)
    scene = gi.Scene(
        [gi.Node("floor", [quad((-1, 0, 1), (2, 0, 0), (0, 0, -2), shiny, "floor")])], environment=sky_of(slope)
    )
    toward = np.array([0.5, 1.0, 0.3]) / np.linalg.norm([0.5, 1.0, 0.3])
    camera = gi.Camera.look_at(2.0 * toward, (0, 0, 0), hfov=0.2, resolution=(8, 8))
    direct = replace(DIRECT, lobe="phong", glossy="transfer")
    used = gi.Pipeline(environment=direct, emitters=None, indirect=None, spp=1)
    mine = next(gi.render(scene, camera, used, device=st.device().alias)).numpy("environment").mean(axis=(0, 1))
    directions, solid = sky_nodes()
    mirror = np.array([-toward[0], toward[1], -toward[2]])
    exponent = 2 / roughness**4 - 2
    lobe = (exponent + 2) / (2 * np.pi) * np.maximum(directions @ mirror, 0) ** exponent
    known = (slope(directions) * (lobe * np.maximum(directions[:, 1], 0) * np.ravel(solid))[:, None]).sum(axis=0)
    np.testing.assert_allclose(mine, known, rtol=0.04)


def test_lamps_that_move_are_refused_with_what_to_take_instead():
    glow = gi.Material("glow", (0.0, 0.0, 0.0), specular=0.0, emission=(5.0, 5.0, 5.0))
    scene = corner(None, gi.Node("lamp", [quad((-0.1, 0, 0.1), (0.2, 0, 0), (0, 0, -0.2), glow, "lamp")]))
    scene.animate("lamp", [gi.Keyframe(0.0, (0, 0.9, 0)), gi.Keyframe(1.0, (0, 0.9, 0.4))])
    with pytest.raises(gi.OptionError, match=r"lamps of this scene move.*BsdfPaths\(ends_in=RadianceTransfer"):
        rendered(scene, pipeline(environment=None))
    with pytest.warns(UserWarning, match="knows nothing of what moves"):
        bake = gi.bake(scene, DIRECT, st.device().alias)  # which direct light may take
    with pytest.raises(gi.OptionError, match="lamps of this scene move"):
        rendered(scene, pipeline(environment=None), bakes=[bake])


def test_a_sky_of_lamps_warns():
    pixels = np.full((64, 128, 3), 0.01, np.float32)
    pixels[20, 40] = pixels[24, 90] = 2000.0
    with pytest.warns(UserWarning, match="2 small lamps hold"):
        rendered(corner(gi.Environment(pixels=pixels)), pipeline(indirect=None))


def test_a_dark_part_of_the_sky_brings_no_less_than_the_darkest():
    """The floor of a pit sees a dark zenith alone, where the harmonics of a bright horizon swing far below 0."""
    pixels = np.full((64, 128, 3), 0.2, np.float32)
    pixels[20:44] = 4.0
    walls = [
        quad((-1, 0, -1), (2, 0, 0), (0, 6, 0), GREY),
        quad((1, 0, 1), (-2, 0, 0), (0, 6, 0), GREY),
        quad((-1, 0, 1), (0, 0, -2), (0, 6, 0), GREY),
        quad((1, 0, -1), (0, 0, 2), (0, 6, 0), GREY),
    ]
    floor = quad((-1, 0, 1), (2, 0, 0), (0, 0, -2), GREY)
    scene = gi.Scene([gi.Node("pit", [floor, *walls])], environment=gi.Environment(pixels=pixels))
    camera = gi.Camera.look_at((0, 1.5, 0.1), (0, 0, 0), hfov=50, resolution=(16, 16))
    used = pipeline(environment=gi.RadianceTransfer(resolution=64, bounces=0), indirect=None)
    mine = next(gi.render(scene, camera, used)).numpy("environment")
    known = next(gi.render(scene, camera, gi.Pipeline(indirect=None, spp=1024))).numpy("environment")
    assert mine.mean() == pytest.approx(known.mean(), rel=0.1)
    assert radiance_range(scene.environment) == (pytest.approx([0.2] * 3), pytest.approx([4.0] * 3))
    turned = radiance_range(gi.Environment(pixels=pixels, rotation=70.0, scale=2.0))
    assert turned == (pytest.approx([0.4] * 3), pytest.approx([8.0] * 3))
    assert radiance_range(gi.Environment.constant((1.0, 2.0, 3.0))) == (pytest.approx([1, 2, 3]),) * 2
