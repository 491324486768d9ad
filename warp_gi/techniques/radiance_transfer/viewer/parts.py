"""Arrays in a page: bytes parted by place in their number, deflated, in base64."""

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

        The lowest bytes of all numbers come first, then the next ones: neighbours of one place are alike, which is
        what deflate finds.
        """
        array = np.ascontiguousarray(array)
        size = array.dtype.itemsize
        planes = array.astype(array.dtype.newbyteorder("<")).view(np.uint8).reshape(-1, size).T
        self.texts.append(base64.b64encode(zlib.compress(planes.tobytes(), LEVEL)).decode("ascii"))
        return {"part": len(self.texts) - 1, "size": size, "shape": list(array.shape)}

    def add_differences(self, numbers: np.ndarray) -> dict[str, Any]:
        """Add int16 [..., width] as differences from the number on the left."""
        differences = numbers.copy()
        differences[..., 1:] -= numbers[..., :-1]  # modulo 2^16
        return self.add(differences)

    def add_file(self, data: bytes) -> dict[str, Any]:
        """Add a file as it is, and return the number of the part."""
        self.texts.append(base64.b64encode(data).decode("ascii"))
        return {"part": len(self.texts) - 1}
