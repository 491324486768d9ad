"""``warp-gi bake`` of light field probes."""

from __future__ import annotations

from pathlib import Path

from warp_gi.baking import Bake
from warp_gi.errors import OptionError
from warp_gi.scene.camera import Camera
from warp_gi.scene.scene import Scene
from warp_gi.techniques.bake_tool import BakeTool, ExportRequest, Rows, Table, times
from warp_gi.techniques.light_field import export as export_files
from warp_gi.techniques.light_field import pictures
from warp_gi.techniques.light_field.estimator import LightFieldProbes
from warp_gi.techniques.light_field.places import probe_grid
from warp_gi.techniques.light_field.state import baked_resolution, bounce_changes


class LightFieldTool(BakeTool[LightFieldProbes]):
    """Bakes all probes of a grid, which lies around what the camera path reaches, or else where light is."""

    settings = LightFieldProbes
    summary = (
        "The light that arrives at each point of a grid from all directions, under the scene's sky. The grid",
        "fills the space that light paths from the camera reach, along the whole of its path.",
    )
    shows = ("their maps, their places in the view, and the path of a ray through the maps",)
    exports = ("atlases NAME.radiance.exr and so on for NAME.exr",)
    examples = (
        "hall.glb --environment city.exr --counts 4 4 4",
        "atrium --export out/a.exr --show out/atrium_probes",
    )
    exported = "atlases"
    finds_places = True

    def check(self, settings: LightFieldProbes, everywhere: bool) -> None:
        """Raise OptionError for settings that are a way to render, and for ``everywhere``."""
        if everywhere:
            raise OptionError(
                "--everywhere goes with visibility fields; a bake of probes is always of the whole grid: omit it"
            )
        if settings.primary == "probes":
            raise OptionError(
                'primary "probes" is a way to render; bake without it, then warp-gi render FILE shows the bake'
            )

    def check_scene(self, settings: LightFieldProbes, scene: Scene) -> None:
        """Raise OptionError for too many probes, if their counts are given; without, only the bake knows them."""
        if all(settings.counts):
            probe_grid(scene.bounds, settings.counts, settings.spacing, settings.probe_settings.largest_map)

    def check_export(self, settings: LightFieldProbes, path: Path, components: int) -> None:
        """Raise OptionError unless the file is an .exr."""
        export_files.check_export_name(path)

    def exported_files(self, path: Path) -> list[Path]:
        """Return the files that ``export`` writes."""
        atlases = [path.with_name(f"{path.stem}.{name}.exr") for name in export_files.ATLASES]
        return [*atlases, *super().exported_files(path)[1:]]

    def export(self, bake: Bake, path: Path, scene: Scene, request: ExportRequest[LightFieldProbes]) -> list[Path]:
        """Write the maps as atlases."""
        return export_files.export_atlases(bake, path)

    def write_pictures(
        self, scene: Scene, camera: Camera, bake: Bake, settings: LightFieldProbes, folder: Path, device: str, seed: int
    ) -> list[Path]:
        """Write the maps, the places of probes, and the path of a ray."""
        return pictures.write_pictures(scene, camera, bake, settings, folder, device, seed)

    def rows(self, bake: Bake, seconds: float) -> Rows:
        """Return counts of probes, texels and rays, rays a second, and what the last bounce changed."""
        counts, settings, changes = bake.counts, bake.settings, bounce_changes(bake)
        size, few = baked_resolution(bake), int(settings["irradiance_resolution"])
        return [
            ("probes", int(counts["probes"])),
            ("probes usable", int(counts["probes"] - counts["covered"])),
            ("probes covered", int(counts["covered"])),
            ("grid", times(bake.arrays["grid_counts"])),
            ("spacing [m]", times(f"{step:.3g}" for step in bake.arrays["grid_spacing"])),
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

    def tables(self, bake: Bake) -> list[Table]:
        """Return what each bounce changed."""
        rows = list(enumerate(bounce_changes(bake), 1))
        return [Table("light that bounces", ("bounce", "change of the irradiance"), rows)]

    def advice(self, bake: Bake, settings: LightFieldProbes) -> str:
        """Return advice to allow more bounces, if light still changed too much in the last one."""
        last = bounce_changes(bake)[-1]
        if not settings.tolerance or last <= settings.tolerance:
            return ""
        return (
            f"the last bounce still changed {last:.2g} of the light, more than the tolerance of "
            f"{settings.tolerance:g}: give more --bounces than {settings.bounces}"
        )


TOOL = LightFieldTool()
