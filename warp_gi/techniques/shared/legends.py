"""Legends below pictures: what their colours mean, in words or on a scale."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from warp_gi.sequence.preview import magma

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont, ImageFont

Color = tuple[int, int, int]
"""Red, green and blue in sRGB, 0 to 255."""
_LINE = 26  # pixels from a line of text to the next


def label_font(size: int = 16) -> FreeTypeFont | ImageFont:
    """Return the font of legends, ``size`` pixels high."""
    from PIL import ImageFont

    try:
        return ImageFont.load_default(size)
    except TypeError:  # Pillow before 10.1
        return ImageFont.load_default()


def with_keys(image: np.ndarray, keys: Sequence[tuple[Color, str]], title: str = "") -> np.ndarray:
    """Return the image with a legend below it: a box of each colour with its meaning, then the title."""
    from PIL import Image, ImageDraw

    font = label_font()
    rows: list[list[tuple[Color, str, int]]] = [[]]
    width, at = max(image.shape[1], 360), 8
    for color, text in keys:
        needed = 22 + math.ceil(font.getlength(text)) + 18
        if at + needed > width and rows[-1]:
            rows.append([])
            at = 8
        rows[-1].append((color, text, at))
        at += needed
    rows = rows if keys else []
    titles = _wrapped(title, font, width - 16)
    bar = Image.new("RGB", (width, _LINE * (len(rows) + len(titles)) + 6), (255, 255, 255))
    draw = ImageDraw.Draw(bar)
    for row, entries in enumerate(rows):
        for color, text, x in entries:
            y = 4 + _LINE * row
            draw.rectangle((x, y + 2, x + 16, y + 18), fill=color, outline=(90, 90, 90))
            draw.text((x + 22, y), text, fill=(0, 0, 0), font=font)
    for row, text in enumerate(titles):
        draw.text((8, 4 + _LINE * (len(rows) + row)), text, fill=(0, 0, 0), font=font)
    return stacked(image, np.asarray(bar))


def with_scale(values: np.ndarray, top: float, title: str) -> np.ndarray:
    """Return ``values`` in the magma colours, with a scale from 0 to ``top`` below."""
    return stacked(magma(values / top), scale_bar(values.shape[1], top, title))


def scale_bar(width: int, top: float, title: str) -> np.ndarray:
    """Return the magma colours from 0 to ``top`` above a title, for a picture ``width`` pixels wide."""
    from PIL import Image, ImageDraw

    font, width = label_font(), max(width, 360)
    titles = _wrapped(title, font, width - 16)
    bar = Image.new("RGB", (width, _LINE * (1 + len(titles)) + 6), (255, 255, 255))
    draw = ImageDraw.Draw(bar)
    end = f"{top:g}"
    right = width - 16 - math.ceil(font.getlength(end))
    draw.text((8, 4), "0", fill=(0, 0, 0), font=font)
    draw.text((right + 8, 4), end, fill=(0, 0, 0), font=font)
    ramp = magma(np.broadcast_to(np.linspace(0, 1, right - 28, dtype=np.float32), (16, right - 28)))
    bar.paste(Image.fromarray(ramp), (28, 6))
    for row, text in enumerate(titles):
        draw.text((8, 4 + _LINE * (1 + row)), text, fill=(0, 0, 0), font=font)
    return np.asarray(bar)


def _wrapped(text: str, font: FreeTypeFont | ImageFont, width: int) -> list[str]:
    """Return a text as lines of at most ``width`` pixels."""
    lines: list[str] = []
    for word in text.split():
        if lines and font.getlength(f"{lines[-1]} {word}") <= width:
            lines[-1] += f" {word}"
        else:
            lines.append(word)
    return lines


def stacked(image: np.ndarray, legend: np.ndarray) -> np.ndarray:
    """Return an image above its legend, the narrower of the two widened with white."""
    width = max(image.shape[1], legend.shape[1])
    parts = [np.pad(p, ((0, 0), (0, width - p.shape[1]), (0, 0)), constant_values=255) for p in (image, legend)]
    return np.concatenate(parts)


def round_above(value: float) -> float:
    """Return the smallest number of the form 1, 2 or 5 times a power of ten that is at least ``value``."""
    power = 10.0 ** math.floor(math.log10(value))
    return next((step * power for step in (1, 2, 5) if step * power >= value), 10 * power)


def exposure_of(image: np.ndarray) -> float:
    """Return the exposure, in stops, that brings the mean of lit pixels to about 0.3, as the sky alone may be dim."""
    light = image.mean(-1)
    lit = light[light > 0]
    return 0.0 if not lit.size else float(np.clip(math.log2(0.3 / float(lit.mean())), -4, 8))
