"""The settings of light field probes that decide where they stand and what they hold."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

from warp_gi.baking import Setting

FEW_PROBES = 128
"""Probes up to which a map has ``FEW_RESOLUTION`` texels along a side unless told."""
FEW_RESOLUTION, MANY_RESOLUTION = 128, 64
"""Texels along a side of a map unless told: of up to ``FEW_PROBES`` probes, and of more."""
MOST_PROBES = 1 << 20
"""Largest number of probes."""


@dataclass(frozen=True)
class ProbeSettings:
    """What decides where probes stand and what they hold; the fields of a LightFieldProbes of these names.

    Placement, baking and the state know these alone, and nothing of the estimator.
    """

    counts: tuple[int, int, int]
    """Probes along x, y and z; 0 follows from the spacing."""
    spacing: float
    """Metres between probes; 0 is chosen by the size of the box that they fill."""
    resolution: int
    """Texels along a side of a probe's map; 0 is 128 for up to 128 probes, 64 for more."""
    irradiance_resolution: int
    """Texels along a side of a probe's map of irradiance."""
    rays: int
    """Rays a texel while baking."""
    bounces: int
    """Largest number of passes of light from probes to probes."""
    tolerance: float
    """Relative change of the irradiance below which light bounces no more."""
    relocate: bool
    """Whether probes move out of walls."""
    weights: Literal["visibility", "trilinear"]
    """How the eight probes around a point are blended: by who sees it, or as if all of them did."""
    hysteresis: float
    """Share of its old irradiance that a refreshed probe keeps."""

    @property
    def largest_map(self) -> int:
        """Texels along a side of the largest map of a probe, if there are many probes."""
        return max(map_resolution(self.resolution, MOST_PROBES), self.irradiance_resolution)

    def stored(self) -> dict[str, Setting]:
        """Return the settings that a bake stores and is checked by; how probes are refreshed is not among them."""
        values = asdict(self)
        del values["hysteresis"]
        return {**values, "counts": "x".join(str(int(count)) for count in self.counts)}


def map_resolution(resolution: int, probes: int) -> int:
    """Return the texels along a side of a map that a setting of ``resolution`` means for so many probes."""
    return resolution or (FEW_RESOLUTION if probes <= FEW_PROBES else MANY_RESOLUTION)
