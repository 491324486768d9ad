"""Pictures for reports: sets of them by case, and what a suite hands over while it runs."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from warp_gi.bench.harness.measure import Row, attempt
from warp_gi.errors import OptionError

REFERENCE = "reference"
WIDEST = 240
"""Largest width in pixels of a suite's pictures, which keeps a report of all suites near 10 MB."""
ROUNDING = 2.0**-6
"""Largest relative change of a suite's pictures by rounding, which makes them zip well; error maps do not show it."""


@dataclass(frozen=True)
class PictureSet:
    """Pictures of one case by several estimators, to compare with each other. ``validate`` raises OptionError."""

    case: str
    reference: np.ndarray | None
    """Linear radiance, float32 [height, width, 3]; without one there are no error maps."""
    images: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Linear radiance by estimator, each of the reference's shape. May hold NaN and infinities, which are shown."""
    suite: str = ""
    """Name of the suite in whose section of the report the pictures stand."""
    note: str = ""
    """Note on what was done to the pictures after rendering."""

    def all(self) -> dict[str, np.ndarray]:
        """Return the reference, if there is one, and the images."""
        return ({} if self.reference is None else {REFERENCE: self.reference}) | dict(self.images)

    def validate(self) -> None:
        """Raise OptionError unless there is a picture, and all are floats [height, width, 3] of one size."""
        if REFERENCE in self.images:
            raise OptionError(f"pictures of {self.case!r}: give the reference as such, not among the images")
        pictures = self.all()
        if not pictures:
            raise OptionError(f"pictures of {self.case!r}: there are none")
        first = next(iter(pictures.values()))
        for name, picture in pictures.items():
            is_image = picture.ndim == 3 and picture.shape[2] == 3 and picture.size and picture.dtype.kind == "f"
            if not is_image or picture.shape != first.shape:
                raise OptionError(
                    f"pictures of {self.case!r}, {name!r}: expected floats [height, width, 3] like the others'"
                    f" {list(first.shape)}, got {picture.dtype} {list(picture.shape)}"
                )

    def reduced(self, widest: int = WIDEST) -> PictureSet:
        """Return the set with pictures of at most ``widest`` pixels, means of blocks, and rounded mantissas."""
        block = math.ceil(next(iter(self.all().values())).shape[1] / widest)
        reference = None if self.reference is None else _rounded(block_means(self.reference, block))
        images = {name: _rounded(block_means(image, block)) for name, image in self.images.items()}
        means = f"means of {block} x {block} that were rendered, " if block > 1 else ""
        return replace(self, reference=reference, images=images, note=f"{means}values kept to {ROUNDING:.1%}")


@dataclass(frozen=True)
class Gallery:
    """Pictures that suites add for a report."""

    suite: str = ""
    sets: list[PictureSet] = field(default_factory=list)
    is_open: bool = True
    """Whether pictures are kept."""

    def of(self, suite: str) -> Gallery:
        """Return this gallery for another suite; the sets are shared."""
        return replace(self, suite=suite)

    def add(self, pictures: PictureSet) -> None:
        """Keep a small copy of the pictures, if anything is kept; raises OptionError for what are none."""
        if self.is_open:
            pictures.validate()
            self.sets.append(replace(pictures.reduced(), suite=self.suite))


CLOSED = Gallery(is_open=False)
"""Gallery that keeps nothing, for runs without a report."""


def call(measure: Callable[..., Any], quick: bool, device: str, gallery: Gallery, **others: Any) -> Any:
    """Call a suite's ``run``, or a part of one, with the gallery if it takes one."""
    given = {"gallery": gallery} if "gallery" in inspect.signature(measure).parameters else {}
    return measure(quick=quick, device=device, **given, **others)


def run_parts(
    parts: Mapping[str, Callable[..., list[Row]]], chosen: Sequence[str], quick: bool, device: str, gallery: Gallery
) -> list[Row]:
    """Return the rows of a suite's parts, all of them if none is chosen; one that fails is a row that says why."""
    rows: list[Row] = []
    for name in chosen or parts:
        rows += attempt({"part": name}, partial(call, parts[name], quick, device, gallery))
    return rows


def block_means(picture: np.ndarray, size: int) -> np.ndarray:
    """Return the mean of each block of ``size`` by ``size`` pixels, float32; a rest at the edges is left out."""
    height, width = (max(pixels // size, 1) for pixels in picture.shape[:2])
    kept = picture[: height * size, : width * size]
    return kept.reshape(height, -1, width, kept.shape[1] // width, 3).mean(axis=(1, 3), dtype=np.float64).astype("f4")


def _rounded(picture: np.ndarray) -> np.ndarray:
    mantissa, exponent = np.frexp(picture)
    return np.ldexp(np.round(mantissa / ROUNDING) * ROUNDING, exponent).astype(np.float32)
