"""The result of a file reader: the arguments of a Scene."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from warp_gi.scene.files.support import Findings
from warp_gi.scene.model import Mesh, Node, PunctualLight
from warp_gi.scene.normals import smooth_mesh
from warp_gi.scene.pinhole import Camera


@dataclass(eq=False)
class SceneParts:
    """The contents of one file, before a Scene checks them."""

    nodes: list[Node]
    lights: list[PunctualLight] = field(default_factory=list)
    cameras: dict[str, Camera] = field(default_factory=dict)
    camera_nodes: dict[str, int] = field(default_factory=dict)
    findings: Findings = field(default_factory=Findings)
    """What the file uses and was not read in full."""

    def scaled(self, scale: float) -> SceneParts:
        """Return the parts with all lengths times ``scale``; intensities stay as they are."""
        grow = np.diag([scale, scale, scale, 1.0])

        def scaled_node(node: Node) -> Node:
            if node.parent is not None:
                return node
            keys = [
                replace(k, translation=tuple(scale * np.array(k.translation)), scale=tuple(scale * np.array(k.scale)))
                for k in node.keyframes or ()
            ]
            return replace(node, parent_from_node=grow @ node.parent_from_node, keyframes=keys or None)

        def scaled_light(light: PunctualLight) -> PunctualLight:
            position = light.position if light.node is not None else tuple(scale * np.array(light.position))
            return replace(light, position=position, range=None if light.range is None else scale * light.range)

        def scaled_camera(camera: Camera) -> Camera:
            return replace(camera, world_from_camera=grow @ camera.world_from_camera)

        return SceneParts(
            [scaled_node(node) for node in self.nodes],
            [scaled_light(light) for light in self.lights],
            {name: scaled_camera(camera) for name, camera in self.cameras.items()},
            self.camera_nodes,
            self.findings,
        )

    def smoothed(self, angle: float) -> SceneParts:
        """Return the parts with crease-aware normals on the meshes that have none; see ``smooth_mesh``."""
        done: dict[int, Mesh] = {}

        def smoothed_mesh(mesh: Mesh) -> Mesh:
            if id(mesh) not in done:
                done[id(mesh)] = smooth_mesh(mesh, angle) if mesh.normals is None else mesh
            return done[id(mesh)]

        nodes = [replace(node, meshes=[smoothed_mesh(mesh) for mesh in node.meshes]) for node in self.nodes]
        return SceneParts(nodes, self.lights, self.cameras, self.camera_nodes, self.findings)
