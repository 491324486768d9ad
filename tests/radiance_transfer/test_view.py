"""The page of a bake without a browser: what is in it, its size, and mistakes."""

from __future__ import annotations

import base64
import json
import re
import zlib
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from atlas_tools import fetched, random_points
from transfer_bake_tools import bake_of, court, random_bake

import warp_gi as gi
from warp_gi.baking import Bake
from warp_gi.cli import main as cli
from warp_gi.errors import BakeError, OptionError
from warp_gi.techniques.radiance_transfer.pca import expand_bounces
from warp_gi.techniques.radiance_transfer.textures import TransferTextures
from warp_gi.techniques.radiance_transfer.vertices import vertex_atlas
from warp_gi.techniques.radiance_transfer.viewer import pages, skies
from warp_gi.techniques.radiance_transfer.viewer.page import write_view

CAMERA = gi.Camera.look_at((2.6, 3.4, 3.4), (-0.1, 0.4, -0.1), hfov=52, resolution=(96, 64))
LIGHT = np.random.default_rng(7).normal(size=(3, 25))


class Page(HTMLParser):
    """What a page says about itself, its arrays, and all that it may load."""

    def __init__(self, path):
        super().__init__()
        self.text = path.read_text(encoding="utf-8")
        self.loads, self.scripts, self._name = [], {}, None
        self.feed(self.text)
        self.about = json.loads(self.scripts["about"])

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.loads += [value for name, value in attributes if name in ("src", "href", "srcset", "action", "data")]
        self._name = given.get("id") if tag == "script" else None

    def handle_data(self, data):
        if self._name:
            self.scripts[self._name] = self.scripts.get(self._name, "") + data

    def handle_endtag(self, tag):
        self._name = None

    def array(self, record, kind):
        """A part of the page, [*shape]."""
        packed = zlib.decompress(base64.b64decode(self.scripts[f"part-{record['part']}"]))
        planes = np.frombuffer(packed, np.uint8).reshape(record["size"], -1)
        differences = np.ascontiguousarray(planes.T).view(f"<u{record['size']}").reshape(record["shape"])
        return np.cumsum(differences, axis=-1, dtype=differences.dtype).view(kind)

    def texels(self, page, side):
        """Numbers of one side of a page, float64 [height, width, 4 * layers]."""
        record = self.about["pages"][page][side]
        layers = [self.array(one, "<i2") for one in record["layers"]]
        return np.moveaxis(np.concatenate(layers), 0, -1) * np.array(record["steps"])

    def shaded(self, page, side, places):
        """Irradiance under LIGHT at places [n, 2] in 0..1, as the shader has it: fetched, then multiplied."""
        texels, about = self.texels(page, side), self.about
        at = places * texels.shape[1::-1] - 0.5
        low = np.floor(at).astype(int)
        result = np.zeros((len(places), texels.shape[2]))
        for j in range(2):
            for i in range(2):
                share = np.prod(np.where([i, j], at - low, 1 - (at - low)), axis=1)
                x, y = np.clip(low + np.array([i, j]), 0, np.array(texels.shape[1::-1]) - 1).T
                result += share[:, None] * texels[y, x]
        parts = np.array(about["components"]).reshape(-1, 75)
        bounces = (result[:, 28 : 28 + len(parts)] @ parts).reshape(-1, 3, 25)
        direct = result[:, :25] @ LIGHT.T
        return direct, np.einsum("ncj,cj->nc", bounces, LIGHT), result[:, 25:28]


@pytest.fixture(scope="module")
def scene():
    result = court()
    result.environment = gi.Environment(pixels=np.random.default_rng(2).random((16, 32, 3), np.float32), rotation=30)
    return result


@pytest.fixture(scope="module")
def textures(scene):
    """Random numbers that 24 components hold, on two pages."""
    made = random_bake(scene)
    rng = np.random.default_rng(8)
    basis = np.linalg.qr(rng.normal(size=(75, 12)))[0].T
    bounces = expand_bounces(basis, rng.normal(size=(made.atlas.count, 12)))
    return replace(made, bounces=bounces.astype(np.float16), lamps=made.lamps * np.float32(1e-4))


