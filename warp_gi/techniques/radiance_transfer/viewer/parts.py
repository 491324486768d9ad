"""Arrays in a page: differences of numbers, bytes parted by their place in these, deflated, in base64."""

from __future__ import annotations

import base64
import zlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np

LEVEL = 6
"""Effort of zlib; 9 takes four times as long for 0.5 % less."""


@dataclass
class Parts:
    """Parts of a page, in the order of their numbers; ``unpack.js`` reads them."""

    texts: list[str] = field(default_factory=list)
    """Parts as base64."""

    @property
    def nbytes(self) -> int:
        """Size of all parts in the page."""
        return sum(map(len, self.texts))

    def add(self, array: np.ndarray) -> dict[str, Any]:
        """Add an array, and return what says how it is read: number of the part, bytes of a number, and shape.

        Bits of numbers, as whole ones, are kept as differences from those before them on the last axis: neighbours are
        alike. The lowest bytes of all come first, then the next ones, which is what deflate makes most of.
        """
        size = array.dtype.itemsize
        numbers = np.ascontiguousarray(array, array.dtype.newbyteorder("<")).view(f"<u{size}")
        differences = numbers.copy()
        differences[..., 1:] -= numbers[..., :-1]  # modulo 2^bits
        planes = differences.reshape(-1).view(np.uint8).reshape(-1, size).T
        self.texts.append(base64.b64encode(zlib.compress(planes.tobytes(), LEVEL)).decode("ascii"))
        return {"part": len(self.texts) - 1, "size": size, "shape": list(array.shape)}

    def add_file(self, data: bytes) -> dict[str, Any]:
        """Add a file as it is, and return the number of the part."""
        self.texts.append(base64.b64encode(data).decode("ascii"))
        return {"part": len(self.texts) - 1}
