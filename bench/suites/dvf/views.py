"""Views that visibility fields are measured on: one bake for each of their settings, and the stages of a frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

import warp_gi as gi
from warp_gi import launch
from warp_gi.bench.harness.measure import Row
from warp_gi.bench.harness.stages import DARK, LAMBERT, Case, Stage, View, rmse
from warp_gi.techniques.visibility_field import audit as visibility_audit
from warp_gi.techniques.visibility_field.state import FieldState

CASES = (
    Case("sponza", target=4.0, materials=LAMBERT),
    Case("atrium_white", "atrium", 3.0, materials=DARK),
    Case("bistro_white", "Bistro", 2.0, {"cell_size": 1.0}, DARK),
    Case("street_white", "street", 2.0, {"cell_size": 1.0}, DARK),
)
QUICK_SETTINGS: dict[str, Any] = {"cell_size": 4.0, "resolution": 36}
"""Settings of fields that bake in seconds and save fewer rays, for the quick form."""
QUICK_CASES = tuple(replace(case, settings=QUICK_SETTINGS) for case in (CASES[0], CASES[3]))
SIZE, QUICK_SIZE = (480, 270), (160, 90)
"""Picture size in pixels."""


def glossy(scene: gi.Scene) -> gi.Scene:
    """Return the scene with every surface coated, of roughness 0.3."""
    nodes = [
        replace(
            node,
            meshes=[
                replace(mesh, material=replace(mesh.material, metallic=0.0, specular=1.0, roughness=0.3))
                for mesh in node.meshes
            ],
        )
        for node in scene.nodes
    ]
    return gi.Scene(nodes, scene.lights, scene.environment, scene.cameras, scene.name)


class FieldStage(Stage):
    """A stage of a visibility field."""

    state: FieldState

    @property
    def memory(self) -> int:
        """Bytes of the field on the device."""
        return self.state.masks.nbytes + self.state.slots.nbytes


@dataclass
class FieldView(View):
    """A view of visibility fields."""

    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the view's fields that are not the defaults."""
    _cells: dict[float, int] = field(default_factory=dict)

    def estimator(self, **settings: Any) -> gi.VisibilityField:
        """Return this view's field with other ``settings``."""
        return gi.VisibilityField(**{**self.settings, **settings})

    def with_scene(self, scene: gi.Scene) -> FieldView:
        """Return this view of a scene of the same geometry; the bakes are shared."""
        return replace(self, scene=scene)

    def stage(self, spp: int, **settings: Any) -> FieldStage:
        """Return the stage at ``spp`` samples a pixel."""
        estimator = self.estimator(**settings)
        bake = self.bake(estimator)[0] if estimator.uses_cells else None
        return FieldStage(self.scene, self.camera, estimator, spp, self.device, bake)

    def scene_memory(self, stage: FieldStage) -> int:
        """Return the bytes of the field if every cell of the scene were baked."""
        size = stage.state.grid.cell_size
        if size not in self._cells:
            state = FieldState(self.scene, launch.get_device(self.device), stage.estimator.mask_settings, 0)
            self._cells[size] = len(state.baker("static").find().cells)
        return self._cells[size] * 4 * stage.state.words + stage.state.slots.nbytes


def white_error(stage: FieldStage, traced: FieldStage) -> np.ndarray:
    """Return how the pictures of Lambert surfaces under a white sky would differ if all were white, [pixel]."""
    channel = np.argmax(stage.albedo, axis=-1)[..., None]
    albedo, difference = (np.take_along_axis(a, channel, -1) for a in (stage.albedo, stage.picture - traced.picture))
    return (difference / np.maximum(albedo, 1e-6)).reshape(-1)


def quality(stage: FieldStage, traced: FieldStage) -> Row:
    """Return errors of a stage of Lambert surfaces under a white sky, and the share of rays that it traces.

    Wrong rays are those that the field is sure of and wrong about; "unbiased" makes up for them. What the mode
    "paper" gets wrong shows in the picture, as no cell of its errs in both ways; in the others the audit counts it.
    """
    counts = visibility_audit.audit(stage.frame, stage.state)
    total = max(int(visibility_audit.rays_asked(counts).sum()), 1)
    traced_share = float(visibility_audit.rays_traced(counts, stage.estimator).sum() / total)
    error, wrong = white_error(stage, traced), counts["lost"] + counts["leaked"]
    if stage.estimator.mode == "three_state":
        error = (counts["leaked"] - counts["lost"]) / stage.spp
    elif stage.estimator.mode == "paper":
        wrong = np.rint(np.abs(error) * stage.spp)
    return {
        "RMSE": rmse(stage.picture, traced.picture),
        "relMSE": gi.metrics.rel_mse(stage.picture, traced.picture),
        "FLIP": gi.metrics.flip(stage.picture, traced.picture),
        "RMSE white": rmse(error),
        "traced share": traced_share,
        "wrong per million": float(wrong.sum() / total * 1e6),
    }
