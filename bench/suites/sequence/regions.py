"""What documents show of the suite ``sequence``."""

from __future__ import annotations

from warp_gi.bench.publish.figures import Figure, Grid, GridColumn, Region, Text
from warp_gi.bench.suites.sequence.columns import COLUMNS

_SEQUENCE = Region(
    COLUMNS,
    "**Sequences**, `warp-gi bench sequence`, from the command to written files:",
    (
        Text(
            "{frames} frames of the atrium, {pixels}, {spp} samples a pixel, written files included:",
            {key: Figure(key) for key in ("frames", "pixels", "spp")},
            "speed",
        ),
        Grid(
            "pipeline",
            "pipeline",
            (
                GridColumn("frames a minute", Figure("frames a minute")),
                GridColumn("bake, s", Figure("bake s", table="stages")),
                GridColumn("trace, s a frame", Figure("trace s a frame", table="stages")),
                GridColumn("peak GB", Figure("peak GB")),
                GridColumn("memory grows, KB a frame", Figure("KB a frame", table="memory")),
            ),
            "speed",
        ),
        Text(
            "Blender Cycles {version} on the same CPU, {frames} frames of the {scene} at {pixels} with {spp} samples, "
            "Lambert materials, no denoiser: {ours} frames a minute beside its {theirs}, {faster} times as many; the "
            "mean is {mean} % off.",
            {
                "version": Figure("blender"),
                "frames": Figure("frames"),
                "scene": Figure("scene"),
                "pixels": Figure("pixels"),
                "spp": Figure("spp"),
                "ours": Figure("ours frames a minute"),
                "theirs": Figure("blender frames a minute"),
                "faster": Figure("faster", at_least=1.0),
                "mean": Figure("means differ", scale=100.0),
            },
            "Blender",
        ),
    ),
)

REGIONS = {"sequence": _SEQUENCE}
