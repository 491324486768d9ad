"""Light maps from a surface cache: their texels against closed forms, sums in float64 and the path tracer."""

from dataclasses import replace

import numpy as np
import pytest
import statistics_tools as st
from atlas_tools import box
from scene_tools import GREY, quad
from statistics_tools import every_device  # noqa: F401
from truth_tools import camera_in_box, closed_box, scene_of

import warp_gi as gi
from warp_gi.bench.harness.court import court, court_camera
from warp_gi.errors import BakeError, OptionError, SceneError
from warp_gi.launch import set_threads
from warp_gi.scheduler import FrameScheduler
from warp_gi.techniques.shared.atlas.atlas import page_coordinates
from warp_gi.techniques.surface_cache import light_map as maps
from warp_gi.techniques.surface_cache.light_map import LightMap, LightMapSettings, bake_light_map

CACHE = gi.SurfaceCache(paths=20_000)
ABOVE = gi.Camera.look_at((0.1, 3.0, 0.2), (0, 0, 0), up=(0, 0, -1), hfov=80)
BLACK = gi.Material("black", (0, 0, 0), specular=0.0)


def light_map(scene: gi.Scene, camera: gi.Camera, cache: gi.SurfaceCache = CACHE, **settings) -> LightMap:
    chosen = LightMapSettings(**{"resolution": 64, "texel_sets": "one", **settings})
    bake = gi.bake(scene, cache, st.device().alias, camera=camera)
    return bake_light_map(scene, bake, cache, chosen, st.device().alias)


def slot_points(scene: gi.Scene, found: LightMap) -> np.ndarray:
    """Return where the slots of fronts lie, float64 [slot, 3]."""
    count = len(found.irradiance)
    u, v = found.atlas.slot_points[:count].T.astype(np.float64)[..., None]
    a, b, c = np.moveaxis(scene._flat.points[scene._flat.indices[found.atlas.slot_faces[:count]]], 1, 0)
    return a * (1 - u - v) + b * u + c * v


def lamp_over(*below: gi.Mesh, emission: float = 4.0) -> gi.Scene:
    """A square lamp of 1 m that looks down from a height of 1.5 m, over surfaces."""
    lamp = gi.Material("lamp", (0, 0, 0), specular=0.0, emission=(emission, 2.0, 1.0))
    return scene_of(quad((-0.5, 1.5, -0.5), (1, 0, 0), (0, 0, 1), lamp, "lamp"), *below)


def floor(material: gi.Material = BLACK, **fields) -> gi.Mesh:
    mesh = quad((-2, 0, 2), (4, 0, 0), (0, 0, -4), material, "floor")
    return replace(mesh, **fields)


def lamp_irradiance(points: np.ndarray, height: float = 1.5, order: int = 24) -> np.ndarray:
    """Return the integral of cos cos / r^2 over the lamp at points [n, 3] that face up, in float64."""
    nodes, weights = np.polynomial.legendre.leggauss(order)
    x, z = np.meshgrid(0.5 * nodes, 0.5 * nodes)
    to = np.stack([x.ravel(), np.full(x.size, height), z.ravel()], axis=1) - points[:, None]
    squared = (to**2).sum(axis=2)
    return (to[..., 1] ** 2 / squared**2) @ (0.25 * np.outer(weights, weights).ravel())


# ---- what texels hold ----


