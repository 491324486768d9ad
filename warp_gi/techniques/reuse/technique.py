"""Sample reuse over frames: the visibility light cache and guided paths (temporal_reuse.txt)."""

from warp_gi.registry import Entry, Technique

TECHNIQUE = Technique(
    name="sample-reuse",
    short="reuse",
    estimators={"VisibilityLightCache": Entry("light_cache"), "GuidedPaths": Entry("guided_paths")},
    services={"SampleOctree": Entry("sample_octree")},
    functions={"reuse_pictures": "pictures"},
    presets={
        "reuse": {"emitters": "VisibilityLightCache", "indirect": "GuidedPaths"},
        "hybrid": {
            "environment": "VisibilityField",
            "emitters": "VisibilityLightCache",
            "indirect": "GuidedPaths",
        },
    },
    samplers=("light_cache.CACHED_LIGHTS", "guided_directions.GUIDED_DIRECTIONS"),
    suite="reuse",
    page="techniques/sample_reuse.md",
)
