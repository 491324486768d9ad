"""Tone-mapped previews.

The curve is Stephen Hill's fit of the ACES reference and output transforms: a matrix
that desaturates bright colours, a filmic curve with toe and shoulder, and a matrix back,
then the sRGB coding. Scene values are divided by 0.6 first, so that middle grey stays
about where it is. Exposure is in stops and fixed: previews of a sequence do not pump.
"""

from __future__ import annotations

import io
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from warp_gi.color import encode_srgb
from warp_gi.errors import OptionError, check_number
from warp_gi.files import replacing

MOST_STOPS = 100.0
"""Largest exposure up or down: float32 has 277 stops from its least to its largest number."""
EXPOSURE = "warp_gi exposure"
"""Name of a preview's exposure in its file."""
_MIDDLE = 0.6
_INPUT = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
_OUTPUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])


def check_exposure(exposure: float) -> None:
    """Raise OptionError for an exposure that is no number of stops from -MOST_STOPS to MOST_STOPS."""
    check_number("exposure", exposure)
    if not -MOST_STOPS <= exposure <= MOST_STOPS:
        raise OptionError(f"exposure must be from {-MOST_STOPS:g} to {MOST_STOPS:g} stops, got {exposure:g}")


def tone_map(image: np.ndarray, exposure: float = 0.0) -> np.ndarray:
    """Return linear radiance [height, width, 3] as sRGB uint8 [height, width, 3].

    ``exposure`` is in stops: +1 doubles the light. NaN becomes black, infinity white. Raises OptionError for an
    exposure past 100 stops.
    """
    check_exposure(exposure)
    light = np.nan_to_num(np.asarray(image, np.float64), nan=0.0, posinf=1e6, neginf=0.0)
    x = np.clip(light * 2.0**exposure / _MIDDLE, 0, 1e6) @ _INPUT.T
    x = (x * (x + 0.0245786) - 0.000090537) / (x * (0.983729 * x + 0.4329510) + 0.238081)
    return to_bytes(encode_srgb(x @ _OUTPUT.T))


def to_bytes(values: np.ndarray) -> np.ndarray:
    """Return values 0..1 rounded to uint8 0..255."""
    return np.round(np.clip(values, 0, 1) * 255).astype(np.uint8)


def magma(values: np.ndarray) -> np.ndarray:
    """Return values 0..1 [height, width] in the magma colours, uint8 [height, width, 3]: 0 is black, 1 pale yellow."""
    import OpenImageIO as oiio

    source = oiio.ImageBuf(np.ascontiguousarray(np.clip(values, 0, 1), np.float32)[:, :, None])
    return to_bytes(np.asarray(oiio.ImageBufAlgo.color_map(source, 0, "magma").get_pixels(oiio.FLOAT))[:, :, :3])


def write_pngs(folder: str | Path, pictures: Mapping[str, np.ndarray]) -> list[Path]:
    """Write uint8 [height, width, 3] images as NAME.png to a folder, and return the paths."""
    paths = [Path(folder) / f"{name}.png" for name in pictures]
    for path, pixels in zip(paths, pictures.values(), strict=True):
        write_png(path, np.ascontiguousarray(pixels))
    return paths


def write_png(path: str | Path, pixels: np.ndarray, exposure: float = 0.0) -> None:
    """Write uint8 [height, width, 3] as PNG; the file appears whole or not at all. Raises OSError.

    An ``exposure`` that is not 0 is in it as a text, see ``preview_exposure``.
    """
    from PIL import Image, PngImagePlugin

    about = PngImagePlugin.PngInfo()
    if exposure:
        about.add_text(EXPOSURE, repr(float(exposure)))
    with replacing(path) as part:  # by runs alone: a quarter of the time, and 1 % larger
        Image.fromarray(pixels).save(part, format="PNG", compress_type=zlib.Z_RLE, pnginfo=about)


def preview_exposure(path: str | Path) -> float | None:
    """Return the exposure in stops of a preview; None if it is missing, or no PNG file."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            return float(image.info.get(EXPOSURE, 0.0))
    except (OSError, ValueError, SyntaxError):
        return None


def picture_bytes(radiance: np.ndarray) -> bytes:
    """Return linear radiance [height, width, 3], tone-mapped, as the bytes of a PNG file: a notebook shows them."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(tone_map(radiance)).save(file, format="PNG")
    return file.getvalue()
