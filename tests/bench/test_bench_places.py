"""The table of places: what it names exists, looks at something, and is what the suites take; previews of it."""

from __future__ import annotations

import importlib
import re

import numpy as np
import pytest
from PIL import Image

import warp_gi as gi
from warp_gi.bench import mitsuba_reference, previews
from warp_gi.bench.compare import reference as compare_reference
from warp_gi.bench.harness import catalogue, places, scenes
from warp_gi.bench.harness.places import PLACES, Place
from warp_gi.bench.harness.stages import Case
from warp_gi.bench.peers import blender_peer
from warp_gi.bench.suites.dvf import views as dvf_views
from warp_gi.bench.suites.path import suite as path
from warp_gi.bench.suites.probes import defaults as probes_defaults
from warp_gi.bench.suites.probes import denoise as probes_denoise
from warp_gi.bench.suites.probes import views as probes_views
from warp_gi.bench.suites.rays import suite as rays
from warp_gi.bench.suites.reuse import quality as reuse_quality
from warp_gi.bench.suites.reuse import views as reuse_views
from warp_gi.sequence.exr import write_exr
from warp_gi.sequence.frames import write_preview

SMALL = ("cornell_box", "cylinders", "guiding_ring", "sphere_row", "spheres", "strobe", "two_rooms", "two_rooms_dark")
BUILT = [name for name, place in PLACES.items() if not place.files]


def cases_of(module: object) -> list[Case]:
    """Return the cases that a module has by name, or in tuples."""
    groups = [value if isinstance(value, tuple) else (value,) for value in vars(module).values()]
    return [case for group in groups for case in group if isinstance(case, Case)]


# ---- references ----


def test_references_lose_no_bounces_whatever_the_default_depth_is(monkeypatch):
    """The pictures that suites measure against have the mean of paths of 64 edges; 8 would lose 7 % here."""
    place = PLACES["two_rooms"]
    scene, camera = place.scene(), place.camera().at_resolution(24, 16)

    def mean(picture):
        return picture.mean(dtype=np.float64)

    deep = gi.Pipeline(indirect=gi.BsdfPaths(max_depth=64), spp=256, camera_samples=1)
    expected = next(gi.render(scene, camera, deep, seed=5))
    monkeypatch.setattr(gi.BsdfPaths.__init__, "__defaults__", (8, *gi.BsdfPaths.__init__.__defaults__[1:]))
    assert gi.BsdfPaths().max_depth == 8
    compared = compare_reference.computed(scene, camera, "cpu", 1, 256, centred=True)
    assert mean(compared.picture) == pytest.approx(mean(expected.numpy("beauty")), rel=0.015)
    probes = probes_views.ProbeView(scene, camera, reference_spp=128)
    assert mean(probes.reference) == pytest.approx(mean(expected.numpy("indirect")), rel=0.03)
    reuse = reuse_views.Truth(scene, camera, spp=128)
    assert mean(reuse.mean("indirect")) == pytest.approx(mean(expected.numpy("indirect")), rel=0.03)


# ---- the table ----


def test_titles_tell_places_apart():
    titles = [place.title for place in PLACES.values()]
    assert len(set(titles)) == len(titles) and all(titles)


@pytest.mark.parametrize(
    "name", [name for name in PLACES if not (isinstance(PLACES[name].view, str) and PLACES[name].view)]
)
def test_paths_give_cameras(name):
    camera = PLACES[name].camera()
    assert camera.resolution == PLACES[name].path().resolution and min(camera.resolution) >= 360
    assert 0.0 < camera.hfov < 120.0 and np.isfinite(camera.world_from_camera).all()


def test_a_view_may_be_a_camera_of_the_scene():
    row, spot = PLACES["sphere_row"], gi.builtin_scene("sphere_row").cameras["main"]
    assert row.view == "main" and len(row.path().keys) == 1
    np.testing.assert_allclose(row.camera().world_from_camera, spot.world_from_camera, atol=1e-12)


