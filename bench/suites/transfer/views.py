"""What the parts of the suite ``transfer`` share: skies, pictures of one term, and errors without the paths' noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness import places
from warp_gi.bench.harness.court import band_limited
from warp_gi.bench.harness.measure import Row
from warp_gi.bench.harness.scenes import REFERENCE_DEPTH, SCENES
from warp_gi.frame import TERMS

SIZE, QUICK_SIZE = (240, 160), (96, 64)
"""Pictures in which errors are measured, pixels."""
BIG, BIGGER, SMALL = (960, 540), (1920, 1080), (240, 136)
"""Pictures whose time is measured; the last in the quick form."""
SEED = 7
DENSE = 256
"""Texels along a side of the court's atlas at about 27 texels a metre."""
WHITE_METAL: dict[str, Any] = {"base_color": (1.0, 1.0, 1.0), "metallic": 1.0, "specular": 1.0}


def sky_file(name: str) -> str:
    """Return the file of a photographed sky in the folder of scenes."""
    return f"environments/{name}.exr"


def true_sky(name: str) -> gi.Environment:
    """Return a photographed sky; one of our own where its file is missing, as ``sky_missing`` tells."""
    if sky_missing(name):
        return own_sky()
    return gi.Environment.load(SCENES / sky_file(name))


def sky_missing(name: str) -> str:
    """Return a message if a photographed sky is missing; else an empty text."""
    return places.missing([sky_file(name)])


def smooth_sky(name: str = "courtyard") -> gi.Environment:
    """Return a sky of 25 numbers, of a photographed one or, where that is missing, of our own."""
    return band_limited(true_sky(name))


def own_sky(height: int = 64) -> gi.Environment:
    """Return a sky with a warm side and a small sun, where there are no photographed ones."""
    theta = np.pi * np.arange(height)[:, None] / (height - 1)
    phi = 2 * np.pi * (np.arange(2 * height)[None] + 0.5) / (2 * height)
    up, side = np.cos(theta) + 0 * phi, np.sin(theta) * np.sin(phi)
    pixels = np.stack([0.6 + 0.4 * side + 0 * up, 0.6 + 0.1 * side + 0.1 * up, 0.6 + 0.4 * up], axis=-1)
    pixels[height // 5, height // 3 : height // 3 + 2] = 300.0
    return gi.Environment(pixels=pixels.astype(np.float32), name="own")


def with_materials(scene: gi.Scene, **changes: Any) -> gi.Scene:
    """Return the scene with all materials changed."""
    made: dict[int, gi.Material] = {}
    nodes = []
    for node in scene.nodes:
        meshes = []
        for mesh in node.meshes:
            made.setdefault(id(mesh.material), replace(mesh.material, **changes))
            meshes.append(replace(mesh, material=made[id(mesh.material)]))
        nodes.append(replace(node, meshes=meshes))
    return gi.Scene(nodes, scene.lights, scene.environment, scene.cameras, scene.name)


def metal(scene: gi.Scene, roughness: float) -> gi.Scene:
    """Return the scene of white metal: all that it reflects is one lobe."""
    return with_materials(scene, **WHITE_METAL, roughness=roughness)


def under(scene: gi.Scene, sky: gi.Environment | None) -> gi.Scene:
    """Return the scene under another sky, without lamps."""
    return gi.Scene(scene.nodes, [], sky, scene.cameras, scene.name)


@dataclass
class TermView:
    """A term of a scene from a camera: pictures by any estimator, and by the path tracer, which are made once."""

    scene: gi.Scene
    camera: gi.Camera
    term: str
    reference_spp: int
    device: str = "cpu"
    camera_samples: int = 1
    """Camera samples of a picture; 1 is in the middle of pixels."""
    buffer: str = ""
    """The frame's buffer that is a picture; that of the term if not given."""
    _halves: list[np.ndarray] = field(default_factory=list)

    def frame(self, estimator: Any, spp: int, bakes: Sequence[gi.Bake] = (), seed: int = SEED) -> gi.Frame:
        """Return a frame with this term alone."""
        terms: dict[str, Any] = dict.fromkeys(TERMS) | {self.term: estimator}
        pipeline = gi.Pipeline(**terms, spp=max(spp, self.camera_samples), camera_samples=self.camera_samples)
        return gi.FrameScheduler(self.scene, self.camera, pipeline, self.device, seed=seed, bakes=bakes).frame(0)

    def picture(self, estimator: Any, spp: int, bakes: Sequence[gi.Bake] = (), seed: int = SEED) -> np.ndarray:
        """Return the term, float32 [height, width, 3]."""
        return self.frame(estimator, spp, bakes, seed).numpy(self.buffer or self.term).copy()

    def traced(self, spp: int, seed: int) -> np.ndarray:
        """Return the path tracer's picture."""
        paths = gi.TracedEnvironment() if self.term == "environment" else gi.BsdfPaths(max_depth=REFERENCE_DEPTH)
        return self.picture(paths, spp, seed=seed)

    @property
    def halves(self) -> list[np.ndarray]:
        """Two pictures of the path tracer that are independent of each other."""
        if not self._halves:
            self._halves = [self.traced(self.reference_spp, SEED + 1 + half) for half in range(2)]
        return self._halves

    @property
    def reference(self) -> np.ndarray:
        """The mean of both halves."""
        return np.asarray(np.mean(self.halves, axis=0))

    def errors(self, picture: np.ndarray, mask: np.ndarray | None = None) -> Row:
        """Return error and bias over the reference's mean, and what noise was subtracted; of masked pixels."""
        return errors(picture, self.halves, mask)


def errors(picture: np.ndarray, halves: Sequence[np.ndarray], mask: np.ndarray | None = None) -> Row:
    """Return errors over the mean of the reference, which is two independent halves.

    The noise of the mean of both is that of half their difference; its square is subtracted from the squared error.
    """
    own, a, b = (one.astype(np.float64)[... if mask is None else mask] for one in (picture, *halves))
    reference = (a + b) / 2
    mean = max(float(reference.mean()), 1e-30)
    noise = float(np.mean(((a - b) / 2) ** 2))
    squared = float(np.mean((own - reference) ** 2)) - noise
    return {
        "rel": max(squared, 0.0) ** 0.5 / mean,
        "bias, %": 100 * (float(own.mean()) / mean - 1),
        "noise of reference": noise**0.5 / mean,
    }