@pytest.fixture(scope="module")
def written(scene, textures, tmp_path_factory):
    path = tmp_path_factory.mktemp("view") / "court.html"
    assert write_view(bake_of(textures, scene), scene, CAMERA, path) == path
    assert [file.name for file in path.parent.iterdir()] == ["court.html"]
    return Page(path)


# ---- what is in it ----


def test_the_file_stands_alone(written):
    assert [value for value in written.loads if not value.startswith(("data:", "#"))] == []
    assert not re.search(r"url\(|@import|https?://|\bimport\b", written.text)
    assert "$" not in re.sub(r"\$\{|<script>.*?</script>", "", written.text, flags=re.DOTALL)
    assert "default-src 'none'" in written.text and "<title>court</title>" in written.text


def test_every_number_of_a_slot_is_in_its_texel(written, textures):
    """To half a step of a thousandth of the RMS."""
    atlas = textures.atlas
    rows = pages.rows_of(textures)
    steps = pages.steps_of(rows, pages.FINE)
    rms = np.sqrt((rows.values.astype(np.float64) ** 2).mean(axis=0))
    assert (steps[:28] <= 1.5 * rms[:28] / 1024).all() and (steps[28:40] <= 1.5 * rms[28:40] / 256).all()
    for page, side in ((0, 0), (0, 1), (1, 0)):
        texels = written.texels(page, side)
        first, width, height = atlas.pages[page]
        slots = atlas.slots[side, first : first + width * height].reshape(height, width)
        error = np.abs(texels - rows.values[slots].astype(np.float64))[slots >= 0]
        assert (error <= 0.501 * steps).all()
    assert written.about["pages"][1][1] is None


def test_light_is_that_of_the_bake(written, textures):
    """What the shader adds up at points of faces against sums over slots."""
    atlas = textures.atlas
    about = written.about
    places = written.array(about["places"], "<f4").T.astype(np.float64)
    triangles = written.array(about["triangles"], "<u4").T
    positions = written.array(about["positions"], "<f4").T
    compared = 0
    for group in about["groups"]:
        for triangle in triangles[group["first"] : group["first"] + group["count"]]:
            flat_points = court()._flat.points[court()._flat.indices]
            face = next(f for f in range(len(flat_points)) if np.array_equal(flat_points[f], positions[triangle]))
            assert atlas.face_pages[face] == group["page"]
            faces, u, v = random_points(np.array([face]), 40, seed=face)
            slots, shares = fetched(atlas, faces, u, v, group["side"])
            whole = ((slots >= 0) | (shares < 1e-6)).all(axis=1)
            at = np.stack([1 - u - v, u, v], axis=1) @ places[triangle]
            direct, bounced, lamps = written.shaded(group["page"], group["side"], at)
            mean = lambda values: (values[slots].astype(np.float64) * shares[..., None]).sum(axis=1)  # noqa: B023, E731
            flat = mean(textures.bounces.reshape(-1, 75)).reshape(-1, 3, 25)
            expected = [mean(textures.transfer) @ LIGHT.T, np.einsum("ncj,cj->nc", flat, LIGHT), mean(textures.lamps)]
            for got, wanted in zip((direct, bounced, lamps), expected, strict=True):
                np.testing.assert_allclose(got[whole], wanted[whole], atol=0.02)
            compared += whole.sum()
    assert compared > 500


def test_texels_beside_a_slot_are_filled(scene, textures):
    """With the mean of those around; a fetch that touches them sees no black."""
    atlas = textures.atlas
    ones = replace(textures, transfer=np.ones_like(textures.transfer))
    rows = pages.rows_of(ones)
    layer = next(pages.page_layers(atlas, rows, 0, 0, 1, np.full(4 * rows.layers, 0.5, np.float32)))
    first, width, height = atlas.pages[0]
    kept = atlas.slots[0, first : first + width * height].reshape(height, width) >= 0
    around = np.pad(kept, 1)
    beside = np.any([around[j : j + height, i : i + width] for j in range(3) for i in range(3)], axis=0)
    assert (layer[0][beside] == 2).all() and beside.sum() > kept.sum()


