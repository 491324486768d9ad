"""``warp-gi bake`` of visibility fields."""

from __future__ import annotations

from pathlib import Path

from warp_gi.baking import Bake
from warp_gi.errors import OptionError
from warp_gi.scene.camera import Camera
from warp_gi.scene.scene import Scene
from warp_gi.techniques.bake_tool import BakeTool, ExportRequest, Rows, times
from warp_gi.techniques.visibility_field import export as export_files
from warp_gi.techniques.visibility_field import pictures
from warp_gi.techniques.visibility_field.estimator import VisibilityField


class VisibilityFieldTool(BakeTool[VisibilityField]):
    """Bakes the cells that a camera path sees, or all of them."""

    settings = VisibilityField
    summary = (
        "Which way the sky is seen, in the cells that the camera path sees; --everywhere: in all.",
        "It depends on the geometry alone: one bake serves every sky, only the pictures depend on it.",
    )
    shows = ("maps, labels, how many rays are left to trace, and the error",)
    exports = ("a .png for each layer (#### is its number), or one .exr",)
    examples = (
        "hall.glb --cell-size 0.5 --camera path.json",
        "hall.glb --everywhere --export out/hall.png -o out/hall.dvf.safetensors",
        "atrium --show out/atrium_field",
    )
    exported = "textures"
    needs_sky = True

    def check(self, settings: VisibilityField, everywhere: bool) -> None:
        """Raise OptionError for the mode that uses no bake."""
        if not settings.uses_cells:
            raise OptionError('mode "traced" uses no bake; choose another, or render with it as it is')

    def check_scene(self, settings: VisibilityField, scene: Scene) -> None:
        """Raise OptionError for a grid that is too fine."""
        settings.bake_settings(scene)

    def check_export(self, settings: VisibilityField, path: Path, components: int) -> None:
        """Raise OptionError unless the file is a .png or .exr."""
        export_files.check_export_name(path)

    def export(self, bake: Bake, path: Path, scene: Scene, request: ExportRequest[VisibilityField]) -> list[Path]:
        """Write the masks as textures."""
        return export_files.export_textures(bake, path)

    def write_pictures(
        self, scene: Scene, camera: Camera, bake: Bake, settings: VisibilityField, folder: Path, device: str, seed: int
    ) -> list[Path]:
        """Write maps, labels, shares of traced rays, and the error."""
        return pictures.write_pictures(scene, camera, bake, settings, folder, device, seed)

    def rows(self, bake: Bake, seconds: float) -> Rows:
        """Return counts of cells, samples and rays, and rays a second."""
        counts = bake.counts
        return [
            ("cells", int(counts["cells"])),
            ("cell size [m]", float(bake.settings["cell_size"])),
            ("grid", times(bake.arrays["grid_shape"])),
            ("surface samples", int(counts["samples"])),
            ("rays", int(counts["rays"])),
            ("rays traced", int(counts["rays_traced"])),
            ("seconds", round(seconds, 3)),
            ("million rays a second", counts["rays"] / 1e6 / max(seconds, 1e-9)),
            ("million traced a second", counts["rays_traced"] / 1e6 / max(seconds, 1e-9)),
        ]


TOOL = VisibilityFieldTool()
