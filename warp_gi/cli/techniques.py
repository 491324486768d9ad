"""What ``warp-gi bake`` can bake for: the settings, files, pictures and closing table of each technique."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from warp_gi.baking import Bake
from warp_gi.cli.options import value_given
from warp_gi.cli.report import Reporter
from warp_gi.errors import OptionError, unknown_name
from warp_gi.scene.camera import Camera
from warp_gi.scene.scene import Scene
from warp_gi.techniques.light_field import export as light_field_export
from warp_gi.techniques.light_field import pictures as light_field_pictures
from warp_gi.techniques.light_field.estimator import LightFieldProbes
from warp_gi.techniques.light_field.places import probe_grid
from warp_gi.techniques.light_field.state import baked_resolution, bounce_changes
from warp_gi.techniques.visibility_field import export as visibility_export
from warp_gi.techniques.visibility_field.estimator import VisibilityField

Rows = list[tuple[str, Any]]
Settings = VisibilityField | LightFieldProbes


@dataclass(frozen=True)
class Technique:
    """How one technique is baked from the command line."""

    settings: type
    """The estimator, whose fields are the flags."""
    short_name: str
    """In the name of a bake's file."""
    exported: str
    """What files of an export are called."""
    is_of_view: bool
    """Whether it bakes no more than the camera sees, unless told otherwise."""
    bakes_unseen: bool
    """Whether it finds out by itself what to bake of a scene that has no camera."""
    check: Callable[[Any, bool], None]
    """Given the settings and whether --everywhere was, raises OptionError for what makes no sense."""
    check_scene: Callable[[Any, Scene], None]
    """Given the settings and the scene, raises OptionError for a bake that would be too large."""
    check_export_name: Callable[[Path], None]
    """Raises OptionError for a file that an export cannot be."""
    export: Callable[[Bake, Path], list[Path]]
    """Writes the files of an export and returns them, the description last."""
    write_pictures: Callable[[Scene, Camera, Bake, Any, Path, str, int], list[Path]]
    """Writes pictures of the bake to a folder."""
    needs_sky: bool
    """Whether the pictures show nothing without a sky, and a white one may stand for it."""
    summary: Callable[[Bake, float], Rows]
    """Returns rows of the closing table, of a bake and the seconds that it took."""
    report: Callable[[Bake, Any, Reporter], None] = lambda bake, settings, report: None
    """Tells what else there is to say, after the table."""


def technique_of(arguments: Sequence[str]) -> str:
    """Return the name of the technique that the arguments of a command ask for.

    Raises OptionError for an unknown one, and for a flag that is a setting of another one only.
    """
    given = value_given(arguments, "--technique")
    chosen = DEFAULT_TECHNIQUE if given is None else given
    if chosen not in TECHNIQUES:
        raise unknown_name("technique", chosen, TECHNIQUES)
    names = {name: {field.name for field in fields(one.settings)} for name, one in TECHNIQUES.items()}
    for argument in arguments:
        flag = argument.partition("=")[0]
        setting = flag.removeprefix("--").removeprefix("no-").replace("-", "_")
        owner = next((name for name in names if setting in names[name]), None)
        if flag.startswith("--") and owner is not None and setting not in names[chosen]:
            raise OptionError(
                f"{flag} is a setting of {owner}, but {chosen} is baked; leave it out, or give --technique {owner}"
            )
    return chosen


# ---- visibility field ----


def _check_field(settings: VisibilityField, everywhere: bool) -> None:
    if settings.mode == "traced":
        raise OptionError('mode "traced" uses no bake; choose another, or render with it as it is')


def _summary_of_field(bake: Bake, seconds: float) -> Rows:
    counts = bake.counts
    return [
        ("cells", int(counts["cells"])),
        ("cell size [m]", float(bake.settings["cell_size"])),
        ("grid", _times(bake.arrays["grid_shape"])),
        ("surface samples", int(counts["samples"])),
        ("rays", int(counts["rays"])),
        ("rays traced", int(counts["rays_traced"])),
        ("seconds", round(seconds, 3)),
        ("million rays a second", counts["rays"] / 1e6 / max(seconds, 1e-9)),
        ("million traced a second", counts["rays_traced"] / 1e6 / max(seconds, 1e-9)),
    ]


# ---- light field probes ----


def _check_probes(settings: LightFieldProbes, everywhere: bool) -> None:
    if everywhere:
        raise OptionError(
            "--everywhere goes with visibility fields; a bake of probes is always of the whole grid: omit it"
        )
    if settings.primary == "probes":
        raise OptionError(
            'primary "probes" is a way to render; bake without it, then warp-gi render FILE shows the bake'
        )


def _check_grid(settings: LightFieldProbes, scene: Scene) -> None:
    if all(settings.counts):  # else the grid follows from what the camera reaches, which is for the bake to find out
        probe_grid(scene.bounds, settings.counts, settings.spacing, settings.largest_map)


def _summary_of_probes(bake: Bake, seconds: float) -> Rows:
    counts, settings, changes = bake.counts, bake.settings, bounce_changes(bake)
    size, few = baked_resolution(bake), int(settings["irradiance_resolution"])
    return [
        ("probes", int(counts["probes"])),
        ("probes usable", int(counts["probes"] - counts["covered"])),
        ("probes covered", int(counts["covered"])),
        ("grid", _times(bake.arrays["grid_counts"])),
        ("spacing [m]", _times(f"{step:.3g}" for step in bake.arrays["grid_spacing"])),
        ("map of a probe", f"{size} x {size}"),
        ("map of irradiance", f"{few} x {few}"),
        ("texels", int(counts["probes"]) * size**2),
        ("rays", int(counts["rays"])),
        ("seconds", round(seconds, 3)),
        ("million rays a second", counts["rays"] / 1e6 / max(seconds, 1e-9)),
        ("bounces", len(changes)),
        ("change of the last", changes[-1]),
        ("maps in memory [MB]", counts["bytes"] / 1e6),
    ]


def _report_bounces(bake: Bake, settings: LightFieldProbes, report: Reporter) -> None:
    changes = bounce_changes(bake)
    rows = [(number, change) for number, change in enumerate(changes, 1)]
    report.table("light that bounces", ("bounce", "change of the irradiance"), rows)
    if settings.tolerance and changes[-1] > settings.tolerance:
        report.line(
            f"the last bounce still changed {changes[-1]:.2g} of the light, more than the tolerance of "
            f"{settings.tolerance:g}: give more --bounces than {settings.bounces}"
        )


def _times(values: Any) -> str:
    return " x ".join(map(str, values))


TECHNIQUES = {
    "visibility-field": Technique(
        settings=VisibilityField,
        short_name="dvf",
        exported="textures",
        is_of_view=True,
        bakes_unseen=False,
        check=_check_field,
        check_scene=lambda settings, scene: settings.bake_settings(scene),  # raises for a grid that is too fine
        check_export_name=visibility_export.check_export_name,
        export=visibility_export.export_textures,
        write_pictures=visibility_export.write_pictures,
        needs_sky=True,
        summary=_summary_of_field,
    ),
    "light-field-probes": Technique(
        settings=LightFieldProbes,
        short_name="probes",
        exported="atlases",
        is_of_view=True,
        bakes_unseen=True,
        check=_check_probes,
        check_scene=_check_grid,
        check_export_name=light_field_export.check_export_name,
        export=light_field_export.export_atlases,
        write_pictures=light_field_pictures.write_pictures,
        needs_sky=False,
        summary=_summary_of_probes,
        report=_report_bounces,
    ),
}
DEFAULT_TECHNIQUE = "visibility-field"