def test_a_white_furnace():
    """Irradiance is pi / (1 - albedo) at every texel, in the corners too."""
    box_scene, cache = scene_of(*closed_box(0.8, 1.0)), replace(CACHE, paths=60_000)
    found = light_map(box_scene, camera_in_box(), cache, resolution=40, samples=128)
    share = found.irradiance / (5 * np.pi)
    assert len(share) > 800 and found.is_known.all()
    np.testing.assert_allclose(share.mean(axis=0), 1, atol=0.005)
    blocks = share[: len(share) // 64 * 64].reshape(-1, 64, 3).mean(axis=1)
    assert np.abs(blocks - 1).max() < 0.02


def test_a_floor_under_a_lamp():
    """The floor is black, so all light comes straight from the lamp: a form factor, a sum in float64."""
    scene = lamp_over(floor())
    found = light_map(scene, ABOVE, resolution=32, samples=1024)
    places = slot_points(scene, found)
    on_floor = np.flatnonzero((np.abs(places[:, 1]) < 1e-6) & (np.abs(places).max(axis=1) < 1.9))  # whole texels
    expected = lamp_irradiance(places[on_floor])[:, None] * (4.0, 2.0, 1.0)
    share = found.irradiance[on_floor] / expected
    print(np.abs(share - 1).max(), share.mean(), share.std())
    assert len(on_floor) > 300
    np.testing.assert_allclose(found.irradiance[on_floor], expected, rtol=0.02)


def test_a_sky_and_a_sun():
    """A floor in the open gets pi L of a constant sky, and the irradiance of a sun times its cosine."""
    direction = np.array([0.3, -1.0, 0.2])
    sun = gi.PunctualLight("directional", intensity=(3.0, 2.0, 1.0), direction=tuple(direction))
    found = light_map(scene_of(floor(), environment=0.5, lights=[sun]), ABOVE, samples=16)
    cosine = 1 / np.linalg.norm(direction)
    np.testing.assert_allclose(
        found.irradiance, np.tile(0.5 * np.pi + cosine * np.array([3.0, 2.0, 1.0]), (len(found.irradiance), 1)), 1e-4
    )


def test_a_court_as_by_paths():
    """Times albedo / pi, read at the pixels of a view, it is the path tracer's picture but for what texels blur."""
    scene = court((1.0, 0.9, 0.8))
    camera = court_camera((96, 64))
    found = light_map(scene, camera, replace(CACHE, paths=100_000), resolution=256, samples=64)
    nothing = gi.Pipeline(environment=None, emitters=None, indirect=None, spp=1, camera_samples=1)
    frame = FrameScheduler(scene, camera, nothing, st.device().alias, 1).frame(0)
    face, u, v = (getattr(frame.hits, name).numpy() for name in ("face", "u", "v"))
    hit = np.flatnonzero(face >= 0)
    shown = np.zeros((len(face), 3))
    shown[hit] = found.at(face[hit], u[hit], v[hit]) / np.pi * frame.numpy("albedo").reshape(-1, 3)[hit]
    pipeline = gi.Pipeline(spp=64, camera_samples=1)
    traced = next(gi.render(scene, camera, pipeline, device=st.device().alias, seed=2))
    reference = traced.numpy("beauty").reshape(-1, 3)
    lit = np.zeros(len(face), bool)
    lit[hit] = True
    tiles = [np.where(lit[:, None], one, 0).reshape(8, 8, 12, 8, 3).mean(axis=(1, 3)) for one in (shown, reference)]
    assert hit.size > 3000
    assert abs(tiles[0].sum() / tiles[1].sum() - 1) < 0.01
    assert np.abs(tiles[0] - tiles[1]).max() < 0.06 * tiles[1].mean(), "where texels are 2 cm and cells 5"


def test_normals_are_interpolated_and_normal_maps_have_no_part():
    tilted = np.array([0.0, 1.0, 0.5]) / np.hypot(1, 0.5)
    bumps = gi.Texture("bumps", np.tile(np.array([[[200, 128, 200, 255]]], np.uint8), (2, 2, 1)))
    uvs = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    sun = gi.PunctualLight("directional", intensity=(1.0, 1.0, 1.0), direction=(0, -1, 0))
    for mapped in (False, True):
        material = replace(BLACK, normal_texture=bumps if mapped else None)
        mesh = floor(material, normals=np.tile(tilted, (4, 1)).astype(np.float32), uvs=uvs)
        found = light_map(scene_of(mesh, lights=[sun]), ABOVE, samples=4)
        np.testing.assert_allclose(found.irradiance, np.float32(tilted[1]), rtol=1e-5)


def test_texels_hold_the_light_of_fronts():
    """A sheet in sunlight, seen from below: its texels hold what arrives above."""
    sun = gi.PunctualLight("directional", intensity=(1.0, 1.0, 1.0), direction=(0, -1, 0))
    found = light_map(scene_of(floor(), lights=[sun]), gi.Camera.look_at((0, -2, 0.1), (0, 0, 0)), samples=4)
    assert (found.atlas.slot_sides == 1).any()
    np.testing.assert_allclose(found.irradiance, 1, rtol=1e-5)


def test_a_texel_is_gathered_over_all_of_its_area():
    """Half of a lamp's light is cut off by a shade; along the shadow's edge texels hold shares, not all or nothing."""
    sun = gi.PunctualLight("directional", intensity=(1.0, 1.0, 1.0), direction=(0, -1, 0))
    shade = quad((-4, 1, 4), (4.3, 0, 0), (-0.6, 0, -8), BLACK, "shade")
    scene = scene_of(floor(), shade, lights=[sun])
    found = light_map(scene, gi.Camera.look_at((0.5, 0.5, 1), (0.3, 0, 0)), samples=64, texel_sets="floor=1,shade=0.1")
    on_floor = found.atlas.slot_faces[: len(found.irradiance)] < 2
    values = np.unique(found.irradiance[on_floor, 0].round(4))
    assert set(values[[0, -1]]) == {0, 1}
    assert len(values) > 2 and set(values) <= {0, 0.25, 0.5, 0.75, 1}


def test_places_lie_in_their_texels():
    scene = scene_of(floor())
    found = light_map(scene, ABOVE, samples=1, resolution=32)
    places = maps._places(found.atlas, len(found.irradiance), 1, 0, st.device())
    starts, faces, points = (getattr(places, name).numpy() for name in ("starts", "faces", "points"))
    owner = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    at = page_coordinates(found.atlas, faces, *points.T)[1] * found.size
    texels = np.flatnonzero(found.atlas.slots[0] >= 0)[np.argsort(found.atlas.slots[0][found.atlas.slots[0] >= 0])]
    middles = np.stack([texels % found.size[0], texels // found.size[0]], axis=1) + 0.5
    away = np.abs(at - middles[owner])
    several = np.diff(starts)[owner] > 1
    assert set(np.diff(starts)) <= {1, 2, 3, 4} and (np.diff(starts) == 4).mean() > 0.7
    assert away[several].max() < 0.29 and away.max() < 1.01


def test_beside_a_box_no_texel_is_black():
    """Where the box stands on the floor nobody sees the floor, and bilinear fetches beside the box read it."""
    scene = scene_of(floor(GREY), replace(box((-0.5, -0.1, -0.5), (1.0, 0.5, 1.0)), material=GREY), environment=1.0)
    found = light_map(scene, ABOVE, samples=64)
    x, z = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-0.51, 0.51, 103)] * 2))
    beside = np.maximum(np.abs(x), np.abs(z)) > 0.505
    x, z = x[beside], z[beside]
    across, along = (x + 2) / 4, (2 - z) / 4  # of the floor, whose first face has the corners 0 0, 1 0, 1 1
    faces = np.where(across >= along, 0, 1)
    u = np.where(faces == 0, across - along, across)
    v = np.where(faces == 0, along, along - across)
    corners = scene._flat.points[scene._flat.indices[faces]]
    places = (corners * np.stack([1 - u - v, u, v], axis=1)[..., None]).sum(axis=1)
    np.testing.assert_allclose(places, np.stack([x, 0 * x, z], axis=1), atol=1e-5)
    light = found.at(faces, u, v)
    assert len(light) > 400 and light.min() > 0.6 * np.pi
    on_floor = found.atlas.slot_faces[: len(found.irradiance)] < 2
    under = on_floor & (np.abs(slot_points(scene, found)).max(axis=1) < 0.3)
    assert under.sum() > 20 and found.irradiance[under].max() < 0.1 * np.pi


