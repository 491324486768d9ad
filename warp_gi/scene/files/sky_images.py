"""Sky maps from image files: the layer, the data window, the primaries and the orientation that a file says.

OpenImageIO reads the pixels and leaves all of that to its caller. Of Radiance files it keeps the last ``EXPOSURE``
where all of them multiply, drops ``COLORCORR`` and ``PRIMARIES``, swaps two orientations and refuses XYZE: so their
header is read here.
"""

from __future__ import annotations

import re
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warp_gi.color import RGB_FROM_XYZ, bands, decode_srgb, rgb_from_primaries
from warp_gi.errors import SceneError
from warp_gi.files import user_path
from warp_gi.memory import check_memory
from warp_gi.openimageio import open_image, reason

LARGEST_HEIGHT = 4096  # texel coordinates must be exact in float32 with bits left to interpolate
MOST_HEADER = 1 << 20  # bytes in which the header of a Radiance picture ends
LARGEST_WINDOW = 4 * LARGEST_HEIGHT  # pixels a side of a data window, which may be larger than the display window
BEAUTY = ("beauty", "combined", "rgba", "rgb", "default")
"""Names, in lower case, of parts and layers that hold the picture itself, the likeliest first."""
COLORS = ({"r", "red"}, {"g", "green"}, {"b", "blue"})
GREYS = ("y", "l", "i", "v", "r", "luminance", "intensity", "grey", "gray")
"""Names, in lower case, by which the only channel of an EXR file is a grey picture, and no depth or number."""
XYZ_PRIMARIES = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0)

ORIENTATIONS = {"-Y+": 1, "-Y-": 2, "+Y-": 3, "+Y+": 4, "+X-": 5, "-X-": 6, "-X+": 7, "+X+": 8}
"""Orientation, as TIFF and EXIF count, by the first axis and the sign of the second one of a Radiance picture."""


@dataclass(frozen=True)
class Layer:
    """Three channels of one part of a file."""

    part: int
    part_name: str
    prefix: str
    channels: tuple[int, int, int]

    @property
    def name(self) -> str:
        """Name by which a user chooses it."""
        return ".".join(name for name in (self.part_name, self.prefix) if name) or "RGB"


@dataclass
class RadianceHeader:
    """What the header of a Radiance picture says beside its size; the defaults are those of a missing line."""

    scale: np.ndarray = field(default_factory=lambda: np.ones(3))
    """What every pixel was multiplied with, so that it has to be divided by it: float64 [3]."""
    is_xyz: bool = False
    primaries: tuple[float, ...] | None = None
    orientation: int = 1
    """As TIFF and EXIF count. (OpenImageIO 3.2 takes +X +Y for -X -Y and the other way round.)"""


def split_layer(text: str | Path) -> tuple[Path, str]:
    """Return the file and the layer of "FILE:layer"; the layer of a mere file is "". A name with a colon may be one."""
    path = user_path(text)
    text = str(path)
    if path.is_file():
        return path, ""
    for colon in re.finditer(":", text):  # a layer may have colons and slashes of its own
        if Path(text[: colon.start()]).is_file():
            return Path(text[: colon.start()]), text[colon.end() :]
    match = re.fullmatch(r"(.+\.\w+):([^/\\]+)", text) or re.fullmatch(r"(.*#[^/\\:]*\.\w+):(.+)", text)
    return (Path(match[1]), match[2]) if match else (path, "")


def check_size(name: str, width: int, height: int) -> None:
    """Raise SceneError for a map that is not 2:1, too small or too large."""
    if width != 2 * height or height < 2:
        raise SceneError(
            f"{name}: a latitude-longitude map is twice as wide as high and at least 4x2, got {width}x{height};"
            " convert or crop it"
        )
    if height > LARGEST_HEIGHT:
        raise SceneError(f"{name}: at most {2 * LARGEST_HEIGHT}x{LARGEST_HEIGHT} is supported, got {width}x{height}")


def read_sky(path: Path, layer: str = "") -> np.ndarray:
    """Return the linear Rec. 709 pixels of a latitude-longitude map, float32 [height, width, 3], the zenith on top.

    ``layer`` names a part of an EXR file, a layer of it (``albedo`` of ``albedo.R``), or both (``part.layer``). "" is
    the only one with red, green and blue, the one without a name, or the one that is called beauty. The display window
    is the sky; what the data window leaves out of it is black. Colours in other primaries (``chromaticities``) are
    converted with white kept white (Bradford); XYZ as it is. Integers are sRGB.

    Raises SceneError if the file is missing, damaged, deep or not 2:1, and if it does not say which layer is meant.
    """
    name = f"environment {str(path)!r}"
    _check_there(path, name)
    with path.open("rb") as file:
        is_radiance = file.read(2) == b"#?"
    if is_radiance:
        return _read_radiance(path, name, layer)
    return _read_pixels(path, name, layer)


