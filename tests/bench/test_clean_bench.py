"""The suite `clean`: its measures against closed forms, its quick run, what documents show of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.bench.harness import places
from warp_gi.bench.harness.gallery import Gallery
from warp_gi.bench.harness.scenes import light, quad
from warp_gi.bench.peers import blender_peer, luxcore_peer
from warp_gi.bench.peers.mitsuba_peer import PeerMissing
from warp_gi.bench.publish.figures import region_text
from warp_gi.bench.report import suite_plots
from warp_gi.bench.suites.clean import (
    cases,
    contenders,
    first,
    measures,
    peers,
    references,
    renderers,
    sequences,
    suite,
    switched,
)
from warp_gi.bench.suites.clean.columns import COLUMNS
from warp_gi.bench.suites.clean.regions import REGIONS

RNG = np.random.default_rng(8)


# ---- measures ----


def noise(size=(90, 120), deviation=1.0):
    return RNG.normal(0, deviation, (*size, 3))


def test_relative_error_is_that_of_a_loop_without_the_halves_noise():
    truth = RNG.uniform(0.2, 2.0, (90, 120, 3))
    halves = [truth + noise(deviation=0.1), truth + noise(deviation=0.1)]
    picture = truth + 0.1
    expected = np.mean([0.01 / (value**2 + 0.01 * truth.mean() ** 2) for value in truth.ravel()])
    assert measures.rel_mse(picture, halves, truth) == pytest.approx(expected, rel=0.1)
    assert measures.rel_mse(1e-3 * picture, [1e-3 * half for half in halves], 1e-3 * truth) == pytest.approx(
        measures.rel_mse(picture, halves, truth)
    )  # a dark scene is judged as a bright one


def test_a_moved_picture_has_no_flicker():
    """A smooth picture that moves by 2.25 and -1.5 pixels, in closed form; bilinear interpolation of it is exact."""
    y, x = np.mgrid[:40, :60].astype(float)

    def shown(dx, dy):
        return np.stack([3 + 0.02 * (x + dx) + 0.01 * (y + dy)] * 3, -1)

    motion = np.zeros((40, 60, 2)) + np.array([2.25, -1.5])
    assert measures.flicker(shown(2.25, -1.5), shown(0, 0), motion, shown(0, 0)) < 1e-12
    assert measures.flicker(shown(0, 0), shown(0, 0), motion, shown(0, 0)) > 1e-3  # the wrong way
    values, inside = measures.moved(shown(0, 0), motion)
    np.testing.assert_allclose(values[inside], shown(2.25, -1.5)[inside])
    assert not inside[0].any() and inside[2, :57].all() and not inside[:, 58:].any()


def test_flicker_of_noise_is_known():
    """The mean size of a difference of two normal numbers is 2 / sqrt(pi) deviations; over light and a tenth of it."""
    light = np.full((90, 120, 3), 2.0)
    found = measures.flicker(light + noise(), light + noise(), np.zeros((90, 120, 2)), light)
    assert found == pytest.approx(2 / np.sqrt(np.pi) / 2.2, rel=0.02)


def test_likeness_of_white_noise_and_of_a_grid():
    light, wall = np.full((90, 120, 3), 2.0), np.ones((90, 120), bool)
    halves = [light + noise(), light + noise()]
    one, two, size = measures.pattern(light + np.repeat(noise()[..., :1], 3, -1), halves, wall)
    assert one == pytest.approx(-14 / 81 / (8 / 9), abs=0.03) and two == pytest.approx(3 / 81 / (8 / 9), abs=0.03)
    assert size == pytest.approx(np.sqrt(8 / 9) / 2, rel=0.05)
    y, x = np.mgrid[:90, :120]
    grid = light + 0.3 * (-1.0) ** (x + y)[..., None]
    one, two, size = measures.pattern(grid, halves, wall)
    assert one < -0.85 and two > 0.85 and size == pytest.approx(0.3 * 8 / 9 / 2, rel=0.2)
    smooth = light + 0.3 * np.sin(x / 3.0)[..., None]
    assert measures.pattern(smooth, [light, light], wall)[1] > 0.7
    assert measures.pattern(light, halves, np.zeros_like(wall)) is None
    assert measures.pattern(light, [light, light], wall) is None  # no error at all


def test_walls_are_flat_and_plain():
    objects = np.zeros((20, 30), int)
    objects[:, 15:] = 1
    normals = np.tile([0.0, 1.0, 0.0], (20, 30, 1))
    albedo = np.full((20, 30, 3), 0.5)
    albedo[10, 5] = 0.9
    found = measures.walls(objects, normals, albedo)
    assert found[4, 5] and found[4, 20] and not found[:2].any() and not found[:, -2:].any()
    assert not found[:, 13:17].any()  # both sides of the edge
    assert not found[8:13, 3:8].any() and found[10, 8]  # all around the spot
    normals[:, 20:] = [1.0, 0.0, 0.0]
    assert not measures.walls(objects, normals, albedo)[:, 18:22].any()


def test_old_light_is_the_share_that_is_left():
    before, now = RNG.uniform(1, 2, (2, 50, 60, 3))
    for share in (0.0, 0.3, 1.0):
        picture = share * before + (1 - share) * now + noise((50, 60), 0.1)
        assert measures.left_over(picture, now, before) == pytest.approx(share, abs=0.02)


def test_times_are_read_off_a_line_of_errors():
    points = [(1.0, 0.4), (4.0, 0.2), (16.0, 0.1)]
    assert sequences.at_time(points, 2.0) == pytest.approx(0.4 / 2**0.5)
    assert sequences.at_time(points, 100.0) == pytest.approx(0.1)
    assert sequences.time_of(points, 0.2 / 2**0.5) == (pytest.approx(8.0), True)
    assert sequences.time_of(points, 0.05) == (16.0, False) and sequences.time_of(points, 0.5) == (1.0, True)


def test_a_reference_is_cleaned_where_that_helps():
    light = np.full((40, 50, 3), 0.5, np.float32)
    near, far = ((light + deviation * noise((40, 50))).astype("f4") for deviation in (0.01, 0.3))
    noisy, clean = (near, far), (near, light)
    for given, flip, cleaned, is_cleaned in (
        (noisy, 0.3, clean, True),
        (noisy, 0.04, clean, False),
        (clean, 0.06, noisy, False),
        (noisy, 0.3, None, False),
    ):
        made = references.Truth(given, flip, cleaned)
        assert made.is_cleaned == is_cleaned
        np.testing.assert_allclose(made.shown, np.mean(cleaned if is_cleaned else given, axis=0))


# ---- references ----


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    folder = tmp_path_factory.mktemp("references")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WARP_GI_REFERENCES", str(folder))
        yield folder


def box():
    return gi.builtin_scene("cornell_box")


def test_a_reference_is_kept_and_known_again(kept, monkeypatch):
    path = gi.builtin_camera_path("cornell_box").at_resolution(24, 16)
    made = references.truth(box, path, 3, 8, "cpu")
    assert made.mean > 0 and 0 < made.noise < 1 and not np.array_equal(*made.halves)

    def refuse(*given, **more):
        raise AssertionError("rendered again")

    computed = references.reference.computed
    monkeypatch.setattr(references.reference, "computed", refuse)
    again = references.truth(box, path, 3, 8, "cpu")
    np.testing.assert_array_equal(again.halves, made.halves)
    for changed in ({"frame": 4}, {"spp": 16}, {"path": path.at_resolution(16, 16)}):
        with pytest.raises(AssertionError, match="rendered again"):
            references.truth(box, **{"path": path, "frame": 3, "spp": 8, "device": "cpu"} | changed)
    monkeypatch.setattr(references.reference, "computed", computed)
    name = references.key(box(), path.camera(3), 3, 8)
    (kept / f"{name}.safetensors").write_bytes(b"damaged")
    np.testing.assert_array_equal(references.truth(box, path, 3, 8, "cpu").halves, made.halves)


def test_a_reference_shows_the_sky_and_poses_of_its_moment():
    scene = box()
    scene.environment = gi.TurningSky(gi.Environment(pixels=RNG.uniform(0, 1, (8, 16, 3)).astype("f4")), 90.0)
    still = references.still(scene, 1.0)
    assert not still.is_sky_animated and still.environment.rotation % 360 == pytest.approx(90)
    moving = cases.sliding_crate()
    camera = cases.MOVING[1].path().camera(0)
    assert references.key(moving, camera, 3, 8) != references.key(moving, camera, 4, 8)
    assert references.key(box(), camera, 3, 8) == references.key(box(), camera, 4, 8)


def test_lamps_of_a_cleaned_reference_stay():
    pytest.importorskip("pyoidn")
    camera = gi.builtin_camera_path("cornell_box").at_resolution(48, 32).camera(0)
    frame = gi.FrameScheduler(box(), camera, gi.Pipeline(spp=16)).frame(0)
    picture = frame.numpy("beauty")
    clean = references.cleaner(box(), camera, 0, "cpu")(picture)
    lamp = frame.numpy("emission").max(-1) > 0
    assert lamp.any() and np.array_equal(clean[lamp], picture[lamp])
    assert clean.mean() == pytest.approx(picture.mean(), rel=0.03) and not np.array_equal(clean, picture)
    assert references.grown(np.eye(5) * np.arange(5) > 3).sum() == 4


# ---- the suite ----


@pytest.fixture(scope="module")
def pictures():
    return Gallery()


@pytest.fixture(scope="module")
def rows(kept, pictures):
    """Rows of all parts that need no other renderer, as small as can be."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (sequences, switched):
            patch.setattr(module, "QUICK_SIZE", (24, 16))
            patch.setattr(module, "QUICK_SPP", 16)
        patch.setattr(sequences, "QUICK_LAST", 5)
        patch.setattr(sequences, "QUICK_SAMPLES", (1, 16))
        patch.setattr(first, "QUICK_COMMAND", (*first.QUICK_COMMAND[:-1], "24x16"))
        return suite.run(True, "cpu", ("built-in", "switched", "first"), pictures)


