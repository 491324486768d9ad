"""Techniques, a folder each. A new technique is its folder and a line here; ``technique.py`` in it says the rest."""

TECHNIQUES = (
    "paths",
    "light_hierarchy",
    "visibility_field",
    "light_field",
    "reuse",
    "radiance_transfer",
    "surface_cache",
    "visibility_polygons",
)