@pytest.mark.parametrize("name", SMALL)
def test_built_places_are_looked_at(name):
    """Rays through the middle of the picture hit something."""
    place = PLACES[name]
    assert name in BUILT
    camera = place.camera().at_resolution(5, 5)
    ways = camera.directions(np.array([(x, y) for x in (2.0, 2.5, 3.0) for y in (2.0, 2.5, 3.0)])).astype(np.float32)
    eyes = np.tile(camera.position.astype(np.float32), (len(ways), 1))
    assert (place.scene().bvh("cpu").intersect(eyes, ways).face.numpy() >= 0).mean() > 0.5


def test_what_lights_a_place_is_its_own_or_the_tables():
    assert gi.builtin_scene("cornell_box").environment is None or PLACES["cornell_box"].scene().environment.is_black
    white = Place("white", "cornell_box", environment=places.WHITE).scene()
    np.testing.assert_allclose(white.environment.mean_radiance, 1.0)
    row = PLACES["sphere_row"].scene()
    assert row.environment.content_hash == gi.builtin_scene("sphere_row").environment.content_hash
    np.testing.assert_allclose(PLACES["spheres"].scene().environment.mean_radiance, (0.2, 0.3, 0.5), rtol=1e-6)


def test_files_are_read_and_what_is_missing_is_said(monkeypatch, tmp_path):
    monkeypatch.setattr(scenes, "SCENES", tmp_path)
    for name, place in PLACES.items():
        assert bool(place.missing) == (name not in BUILT)
        assert not place.missing or "WARP_GI_SCENES" in place.missing
    place = Place("box", "box.obj", PLACES["cylinders"].view, "sky.exr")
    (tmp_path / "box.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 0 1\nf 1 2 3\n", encoding="utf-8")
    assert place.files == ("box.obj", "sky.exr")
    assert "sky.exr" in place.missing and "box.obj" not in place.missing
    with pytest.raises(gi.SceneError, match=r"sky\.exr"):
        place.scene()
    write_exr(tmp_path / "sky.exr", {"beauty": np.full((4, 8, 3), 2.0)}, {})
    assert place.missing == "" and place.scene().triangle_count == 1
    np.testing.assert_allclose(place.scene().environment.mean_radiance, 2.0, rtol=1e-3)
    assert PLACES["dragon"].files == (scenes.DRAGON,) and "environments" in PLACES["sponza_courtyard"].missing


# ---- suites ----


def test_suites_take_places_of_the_table():
    files = [path for path in sorted(catalogue.FOLDER.glob("*/*.py")) if path.stem != "__init__"]
    modules = [importlib.import_module(f"warp_gi.bench.suites.{path.parent.name}.{path.stem}") for path in files]
    taken = {case.place for module in modules for case in cases_of(module)}
    taken |= {case.place for case in mitsuba_reference.PICTURES.values()}
    taken |= {*rays.CASES.values(), *path.FIRST_FRAMES.values(), blender_peer.FULL.scene, blender_peer.QUICK.scene}
    assert taken <= set(PLACES) and len(taken) > 20
    for picture in previews.README_PICTURES.values():
        assert set(picture.places) <= set(BUILT)  # pictures of others' scenes are not ours to give away


def test_a_case_changes_materials_and_nothing_else():
    plain, lambert = Case("sphere_row"), Case("sphere_row", "row", materials={"diffuse": True})
    assert (plain.name, lambert.name) == ("sphere_row", "row")
    assert any(m.metallic for m in plain.scene().materials)
    assert not any(m.metallic or m.specular for m in lambert.scene().materials)
    assert (plain.camera().world_from_camera == lambert.camera().world_from_camera).all()
    dark = Case("cornell_box", "dark", materials=path._UNLIT)
    assert dark.scene().emitter_count == 0 and path.CASES[-1].scene().emitter_count == 2


def test_suites_have_something_to_do_without_files(monkeypatch, tmp_path):
    monkeypatch.setattr(scenes, "SCENES", tmp_path)
    lists = [dvf_views.CASES, reuse_quality.QUICK_CASES, probes_denoise.CASES, probes_defaults.QUICK_CASES, path.CASES]
    for cases in (*lists, [PLACES[rays.CASES[name]] for name in rays.QUICK_SCENES]):
        assert any(not case.missing for case in cases)


# ---- previews ----