def named(rows, table, **values):
    return [row for row in rows if row.get("table") == table and values.items() <= row.items()]


def test_rows_are_declared_and_of_every_contender(rows):
    assert not any("failed" in row for row in rows) and COLUMNS.undeclared(rows) == []
    found = named(rows, sequences.SEQUENCES, case="Cornell box")
    said = [(row["renderer"], row["spp"]) for row in found]
    has_oidn = (contenders.OIDN, 1) in said
    sides = [contenders.PATH, contenders.FILTERED, *[contenders.OIDN] * has_oidn]
    assert said == [
        (contenders.CLEAN, 1),
        (contenders.UNBLENDED, 1),
        *((side, spp) for spp in (1, 16) for side in sides),
    ]
    for row in found:
        assert 0 < row["FLIP"] < 1 and 0.7 < row["mean"] < 1.3 and row["us a pixel"] > 0 and row["flicker"] > 0
    clean, path = (named(found, sequences.SEQUENCES, renderer=name)[0] for name in (contenders.CLEAN, contenders.PATH))
    assert clean["FLIP"] < path["FLIP"] and clean["flicker"] < path["flicker"]
    assert path["mean of judged"] == pytest.approx(1, abs=0.5) and clean["fill cpu s"] > 0 and clean["peak GB"] > 0.01
    many = named(found, sequences.SEQUENCES, renderer=contenders.PATH, spp=16)[0]
    assert many["FLIP first"] == many["mean of judged"] == "" and many["relMSE"] < path["relMSE"]


