"""Discrete visibility fields (dvf.txt)."""

from warp_gi.registry import Entry, Technique

TECHNIQUE = Technique(
    name="visibility-field",
    short="dvf",
    estimators={"VisibilityField": Entry("estimator")},
    presets={"dvf": {"environment": "VisibilityField"}},
    bake_tool="bake_tool",
    suite="dvf",
    page="techniques/visibility_field.md",
)
