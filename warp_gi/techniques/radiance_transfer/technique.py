"""Radiance transfer textures (prt_textures.txt)."""

from warp_gi.registry import Claim, Entry, Technique

_SETTINGS = {"resolution": 256}

TECHNIQUE = Technique(
    name="radiance-transfer",
    short="transfer",
    estimators={
        "RadianceTransfer": Entry(
            "estimator",
            {
                "": Claim(_SETTINGS, unbiased=False, bound=0.05),
                "indirect": Claim({**_SETTINGS, "term": "indirect"}, unbiased=False, bound=0.05),
            },
        )
    },
    presets={
        "transfer": {
            "environment": "RadianceTransfer",
            "indirect": ("RadianceTransfer", {"term": "indirect"}),
        },
    },
    bake_tool="bake_tool",
    samplers=("transfer_light.TRANSFER_CACHE",),
    suite="transfer",
)