def test_previews_are_pngs_and_missing_places_are_passed_over(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(scenes, "SCENES", tmp_path)
    monkeypatch.setattr(previews, "WIDTH", 24)
    folder = tmp_path / "seen"
    assert previews.main(["cornell_box", "sponza", "strobe", "-o", str(folder), "--spp", "4"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in said] == ["wrote", "sponza:", "wrote"] and "crytek_sponza.glb" in said[1]
    assert sorted(file.name for file in folder.iterdir()) == ["cornell_box.png", "strobe.png"]
    sizes = {name: Image.open(folder / f"{name}.png") for name in ("cornell_box", "strobe")}
    assert (sizes["cornell_box"].size, sizes["strobe"].size) == ((24, 24), (24, 14))
    box = np.asarray(sizes["cornell_box"]).astype(float)
    assert box[:, :6, 0].mean() > 1.5 * box[:, :6, 1].mean()  # the red wall is on the left
    frame = next(
        iter(
            gi.render(
                PLACES["cornell_box"].scene(),
                PLACES["cornell_box"].path().at_resolution(24, 24),
                gi.Pipeline.preset("path", spp=4),
            )
        )
    )
    written = write_preview(frame, tmp_path / "rendered.png")
    assert np.array_equal(np.asarray(Image.open(written)), np.asarray(sizes["cornell_box"]))


def test_a_preview_of_a_pipeline_with_a_history_has_one():
    place = PLACES["cornell_box"]
    scheduler = gi.FrameScheduler(
        place.scene(), place.path().at_resolution(24, 16), gi.Pipeline.preset("clean", spp=1), "cpu"
    )
    frames = [scheduler.frame(index).numpy("beauty").copy() for index in range(3)]
    shown = previews.tone_map(previews.stored_values("beauty", frames[2]))
    assert np.array_equal(previews.render("cornell_box", (24, 16), 1, 2, preset="clean"), shown)
    assert previews.README_PICTURES["assets/atrium.jpg"].pipeline == "clean"


def test_previews_are_never_larger_than_the_place():
    assert previews.preview_size((960, 540)) == (480, 270)
    assert previews.preview_size((320, 200)) == (320, 200) and previews.preview_size((4000, 1)) == (480, 1)


def test_wrong_previews_are_one_line(tmp_path, capsys):
    assert previews.main(["cornell_boks", "-o", str(tmp_path / "none")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "did you mean 'cornell_box'" in error and not (tmp_path / "none").exists()
    assert previews.main(["cornell_box", "-o", str(tmp_path), "--spp", "0"]) == 2
    assert previews.main(["cornell_box", "--readme"]) == 2
    assert capsys.readouterr().err.count("\n") == 2 and not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("", encoding="utf-8")
    assert previews.main(["cornell_box", "-o", str(tmp_path / "file")]) == 2


def test_pictures_of_the_readme_are_made_anew(monkeypatch, tmp_path, capsys):
    strip = previews.ReadmePicture(("cornell_box", "strobe", "spheres", "cylinders"), (12, 8), 2, columns=2)
    monkeypatch.setattr(previews, "README_PICTURES", {"assets/strip.jpg": strip})
    monkeypatch.setattr(previews, "ROOT", tmp_path)
    assert previews.main(["--readme", "--spp", "1"]) == 0
    assert capsys.readouterr().out == f"wrote {tmp_path / 'assets/strip.jpg'}\n"
    picture = Image.open(tmp_path / "assets/strip.jpg")
    assert picture.format == "JPEG" and picture.size == (24, 16)


def test_places_of_a_picture_stand_in_rows(monkeypatch):
    names = ("cornell_box", "strobe", "spheres", "cylinders")
    monkeypatch.setattr(previews, "render", lambda name, size, *_: np.full((2, 3, 3), names.index(name), np.uint8))
    pixels = previews.tiled(previews.ReadmePicture(names, (3, 2), 1, columns=2))
    assert pixels[::2, ::3, 0].tolist() == [[0, 1], [2, 3]]


def test_the_readme_shows_what_the_table_makes():
    text = (previews.ROOT / "README.md").read_text(encoding="utf-8")
    assert set(re.findall(r"!\[[^]]*\]\((assets/[^)]+)\)", text)) == set(previews.README_PICTURES)
    for file, picture in previews.README_PICTURES.items():
        rows = len(picture.places) // picture.columns
        assert Image.open(previews.ROOT / file).size == (picture.size[0] * picture.columns, picture.size[1] * rows)
