"""``warp-gi bake`` of visibility polygons."""

from __future__ import annotations

from pathlib import Path

from warp_gi.baking import Bake
from warp_gi.errors import OptionError
from warp_gi.scene.camera import Camera
from warp_gi.scene.scene import Scene
from warp_gi.techniques.bake_tool import BakeTool, ExportRequest, Rows, Table
from warp_gi.techniques.visibility_polygons import export as export_files
from warp_gi.techniques.visibility_polygons import pictures
from warp_gi.techniques.visibility_polygons.bake import check_rests
from warp_gi.techniques.visibility_polygons.estimator import VisibilityPolygons

SET_ARRAYS = ("positions", "normals", "set_states", "contour_starts", "point_starts", "points")
"""Arrays of a bake that are of vertices; the others are of triangles."""


class VisibilityPolygonsTool(BakeTool[VisibilityPolygons]):
    """Bakes what all vertices see."""

    settings = VisibilityPolygons
    summary = (
        "What each vertex sees of the sky, as polygons, and which points of them belong together over triangles.",
        "It depends on the geometry alone: one bake serves every sky, only the pictures depend on it.",
    )
    shows = ("what some vertices see, which triangles are traced, a view and its error",)
    exports = ("NAME.bin and, beside it, NAME.json, which says how to read it",)
    examples = ("bust.glb --resolution 64 -o out/bust.polygons.safetensors", "sphere_row --show out/polygons")
    exported = "polygons"
    needs_sky = True
    finds_places = True

    def check(self, settings: VisibilityPolygons, everywhere: bool) -> None:
        """Raise OptionError for ``everywhere``."""
        if everywhere:
            raise OptionError(
                "--everywhere goes with visibility fields; a bake of polygons is always of all vertices: omit it"
            )

    def check_scene(self, settings: VisibilityPolygons, scene: Scene) -> None:
        """Raise SceneError where something moves."""
        check_rests(scene)

    def check_export(self, settings: VisibilityPolygons, path: Path, components: int) -> None:
        """Raise OptionError unless the file is a .bin."""
        export_files.check_export_name(path)

    def export(self, bake: Bake, path: Path, scene: Scene, request: ExportRequest[VisibilityPolygons]) -> list[Path]:
        """Write the arrays and their description."""
        return export_files.export_polygons(bake, path)

    def write_pictures(
        self,
        scene: Scene,
        camera: Camera,
        bake: Bake,
        settings: VisibilityPolygons,
        folder: Path,
        device: str,
        seed: int,
    ) -> list[Path]:
        """Write polygons, states of triangles, a view and its error."""
        return pictures.write_pictures(scene, camera, bake, settings, folder, device, seed)

    def rows(self, bake: Bake, seconds: float) -> Rows:
        """Return counts of vertices, points and triangles, the error, and bytes."""
        counts, arrays = bake.counts, bake.arrays
        sets, sides = max(int(counts["sets"]), 1), max(int(counts["sides"]), 1)
        of_sets = sum(arrays[name].nbytes for name in SET_ARRAYS)
        return [
            ("vertices by normal and side", sets),
            ("of these blind", int(counts["blind"])),
            ("of these with too many contours", int(counts["complex"])),
            ("points of contours a vertex", counts["points"] / sets),
            ("sides of triangles", sides),
            ("of these traced", int(counts["traced"])),
            ("of these flagged", int(counts["flagged"])),
            ("error under a uniform sky, mean of the largest in a triangle", counts["mean_error"]),
            ("seconds", round(seconds, 3)),
            ("bytes a vertex", of_sets // sets),
            ("bytes a side of a triangle", (bake.nbytes - of_sets) // sides),
            ("in memory [MB]", bake.nbytes / 1e6),
        ]

    def tables(self, bake: Bake) -> list[Table]:
        """Return the seconds of the stages."""
        stages = ("contours", "correspondence", "check")
        rows = [(name, bake.counts[f"{name}_seconds"], bake.counts[f"{name}_cpu_seconds"]) for name in stages]
        return [Table("seconds by stage", ("stage", "seconds", "CPU seconds"), rows)]


TOOL = VisibilityPolygonsTool()
