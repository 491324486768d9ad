"""Light field probes (light_field_probes.txt)."""

from warp_gi.registry import Entry, Technique

TECHNIQUE = Technique(
    name="light-field-probes",
    short="probes",
    estimators={"LightFieldProbes": Entry("estimator")},
    presets={
        "probes": {"indirect": "LightFieldProbes"},
        "probe_view": {
            "environment": None,
            "emitters": None,
            "indirect": ("LightFieldProbes", {"primary": "probes"}),
        },
    },
    samplers=("light_field_cache.PROBE_CACHE",),
    bake_tool="bake_tool",
    suite="probes",
    page="techniques/light_field_probes.md",
)
