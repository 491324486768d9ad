"""Columns of the suite ``probes``, and of what probes add to the suite ``scaling``."""

from warp_gi.bench.harness.columns import (
    COUNT,
    ERROR,
    MEMORY,
    RATE,
    RATIO,
    TIME,
    columns,
    keys,
    measured,
    notes,
    ratios,
    seconds,
)

SCALING = (*keys("resolution"), *seconds("bake "), *measured(MEMORY, "MB", "lower", "MB"))

COLUMNS = columns(
    "probes",
    keys("case", "mode", "through", "visibility", "weights", "relocate", "probes", "resolution", "spp"),
    keys("pipeline", "rays a pixel"),
    notes("target", "bake at most", "least", "most", "all its scenes"),
    seconds(),
    ratios("faster, {}"),
    # pictures and irradiance beside paths
    measured(ERROR, "times", None, "mean / paths", "lit / paths"),
    measured(ERROR, "W/(m^2 sr) or W/m^2", "lower", "RMSE"),
    measured(ERROR, "share of the mean", "lower", "RMSE / mean"),
    measured(ERROR, "", "lower", "relMSE", "FLIP"),
    measured(ERROR, "share of pixels", "lower", "black pixels"),
    measured(ERROR, "share of blocks", None, "below half", "above twice"),
    measured(ERROR, "times", "lower", "dark / lit"),
    measured(COUNT, "share of pixels", None, "left to rays"),
    measured(COUNT, "probes", None, "covered"),
    measured(TIME, "us", "lower", "us a pixel"),
    measured(TIME, "ns", "lower", "ns a pixel"),
    measured(COUNT, "samples", None, "paths spp for this RMSE"),
    measured(ERROR, "W/(m^2 sr)", None, "paths RMSE in this time"),
    measured(TIME, "ms", None, "Lambertian ms", "glossy ms"),
    # rays
    measured(ERROR, "share of rays", "higher", "agree"),
    measured(ERROR, "share of rays", None, "of known", "unknown"),
    measured(COUNT, "", None, "texels a ray", "blocks a ray", "probes a ray"),
    measured(RATE, "million rays/s", "higher", "Mrays/s"),
    measured(RATE, "million rays/s", None, "tree Mrays/s"),
    measured(RATIO, "times", "higher", "of tree"),
    # bakes
    seconds("bake "),
    measured(COUNT, "m", None, "spacing m"),
    measured(COUNT, "million rays", None, "million rays"),
    measured(COUNT, "passes", None, "passes"),
    measured(ERROR, "share", None, "last change"),
    measured(TIME, "ms", "lower", "update ms a probe, wall", "update ms a probe, cpu"),
    measured(MEMORY, "MB", "lower", "MB"),
    # denoisers
    *(measured(ERROR, "W/(m^2 sr)", "lower", f"{name} RMSE") for name in ("noisy", "ST", "OIDN")),
    *(measured(ERROR, "", "lower", f"{name} relMSE", f"{name} FLIP") for name in ("noisy", "ST", "OIDN")),
    measured(TIME, "ms", "lower", "ST ms", "OIDN ms"),
)
