"""The page of a bake in a browser without a network: its picture against the renderer's, and what moves it."""

from __future__ import annotations

import io
import itertools
import re
from dataclasses import replace

import numpy as np
import pytest
from browser_tools import opened_page, started_browser
from PIL import Image

import warp_gi as gi
from warp_gi import metrics
from warp_gi.bench.harness.court import court
from warp_gi.scene.model import Material, Node, Texture
from warp_gi.sequence.preview import tone_map
from warp_gi.techniques.radiance_transfer.estimator import RadianceTransfer
from warp_gi.techniques.radiance_transfer.viewer.page import write_view

SIZE = (320, 220)
CAMERA = gi.Camera.look_at((1.6, 2.7, 2.6), (-0.2, 1.1, -0.4), hfov=75, resolution=SIZE)
ESTIMATOR = RadianceTransfer(resolution=96, first_rays=16, rays=64, bounce_rays=16, sun=0.0)
SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--force-color-profile=srgb")
READY = "html[data-ready]"


def sky():
    """A blue sky with a soft orange light low in it, and a brown ground."""
    theta, phi = np.pi * np.arange(64)[:, None] / 63, np.pi * (np.arange(128) + 0.5) / 64
    x, y, z = np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi, -np.sin(theta) * np.cos(phi)
    light = np.exp(9 * (0.8 * x + 0.45 * y + 0.4 * z - 1))[..., None] * (9, 5, 2)
    pixels = np.where(y[..., None] > 0, (0.3, 0.5, 0.9), (0.3, 0.2, 0.1)) + light
    return gi.Environment(pixels=pixels.astype(np.float32), rotation=20)


@pytest.fixture(scope="module")
def scene():
    """The court with a picture on its floor, and a wall that shines."""
    made = court(sky())
    x = np.linspace(0, 255, 16)
    pixels = np.stack(np.broadcast_arrays(x[:, None], x, 255 - x, 255), axis=-1).astype(np.uint8)
    floor = Material("floor", (0.9, 0.8, 0.7), specular=0.0, base_color_texture=Texture("ramp", pixels))
    lamp = Material("lamp", (0.5, 0.5, 0.5), specular=0.0, emission=(0.2, 0.4, 1.2), double_sided=False)
    materials = {"floor": floor, "back": lamp}
    nodes = []
    for node in made.nodes:
        meshes = [replace(one, material=materials.get(one.name, one.material)) for one in node.meshes]
        nodes.append(Node(node.name, meshes))
    return gi.Scene(nodes, environment=made.environment, name="court <1>")


@pytest.fixture(scope="module")
def bake(scene):
    return gi.bake(scene, ESTIMATOR)


@pytest.fixture(scope="module")
def written(scene, bake, tmp_path_factory):
    return write_view(bake, scene, CAMERA, tmp_path_factory.mktemp("view") / "court.html")


@pytest.fixture(scope="module")
def browser():
    with started_browser(*SOFTWARE) as started:
        yield started


def rendered(scene, bake, turn):
    """The renderer's picture of all that the page shows: no direct light of lamps; uint8."""
    first = scene.environment
    scene.environment = first.rotated(turn)
    pipeline = gi.Pipeline(ESTIMATOR, None, replace(ESTIMATOR, term="indirect"), spp=64)
    frame = next(iter(gi.render(scene, CAMERA, pipeline, bakes=[bake])))
    scene.environment = first
    return tone_map(frame.numpy("beauty"))


def seen(page):
    """What the window shows, uint8 [height, width, 3]."""
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))


def opened(browser, path, address="", size=SIZE):
    return opened_page(browser, path, *size, address)


@pytest.mark.parametrize("turn", [0, 90])
def test_the_picture_is_that_of_the_renderer(browser, written, scene, bake, turn):
    expected = rendered(scene, bake, turn)
    with opened(browser, written, f"#bare=1&exposure=0&turn={turn}") as page:
        page.wait_for_selector(READY, timeout=60000)
        picture = seen(page)
    assert picture.shape == expected.shape and expected.std() > 20
    difference = metrics.psnr(picture / 255.0, expected / 255.0)
    assert difference > 35, difference
    off = picture.astype(float) - expected  # edges are all that is off by more than rounding
    assert np.abs(off).mean() < 0.5 and np.abs(off.mean(axis=(0, 1))).max() < 0.15
    assert metrics.psnr(picture / 255.0, rendered(scene, bake, turn + 30) / 255.0) < 30  # it would tell


def test_harmonics_turn_as_in_the_library(browser, written, scene):
    with opened(browser, written, "#bare=1") as page:
        page.wait_for_selector(READY, timeout=60000)
        light = "turnedLight(viewer.about.skies[0].light, aboutUp(-75), viewer.about.sphere).map(one => [...one])"
        turned = page.evaluate(light)
    np.testing.assert_allclose(turned, scene.environment.rotated(-75).harmonics_of(5), atol=1e-5)


