"""The settings of transfer textures that decide what is baked."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

from warp_gi.baking import Setting


@dataclass(frozen=True)
class TransferSettings:
    """What decides a bake; the fields of a RadianceTransfer of these names.

    Atlas, baking and the state know these alone, and nothing of the estimator.
    """

    storage: Literal["texture", "vertices"]
    """Where transfer is kept: in texels of an atlas, or at the vertices of the meshes (the baseline)."""
    resolution: int
    """Texels along the longer side of the atlas, which is one page; bakes and their readers know several."""
    texel_sets: str
    """Densities of meshes: "auto", "one" density for all, or "NAME=FACTOR,..." by name of node or mesh."""
    charts: Literal["auto", "xatlas", "own"]
    """Where uv come from: "auto" takes a mesh's own where they are fit, "own" demands it."""
    chart_seconds: float
    """Seconds of CPU time that xatlas may take; 0 is no limit."""
    order: int
    """Order of the spherical harmonics of transfer: 5 (25 numbers a slot) or 6 (36)."""
    first_rays: int
    """Rays a slot before it is known whether it sees sky and surfaces both."""
    rays: int
    """Rays a slot that does."""
    bounce_rays: int
    """Rays a slot that find the surfaces from which light bounces."""
    bounces: int
    """Largest number of bounces; 0 bakes none."""
    tolerance: float
    """Share of all light that a bounce has to add, or there is no further one."""

    def stored(self) -> dict[str, Setting]:
        """Return the settings that a bake stores and is checked by; how long charts may take is not among them."""
        values = asdict(self)
        del values["chart_seconds"]
        return values
