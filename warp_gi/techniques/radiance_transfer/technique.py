"""Radiance transfer textures (prt_textures.txt)."""

from warp_gi.registry import Claim, Entry, Technique

_SETTINGS = {"resolution": 256}
_RESOLUTION = {least: tuple({"resolution": size} for size in (least, 64, 256)) for least in (16, 32)}

TECHNIQUE = Technique(
    name="radiance-transfer",
    short="transfer",
    estimators={
        "RadianceTransfer": Entry(
            "estimator",
            {
                "": Claim(_SETTINGS, unbiased=False, bound=0.05, resolution=_RESOLUTION[16]),
                "indirect": Claim(
                    {**_SETTINGS, "term": "indirect"}, unbiased=False, bound=0.05, resolution=_RESOLUTION[32]
                ),
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
    page="techniques/radiance_transfer.md",
    samplers=("transfer_light.TRANSFER_CACHE",),
    suite="transfer",
)
