"""The settings of visibility polygons that decide what is baked, apart from those that say how frames use them."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from warp_gi.baking import Setting


@dataclass(frozen=True)
class PolygonSettings:
    """What decides a bake, beside the geometry; the fields of a VisibilityPolygons of these names."""

    resolution: int
    """Rays along a side of a vertex's map of its hemisphere."""
    simplified: float
    """Degrees by which contours may be off once they are simplified."""
    flagged_above: float
    """Share of light under a uniform sky that may be wrong at a point, or the triangle is flagged."""

    def stored(self) -> dict[str, Setting]:
        """Return the settings that a bake stores and is checked by."""
        return asdict(self)
