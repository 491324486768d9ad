"""Visibility polygons (visibility_correspondence.txt)."""

from warp_gi.registry import Claim, Entry, Technique

TECHNIQUE = Technique(
    name="visibility-polygons",
    short="polygons",
    estimators={
        "VisibilityPolygons": Entry(
            "estimator",
            {
                "": Claim(unbiased=False, bound=0.01),
                "unbiased": Claim({"mode": "unbiased", "flagged_above": 1.0}),
                "exact": Claim({"evaluator": "exact"}, unbiased=False, bound=0.01),
            },
        )
    },
    presets={"polygons": {"environment": "VisibilityPolygons"}},
    bake_tool="bake_tool",
    suite="polygons",
    page="techniques/visibility_polygons.md",
)