def test_what_moves_it(browser, written):
    """Right button and keys turn the sky, the left button and the wheel the view; R leads back."""
    with opened(browser, written, "#bare=1&exposure=0&turn=10") as page:
        page.wait_for_selector(READY, timeout=60000)
        state = lambda: page.evaluate("[viewer.state.turn, viewer.view.yaw, viewer.view.distance]")  # noqa: E731
        first, start = seen(page), state()
        page.mouse.move(100, 100)
        page.mouse.down(button="right")
        page.mouse.move(140, 100)
        page.mouse.up(button="right")
        assert state() == [30, *start[1:]]
        assert not np.array_equal(seen(page), first)
        page.keyboard.press("a")
        assert state()[0] == 25
        page.mouse.down()
        page.mouse.move(100, 110)
        page.mouse.up()
        assert state()[0] == 25 and state()[1] == pytest.approx(np.radians(0.4 * 40))
        page.mouse.wheel(0, -200)
        for _ in range(50):  # the browser hands on wheels when it likes
            page.wait_for_timeout(20)
            if state()[2] < 0.9 * start[2]:
                break
        assert state()[2] == pytest.approx(start[2] / 1.05**5)
        page.keyboard.press("r")
        assert state() == start
        assert np.array_equal(seen(page)[4:-4, 4:-4], first[4:-4, 4:-4])  # within the frame of what has the keys


def test_the_panel(browser, written):
    """Names are escaped; the choice of a sky, the sliders and the box are what the picture shows."""
    with opened(browser, written, size=(900, 600)) as page:
        page.wait_for_selector(READY, timeout=60000)
        assert page.title() == "court <1>" and page.inner_text("#panel h1") == "court <1>"
        assert "Direct light of lamps is not shown." in page.inner_text("#notes")
        assert page.inner_text("#message") == ""
        pictures = [seen(page)]
        page.select_option("#sky", label="orange and blue")
        pictures.append(seen(page))
        for selector, value in (("#exposure", 1.5), ("#turn", 100)):
            page.eval_on_selector(selector, "(e, v) => { e.value = v; e.dispatchEvent(new Event('input')) }", value)
            pictures.append(seen(page))
        page.uncheck("#bounces")
        pictures.append(seen(page))
        assert page.inner_text("#exposure-value") == "1.5 stops" and page.inner_text("#turn-value") == "100\u00b0"
        right = [one[:, 350:].astype(int) for one in pictures]
        assert all(np.abs(a - b).mean() > 1 for a, b in itertools.pairwise(right))
        assert right[2].mean() > right[1].mean() and right[4].mean() < right[3].mean()


def test_exposure_suits_the_view(browser, scene, bake, written, tmp_path):
    """In a scene 64 times as dark the page shows nearly the same, 6 stops up; a number that is given is kept."""
    dark = scene.environment
    dark = gi.Environment(pixels=dark.pixels, rotation=dark.rotation, scale=1 / 64)
    path = write_view(bake, gi.Scene(scene.nodes, environment=dark), CAMERA, tmp_path / "dark.html")
    stops = []
    for one in (written, path):
        with opened(browser, one, "#bounces=0") as page:
            page.wait_for_selector(READY, timeout=60000)
            stops.append(page.evaluate("viewer.state.exposure"))
            middle = np.median(seen(page).mean(axis=2))
            assert 70 < middle < 150
            page.evaluate("viewer.set({ exposure: 3 })")
            page.keyboard.press("e")
            assert page.evaluate("viewer.state.exposure") == stops[-1]
    assert 4 < stops[1] - stops[0] <= 6.1
    write_view(bake, scene, CAMERA, path, exposure=-1.5)
    with opened(browser, path) as page:
        page.wait_for_selector(READY, timeout=60000)
        assert page.evaluate("viewer.state.exposure") == -1.5


def test_a_narrow_window_shows_all_of_the_view(browser, written):
    """The panel is closed, and the canvas fills the window."""
    with opened(browser, written, size=(220, 400)) as page:
        page.wait_for_selector(READY, timeout=60000)
        assert page.eval_on_selector("#view", "c => [c.width, c.height]") == [220, 400]
        assert not page.eval_on_selector("#panel", "d => d.open")
        assert page.evaluate("viewer.view.slopes(220 / 400)")[0] == pytest.approx(np.tan(np.radians(37.5)))


def test_a_damaged_page_says_so(browser, written, tmp_path):
    text = written.read_text(encoding="utf-8")
    broken = tmp_path / "broken.html"
    broken.write_text(re.sub(r'(id="part-2">.{40}).{40}', r"\1", text), encoding="utf-8")
    with opened(browser, broken) as page:
        page.wait_for_selector("html[data-failed]", timeout=60000)
        assert page.inner_text("#message").startswith("Cannot show this bake: ")