def test_skies(written, scene):
    own = written.about["skies"][0]
    np.testing.assert_allclose(own["light"], scene.environment.harmonics_of(5), atol=1e-5)
    assert own["rotation"] == 30 and own["map"]["shape"] == [3, 16, 32]
    pixels = np.moveaxis(written.array(own["map"], "<f2"), 0, -1)
    np.testing.assert_array_equal(pixels, scene.environment.pixels.astype(np.float16))
    mean = np.array([0.2126, 0.7152, 0.0722]) @ scene.environment.mean_radiance
    for sky in written.about["skies"][1:]:
        light = np.array(sky["light"])
        assert np.array([0.2126, 0.7152, 0.0722]) @ light[:, 0] / np.sqrt(4 * np.pi) == pytest.approx(mean, rel=1e-4)
        assert np.array(light).shape == (3, 25)


def test_without_a_sky_there_are_made_ones(scene):
    assert [sky.name for sky in skies.page_skies(None)] == [sky.name for sky in skies.page_skies(gi.Environment())]
    assert len(skies.page_skies(scene.environment)) == 1 + len(skies.page_skies(None)) >= 3
    for sky in skies.page_skies(None):  # 25 numbers hold them
        shown = gi.Environment(pixels=sky.pixels.astype(np.float32))
        high = shown.harmonics_of(10)
        assert (high[:, 25:] ** 2).sum() < 0.015 * (high**2).sum(), sky.name


def test_a_map_made_smaller_keeps_its_light():
    rng = np.random.default_rng(4)
    sky = gi.Environment(pixels=np.repeat(np.repeat(rng.random((17, 33, 3), np.float32), 8, 0)[:129], 8, 1)[:, :258])
    small = gi.Environment(pixels=skies.smaller_map(sky.pixels, 33).astype(np.float32))
    np.testing.assert_allclose(small.mean_radiance, sky.mean_radiance, rtol=2e-3)
    np.testing.assert_allclose(small.harmonics_of(5), sky.harmonics_of(5), atol=0.02)
    assert np.allclose(skies.smaller_map(np.ones((64, 128, 3)), 16), 1)


def test_materials_and_images(written, scene):
    about = written.about
    floor = about["materials"][0]
    assert floor["color"] == [0.6, 0.6, 0.6] and floor["image"] == 0 and floor["cutoff"] == -1
    assert [one["wrap"] for one in about["images"]] == [["repeat", "repeat"]]
    data = base64.b64decode(written.scripts[f"part-{about['images'][0]['part']}"])
    assert data[:4] == b"RIFF" and data[8:12] == b"WEBP"


def test_faces_of_which_nothing_is_kept_are_left_out(scene, textures, tmp_path):
    """And told; of transfer of order 6 a page has the 25 numbers that a sky has."""
    pages_of_faces = textures.atlas.face_pages.copy()
    pages_of_faces[[0, 7]] = -1
    atlas, wide = replace(textures.atlas, face_pages=pages_of_faces), random_bake(scene, order=6).transfer
    other = TransferTextures(atlas, wide, textures.bounces[:0], textures.lamps[:0])
    page = Page(write_view(bake_of(other, scene), scene, CAMERA, tmp_path / "a.html"))
    notes = page.about["notes"]
    assert notes == ["Left out are 2 of 16 triangles: they move, or nothing is kept there."]
    fronts = [group for group in page.about["groups"] if group["side"] == 0]
    assert sum(group["count"] for group in fronts) == 14
    rows = pages.rows_of(other)
    np.testing.assert_array_equal(rows.values[:, :25], wide[:, :25])
    assert rows.layers == 7 and not rows.values[:, 25:].any() and not page.about["hasBounces"]


# ---- its size ----


def test_less_detail_is_told_and_fits(scene, textures, tmp_path, written):
    whole = len(written.text.encode()) / 1e6
    sizes = {}
    for share in (0.9, 0.5):
        largest = round(share * whole, 3)
        with pytest.warns(UserWarning, match=rf"small.html: It has .*, to stay under {largest:g} MB"):
            write_view(bake_of(textures, scene), scene, CAMERA, tmp_path / "small.html", largest_mb=largest)
        page = Page(tmp_path / "small.html")
        assert len(page.text.encode()) <= largest * 1e6
        assert page.about["notes"][-1].startswith("It has ")
        sizes[share] = page.about["pages"][0][0]["size"]
    width, height = textures.atlas.pages[0, 1:]
    assert sizes[0.5] < [width, height]
    small = list((tmp_path).iterdir())
    with pytest.raises(OptionError, match=r"expected a page of at most 0.01 MB, got 0\.\d+ MB with the fewest texels"):
        write_view(bake_of(textures, scene), scene, CAMERA, tmp_path / "none.html", largest_mb=0.01)
    assert list(tmp_path.iterdir()) == small


