"""What transfer textures look like: charts, how much of the sky is seen, what bounces, and a view under the sky."""

from __future__ import annotations

import colorsys
import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from warp_gi.baking import Bake
from warp_gi.pipeline import Pipeline
from warp_gi.scene.camera import Camera
from warp_gi.scene.scene import Scene
from warp_gi.scheduler import FrameScheduler
from warp_gi.sequence.preview import magma, tone_map, write_pngs
from warp_gi.techniques.radiance_transfer.estimator import RadianceTransfer
from warp_gi.techniques.radiance_transfer.export import SIDES
from warp_gi.techniques.radiance_transfer.textures import TransferTextures, transfer_textures
from warp_gi.techniques.shared.lamps import lamps_move
from warp_gi.techniques.shared.legends import exposure_of, scale_bar, stacked, with_keys

PAGE_PIXELS = 2048
"""Largest width and height of a picture of a page; of larger pages some texels are left out."""
EMPTY = (40, 44, 52)
"""Colour of texels without a slot, in sRGB."""
WHITE_SKY = math.sqrt(4.0 * math.pi)
"""First coefficient of a sky of radiance 1; the others are 0."""


def write_pictures(
    scene: Scene,
    camera: Camera,
    bake: Bake,
    settings: RadianceTransfer,
    folder: str | Path,
    device: str = "cpu",
    seed: int = 0,
) -> list[Path]:
    """Write what transfer textures hold, and a view of the scene by them; return the paths.

    For each page, and its backs where there are any: charts.page0.png has each chart in a colour, sky.page0.png how
    much of the light of a white sky arrives directly, bounces.page0.png what arrives over other surfaces. view.png is
    the scene under its sky. Transfer at vertices has no pages.

    Args:
        scene: Scene that was baked.
        camera: View that is shown.
        bake: Bake of the scene.
        settings: Settings of the bake.
        folder: Where pictures go; made if missing.
        device: Device that renders.
        seed: Seed of the view.

    Raises BakeError for a bake of another technique, OSError when nothing can be written.
    """
    textures = transfer_textures(bake)
    pictures = {}
    for page in range(len(textures.atlas.pages)):
        for side, word in enumerate(SIDES):
            slots = page_slots(textures, page, side)
            if (slots >= 0).any():
                suffix = f"page{page}" + f".{word}" * side
                pictures[f"charts.{suffix}"] = draw_charts(textures, slots)
                pictures[f"sky.{suffix}"] = draw_sky(textures, slots)
                if len(textures.bounces):
                    pictures[f"bounces.{suffix}"] = draw_bounces(textures, slots)
    pictures["view"] = draw_view(scene, camera, bake, settings, device, seed)
    return write_pngs(folder, pictures)


def page_slots(textures: TransferTextures, page: int, side: int) -> np.ndarray:
    """Return the slots of a page's texels, int32 [height, width], every so many of a large one; -1 without one."""
    first, width, height = textures.atlas.pages[page]
    step = -(-max(width, height) // PAGE_PIXELS)
    return textures.atlas.slots[side, first : first + width * height].reshape(height, width)[::step, ::step]


def draw_charts(textures: TransferTextures, slots: np.ndarray) -> np.ndarray:
    """Return the charts of texels in colours, uint8 [height + legend, width, 3]."""
    charts = textures.atlas.charts[textures.atlas.slot_faces[np.maximum(slots, 0)]]
    kept = slots >= 0
    numbers, which = np.unique(charts[kept], return_inverse=True)
    colors = [colorsys.hsv_to_rgb(number * 0.618034 % 1.0, 0.55 + 0.3 * (number % 2), 0.95) for number in numbers]
    image = np.full((*slots.shape, 3), EMPTY, np.uint8)
    image[kept] = (np.array(colors) * 255).astype(np.uint8)[which]
    return with_keys(image, (), f"{len(numbers):,} charts; {kept.mean():.1%} of the texels hold a surface")


def draw_sky(textures: TransferTextures, slots: np.ndarray) -> np.ndarray:
    """Return the share of a white sky's light that arrives directly, uint8 [height + legend, width, 3]."""
    rows = textures.transfer[np.maximum(slots, 0), 0].astype(np.float32)
    image = magma(rows * (WHITE_SKY / math.pi))
    image[slots < 0] = EMPTY
    return stacked(image, scale_bar(image.shape[1], 1.0, "light of a white sky that arrives directly, of all of it"))


def draw_bounces(textures: TransferTextures, slots: np.ndarray) -> np.ndarray:
    """Return the light of a white sky that arrives over other surfaces, uint8 [height + legend, width, 3]."""
    light = textures.bounces[np.maximum(slots, 0), :, 0].astype(np.float32) * (WHITE_SKY / math.pi)
    light[slots < 0] = 0
    mean = float(light[slots >= 0].mean())
    image = tone_map(light, exposure_of(light))
    image[slots < 0] = EMPTY
    return with_keys(image, (), f"light of a white sky over other surfaces: {mean:.3g} of all of it on average")


def draw_view(
    scene: Scene, camera: Camera, bake: Bake, settings: RadianceTransfer, device: str, seed: int
) -> np.ndarray:
    """Return the light of the sky in a view, by transfer alone, uint8 [height, width, 3]."""
    environment = replace(settings, term="environment")
    bounces = settings.bounces > 0 and not lamps_move(scene)
    indirect = replace(settings, term="indirect") if bounces else None
    pipeline = Pipeline(environment=environment, indirect=indirect, emitters=None, spp=4)
    frame = FrameScheduler(scene, camera, pipeline, device, seed, bakes=[bake]).frame(0)
    return tone_map(frame.numpy("beauty"), exposure_of(frame.numpy("beauty")))
