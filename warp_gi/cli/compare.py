"""``warp-gi compare``: how far a picture is from its reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from warp_gi import metrics
from warp_gi.cli.options import parse_options
from warp_gi.cli.report import print_table
from warp_gi.errors import OptionError, SceneError, one_line
from warp_gi.files import replacing
from warp_gi.scene.files import images
from warp_gi.sequence.exr import read_exr, write_exr
from warp_gi.sequence.preview import magma, tone_map, write_png


@dataclass
class Compare:
    """Measure how far IMAGE is from REFERENCE: RMSE, relMSE, PSNR and FLIP, and write a picture of the difference.

    EXR, HDR and NPY files are linear and FLIP is its HDR form; PNG and JPEG files are sRGB-coded and FLIP is its
    LDR form.
    """

    image: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IMAGE")]
    """File of the picture to judge."""
    reference: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="REFERENCE")]
    """File of the picture as it should be."""
    layer: str = "beauty"
    """Layer of EXR files to compare, for example indirect or albedo."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = Path("difference.png")
    """File for the difference. PNG: image, reference and FLIP side by side. EXR: image minus reference."""
    epsilon: float = metrics.RELATIVE_EPSILON
    """Number added below the line of relMSE, the mean of (image - reference)^2 / (reference^2 + epsilon)."""
    peak: float = 1.0
    """Value that counts as full signal in PSNR."""
    exposure: float = 0.0
    """Exposure of the pictures in the PNG, in stops."""


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    options = parse_options(Compare, "compare", arguments)
    image, reference = (read_image(path, options.layer) for path in (options.image, options.reference))
    if (image.dtype == np.uint8) != (reference.dtype == np.uint8):
        raise OptionError(f"{options.image} and {options.reference}: one is linear, one 8-bit sRGB; give two of a kind")
    rows = [
        ("RMSE", metrics.rmse(image, reference)),
        ("relMSE", metrics.rel_mse(image, reference, options.epsilon)),
        ("PSNR [dB]", metrics.psnr(image, reference, options.peak)),
    ]
    errors = metrics.flip_map(image, reference)
    rows.append(("FLIP", float(errors.mean(dtype=np.float64))))
    write_difference(options.output, image, reference, errors, options.exposure)
    print_table(f"{options.image} against {options.reference}", ("measure", "value"), rows)
    print(f"difference: {options.output}")
    return 0


def read_image(path: Path, layer: str = "beauty") -> np.ndarray:
    """Return a picture, float [height, width(, channels)] linear or uint8 [height, width, 3] sRGB-coded.

    ``layer`` picks one of several layers of an EXR file. Raises SceneError for files
    that are missing, damaged or hold no picture, OptionError for a layer that is not there.
    """
    path = Path(path)
    if not path.is_file():
        raise SceneError(f"{path}: no such file")
    kind = path.suffix.lower()
    if kind == ".exr":
        buffers = read_exr(path)[0]
        if len(buffers) == 1 and layer == "beauty":
            return next(iter(buffers.values()))
        if layer not in buffers:
            raise OptionError(f"{path} has no layer {layer!r} (it has: {', '.join(buffers)})")
        return buffers[layer]
    if kind == ".npy":
        try:
            array = np.load(path, allow_pickle=False)
        except (ValueError, OSError, EOFError, SyntaxError, TypeError) as error:
            raise SceneError(f"{path}: not a NumPy array ({one_line(error)})") from error
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "fuib" or array.ndim not in (2, 3):
            raise SceneError(
                f"{path}: expected numbers [height, width] or [height, width, channels], got {array!r:.80}"
            )
        return array
    if kind == ".hdr":
        return next(iter(read_exr(path)[0].values()))
    try:
        return np.ascontiguousarray(images.read_image(path, str(path))[..., :3])
    except SceneError as error:
        raise SceneError(f"{error}; expected EXR, HDR, NPY, PNG or JPEG") from error


def write_difference(
    path: Path, image: np.ndarray, reference: np.ndarray, errors: np.ndarray, exposure: float = 0.0
) -> None:
    """Write image, reference and FLIP side by side (PNG), or image minus reference (EXR)."""
    if path.suffix.lower() == ".exr":
        with replacing(path) as part:
            difference = np.asarray(image, np.float32) - np.asarray(reference, np.float32)
            write_exr(part, {"beauty": difference}, {}, precision="float")
    elif path.suffix.lower() == ".png":
        panels = [_display(image, exposure), _display(reference, exposure), magma(errors)]
        write_png(path, np.concatenate(panels, axis=1))
    else:
        raise OptionError(f"cannot write {path.name}: the difference is a .png or an .exr file")


def _display(image: np.ndarray, exposure: float) -> np.ndarray:
    if image.ndim == 2:
        image = image[:, :, None]
    image = np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image[:, :, :3]
    return image if image.dtype == np.uint8 else tone_map(image, exposure)
