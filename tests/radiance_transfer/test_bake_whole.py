"""Whole bakes: what is in them, keys, vertices and texels, hits that are gathered again, errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scene_tools import quad
from transfer_tools import open_transfer, transfer_settings

import warp_gi as gi
from warp_gi import launch
from warp_gi.bench.harness.scenes import LIVING_ROOM, SCENES
from warp_gi.errors import BakeError, SceneError
from warp_gi.techniques.radiance_transfer.bake import bake_transfer, regather, transfer_key
from warp_gi.techniques.radiance_transfer.rays import trace_slots, transfer_work
from warp_gi.techniques.radiance_transfer.textures import transfer_textures
from warp_gi.techniques.radiance_transfer.vertices import vertex_atlas
from warp_gi.techniques.shared.atlas.build import make_atlas
from warp_gi.techniques.shared.lamps import lamps_move

ATLAS = ("corners", "face_pages", "charts", "pages", "slots", "corner_slots", "slot_faces", "slot_points", "slot_sides")
KEYS = [gi.Keyframe(0.0), gi.Keyframe(1.0, translation=(0.0, 1.0, 0.0))]


def lambert(color):
    return gi.Material("lambert", tuple(color), specular=0.0)


def court(wall=(0.8, 0.3, 0.1), lights=(), parts=4, **fields):
    """A white floor of 2 x 2 m with a coloured wall of 1 m at x = 0, each of parts x parts cells."""
    steps = np.linspace(0, 1, parts + 1)
    u, v = (grid.reshape(-1, 1) for grid in np.meshgrid(steps, steps, indexing="ij"))
    row, column = (grid.reshape(-1) for grid in np.meshgrid(np.arange(parts), np.arange(parts), indexing="ij"))
    a = row * (parts + 1) + column
    b = a + parts + 1
    indices = np.concatenate([np.stack([a, b, b + 1], axis=1), np.stack([a, b + 1, a + 1], axis=1)]).astype(np.int32)

    def grid_of(corner, edge_u, edge_v, material):
        points = (np.asarray(corner) + u * np.asarray(edge_u) + v * np.asarray(edge_v)).astype(np.float32)
        return gi.Mesh(points, indices, material)

    floor = grid_of((0, 0, 0), (0, 0, 2), (2, 0, 0), lambert((1, 1, 1)))
    side = grid_of((0, 0, 0), (0, 1, 0), (0, 0, 2), lambert(wall))
    return gi.Scene([gi.Node("floor", [floor]), gi.Node("wall", [side])], lights, **fields)


def box():
    """A cube whose faces share their vertices, without normals."""
    corners = np.float32([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    indices = np.int32([t for a, b, c, d in faces for t in ([a, b, c], [a, c, d])])
    return gi.Scene([gi.Node("box", [gi.Mesh(corners, indices, lambert((0.5, 0.5, 0.5)))])])


@pytest.fixture(scope="module")
def scene():
    return court(lights=[gi.PunctualLight("point", (2.0, 4.0, 8.0), (1.0, 1.0, 1.0))], environment=1.0, name="court")


@pytest.fixture(scope="module")
def bake(scene):
    return bake_transfer(scene, transfer_settings(), "cpu", keep_hits=True)


def test_what_a_bake_holds(scene, bake, tmp_path):
    assert (bake.technique, bake.scene_name) == ("RadianceTransfer", "court")
    bake.check("RadianceTransfer", transfer_key(scene), transfer_settings().stored())
    slots = bake.counts["slots"]
    assert bake.arrays["transfer"].shape == (slots, 25) and bake.arrays["transfer"].dtype == np.float16
    assert bake.arrays["bounces"].shape == (slots, 3, 25) and bake.arrays["bounces"].dtype == np.float16
    assert bake.arrays["lamps"].shape == (slots, 3) and bake.arrays["lamps"].dtype == np.float32
    assert set(bake.arrays) == {f"atlas_{name}" for name in ATLAS} | {
        "transfer", "bounces", "lamps", "hits", "hits_key"
    }  # fmt: skip
    assert 64 * slots < bake.counts["rays"] < 512 * slots
    assert 1 <= bake.counts["bounces"] < 16 and bake.counts["last_share"] < 0.002
    assert bake.counts["black_share"] < 0.01
    assert {f"{stage}_{kind}" for stage in ("charts", "rays", "bounces") for kind in ("seconds", "cpu_seconds")} < set(
        bake.counts
    )
    read = gi.load_bake(bake.save(tmp_path / "court.safetensors"))
    assert read.digest == bake.digest and read.settings == bake.settings and read.counts == bake.counts
    textures = transfer_textures(read)
    assert textures.atlas.count == slots and textures.bounces.any() and textures.lamps.any()


def test_only_what_is_wanted_is_baked():
    plain = bake_transfer(court(), transfer_settings(), "cpu")
    assert plain.arrays["lamps"].shape == (0, 3) and "hits" not in plain.arrays
    direct = bake_transfer(court(), transfer_settings(bounces=0, order=6), "cpu")
    assert direct.arrays["bounces"].shape == (0, 3, 25) and direct.arrays["lamps"].shape == (0, 3)
    assert direct.arrays["transfer"].shape[1] == 36 and "bounces" not in direct.counts
    assert np.abs(direct.arrays["transfer"][:, :25] - plain.arrays["transfer"].astype(float)).max() < 2e-3


def test_seeds_decide_and_progress_is_told(scene, bake):
    told = []
    again = bake_transfer(scene, transfer_settings(), "cpu", progress=told.append)
    names = ("transfer", "bounces", "lamps")
    assert all(np.array_equal(again.arrays[name], bake.arrays[name]) for name in names)
    assert told == sorted(told) and told[-1] == pytest.approx(1.0) and len(told) > 5
    try:
        launch.set_threads(1)
        other = bake_transfer(scene, transfer_settings(), "cpu", keep_hits=True)
    finally:
        launch.set_threads(None)
    assert other.digest == bake.digest
    assert not np.array_equal(
        bake_transfer(scene, transfer_settings(), "cpu", 1).arrays["transfer"], again.arrays["transfer"]
    )


def test_vertices_and_texels_agree(bake):
    """The same light on the floor away from the wall's foot, at vertices and in texels."""

    def means(bake, place):
        textures = transfer_textures(bake)
        atlas = textures.atlas
        fronts = atlas.slot_sides == 0
        on_floor = fronts & (atlas.slot_faces < 2 * place**2)
        return textures.transfer[on_floor].astype(float).mean(axis=0), textures.bounces[on_floor].astype(float).mean(
            axis=0
        )

    vertices = bake_transfer(court(parts=24), transfer_settings(storage="vertices"), "cpu")
    texels = bake_transfer(court(parts=24), transfer_settings(resolution=128), "cpu")
    (transfer_v, bounces_v), (transfer_t, bounces_t) = means(vertices, 24), means(texels, 24)
    assert np.abs(transfer_v - transfer_t).max() < 0.04 * np.abs(transfer_t).max()
    assert np.abs(bounces_v - bounces_t).max() < 0.12 * np.abs(bounces_t).max()
    assert vertices.settings["storage"] == "vertices" and "hits" not in vertices.arrays