def test_a_wall_through_a_floor_draws_no_dark_line():
    """Behind the wall is nothing, and no light: texels that it cuts, and those behind it, have the light before it."""
    wall = quad((0.235, -0.5, 30), (0.3, 0, -60), (0, 30, 0), BLACK, "wall")
    lamp = gi.PunctualLight("point", intensity=(1.0, 1.0, 1.0), position=(-0.5, 1, 0))
    scene = scene_of(floor(), wall, lights=[lamp])
    found = light_map(scene, ABOVE, samples=64, texel_sets="floor=1,wall=0.03", resolution=128)
    z = np.linspace(-1.2, 1.2, 97)
    x = 0.235 + 0.3 * (30 - z) / 60 - 0.002
    across, along = (x + 2) / 4, (2 - z) / 4  # of the floor, as in the test above
    faces = np.where(across >= along, 0, 1)
    light = found.at(faces, np.where(faces == 0, across - along, across), np.where(faces == 0, along, along - across))
    squared = (x + 0.5) ** 2 + 1 + z**2
    np.testing.assert_allclose(light[:, 0], squared**-1.5, rtol=0.08)
    beyond = slot_points(scene, found)[:, 0] > 0.6
    assert (found.irradiance[beyond] == 0).all() and beyond.any()


def test_what_lies_inside_of_something_is_known_to_nobody():
    """A small sheet in a closed box: its texels get the colour of others in the picture."""
    hidden = quad((0, 0, 0), (0.02, 0, 0), (0, 0.02, 0), GREY, "hidden")
    scene = scene_of(box((-0.5, -0.5, -0.5), (1.0, 1.0, 1.0)), hidden, environment=1.0)
    found = light_map(scene, gi.Camera.look_at((3, 2, 1), (0, 0, 0)), samples=4, texel_sets="hidden=20,box=1")
    fronts = found.atlas.slot_faces[: len(found.irradiance)]
    assert (found.is_known == (fronts < 12)).all() and (fronts >= 12).sum() > 20
    np.testing.assert_allclose(found.image(), np.pi, rtol=1e-4)