def test_coarser_texels_are_means(scene, textures):
    rows, steps = pages.rows_of(textures), np.full(4 * 13, 1e-3, np.float32)
    atlas = textures.atlas
    fine = next(pages.page_layers(atlas, rows, 1, 0, 1, steps))[0] * 1e-3
    coarse = next(pages.page_layers(atlas, rows, 1, 0, 2, steps))[0] * 1e-3
    first, width, height = atlas.pages[1]
    kept = atlas.slots[0, first : first + width * height].reshape(height, width) >= 0
    seen = 0
    for j, i in np.ndindex(height // 2, width // 2):
        block = np.s_[2 * j : 2 * j + 2, 2 * i : 2 * i + 2]
        if kept[block].any():
            assert coarse[j, i] == pytest.approx(fine[block][kept[block]].mean(), abs=2e-3)
            seen += 1
    assert seen > 50


# ---- mistakes ----


def test_mistakes(scene, textures, tmp_path):
    path, bake = tmp_path / "a.html", bake_of(textures, scene)
    cut = Bake(bake.technique, bake.scene_key, {}, {**bake.arrays, "transfer": bake.arrays["transfer"][:-1]})
    atlas = vertex_atlas(scene)
    none = np.zeros((0, 3, 25), np.float16), np.zeros((0, 3), np.float32)
    vertices = bake_of(TransferTextures(atlas, np.zeros((atlas.count, 25), np.float16), *none), scene)
    other = gi.Scene([gi.Node("floor", [scene.nodes[0].meshes[0]])])
    cases = [
        (lambda: write_view(bake, scene, CAMERA, tmp_path / "a.htm"), OptionError, "a view is one .html file"),
        (lambda: write_view(bake, scene, CAMERA, path, largest_mb=0), OptionError, "largest_mb must be finite and"),
        (lambda: write_view(bake, scene, CAMERA, path, exposure=np.inf), OptionError, "exposure must be a finite"),
        (lambda: write_view(bake_of(textures, scene, "Other"), scene, CAMERA, path), BakeError, "got one of Other"),
        (lambda: write_view(bake, other, CAMERA, path), BakeError, "with 2 triangles, got one of "),
        (lambda: write_view(cut, scene, CAMERA, path), BakeError, "does not hold transfer textures that fit together"),
        (lambda: write_view(vertices, scene, CAMERA, path), OptionError, "this bake is at vertices"),
    ]
    for call, kind, words in cases:
        with pytest.raises(kind, match=words):
            call()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--technique=transfer", "--view=a.png"], "cannot write a.png: a view is one .html file"),
        (["--technique=transfer", "--view=a.html", "--storage=vertices"], "a view shows texels, not vertices"),
        (["--view=a.html"], "--view is not known to bakes for VisibilityField; leave it out"),
        (["--technique=probes", "--view=a.html"], "--view is not known to bakes for LightFieldProbes"),
    ],
)
def test_mistakes_of_the_command_are_one_line(arguments, words, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["bake", "cornell_box", *arguments]) == 2
    error = capfd.readouterr().err
    assert error.startswith("warp-gi: error: ") and error.count("\n") == 1 and words in error
    assert list(tmp_path.iterdir()) == []


def test_the_command_writes_a_view(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ["bake", "cornell_box", "--technique=transfer", "--resolution=64", "--first-rays=16", "--rays=16"]
    assert cli.main([*command, "--bounce-rays=16", "--bounces=2", "--view=views/box.html"]) == 0
    assert "view: views/box.html" in capsys.readouterr().out
    page = Page(tmp_path / "views" / "box.html")
    assert page.about["name"] == "cornell_box" and "Direct light of lamps is not shown." in page.about["notes"]
