"""``warp-gi bake`` of surface caches."""

from __future__ import annotations

from pathlib import Path

from warp_gi.baking import Bake
from warp_gi.errors import OptionError
from warp_gi.scene.camera import Camera
from warp_gi.scene.scene import Scene
from warp_gi.techniques.bake_tool import BakeTool, Rows
from warp_gi.techniques.surface_cache import pictures
from warp_gi.techniques.surface_cache.cache import SurfaceCache, check_still
from warp_gi.techniques.surface_cache.cells import table_nbytes
from warp_gi.techniques.surface_cache.export import check_export_name, export_points


class SurfaceCacheTool(BakeTool[SurfaceCache]):
    """Fills the cells that the whole camera path needs."""

    settings = SurfaceCache
    summary = (
        "The light that arrives at surfaces, in small cells of them, by paths from the whole camera path,",
        "under the scene's sky. Rendered by --pipeline cache.",
    )
    shows = ("the cells, their samples, and the irradiance that they hold",)
    exports = ("points with normal and irradiance for NAME.ply",)
    examples = ("hall.glb --paths 1000000 --show out/hall_cells",)
    exported = "points"

    def check(self, settings: SurfaceCache, everywhere: bool) -> None:
        """Raise OptionError for ``everywhere``."""
        if everywhere:
            raise OptionError(
                "--everywhere goes with visibility fields; a surface cache is of what the camera path needs: omit it"
            )

    def check_scene(self, settings: SurfaceCache, scene: Scene) -> None:
        """Raise SceneError for a scene that moves."""
        check_still(scene)

    def check_export(self, settings: SurfaceCache, path: Path, components: int) -> None:
        """Raise OptionError unless the file is a .ply, beside which no file of another's would be overwritten."""
        check_export_name(path)

    def export(self, bake: Bake, path: Path, scene: Scene, components: int) -> list[Path]:
        """Write the cells as points."""
        return export_points(bake, path)

    def write_pictures(
        self, scene: Scene, camera: Camera, bake: Bake, settings: SurfaceCache, folder: Path, device: str, seed: int
    ) -> list[Path]:
        """Write the cells, their samples and their irradiance."""
        return pictures.write_pictures(scene, camera, bake, settings, folder, device, seed)

    def rows(self, bake: Bake, seconds: float) -> Rows:
        """Return counts of paths, vertices and cells."""
        counts = bake.counts
        return [
            ("paths", int(bake.settings["paths"])),
            ("vertices", int(counts["vertices"])),
            ("cells", int(counts["cells"])),
            ("cells without a place", int(counts["cells_over"])),
            ("side of a cell [m]", float(bake.arrays["side"][0])),
            ("samples a cell", counts["samples"] / max(counts["cells"], 1)),
            ("seconds", round(seconds, 3)),
            ("in memory [MB]", table_nbytes(bake.arrays["keys"]) / 1e6),
        ]


TOOL = SurfaceCacheTool()