# ---- how it is made ----


def test_any_number_of_threads_gives_one_map():
    maps_made = []
    try:
        for threads in (1, 2):
            set_threads(threads)
            maps_made.append(light_map(court(1.0), court_camera((32, 24)), replace(CACHE, paths=2000), samples=4))
    finally:
        set_threads(None)
    np.testing.assert_array_equal(maps_made[0].irradiance, maps_made[1].irradiance)
    np.testing.assert_array_equal(maps_made[0].image(), maps_made[1].image())


def test_progress_rises_to_all():
    told = []
    scene = lamp_over(floor())
    bake = gi.bake(scene, CACHE, camera=ABOVE)
    bake_light_map(scene, bake, CACHE, LightMapSettings(resolution=32, samples=1), progress=told.append)
    assert told == sorted(told) and told[-1] == 1


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"resolution": 8}, "resolution must be a whole number from 16 to 16384, got 8"),
        ({"samples": 0}, "samples must be a whole number from 1 to 1048576, got 0"),
        ({"charts": "mine"}, "unknown charts 'mine'"),
        ({"chart_seconds": -1.0}, "chart_seconds must be a finite number that is not negative, got -1"),
        ({"texel_sets": "floor"}, "texel_sets must be"),
    ],
)
def test_settings_out_of_range(settings, told):
    with pytest.raises(OptionError, match=told):
        LightMapSettings(**settings).validate()


def test_what_cannot_be_mapped():
    scene = lamp_over(floor())
    bake = gi.bake(scene, CACHE, camera=ABOVE)
    with pytest.raises(BakeError, match="other settings"):
        bake_light_map(scene, bake, gi.SurfaceCache(), LightMapSettings())
    other = scene_of(floor(), environment=1.0)
    with pytest.raises(BakeError, match="bake it again"):
        bake_light_map(other, bake, CACHE, LightMapSettings())
    flat = scene_of(quad((0, 0, 0), (1, 0, 0), (2, 0, 0)), environment=1.0)
    with pytest.raises(SceneError, match="no surface in this scene"):
        bake_light_map(flat, gi.bake(flat, CACHE, camera=ABOVE), CACHE, LightMapSettings())