def _check_there(path: Path, name: str) -> None:
    if not path.is_file():
        hint = (
            "give gi.SkySequence(...) for a file a frame"
            if "#" in path.name
            else "give a latitude-longitude EXR or HDR image"
        )
        raise SceneError(f"{name}: no such file; {hint}")
    if path.stat().st_size == 0:
        raise SceneError(f"{name}: the file is empty")


def _read_pixels(path: Path, name: str, wanted: str, orientation: int = 0) -> np.ndarray:
    """Return what ``read_sky`` does; ``orientation`` 0 is what the file's attribute says."""
    import OpenImageIO as oiio

    image = open_image(path)
    if image is None:
        raise SceneError(f"{name}: not an image that can be read ({reason()})")
    try:
        layer = _choose(_layers(image, name), wanted, name, path)
        image.close()
        image = open_image(path)  # readers of some formats do not come back from a part that is not there
        if image is None:
            raise SceneError(f"{name}: not an image that can be read ({reason()})")
        image.seek_subimage(layer.part, 0)
        spec = image.spec(layer.part)
        kind = spec.channelformat(layer.channels[0]).basetype
        if image.format_name() == "openexr" and kind == oiio.UINT32:
            raise SceneError(
                f"{name}: the channels of {layer.name} are whole numbers, as ids are; expected half or float"
            )
        if spec.width < 1 or spec.height < 1:
            raise SceneError(f"{name}: the image has no pixels ({spec.width}x{spec.height})")
        orientation = orientation or spec.get_int_attribute("Orientation", 1)
        full = (spec.full_width, spec.full_height)
        check_size(name, *(full[::-1] if orientation > 4 else full))
        if max(spec.width, spec.height) > LARGEST_WINDOW:
            raise SceneError(
                f"{name}: its data window is {spec.width}x{spec.height}, at most {LARGEST_WINDOW} a side is supported;"
                " crop it to the display window"
            )
        check_memory(f"{name}: a data window of {spec.width}x{spec.height} pixels", 12 * spec.width * spec.height)
        first = layer.channels[0]
        if layer.channels == (first, first + 1, first + 2):
            pixels = _read_channels(image, spec, layer.part, first, first + 3)
        else:
            read = [_read_channels(image, spec, layer.part, one, one + 1) for one in layer.channels]
            known = [one for one in read if one is not None]
            pixels = np.concatenate(known, axis=2) if len(known) == 3 else None
        if pixels is None or image.has_error:
            raise SceneError(f"{name}: the image is damaged or cut short ({reason(image)})")
    except UnicodeDecodeError as error:
        raise SceneError(f"{name}: the image is damaged, or has names that are not UTF-8; write it anew") from error
    finally:
        if image is not None:
            image.close()
    if kind not in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE):
        for rows in bands(spec.height, spec.width):
            pixels[rows] = decode_srgb(pixels[rows])
    pixels = _upright(_in_display_window(pixels, spec), orientation)
    chromaticities = spec.getattribute("chromaticities")
    if chromaticities is not None:
        pixels = _converted(pixels, tuple(chromaticities), name)
    return np.ascontiguousarray(pixels, np.float32)


def _read_channels(image: Any, spec: Any, part: int, first: int, end: int) -> np.ndarray | None:
    """Return channels of a part, float32 [height, width, channel], read some rows at a time; None if they cannot be."""
    import OpenImageIO as oiio

    if spec.tile_width:
        pixels = image.read_image(part, 0, first, end, oiio.FLOAT)
        return None if pixels is None else np.asarray(pixels, np.float32).reshape(spec.height, spec.width, end - first)
    result = np.empty((spec.height, spec.width, end - first), np.float32)
    for rows in bands(spec.height, spec.width):
        read = image.read_scanlines(part, 0, spec.y + rows.start, spec.y + rows.stop, 0, first, end, oiio.FLOAT)
        if read is None:
            return None
        result[rows] = np.asarray(read).reshape(result[rows].shape)
    return result


