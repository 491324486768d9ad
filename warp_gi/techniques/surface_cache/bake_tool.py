"""``warp-gi bake`` of surface caches."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

from warp_gi.baking import Bake
from warp_gi.errors import OptionError
from warp_gi.scene.camera import Camera
from warp_gi.scene.scene import Scene
from warp_gi.techniques.bake_tool import BakeTool, ExportRequest, ExportSettings, Rows
from warp_gi.techniques.surface_cache import light_map_export, pictures
from warp_gi.techniques.surface_cache.cache import SurfaceCache, check_still
from warp_gi.techniques.surface_cache.cells import table_nbytes
from warp_gi.techniques.surface_cache.export import check_export_name, export_points
from warp_gi.techniques.surface_cache.light_map import LightMapSettings, bake_light_map


class SurfaceCacheTool(BakeTool[SurfaceCache]):
    """Fills the cells that the whole camera path needs."""

    settings = SurfaceCache
    summary = (
        "The light that arrives at surfaces, in small cells of them, by paths from the whole camera path,",
        "under the scene's sky. Rendered by --pipeline cache.",
    )
    shows = ("the cells, their samples, and the irradiance that they hold",)
    exports = (
        "for NAME.glb or NAME.gltf a light map, NAME.exr, and the surfaces with its coordinates;",
        "for NAME.ply the cells as points with normal and irradiance",
    )
    examples = (
        "hall.glb --paths 1000000 --show out/hall_cells",
        "atrium --export out/atrium.glb --resolution 2048 --samples 256",
    )
    exported = "exported"
    export_settings = LightMapSettings

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
        """Raise OptionError for a file of an unknown kind, and where a file of another's would be overwritten."""
        if path.suffix.lower() in light_map_export.SUFFIXES:
            light_map_export.check_export_name(path)
        else:
            check_export_name(path)

    def check_export_settings(self, own: ExportSettings, path: Path | None) -> None:
        """Raise OptionError for settings of a light map that are out of range, or without one."""
        own.validate()
        if own != LightMapSettings() and (path is None or path.suffix.lower() not in light_map_export.SUFFIXES):
            names = ", ".join(f"--{one.name.replace('_', '-')}" for one in fields(own) if _is_given(own, one.name))
            raise OptionError(f"{names} goes with a light map: give --export NAME.glb, or leave it out")

    def exported_files(self, path: Path) -> list[Path]:
        """Return the files that ``export`` writes."""
        if path.suffix.lower() in light_map_export.SUFFIXES:
            return list(light_map_export.exported_files(path).values())
        return super().exported_files(path)

    def export(self, bake: Bake, path: Path, scene: Scene, request: ExportRequest[SurfaceCache]) -> list[Path]:
        """Write the cells as points, or a light map."""
        if path.suffix.lower() not in light_map_export.SUFFIXES:
            return export_points(bake, path)
        own = request.own if isinstance(request.own, LightMapSettings) else LightMapSettings()
        light_map = bake_light_map(scene, bake, request.settings, own, request.device, request.seed, request.progress)
        return light_map_export.export_light_map(light_map, path, scene, own, bake)

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


def _is_given(own: ExportSettings, name: str) -> bool:
    return bool(getattr(own, name) != getattr(type(own)(), name))


TOOL = SurfaceCacheTool()
