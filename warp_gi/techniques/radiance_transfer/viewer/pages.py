"""Pages of an atlas as textures: four numbers of a slot in each layer, texels without a slot filled from beside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_gi.techniques.radiance_transfer.textures import LIGHT_NUMBERS, Atlas, TransferTextures

DIRECT_LAYERS = 7
"""Layers of T: 25 numbers; red, green and blue of lamps fill the last of them."""
COMPONENTS = 16
"""Numbers that stand for the 75 of bounces."""
DROPPED_BITS = 3
"""Bits of a half's 10 that are given up where a page would be too large: an error of at most 1 / 256."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Numbers of each slot, as textures hold them."""

    values: np.ndarray
    """T, lamps, and components of bounces, float16 [slots, 4 * layers]."""
    components: np.ndarray
    """Bounces of a slot are its components times this, float64 [components, 3, 25]; empty [0, 3, 25] without any."""
    error: float
    """RMS of what the components leave out, in RMS values of the bounces."""
    has_lamps: bool
    """Whether light of lamps over other surfaces is in it."""

    @property
    def layers(self) -> int:
        """Number of layers."""
        return self.values.shape[1] // 4


def rows_of(textures: TransferTextures) -> Rows:
    """Return the numbers of slots that a page draws with; of transfer of order 6 the 25 that a sky has."""
    components, coefficients, error = _components(textures.bounces)
    layers = DIRECT_LAYERS + -(-len(components) // 4)
    values = np.zeros((textures.atlas.count, 4 * layers), np.float16)
    values[:, :LIGHT_NUMBERS] = textures.transfer[:, :LIGHT_NUMBERS]
    if len(textures.lamps):
        values[:, LIGHT_NUMBERS : LIGHT_NUMBERS + 3] = np.minimum(textures.lamps, np.finfo(np.float16).max)
    if len(components):
        first = 4 * DIRECT_LAYERS
        values[:, first : first + len(components)] = coefficients
    return Rows(values, components, error, bool(len(textures.lamps)))


def _components(bounces: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return components [n, 3, 25], coefficients [slots, n], and the error left, of bounces [slots, 3, 25].

    Without a mean, so that what nothing reflects to stays 0 for any filter.
    """
    if not len(bounces):
        return np.zeros((0, 3, LIGHT_NUMBERS)), np.zeros((0, 0)), 0.0
    flat = bounces.reshape(len(bounces), -1).astype(np.float32)
    squares, vectors = np.linalg.eigh((flat.T @ flat).astype(np.float64))
    vectors = vectors[:, ::-1][:, :COMPONENTS].T
    total = max(squares.sum(), 1e-30)
    error = np.sqrt(max(squares[:-COMPONENTS].sum(), 0.0) / total)
    return vectors.reshape(-1, 3, LIGHT_NUMBERS), flat @ vectors.T.astype(np.float32), float(error)


def page_size(atlas: Atlas, page: int, step: int) -> tuple[int, int]:
    """Return width and height of a page of which ``step`` x ``step`` texels become one."""
    width, height = atlas.pages[page, 1:]
    return -(-int(width) // step), -(-int(height) // step)


def page_texels(atlas: Atlas, values: np.ndarray, page: int, side: int, step: int, dropped_bits: int) -> np.ndarray:
    """Return one side of a page, float16 [4 * layers, height, width].

    Args:
        atlas: Where slots are.
        values: Numbers of slots, float16 [slots, 4 * layers].
        page: Number of the page.
        side: 0 front, 1 back.
        step: Texels along a side that become one, their mean.
        dropped_bits: Lowest bits of halves that are rounded away.
    """
    first, width, height = (int(number) for number in atlas.pages[page])
    slots = atlas.slots[side, first : first + width * height].reshape(height, width)
    fine = np.full((page_size(atlas, page, step)[1] * step, page_size(atlas, page, step)[0] * step), -1, np.int32)
    fine[:height, :width] = slots
    blocks = fine.reshape(fine.shape[0] // step, step, fine.shape[1] // step, step).transpose(0, 2, 1, 3)
    blocks = blocks.reshape(*blocks.shape[:2], -1)
    shares = (blocks >= 0) / np.maximum((blocks >= 0).sum(axis=2, keepdims=True), 1)
    kept = (blocks >= 0).any(axis=2)
    result = np.empty((values.shape[1], *kept.shape), np.float16)
    for channel in range(values.shape[1]):  # one at a time: a large page would not fit into memory as float32
        numbers = (values[:, channel].astype(np.float32)[blocks] * shares).sum(axis=2)
        result[channel] = _rounded(_filled(numbers, kept).astype(np.float16), dropped_bits)
    return result


def _filled(numbers: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Return [height, width] with texels that are not kept set to the mean of those beside them that are, or to 0."""
    height, width = numbers.shape
    sums, counts = np.zeros((2, height + 2, width + 2), np.float32)
    for i in range(3):
        for j in range(3):
            sums[i : i + height, j : j + width] += np.where(kept, numbers, 0)
            counts[i : i + height, j : j + width] += kept
    return np.where(kept, numbers, sums[1:-1, 1:-1] / np.maximum(counts[1:-1, 1:-1], 1))


def _rounded(halves: np.ndarray, dropped_bits: int) -> np.ndarray:
    """Return halves rounded to fewer bits."""
    if dropped_bits == 0:
        return halves
    bits = halves.view(np.uint16)
    lowest = np.uint16((1 << dropped_bits) - 1)
    rounded = (bits + np.uint16(1 << (dropped_bits - 1))) & ~lowest
    return np.where(bits & 0x7FFF >= 0x7BF0, bits, rounded).astype(np.uint16).view(np.float16)


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