def _layers(image: Any, name: str) -> list[Layer]:
    """Return the layers of red, green and blue; where no part has one, the grey or first channels of the first part."""
    found, deep, part = [], 0, 0
    while image.seek_subimage(part, 0):
        spec = image.spec(part)
        if spec.deep:
            deep += 1
        else:
            found += _layers_of(spec, part)
        part += 1
    image.seek_subimage(0, 0)
    reason(image)  # some readers keep that there was no further part, as if reading had failed
    first = image.spec(0)
    if found:
        return found
    if deep:
        raise SceneError(f"{name}: deep EXR, which has no one color a pixel; flatten it first")
    if image.format_name() != "openexr" and first.nchannels >= 3:
        return [Layer(0, "", "", (0, 1, 2))]
    others = [i for i, channel in enumerate(first.channelnames) if channel.upper() != "A"]
    if len(others) == 1:
        last = first.channelnames[others[0]].rpartition(".")[2].lower()
        if last in GREYS or image.format_name() != "openexr":
            return [Layer(0, first.get_string_attribute("name"), "", (others[0],) * 3)]
    raise SceneError(f"{name}: no layer has red, green and blue (channels: {', '.join(first.channelnames)})")


def _layers_of(spec: Any, part: int) -> list[Layer]:
    part_name = spec.get_string_attribute("name")
    channels: dict[str, dict[int, int]] = {}
    for index, channel in enumerate(spec.channelnames):
        prefix, _, last = channel.rpartition(".")
        for place, names in enumerate(COLORS):
            if last.lower() in names:
                channels.setdefault(prefix, {})[place] = index
    return [Layer(part, part_name, p, (c[0], c[1], c[2])) for p, c in channels.items() if len(c) == 3]


def _choose(layers: list[Layer], wanted: str, name: str, path: Path) -> Layer:
    """Return the layer of a name, or the one that is meant without one; raises SceneError that lists all of them."""
    names = ", ".join(layer.name for layer in layers)
    if wanted:
        by_likeness = (
            [layer for layer in layers if layer.name == wanted],
            [layer for layer in layers if layer.part_name == wanted and not layer.prefix],
            [layer for layer in layers if wanted in (layer.prefix, layer.part_name)],
        )
        fits = next((found for found in by_likeness if found), [])
        if len(fits) == 1:
            return fits[0]
        problem = f"{len(fits)} RGB layers are called {wanted!r}" if fits else f"no RGB layer is called {wanted!r}"
        raise SceneError(f"{name}: {problem}; expected one of: {names}")
    if len(layers) == 1:
        return layers[0]
    plain = [layer for layer in layers if not layer.prefix and not layer.part_name]
    if len(plain) == 1:
        return plain[0]
    for beauty in BEAUTY:
        fits = [layer for layer in layers if layer.name.lower().rpartition(".")[2] == beauty]
        if len(fits) == 1:
            return fits[0]
    raise SceneError(
        f"{name}: {len(layers)} layers are RGB and none or several are beauty ({names});"
        f" name one, as {path.name}:{layers[0].name}"
    )


def _in_display_window(pixels: np.ndarray, spec: Any) -> np.ndarray:
    """Return pixels of the data window in the display window; there is black around them, and cut off what is more."""
    if (spec.x, spec.y, spec.width, spec.height) == (spec.full_x, spec.full_y, spec.full_width, spec.full_height):
        return pixels
    left, top = spec.x - spec.full_x, spec.y - spec.full_y
    result = np.zeros((spec.full_height, spec.full_width, 3), np.float32)
    rows = slice(max(top, 0), max(min(top + spec.height, spec.full_height), 0))
    columns = slice(max(left, 0), max(min(left + spec.width, spec.full_width), 0))
    inside = pixels[max(-top, 0) :, max(-left, 0) :]
    height, width = result[rows, columns].shape[:2]
    result[rows, columns] = inside[:height, :width]
    return result


def _upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Return the picture as it is to be seen, of one stored in one of the eight orientations of TIFF and EXIF."""
    if orientation > 4:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return pixels


def _converted(pixels: np.ndarray, chromaticities: tuple[float, ...], name: str) -> np.ndarray:
    """Return colors in Rec. 709 of those in other primaries (x and y of red, green, blue and white)."""
    if np.allclose(chromaticities[:6], XYZ_PRIMARIES, atol=1e-6):
        return _times(pixels, RGB_FROM_XYZ.T)
    matrix = rgb_from_primaries(chromaticities)
    if matrix is None:
        raise SceneError(f"{name}: chromaticities {chromaticities} span no colors; repair or remove the attribute")
    if np.allclose(matrix, np.eye(3), atol=1e-3):  # as far as rounded chromaticities of Rec. 709 are from it
        return pixels
    return _times(pixels, matrix.T)


def _times(pixels: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return pixels times a matrix (computed in float64), float32 [height, width, 3]."""
    result = np.empty(pixels.shape, np.float32)
    for rows in bands(*pixels.shape[:2]):
        result[rows] = pixels[rows] @ matrix
    return result


