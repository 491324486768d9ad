"""Direct light from emitters that a hierarchy over them selects: the default, and the baseline of the light cache."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.estimator import Ahead, Estimator
from warp_gi.kernels import light_hierarchy, path_samplers
from warp_gi.scene.baked import BakedScene, whole_scene
from warp_gi.techniques.light_hierarchy import tree as light_tree
from warp_gi.techniques.light_hierarchy.bounds import EmitterBounds, emitter_bounds

if TYPE_CHECKING:
    from warp_gi.baking import Bake
    from warp_gi.frame import Frame
    from warp_gi.scene.scene import Scene


FEW_LAMPS = 2
"""Fewer lamps than this are picked by power; a punctual light is a lamp, and so are two emissive triangles."""
MOST_EMITTERS = 1 << light_hierarchy.MOST_LEVELS
"""More emitters than this are picked by power, too: halving them makes a tree that is too deep."""


@dataclass(frozen=True)
class LightHierarchy(Estimator):
    """Direct light from emitters, selected at every point by distance, power and orientation. Unbiased.

    A tree over emitters with boxes and orientation cones, eight wide, is descended at random by importance (Conty
    Estevez and Kulla 2018, "Importance Sampling of Many Lights with Adaptive Tree Splitting", without splitting). It
    is refit where lights move. A scene's only lamp, which is one punctual light or up to three emissive triangles, is
    sampled as by ``PowerLights``: there is nothing to choose, and that takes less time. So are more than two million.
    """

    is_per_pixel = True
    term: ClassVar[str] = "emitters"

    def samplers(self, scene: Scene | BakedScene | None = None) -> tuple[Any, ...]:
        """Return the hierarchy; the table by power for a scene of one lamp."""
        by_tree = scene is None or has_choice(scene)
        return (light_hierarchy.HIERARCHY_LIGHTS if by_tree else path_samplers.ALIAS_LIGHTS,)

    def bake_key(self, scene: Scene | BakedScene) -> str:
        """Return a hash of all but the sky."""
        return scene.contents_hash

    def start(
        self, scene: Scene | BakedScene, device: str, bake: Bake | None = None, seed: int = 0
    ) -> TreeState | None:
        """Return the tree over the lights at time 0; None where they are picked by power."""
        if not has_choice(scene):
            return None
        return first_tree(scene, launch.get_device(device))

    def depends_on_past(self, scene: Scene | BakedScene, ahead: Ahead | None = None) -> bool:
        """Return False: the tree's shape is that at time 0, and its bounds are those of the frame's lights."""
        return False

    def preprocess(self, frame: Frame, state: TreeState | None) -> TreeState | None:
        """Bring the tree up to the frame's lights and give it to the paths; without one they get the table by power."""
        if state is None:
            frame.paths.use_lights(path_samplers.ALIAS_LIGHTS, path_samplers.AliasLights())
            return None
        state = moved_tree(frame, state)
        frame.paths.use_lights(light_hierarchy.HIERARCHY_LIGHTS, state.data)
        return state

    def trace(self, frame: Frame, state: TreeState | None) -> None:
        """Ask the path tracer for this term."""
        frame.paths.want(self.term)


@dataclass(frozen=True)
class TreeState:
    """The tree of lights, and the bounds of the lights that it was made for."""

    tree: light_tree.TreeArrays
    """Tree on the host."""
    bounds: EmitterBounds
    """Bounds of the emitters that the tree's boxes and cones are around."""
    data: light_hierarchy.LightTree
    """Tree as kernels read it."""


def has_choice(scene: Scene | BakedScene) -> bool:
    """Whether a scene has more than one lamp, so that different ones light points, and no more than a tree holds."""
    if not 0 < scene.emitter_count <= MOST_EMITTERS:
        return False
    punctual = len(whole_scene(scene).lights)
    return punctual + (scene.emitter_count - punctual) / 2 >= FEW_LAMPS


def first_tree(scene: Scene | BakedScene, device: wp.Device) -> TreeState | None:
    """Return the tree over a scene's lights in their pose now, which is that at time 0; None without lights.

    Later frames keep its topology, so that they do not depend on which frame was rendered first.
    """
    if scene.emitter_count == 0:
        return None
    bounds = emitter_bounds(whole_scene(scene), device)
    tree = light_tree.build_tree(bounds)
    return TreeState(tree, bounds, light_tree.to_device(tree, device))


def moved_tree(frame: Frame, state: TreeState) -> TreeState:
    """Return the tree with its boxes and cones around the lights of a frame."""
    if frame.scene.is_animated:
        bounds = emitter_bounds(whole_scene(frame.scene), frame.device)
        if not _same(bounds, state.bounds):
            tree = light_tree.refit_tree(state.tree, bounds)
            return TreeState(tree, bounds, light_tree.to_device(tree, frame.device))
    return state


def _same(a: EmitterBounds, b: EmitterBounds) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("low", "high", "axis"))
