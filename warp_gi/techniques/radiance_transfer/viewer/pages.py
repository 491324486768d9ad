"""Pages of an atlas as textures: four numbers of a slot in each layer, texels without a slot filled from beside."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from warp_gi.techniques.radiance_transfer.pca import compress_bounces
from warp_gi.techniques.radiance_transfer.textures import LIGHT_NUMBERS, TransferTextures
from warp_gi.techniques.shared.atlas.atlas import Atlas

DIRECT_LAYERS = 7
"""Layers of T: 25 numbers; red, green and blue of lamps fill the last of them."""
COMPONENTS = 24
"""Numbers that stand for the 75 of bounces."""
FINE, COARSE = 1024, 256
"""Steps to which numbers are rounded, as parts of their RMS: a step of 1 / 1024, or where a page would be too large of
1 / 256. Errors are a step / sqrt 12."""
_BOUNCES = 0.25
"""Fineness of the components of bounces beside that of T: the others that are left out are a larger error."""
_LARGEST = 32000
"""Steps from 0 to the largest number at most, to fit int16."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Numbers of each slot, as textures hold them."""

    values: np.ndarray
    """T, lamps, and components of bounces, float16 [slots, 4 * layers]."""
    components: np.ndarray
    """Bounces of a slot are its components times this, float32 [components, 3, 25]; empty [0, 3, 25] without any."""
    error: float
    """Error of bounced light by leaving out other components, as ``CompressedBounces`` states it."""
    has_lamps: bool
    """Whether light of lamps over other surfaces is in it."""

    @property
    def layers(self) -> int:
        """Number of layers."""
        return self.values.shape[1] // 4


def rows_of(textures: TransferTextures) -> Rows:
    """Return the numbers of slots that a page draws with; of transfer of order 6 the 25 that a sky has."""
    components, coefficients, error = _components(textures.bounces)
    first = 4 * DIRECT_LAYERS
    values = np.zeros((textures.atlas.count, first + len(components)), np.float16)
    values[:, :LIGHT_NUMBERS] = textures.transfer[:, :LIGHT_NUMBERS]
    if len(textures.lamps):
        values[:, LIGHT_NUMBERS : LIGHT_NUMBERS + 3] = np.minimum(textures.lamps, np.finfo(np.float16).max)
    if len(components):
        values[:, first:] = coefficients
    return Rows(values, components, error, bool(len(textures.lamps)))