def _read_radiance(path: Path, name: str, layer: str) -> np.ndarray:
    with path.open("rb") as file:
        data = file.read(MOST_HEADER)
    header = parse_radiance(data, name)
    has_runs = has_old_runs(data)
    if header.is_xyz or has_runs:  # a name that OpenImageIO refuses, and a coding that it does not know
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(folder) / "sky.hdr"
            data = path.read_bytes()
            data = without_old_runs(data, name) if has_runs else data
            copy.write_bytes(re.sub(rb"(?m)^FORMAT=\s*32-bit_rle_xyze", b"FORMAT=32-bit_rle_rgbe", data, count=1))
            pixels = _read_pixels(copy, name, layer, header.orientation)
    else:
        pixels = _read_pixels(path, name, layer, header.orientation)
    if header.is_xyz:
        pixels = _times(pixels, RGB_FROM_XYZ.T)
    elif header.primaries is not None:
        pixels = _converted(pixels, header.primaries, name)
    pixels = np.ascontiguousarray(pixels)
    if (header.scale != 1).any():
        for rows in bands(*pixels.shape[:2]):
            pixels[rows] = pixels[rows] / header.scale
    return pixels


SIZE = re.compile(rb"\r?\n\r?\n[-+][XY]\s+(\d+)\s+[-+][XY]\s+(\d+)[^\n]*\n")
"""End of the header of a Radiance picture, and its size: rows or columns, and pixels in each."""


def has_old_runs(data: bytes) -> bool:
    """Return whether the begin of a Radiance picture is in the run-length coding of before 1991, or in none.

    Since then a row that is not as it is begins with 2, 2 and its length.
    """
    size = SIZE.search(data)
    start = data[size.end() : size.end() + 4] if size else b""
    return size is not None and len(start) == 4 and start != bytes((2, 2)) + (int(size[2]) % 65536).to_bytes(2, "big")


def without_old_runs(data: bytes, name: str) -> bytes:
    """Return a Radiance picture in the run-length coding of before 1991 without it; raises SceneError if it is damaged.

    A pixel 1, 1, 1, n stands for n more of the one before; the next such one for 256 times its n.
    """
    size = SIZE.search(data)
    if size is None:
        return data
    count = int(size[1]) * int(size[2])
    check_memory(f"{name}: {count:,} pixels", 8 * count)
    whole = len(data) - size.end() - (len(data) - size.end()) % 4
    coded = np.frombuffer(data, np.uint8, whole, size.end()).reshape(-1, 4)
    is_run = (coded[:, :3] == 1).all(axis=1)
    at = np.arange(len(coded))
    source = np.maximum.accumulate(np.where(is_run, 0, at))
    shift = 8 * np.minimum(at - source - 1, 4)
    repeats = np.where(is_run, coded[:, 3].astype(np.int64) << np.maximum(shift, 0), 1)
    if len(coded) == count or (is_run[:1]).any() or int(repeats.sum()) < count:
        return data  # no runs, or cut short, which its reader tells
    pixels = np.repeat(source, np.minimum(repeats, count))[:count]
    return data[: size.end()] + coded[pixels].tobytes()


def parse_radiance(data: bytes, name: str) -> RadianceHeader:
    """Return what the header of a Radiance picture says; raises SceneError for numbers that are none."""
    header = RadianceHeader()
    blank = re.search(rb"\r?\n\r?\n", data)
    end, start = blank.span() if blank else (len(data), len(data))
    order = re.match(rb"([-+])([XY])\s+\d+\s+([-+])[XY]\s+\d+", data[start : start + 256])
    if order:
        header.orientation = ORIENTATIONS[(order[1] + order[2] + order[3]).decode()]
    for line in re.split("\r?\n", data[:end].decode("latin-1")):
        key, _, value = line.partition("=")  # an indented line is a note of the picture that this one was made of
        if key == "FORMAT":
            header.is_xyz = value.strip() == "32-bit_rle_xyze"
        elif key in ("EXPOSURE", "COLORCORR", "PRIMARIES"):
            try:
                numbers = np.array([float(number) for number in value.split()])
            except ValueError:
                numbers = np.zeros(0)
            count = {"EXPOSURE": 1, "COLORCORR": 3, "PRIMARIES": 8}[key]
            if len(numbers) != count or not np.isfinite(numbers).all() or (key != "PRIMARIES" and (numbers <= 0).any()):
                what = "number" if count == 1 else "numbers"
                raise SceneError(f"{name}: expected {key}= and {count} {what} above 0, got {line!r}; repair the header")
            if key == "PRIMARIES":
                header.primaries = tuple(numbers)
            else:
                header.scale = header.scale * numbers
    return header