def test_references_are_told(rows):
    found = named(rows, sequences.REFERENCE, case="Cornell box")
    assert [row["frame"] for row in found] == [0, 4, 5]
    assert all(0 < row["FLIP of its halves"] < 1 and row["mean error"] < 0.2 for row in found)
    assert [row["flicker of the reference"] != "" for row in found] == [False, True, False]


def test_a_light_that_goes_out_is_forgotten(rows):
    found = named(rows, switched.TABLE, renderer=contenders.CLEAN)
    assert [row["frames later"] for row in found] == [0, switched.SOON]
    assert all(abs(row["old light left"]) < switched.MOST_SOON for row in found)
    assert [row["most left"] for row in found] == ["", switched.MOST_SOON]


def test_the_first_command_is_timed(rows):
    (row,) = named(rows, first.FIRST)
    assert row["frames"] == 4 and 0 < row["to first frame s"] < row["wall s"] and row["peak GB"] > 0.05


def test_a_command_that_fails_is_a_row():
    assert "unknown" in first.timed_run(["cornell_box", "--pipeline", "clen"], {})["failed"]


def test_pictures_stand_beside_the_reference(rows, pictures):
    names = [one.case for one in pictures.sets]
    assert names == ["Cornell box", *(f"light switched off, {later} frames later" for later in (0, 3))]
    assert "clean, 1 spp" in pictures.sets[0].images and "clean" in pictures.sets[1].images


