"""What arrays of a file have to be, before a kernel reads them: types, shapes that fit together, ranges of indices."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from warp_gi.errors import BakeError


@dataclass(frozen=True)
class Layout:
    """What an array has to be."""

    dtypes: str
    """Names of types that it may have, with spaces between."""
    shape: tuple[int | None, ...]
    """Its shape; None is any size."""
    low: float = -np.inf
    """Least value."""
    high: float = np.inf
    """Largest value."""


def misfit(arrays: Mapping[str, np.ndarray], wanted: Mapping[str, Layout]) -> str:
    """Return in words why arrays are not as ``wanted``: what is wrong with the first that is not; "" if all are.

    Values that are not finite are wrong wherever they stand.
    """
    for name, layout in wanted.items():
        if name not in arrays:
            return f"it has no array {name!r}"
        array = np.asarray(arrays[name])
        fits = len(array.shape) == len(layout.shape) and all(
            size in (None, there) for size, there in zip(layout.shape, array.shape, strict=True)
        )
        if array.dtype.name not in layout.dtypes.split() or not fits:
            shape = ", ".join("any" if size is None else str(size) for size in layout.shape)
            return (
                f"its array {name!r} is {array.dtype.name} {list(array.shape)}, expected"
                f" {' or '.join(layout.dtypes.split())} [{shape}]"
            )
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            return f"its array {name!r} has values that are not finite"
        if array.size and not (array.min() >= layout.low and array.max() <= layout.high):
            return (
                f"its array {name!r} has values from {array.min():g} to {array.max():g}, expected {layout.low:g} to"
                f" {layout.high:g}"
            )
    return ""


def check_layout(what: str, arrays: Mapping[str, np.ndarray], wanted: Mapping[str, Layout]) -> None:
    """Raise BakeError unless arrays are as ``wanted``; ``what`` names the bake in the message."""
    if problem := misfit(arrays, wanted):
        raise BakeError(f"{what} does not hold what it should: {problem}; bake it again")
