"""Discrete visibility fields (dvf.txt)."""

from warp_gi.registry import Claim, Entry, Technique

_COARSE = {"samples": 30, "rays": 16, "dilation": 0, "cell_size": 0.6, "resolution": 16}

TECHNIQUE = Technique(
    name="visibility-field",
    short="dvf",
    estimators={
        "VisibilityField": Entry(
            "estimator",
            {
                "": Claim(unbiased=False, bound=0.01, resolution=(_COARSE, {})),
                "unbiased": Claim({"mode": "unbiased", **_COARSE}),
                "traced": Claim({"mode": "traced"}),
                "harmonics": Claim({"sky": "harmonics"}, unbiased=False, bound=0.01),
                "paper": Claim({"mode": "paper", "sky": "harmonics"}, unbiased=False, bound=0.01),
            },
        )
    },
    presets={"dvf": {"environment": "VisibilityField"}},
    bake_tool="bake_tool",
    suite="dvf",
    page="techniques/visibility_field.md",
)