# ---- other renderers ----


@pytest.fixture(scope="module")
def peer_rows(kept):
    """Rows of two renderers of which one is missing; the other shows the reference."""

    def flat(scene, path, frames, spp, device):
        shots = contenders.Shots("flat", spp)
        for frame in frames:
            shots.add(frame, np.full((16, 24, 3), 0.1, np.float32), (2.0, 4.0), frames)
        return shots

    def missing(*given):
        raise PeerMissing("no module flat")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(peers, "RENDERERS", {"flat": flat, "missing": missing})
        patch.setattr(peers, "QUICK_SIZE", (24, 16))
        patch.setattr(peers, "QUICK_SPP", 16)
        patch.setattr(peers, "QUICK_CASE", replace(peers.QUICK_CASE, samples=(4, 8), slower=("flat", 8)))
        return peers.peer_rows(True, "cpu")


def test_other_renderers_stand_beside_ours(peer_rows):
    assert COLUMNS.undeclared(peer_rows) == []
    found = named(peer_rows, peers.TABLE, renderer="flat")
    assert [(row["contender"], row["least faster"]) for row in found] == [("flat, 4 spp", ""), ("flat, 8 spp", 20.0)]
    clean = named(peer_rows, peers.TABLE, renderer=contenders.CLEAN)[0]
    assert found[0]["time / clean"] == pytest.approx(2.0 / clean["s a frame"])
    assert found[0]["FLIP / clean"] == pytest.approx(found[0]["FLIP"] / clean["FLIP"]) and found[0]["FLIP"] > 0.3
    assert named(peer_rows, peers.MISSING) == [
        {"table": peers.MISSING, "case": "Cornell box", "renderer": "missing", "skipped": "no module flat"}
    ]


def test_renderers_that_are_not_installed_are_rows(monkeypatch):
    monkeypatch.setattr(luxcore_peer, "PYTHON", "/nowhere/python")
    monkeypatch.setattr(blender_peer, "PYTHON", "/nowhere/python")
    shown = box(), gi.builtin_camera_path("cornell_box"), (0,), 1, "cpu"
    for name, words in ((renderers.LUXCORE, "pyluxcore alone"), (renderers.GUIDED, "no module bpy")):
        with pytest.raises(PeerMissing, match=words):
            renderers.RENDERERS[name](*shown)


def test_luxcore_gets_the_scene(tmp_path):
    scene = peers.QUICK_CASE.scene()
    found = luxcore_peer.write_meshes(scene, tmp_path)
    assert sum(len(np.load(one["mesh"])["faces"]) for one in found) == scene.triangle_count
    assert any(any(one["emission"]) for one in found)
    camera = gi.Camera.look_at((1, 2, 3), (0, 0, 0), hfov=70, resolution=(30, 40))
    told = luxcore_peer._camera(camera)
    assert np.tan(np.radians(told["angle"]) / 2) == pytest.approx(np.tan(np.radians(35)) * 40 / 30)
    np.testing.assert_allclose(np.array(told["target"]) - told["eye"], -np.array([1, 2, 3]) / 14**0.5, atol=1e-6)


def lamp_under_a_sky():
    """A lamp before a sky with a bright patch to the right, above a floor."""
    lamp = quad((-0.5, -0.25, -2), (1, 0, 0), (0, 0.5, 0), light((3.0, 2.0, 1.0)))
    floor = quad((-2, -1, 0), (4, 0, 0), (0, 0, -4), gi.Material("grey", (0.5, 0.5, 0.5), specular=0.0))
    pixels = np.full((32, 64, 3), 0.05, np.float32)
    pixels[12:16, 2:6] = [0.5, 1.0, 2.0]
    return gi.Scene([gi.Node("all", [lamp, floor])], environment=gi.Environment(pixels=pixels))


