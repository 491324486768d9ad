"""What stands in texels of a picture that hold nothing, so that filters beside charts find no black."""

from __future__ import annotations

import numpy as np


def padded(image: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return an image [height, width, channel] whose texels that are not ``known`` have the colour of those nearby.

    An unknown texel has the mean of the known ones in the smallest block of 2^k x 2^k texels around it that has any. So
    a texel of a mipmap is the mean of the known texels below it. ``known`` is bool [height, width]; where nothing is
    known the image is returned as it is.
    """
    if known.all() or not known.any():
        return image
    height, width = known.shape
    rows, columns = -(-height // 2), -(-width // 2)
    pad = ((0, 2 * rows - height), (0, 2 * columns - width))
    weights = np.pad(known, pad).reshape(rows, 2, columns, 2).astype(np.float64)
    values = np.pad(np.where(known[..., None], image, 0), (*pad, (0, 0))).reshape(rows, 2, columns, 2, -1)
    counts = weights.sum(axis=(1, 3))
    sums = values.sum(axis=(1, 3), dtype=np.float64)
    coarse = padded(sums / np.maximum(counts, 1)[..., None], counts > 0)
    spread = coarse.repeat(2, axis=0).repeat(2, axis=1)[:height, :width]
    return np.where(known[..., None], image, spread).astype(image.dtype)
