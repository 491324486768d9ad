"""The settings of a visibility field that decide its masks, apart from those that say how frames use them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MaskSettings:
    """What decides the masks of a field's cells, beside the geometry; the fields of a VisibilityField of these names.

    Baking and the state know these alone, and nothing of the estimator.
    """

    cell_size: float
    """Edge of a cell in metres; 0 is a 77th of the scene's longest axis."""
    resolution: int
    """Texels along a side of a cell's masks."""
    samples: int
    """Surface samples over the whole scene, by area; 0 is 256 for each side of as much surface as a face of a cell."""
    rays: int
    """Rays of a surface sample, rounded up to a multiple of 8."""
    dilation: int
    """Texels by which the masks of a cell are dilated."""