@pytest.mark.skipif(not luxcore_peer.is_installed(), reason="no pyluxcore; pip install pyluxcore")
def test_luxcore_shows_the_same(tmp_path):
    camera = gi.Camera.look_at((0, 0, 0), (0, 0, -1), hfov=60, resolution=(160, 90))
    found = luxcore_peer.render(lamp_under_a_sky(), [camera], 16, 8, tmp_path).pictures[0]
    ours = next(iter(gi.render(lamp_under_a_sky(), camera, gi.Pipeline(spp=64, camera_samples=64)))).numpy("beauty")
    np.testing.assert_allclose(found.mean((0, 1)), ours.mean((0, 1)), rtol=0.02)
    np.testing.assert_allclose(found[:, 80, 0].sum(), ours[:, 80, 0].sum(), rtol=0.02)
    for rows in (slice(25, 30), slice(60, 65)):  # the lamp's upper and lower edge
        np.testing.assert_allclose(found[rows, 80, 0], ours[rows, 80, 0], atol=0.4)
    assert np.abs(found - ours).mean() < 0.05 * ours.mean() < np.abs(found[:, ::-1] - ours).mean()


@pytest.mark.skipif(not blender_peer.is_installed(), reason="no bpy; pip install bpy")
def test_cycles_shows_the_same_sky(tmp_path):
    camera = gi.Camera.look_at((0, 0, 0), (0, 0, -1), hfov=60, resolution=(160, 90))
    scene = lamp_under_a_sky()
    blender_peer.write_glb(scene, tmp_path / "scene.glb")
    blender_peer.render(tmp_path, [camera], 16, scene.environment, 6, denoise=True)
    found = blender_peer.rendered(tmp_path, 0)
    ours = next(iter(gi.render(scene, camera, gi.Pipeline(spp=64, camera_samples=64)))).numpy("beauty")
    assert np.abs(found - ours).mean() < 0.05 * ours.mean() < np.abs(found[:, ::-1] - ours).mean()


# ---- documents ----


def test_documents_show_all_of_it(rows, peer_rows):
    pytest.importorskip("pyoidn")
    switches = [row | {"frames later": later} for row in named(rows, switched.TABLE)[:3] for later in (0, 3, 8)]
    cold = [row | {"state": first.COLD} for row in named(rows, first.FIRST)]
    stamped = [row | {"suite": "clean", "commit": "abc", "device": "cpu"} for row in (*rows, *peer_rows)]
    stamped += [row | {"suite": "clean"} for row in (*switches, *cold)]
    stamped[0]["pattern"] = 0.4  # no wall is large enough here
    text = region_text("clean", REGIONS["clean"], stamped)
    assert "smooth: **0.40**." in " ".join(text.split())
    assert "| Cornell box |" in text and "| switched off |" in text
    assert "| Cornell box |" in region_text("clean short", REGIONS["clean short"], stamped)
    assert "4 frames of the atrium" in region_text("clean first", REGIONS["clean first"], stamped)
    assert "| flat, 8 spp |" in region_text("clean peers", REGIONS["clean peers"], stamped)
    shown = {plot.title: plot for plot in suite_plots.plots_of("clean", rows)}
    assert len(shown["FLIP over CPU time, Cornell box"].series["clean"][0]) == 2
    assert "switched off, clean" in shown["Old light left after a switch"].series


def test_cases_exist_and_their_cameras_move(monkeypatch, tmp_path):
    for case in (*cases.BUILT_IN, *cases.FROM_FILES, *cases.MOVING, cases.SWITCHED):
        path = case.path()
        eyes = [path.camera(frame).world_from_camera[:3, 3] for frame in (0, case.judged.last)]
        assert 0.2 < np.linalg.norm(eyes[1] - eyes[0]) < 4 and path.resolution == case.size
    monkeypatch.setattr(places.scenes, "SCENES", tmp_path)
    found = sequences.all_rows(cases.FROM_FILES, False, "cpu")
    assert len(found) == 5 and all("WARP_GI_SCENES" in row["skipped"] for row in found)
