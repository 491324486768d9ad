"""``warp-gi bake`` of radiance transfer textures."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warp_gi.baking import Bake
from warp_gi.errors import OptionError, check_whole
from warp_gi.scene.camera import Camera
from warp_gi.scene.scene import Scene
from warp_gi.techniques.bake_tool import BakeTool, ExportRequest, Rows, Table, times
from warp_gi.techniques.radiance_transfer import export as export_files
from warp_gi.techniques.radiance_transfer import pictures
from warp_gi.techniques.radiance_transfer.estimator import RadianceTransfer
from warp_gi.techniques.radiance_transfer.pca import CHANNELS
from warp_gi.techniques.radiance_transfer.textures import transfer_textures
from warp_gi.techniques.radiance_transfer.viewer import page
from warp_gi.techniques.shared.atlas.build import check_surfaces
from warp_gi.techniques.shared.atlas.densities import check_texel_sets


class RadianceTransferTool(BakeTool[RadianceTransfer]):
    """Bakes the textures of all surfaces that rest."""

    settings = RadianceTransfer
    summary = (
        "How the light of any sky arrives at each texel of the surfaces, directly and over other surfaces. There",
        "is no sky in it: one bake serves every sky, only the pictures depend on it.",
    )
    shows = ("charts, what the sky lights directly and over other surfaces, and a view",)
    exports = (
        "for NAME.exr the coefficients, NAME.rgba.exr the same by fours, and NAME.glb,",
        "the surfaces with the coordinates of the atlas; --export-components is of its bounces",
    )
    views = ("the matt surfaces under skies that the mouse turns, in WebGL2; at most 30 MB",)
    examples = (
        "hall.glb --resolution 2048 --order 6",
        "atrium --export out/a.exr --export-components 16 --show out/atrium_transfer",
        "sphere_row --resolution 256 --view out/spheres.html",
    )
    exported = "textures"
    compresses = True
    needs_sky = True
    finds_places = True

    def check(self, settings: RadianceTransfer, everywhere: bool) -> None:
        """Raise OptionError for ``everywhere``."""
        if everywhere:
            raise OptionError(
                "--everywhere goes with visibility fields; a bake of transfer is always of all surfaces: omit it"
            )

    def check_scene(self, settings: RadianceTransfer, scene: Scene) -> None:
        """Raise OptionError or SceneError for unknown names in texel sets, and a scene without a surface to bake."""
        check_texel_sets(scene, settings.texel_sets)
        check_surfaces(scene)

    def check_export(self, settings: RadianceTransfer, path: Path, components: int) -> None:
        """Raise OptionError unless the file is an .exr of texels, and for components of bounces that are not there."""
        export_files.check_export_name(path)
        if settings.storage == "vertices":
            raise OptionError("transfer at vertices has no images; bake with --storage texture to export it")
        if components:
            check_whole("--export-components", components, 1, CHANNELS)
            if not settings.bounces:
                raise OptionError("--export-components are of bounces, and --bounces is 0; leave one of them out")

    def exported_files(self, path: Path) -> list[Path]:
        """Return the files that ``export`` writes."""
        return list(export_files.exported_files(path).values())

    def export(self, bake: Bake, path: Path, scene: Scene, request: ExportRequest[RadianceTransfer]) -> list[Path]:
        """Write images, surfaces and their description."""
        return export_files.export_textures(bake, path, scene, request.components)

    def check_view(self, settings: RadianceTransfer, path: Path) -> None:
        """Raise OptionError unless the file is an .html, and the bake is one of texels."""
        page.check_view_name(path)
        if settings.storage == "vertices":
            raise OptionError("a view shows texels, not vertices; bake with --storage texture to view it")

    def view(self, bake: Bake, scene: Scene, camera: Camera, path: Path) -> Path:
        """Write the page."""
        return page.write_view(bake, scene, camera, path)

    def write_pictures(
        self, scene: Scene, camera: Camera, bake: Bake, settings: RadianceTransfer, folder: Path, device: str, seed: int
    ) -> list[Path]:
        """Write charts, what arrives directly and over other surfaces, and a view."""
        return pictures.write_pictures(scene, camera, bake, settings, folder, device, seed)

    def rows(self, bake: Bake, seconds: float) -> Rows:
        """Return counts of charts, pages, texels, slots and rays, what bounced, and bytes."""
        textures, counts = transfer_textures(bake), bake.counts
        atlas, slots = textures.atlas, max(textures.atlas.count, 1)
        values = (textures.transfer, textures.bounces, textures.lamps)
        rows: Rows = []
        if len(atlas.pages):
            rows = [
                ("charts", int(atlas.charts.max(initial=-1)) + 1),
                ("pages", len(atlas.pages)),
                ("largest page", times(atlas.pages[np.argmax(atlas.pages[:, 1] * atlas.pages[:, 2]), 1:])),
                ("texels", int((atlas.pages[:, 1] * atlas.pages[:, 2]).sum())),
            ]
        rows += [
            ("slots", atlas.count),
            ("slots of backs", int(np.count_nonzero(atlas.slot_sides))),
            ("rays", int(counts["rays"])),
            ("rays a slot", counts["rays"] / slots),
            ("seconds", round(seconds, 3)),
            ("million rays a second", counts["rays"] / 1e6 / max(seconds, 1e-9)),
        ]
        if "bounces" in counts:
            rows += [("bounces", int(counts["bounces"])), ("share of the last", float(counts["last_share"]))]
            if "lamp_bounces" in counts:
                rows.append(("bounces of lamps", int(counts["lamp_bounces"])))
            rows.append(("share of bounces' rays on surfaces without slots", float(counts["black_share"])))
        return [
            *rows,
            ("bytes a slot", sum(array.nbytes for array in values) // slots),
            ("in memory [MB]", bake.nbytes / 1e6),
        ]

    def tables(self, bake: Bake) -> list[Table]:
        """Return the seconds of the stages."""
        stages = [name.removesuffix("_cpu_seconds") for name in bake.counts if name.endswith("_cpu_seconds")]
        rows = [(name, bake.counts[f"{name}_seconds"], bake.counts[f"{name}_cpu_seconds"]) for name in stages]
        return [Table("seconds by stage", ("stage", "seconds", "CPU seconds, without xatlas"), rows)] if rows else []

    def advice(self, bake: Bake, settings: RadianceTransfer) -> str:
        """Return advice to allow more bounces, if the last one still added too much light."""
        last = bake.counts.get("last_share", 0.0)
        if not settings.tolerance or last <= settings.tolerance:
            return ""
        return (
            f"the last bounce still added {last:.2g} of the light, more than the tolerance of "
            f"{settings.tolerance:g}: give more --bounces than {settings.bounces}"
        )


TOOL = RadianceTransferTool()
