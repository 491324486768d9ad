"""Emitters selected by a hierarchy over them."""

from warp_gi.registry import Entry, Technique

TECHNIQUE = Technique(
    name="light-hierarchy",
    short="hierarchy",
    estimators={"LightHierarchy": Entry("estimator")},
    samplers=("light_hierarchy.HIERARCHY_LIGHTS",),
    page="techniques/light_hierarchy.md",
)