def test_vertices_of_a_box_have_a_slot_a_side_and_a_normal():
    atlas = vertex_atlas(box())
    assert atlas.count == 2 * 24 and atlas.corner_slots.shape == (2, 12, 3)
    assert sorted(set(atlas.corner_slots[0].ravel())) == list(range(24))
    assert np.array_equal(atlas.corner_slots[1], atlas.corner_slots[0] + 24)
    assert (atlas.slot_sides == np.repeat([0, 1], 24)).all()
    result = bake_transfer(box(), transfer_settings(storage="vertices"), "cpu").arrays
    normals = np.float64([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]])[atlas.slot_faces // 2]
    assert np.abs(result["transfer"][:24] - open_transfer(normals[:24])).max() < 2e-3
    assert not result["transfer"][24:].any() and not result["bounces"].any()


def test_texels_of_a_box_are_exact():
    textures = transfer_textures(bake_transfer(box(), transfer_settings(), "cpu"))
    fronts = textures.atlas.slot_sides == 0
    normals = np.float64([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]])
    expected = open_transfer(normals[textures.atlas.slot_faces // 2])
    assert fronts.sum() > 1000 and np.abs(textures.transfer[fronts] - expected[fronts]).max() < 2e-3


def test_vertices_with_normals_are_shared():
    mesh = court().nodes[0].meshes[0]
    normals = np.tile(np.float32([0, 1, 0]), (len(mesh.points), 1))
    smooth = gi.Scene([gi.Node("floor", [replace(mesh, normals=normals)])])
    assert vertex_atlas(smooth).count == vertex_atlas(gi.Scene([gi.Node("floor", [mesh])])).count == 2 * 25


def test_degenerate_and_moving_faces_have_no_vertices():
    mesh = court().nodes[0].meshes[0]
    extra = replace(mesh, indices=np.concatenate([np.int32([[0, 0, 1], [0, 1, 2]]), mesh.indices]))
    moving = gi.Node("card", [quad((0, 1, 0), (1, 0, 0), (0, 0, 1))], keyframes=KEYS)
    atlas = vertex_atlas(gi.Scene([moving, gi.Node("floor", [extra])]))
    assert (atlas.corner_slots[:, :4] == -1).all() and (atlas.corner_slots[:, 4:] >= 0).all()
    line = gi.Scene([gi.Node("line", [replace(mesh, indices=np.int32([[0, 0, 1]]))])])
    assert vertex_atlas(line).count == 0
    for storage in ("texture", "vertices"):
        with pytest.raises(SceneError, match="no surface in this scene rests and has an area, so nothing can be baked"):
            bake_transfer(line, transfer_settings(storage=storage), "cpu")


@pytest.mark.parametrize("storage", ["texture", "vertices"])
@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e6])
def test_faces_that_lie_on_each_other(storage, scale):
    """A square three times, once turned over, of any size: both sides are in the open."""
    card = quad((0, 0, 0), (0, 0, scale), (scale, 0, 0))
    thrice = replace(card, indices=np.concatenate([card.indices, card.indices[:, ::-1], card.indices]))
    textures = transfer_textures(
        bake_transfer(gi.Scene([gi.Node("card", [thrice])]), transfer_settings(storage=storage), "cpu")
    )
    up = ((textures.atlas.slot_faces // 2) % 2 == 0) == (textures.atlas.slot_sides == 0)
    assert up.any() and (~up).any()
    for is_up, normal in ((up, (0, 1, 0)), (~up, (0, -1, 0))):
        assert np.abs(textures.transfer[is_up] - open_transfer(normal)).max() < 2e-3
    assert not textures.bounces.any()


def test_key_depends_on_what_is_baked(scene):
    def other(**fields):
        return transfer_key(court(**fields)), transfer_key(court(**fields), bounces=False)

    plain, direct = other()
    assert (plain, direct) == other(environment=3.0, name="other")
    assert plain != direct
    assert other(wall=(0.1, 0.1, 0.1))[0] != plain and other(wall=(0.1, 0.1, 0.1))[1] == direct
    assert transfer_key(scene) != plain and transfer_key(scene, bounces=False) == direct
    assert other(parts=5)[1] != direct
    bumps = gi.Texture("bumps", np.full((2, 2, 4), 128, np.uint8), srgb=False)
    keys = {direct}
    for texture, scale in ((bumps, 1.0), (bumps, 0.5), (replace(bumps, pixels=bumps.pixels + np.uint8(1)), 1.0)):
        bumpy = court()
        bumpy.nodes[1].meshes[0].material = replace(lambert((1, 1, 1)), normal_texture=texture, normal_scale=scale)
        keys.add(transfer_key(gi.Scene(bumpy.nodes), bounces=False))
    assert len(keys) == 4


def test_edited_albedo_is_gathered_again(scene, bake):
    lights = scene.lights
    edited = court(wall=(0.1, 0.9, 0.4), lights=lights, name="court")
    with pytest.raises(BakeError, match=r"this bake is of scene 'court'.*bake it again"):
        bake.check("RadianceTransfer", transfer_key(edited), transfer_settings().stored())
    mended = regather(edited, transfer_settings(), bake, "cpu")
    fresh = bake_transfer(edited, transfer_settings(), "cpu", keep_hits=True)
    assert mended.digest == fresh.digest and mended.scene_key == fresh.scene_key
    assert not np.array_equal(mended.arrays["bounces"], bake.arrays["bounces"])
    assert mended.counts["rays"] == bake.counts["rays"]
    for changed, message in (
        (lambda: regather(court(parts=5), transfer_settings(), bake, "cpu"), "of other geometry or normals"),
        (lambda: regather(edited, transfer_settings(rays=256), bake, "cpu"), "other settings .rays: bake has 512"),
        (lambda: regather(court(), transfer_settings(), bake_transfer(court(), transfer_settings(), "cpu"), "cpu"),
         "has no hits to gather from again"),
    ):  # fmt: skip
        with pytest.raises(BakeError, match=message):
            changed()


def test_what_moves_is_told():
    card = quad((0, 0.5, 0), (1, 0, 0), (0, 0, 1))
    rest = court().nodes
    with pytest.warns(UserWarning, match="knows nothing of what moves: 'card' will cast no shadow"):
        moved = bake_transfer(gi.Scene([gi.Node("card", [card], keyframes=KEYS), *rest]), transfer_settings(), "cpu")
    still = bake_transfer(court(), transfer_settings(), "cpu")
    for name in ("transfer", "bounces"):
        means = [bake.arrays[name].astype(float).mean() for bake in (moved, still)]
        assert means[0] == pytest.approx(means[1], rel=0.01)
    with pytest.raises(SceneError, match="everything in this scene moves; nothing can be baked"):
        bake_transfer(gi.Scene([gi.Node("card", [card], keyframes=KEYS)]), transfer_settings(), "cpu")


def test_lamps_that_move_are_left_out():
    light = gi.PunctualLight("point", (1.0, 1.0, 1.0), node=2)
    scene = gi.Scene([*court().nodes, gi.Node("carrier", keyframes=KEYS)], [light])
    assert lamps_move(scene) and not lamps_move(court(lights=[replace(light, node=None)]))
    assert bake_transfer(scene, transfer_settings(), "cpu").arrays["lamps"].shape == (0, 3)
    shining = replace(quad((0, 1, 0), (1, 0, 0), (0, 0, 1)), material=gi.Material("lamp", emission=(1, 1, 1)))
    assert lamps_move(gi.Scene([*court().nodes, gi.Node("lamp", [shining], keyframes=KEYS)]))
    assert not lamps_move(gi.Scene([*court().nodes, gi.Node("lamp", [shining])]))


def test_lamps_without_reflection_reach_nothing():
    """A lamp beside a black wall: it lights the floor, which reflects to the wall, which reflects nothing."""
    dark = court(wall=(0, 0, 0), lights=[gi.PunctualLight("point", (1.0, 1.0, 1.0), (1.0, 0.5, 1.0))])
    result = transfer_textures(bake_transfer(dark, transfer_settings(), "cpu"))
    on_floor = result.atlas.slot_faces < 32
    assert not result.lamps[on_floor].any() and result.lamps[~on_floor & (result.atlas.slot_sides == 0)].mean() > 0.01


@pytest.mark.parametrize("source", ["sky", "point", "surface"])
def test_light_of_the_floor_is_that_of_the_path_tracer(source):
    lamp = gi.Material("lamp", (0, 0, 0), specular=0.0, emission=(3.0, 2.0, 1.0))
    lights = [gi.PunctualLight("point", (2.0, 4.0, 8.0), (1.0, 1.0, 1.0))] if source == "point" else []
    parts = [gi.Node("lamp", [quad((0.5, 1.5, 0.5), (1, 0, 0), (0, 0, 1), lamp)])] if source == "surface" else []
    scene = gi.Scene([*court().nodes, *parts], lights, 1.0 if source == "sky" else None)
    textures = transfer_textures(bake_transfer(scene, transfer_settings(resolution=256, tolerance=1e-4), "cpu"))
    camera = gi.Camera.look_at((0.4, 3.0, 1.0), (0.3, 0.0, 1.0), hfov=2.0, resolution=(8, 8))
    frame = next(gi.render(scene, camera, gi.Pipeline(spp=512)))
    atlas, geometry = textures.atlas, scene.data("cpu").geometry
    corners = geometry.points.numpy()[geometry.indices.numpy()][atlas.slot_faces]
    weights = np.column_stack([1 - atlas.slot_points.sum(axis=1), atlas.slot_points])
    away = np.einsum("sc,scx->sx", weights, corners) - (0.3, 0, 1)
    near = (atlas.slot_faces < 32) & (atlas.slot_sides == 0) & (np.linalg.norm(away, axis=1) < 0.06)
    white = np.sqrt(4 * np.pi)
    bounced = textures.bounces[near, :, 0].mean(axis=0, dtype=float) * white * (source == "sky")
    direct = textures.transfer[near, 0].mean(dtype=float) * white * (source == "sky")
    if source != "sky":
        bounced = bounced + textures.lamps[near].mean(axis=0)
    for term, irradiance in (("indirect", bounced), ("environment", direct)):
        expected = frame.numpy(term).reshape(-1, 3).mean(axis=0)
        assert irradiance / np.pi == pytest.approx(expected, rel=0.02), term


@pytest.mark.slow
@pytest.mark.parametrize("name, most_rays", [(LIVING_ROOM, 150), ("crytek_sponza.glb", 150), ("modern_hall.glb", 300)])
def test_error_of_real_scenes(name, most_rays):
    """Error of T over slots, relative to its size, against 8192 rays."""
    if not (SCENES / name).exists():
        pytest.skip(f"no {SCENES / name}")
    scene, device = gi.load_scene(SCENES / name), launch.get_device("cpu")
    atlas = make_atlas(scene, transfer_settings(resolution=1024), "cpu")
    some = np.sort(np.random.default_rng(0).choice(atlas.count, 4000, replace=False))
    atlas = replace(
        atlas, **{field: getattr(atlas, field)[some] for field in ("slot_faces", "slot_points", "slot_sides")}
    )

    def traced(seed, **rays):
        return trace_slots(transfer_work(scene, atlas, transfer_settings(bounces=0, **rays), device, seed))

    many = [traced(seed, first_rays=4096, rays=4096).transfer.astype(np.float64) for seed in (11, 12)]
    reference = np.mean(many, axis=0)

    def error(result):
        return np.sqrt(((result.transfer - reference) ** 2).sum() / (reference**2).sum())

    adaptive = traced(0)
    assert error(traced(0, first_rays=256, rays=256)) < 0.028
    assert error(adaptive) < 0.024 and adaptive.rays.mean() < most_rays
    assert error(traced(0, first_rays=128)) < 0.019
