"""Atlases of real scenes; they are looked for in WARP_GI_SCENES, and skipped where they are not."""

import os
from pathlib import Path

import numpy as np
import pytest
from atlas_tools import fetched, points_of, random_points, settings, slot_positions

import warp_gi as gi
from warp_gi.techniques.shared.atlas import chart_cache
from warp_gi.techniques.shared.atlas.build import make_atlas

SCENES = Path(os.environ.get("WARP_GI_SCENES", Path(__file__).parents[2] / ".." / "shared" / "scenes"))

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _own_cache(monkeypatch, tmp_path_factory):
    monkeypatch.setattr(chart_cache, "cache_folder", lambda name: tmp_path_factory.getbasetemp() / "charts")


def real_scene(file):
    if not (SCENES / file).exists():
        pytest.skip(f"{file} is not there; set WARP_GI_SCENES")
    return gi.load_scene(SCENES / file)


@pytest.mark.parametrize(
    ("file", "most_backs"),
    [("living_room/living_room.obj", 0.45), ("modern_hall.glb", 0.5), ("crytek_sponza.glb", 0.5)],
)
def test_real_atlas(file, most_backs):
    scene = real_scene(file)
    atlas = make_atlas(scene, settings(resolution=1024, charts="auto"), "cpu")
    assert (atlas.face_pages >= 0).mean() > 0.999
    assert 0.95 * 1024 <= atlas.pages[0, 1:].max() <= 1024
    faces, u, v = random_points(np.flatnonzero(atlas.face_pages >= 0), 3)
    slots, shares = fetched(atlas, faces, u, v)
    assert np.where(slots < 0, shares, 0.0).max() <= 1e-3
    used = (slots >= 0) & (shares > 1e-3)
    assert (atlas.charts[atlas.slot_faces[slots]] == atlas.charts[faces][:, None])[used].all()
    distances = np.linalg.norm(slot_positions(scene, atlas)[slots] - points_of(scene, faces, u, v)[:, None], axis=2)
    texel = np.sqrt(scene.surface_area / np.count_nonzero(atlas.slot_sides == 0))
    assert np.quantile(distances[used], 0.999) < 3.0 * texel
    assert (atlas.slot_sides == 1).mean() < most_backs


def test_texel_sets_of_the_hall():
    """At one density most triangles of the hall have no texel of their own."""
    scene = real_scene("modern_hall.glb")
    with_texel = {}
    for name in ("one", "auto"):
        atlas = make_atlas(scene, settings(resolution=1024, texel_sets=name), "cpu")
        with_texel[name] = len(np.unique(atlas.slot_faces))
        assert atlas.pages[0, 1:].max() <= 1024
    assert with_texel["auto"] > 5 * with_texel["one"], with_texel
