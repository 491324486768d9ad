"""Light field probes (light_field_probes.txt)."""

from warp_gi.registry import Claim, Entry, Technique

_PROBES = {"counts": (3, 3, 3), "resolution": 32}
_RESOLUTION = (
    {"counts": (2, 2, 2), "resolution": 16, "irradiance_resolution": 4, "rays": 1},
    {"counts": (2, 2, 2)},
    {"counts": (3, 3, 3)},
)

TECHNIQUE = Technique(
    name="light-field-probes",
    short="probes",
    estimators={
        "LightFieldProbes": Entry(
            "estimator",
            {
                "": Claim(_PROBES, unbiased=False, bound=0.08, resolution=_RESOLUTION),
                "irradiance": Claim({**_PROBES, "mode": "irradiance"}, unbiased=False, bound=0.08),
                "traced": Claim({**_PROBES, "mode": "traced"}, unbiased=False, bound=0.03),
            },
        )
    },
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