def _components(bounces: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return components [n, 3, 25], coefficients [slots, n] and the error, of bounces [slots, 3, 25]; n may be 0."""
    if not bounces.any():
        return np.zeros((0, 3, LIGHT_NUMBERS), np.float32), np.zeros((len(bounces), 0), np.float16), 0.0
    basis, coefficients, error = compress_bounces(bounces, COMPONENTS)
    return basis.reshape(-1, 3, LIGHT_NUMBERS), coefficients, error


def page_size(atlas: Atlas, page: int, block: int) -> tuple[int, int]:
    """Return width and height of a page of which ``block`` x ``block`` texels become one."""
    width, height = atlas.pages[page, 1:]
    return -(-int(width) // block), -(-int(height) // block)


def steps_of(rows: Rows, fineness: int) -> np.ndarray:
    """Return the steps to which numbers of each channel are rounded, float32 [4 * layers].

    One step serves all of T, one all components, and each colour of lamps has its own: small numbers matter little
    beside large ones that are added to them. ``fineness`` is the steps in the RMS of the first of each.
    """
    steps = np.ones(rows.values.shape[1], np.float32)
    lamps, bounces = LIGHT_NUMBERS, 4 * DIRECT_LAYERS
    kinds = [(0, lamps, 1.0), *((lamps + c, lamps + c + 1, 1.0) for c in range(3)), (bounces, len(steps), _BOUNCES)]
    for first, end, share in kinds:
        if first == end:
            continue
        rms = math.sqrt(np.mean(rows.values[:, first].astype(np.float64) ** 2))
        largest = float(np.abs(rows.values[:, first:end]).max(initial=0))
        steps[first:end] = max(rms / (share * fineness), largest / _LARGEST, 1e-20)
    return steps


def page_layers(atlas: Atlas, rows: Rows, page: int, side: int, block: int, steps: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the layers of one side of a page as multiples of ``steps``, int16 [4, height, width] each.

    Args:
        atlas: Where slots are.
        rows: Numbers of slots.
        page: Number of the page.
        side: 0 front, 1 back.
        block: Texels along a side that become one, their mean.
        steps: What numbers of a channel are rounded to multiples of, float32 [4 * layers].
    """
    slots = _blocks(atlas, page, side, block)
    kept = np.asarray((slots >= 0).any(axis=2))
    shares = ((slots >= 0) / np.maximum((slots >= 0).sum(axis=2, keepdims=True), 1)).astype(np.float32)
    source, is_beside = _sources(kept)
    for layer in range(rows.layers):
        result = np.empty((4, *kept.shape), np.int16)
        for channel in range(4):
            numbers = (rows.values[:, 4 * layer + channel].astype(np.float32)[slots] * shares).sum(axis=2)
            numbers = np.where(is_beside, _mean_beside(numbers, kept), numbers)
            result[channel] = np.round(numbers.reshape(-1)[source] / steps[4 * layer + channel])
        yield result


def _blocks(atlas: Atlas, page: int, side: int, block: int) -> np.ndarray:
    """Return slots of the texels that become one, -1 for none, int32 [height, width, block^2]."""
    first, width, height = (int(number) for number in atlas.pages[page])
    columns, lines = page_size(atlas, page, block)
    slots = np.full((lines * block, columns * block), -1, np.int32)
    slots[:height, :width] = atlas.slots[side, first : first + width * height].reshape(height, width)
    return slots.reshape(lines, block, columns, block).transpose(0, 2, 1, 3).reshape(lines, columns, -1)


def _beside(values: np.ndarray) -> np.ndarray:
    """Return sums over the 3 x 3 texels around each, float32 [height, width]."""
    height, width = values.shape
    wide = np.pad(values.astype(np.float32), 1)
    return sum((wide[i : i + height, j : j + width] for i in range(3) for j in range(3)), np.zeros(values.shape))


def _mean_beside(numbers: np.ndarray, kept: np.ndarray) -> np.ndarray:
    return _beside(np.where(kept, numbers, 0)) / np.maximum(_beside(kept), 1)


def _sources(kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return from which texel each takes its number, int64 [height, width], and which are set to a mean before that.

    The mean is that of the texels beside that are kept; a fetch may touch these. Further away, where none does, the
    number of the texel on the left goes on: differences of 0 take no room in the page.
    """
    is_beside = ~kept & (_beside(kept) > 0)
    columns = np.where(kept | is_beside, np.arange(kept.shape[1]), 0)
    return np.maximum.accumulate(columns, axis=1) + np.arange(len(kept))[:, None] * kept.shape[1], is_beside


def faces_kept(atlas: Atlas, side: int) -> np.ndarray:
    """Return whether something is kept on a side of each face, bool [faces]: at one of its corners or in its middle."""
    result = np.zeros(len(atlas.face_pages), bool)
    corners = atlas.corners.astype(np.float64)
    middle = corners.mean(axis=1, keepdims=True)
    points = np.concatenate([corners, middle, 0.5 * (corners + middle)], axis=1)
    for page, (first, width, height) in enumerate(atlas.pages):
        faces = np.flatnonzero(atlas.face_pages == page)
        texels = np.clip(points[faces].astype(np.int64), 0, [width - 1, height - 1])
        result[faces] = (atlas.slots[side, first + texels[..., 1] * width + texels[..., 0]] >= 0).any(axis=1)
    return result
