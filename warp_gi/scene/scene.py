"""The scene: nodes with meshes, lights, an environment, cameras, and the buffers kernels read."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from warp_gi.errors import SceneError, check_near, unknown_name
from warp_gi.forks import Guard
from warp_gi.kernels import types
from warp_gi.launch import get_device
from warp_gi.scene import animation, copying, emitters, following, geometry, hashing, hulls, poses, textures
from warp_gi.scene.device_scene import DeviceScene, Trail
from warp_gi.scene.edits import Edits
from warp_gi.scene.model import Keyframe, Material, Mesh, Node, PunctualLight
from warp_gi.scene.sky_motion import appearance, first_sky, sky_at_time

if TYPE_CHECKING:
    from warp_gi.bvh import TriangleBvh
    from warp_gi.scene.environment import Environment, Sky
    from warp_gi.scene.pinhole import Camera


class Scene:
    """A scene: everything that is rendered. Lengths in metres, y up, colours linear Rec. 709.

    Args:
        nodes: Placements of meshes; parents before children. The scene keeps copies of the nodes, not of the meshes.
        lights: Lights without size.
        environment: The sky: a path to a map, an RGB radiance, an Environment, a SunSky, or None for black; or a
            function that returns one of these at a time in seconds, as a ``gi.TurningSky`` does.
        cameras: Cameras by name, in world space, at time 0.
        name: Shown in reports.
        camera_nodes: Which node carries a camera, by the camera's name, for cameras that move with a node.

    Raises SceneError if anything in it cannot be rendered: one line that names the mesh, material or light.

    What pictures are made from is copied: geometry when the scene is made, and by ``animate``; all else when first
    used on a device. The next frame follows edits after that: placements of nodes, materials, textures, lights and the
    sky by assignment, points by ``set_points``. Others are a SceneError there, see ``check_unchanged``.
    """

    def __init__(
        self,
        nodes: Sequence[Node],
        lights: Sequence[PunctualLight] = (),
        environment: Sky | Callable[[float], Sky] = None,
        cameras: Mapping[str, Camera] | None = None,
        name: str = "scene",
        camera_nodes: Mapping[str, int] | None = None,
    ) -> None:
        self._guard = Guard()
        self.name = name
        self.offset = np.zeros(3)
        """What was taken from all positions of a file, float64 [3] in metres; see ``load_scene``'s ``recentre``."""
        self.version = self.moved = 0
        """Number of changes of environment and animation so far. After another one, what was derived from the
        scene is stale."""
        self.nodes: list[Node] = [replace(node) for node in nodes]
        self.lights: list[PunctualLight] = list(lights)
        self.cameras: dict[str, Camera] = dict(cameras or {})
        self.camera_nodes: dict[str, int] = dict(camera_nodes or {})
        geometry.check_nodes(self.nodes)
        self.materials: list[Material] = geometry.distinct_materials(self.nodes)
        for light in self.lights:
            emitters.check_light(light, self.nodes)
        self._flatten()
        self._environment: Environment | None = None
        self._sky_at: Callable[[float], Sky] | None = None
        self._sky_time: float | None = 0.0
        """Time in seconds of the present sky, if it is a function of time; None while it changes."""
        self._sky_shown: tuple[object, ...] | None = None
        self.environment = environment

    def __reduce__(self) -> tuple[object, ...]:
        return copying.made, copying.contents(self)

    def __repr__(self) -> str:
        return copying.description(self)

    def _flatten(self) -> None:
        """Build what follows from the nodes; call again when keyframes change."""
        self.version += 1
        self._moving = poses.moving_nodes(self.nodes)
        self._poses = poses.poses(self.nodes, 0.0)
        self._flat = geometry.flatten(self.nodes, self.materials, self._poses)
        self._hulls = hulls.hulls_of(self.nodes, self._moving)
        if not np.isfinite(self._flat.points).all():
            raise SceneError(f"scene {self.name!r}: node transforms move vertices past the range of float32")
        check_near(self._flat.points)
        following.set_areas(self)
        self._emissive, self._light_grids = following.lights_of(self)
        self._bounds = following.bounds_of(self)
        self._devices: dict[str, DeviceScene] = {}
        self._digests = hashing.Digests(self)
        self._edits = Edits(self)

    # ---- what is in it ----

    @property
    def lock(self) -> threading.RLock:
        """A re-entrant lock. Its holder alone may move or edit the scene, as each frame and bake does.

        Take it around ``update`` and what is read after it, where other threads render.
        """
        return self._guard.lock

    @property
    def environment(self) -> Environment | None:
        """The present sky. Set it to a path, an RGB radiance, an Environment, a SunSky or None; geometry stays built.

        Set to a function of the time in seconds that returns one of these, as a ``gi.TurningSky`` does, it is another
        from frame to frame: that of time 0, or of its attribute ``start`` [s], at first, then that of the last
        ``update_sky``. For one time the function has to return one sky always. Raises SceneError for what is no sky.
        """
        return self._environment

    @environment.setter
    def environment(self, value: Sky | Callable[[float], Sky]) -> None:
        sky_at, start, sky = first_sky(value)
        with self.lock:
            self._sky_at, self._sky_time = sky_at, start
            self._show(sky)

    @property
    def is_sky_animated(self) -> bool:
        """Whether the environment is a function of time."""
        return self._sky_at is not None

    @property
    def sky_at(self) -> Callable[[float], Sky] | None:
        """The function of time in seconds that the environment is, or None."""
        return self._sky_at

    def update_sky(self, time: float) -> bool:
        """Move the sky to ``time`` [s], if it is a function of time; return whether it is another one now.

        Each frame does so before anything is baked or traced. Raises SceneError for what is no sky.
        """
        with self.lock:
            if self._sky_at is None or time == self._sky_time:
                return False
            self._sky_time, sky = None, sky_at_time(self._sky_at, time)
            is_other = appearance(sky) != self._sky_shown
            if is_other:
                self._show(sky)
            self._sky_time = time
            return is_other

    def _show(self, sky: Environment | None) -> None:
        """Make a sky the present one, for everything derived from the scene and on every device."""
        self._sky_shown = ("in the making",)  # an interrupt may leave it half done
        self._environment = sky
        self.version += 1
        for device_scene in self._devices.values():
            device_scene.set_environment(sky)
        if self._devices:
            self._edits.sky_in_use()
        self._sky_shown = appearance(sky) if self._sky_at is not None else None

    @property
    def triangle_count(self) -> int:
        """Number of triangles of all nodes together."""
        return len(self._flat.indices)

    @property
    def emitter_count(self) -> int:
        """Number of emissive triangles and punctual lights together."""
        return len(self._emissive) + len(self.lights)

    @property
    def bounds(self) -> np.ndarray:
        """Lowest and highest corner in metres, float32 [2, 3]; of an animated scene over all of its time."""
        return self._bounds.copy()

    @property
    def radius(self) -> float:
        """Half the diagonal of the bounds in metres."""
        return float(np.linalg.norm(self._bounds[1].astype(np.float64) - self._bounds[0])) / 2.0

    @property
    def surface_area(self) -> float:
        """Area of all triangles at time 0, one side of each, in square metres."""
        return geometry.surface_area(self._flat.points, self._flat.indices)

    @property
    def object_names(self) -> list[str]:
        """Names of the nodes with meshes, by object id."""
        return [node.name for node in self.nodes if node.meshes]

    @property
    def is_animated(self) -> bool:
        """Whether any node has keyframes, or meshes that change their shape."""
        return any(self._moving)

    @property
    def duration(self) -> float:
        """Time of the last keyframe in seconds; 0 if nothing moves."""
        return max(animation.key_times(self.nodes), default=0.0)

    @property
    def memory_bytes(self) -> int:
        """Bytes of geometry, materials and textures on one device, without the tree of ray queries and the sky."""
        flat = self._flat
        arrays = [flat.points, flat.normals, flat.uvs, flat.indices, flat.materials, flat.objects]
        arrays += [part for part in (flat.colors, flat.further_uvs) if part is not None]
        texels = {id(t.pixels): t.pixels.nbytes for t in textures.distinct_textures(self.materials)}
        per_triangle = 4 * self.triangle_count  # Geometry.emitters
        previous = flat.points.nbytes if self.is_animated else 0
        return sum(a.nbytes for a in arrays) + sum(texels.values()) + per_triangle + previous

    def emitter_powers(self) -> np.ndarray:
        """Return the power of each emitter [W, as luminance], float64 [emitter_count].

        Above zero for every emissive triangle; textures count by their mean under the triangle.
        """
        lights = [emitters.light_power(light, self.radius) for light in self.lights]
        return np.concatenate([self._light_grids.get().powers, lights])

    @property
    def geometry_hash(self) -> str:
        """SHA-256 of all that decides visibility: triangles, alpha masks, animation."""
        return self._digests.geometry()

    @property
    def hash(self) -> str:
        """SHA-256 of all that decides the pictures, except the cameras; equal in every process."""
        return hashing.with_sky(self.contents_hash, self._environment)

    @property
    def contents_hash(self) -> str:
        """SHA-256 of all that decides the pictures, except cameras and sky; computed once for each edit."""
        return self._digests.contents()

    @property
    def light_hash(self) -> str:
        """``contents_hash`` as it was before edits moved nodes and points, as keyframes do without another hash."""
        return self._digests.light()

    # ---- what moves ----

    def node(self, name: str) -> Node:
        """Return the node of a name, whose fields may be edited between frames.

        Raises SceneError if several nodes have the name, OptionError if none has.
        """
        matches = [candidate for candidate in self.nodes if candidate.name == name]
        if not matches:
            raise unknown_name("node", name, {candidate.name for candidate in self.nodes})
        if len(matches) > 1:
            raise SceneError(f"{len(matches)} nodes are named {name!r}; give the one that is meant a name of its own")
        return matches[0]

    def animate(self, node: str, keyframes: Sequence[Keyframe]) -> None:
        """Replace the pose of a node (in its parent's space) by keyframes; bakes and device buffers start afresh.

        Raises SceneError for bad keyframes or if several nodes have the name, OptionError if none has.
        """
        target = self.node(node)
        animation.check_keyframes(keyframes, node)
        geometry.check_nodes(self.nodes)  # they are read anew, with every edit so far
        with self.lock:
            animation.set_keyframes(target, keyframes, self.offset)
            self._flatten()

    def set_points(self, mesh: Mesh | Node, points: ArrayLike, normals: ArrayLike | None = None) -> None:
        """Move the vertices of a mesh, wherever it stands in the scene, or of a node that has one mesh alone.

        ``points`` [m] and ``normals`` are float32 [vertex, 3] in the space of the mesh, as many as there are. Without
        ``normals`` a mesh keeps those that it has. Raises SceneError for another number of them, and for values that
        are not finite; then nothing has changed.
        """
        with self.lock:
            following.set_points(self, mesh, points, normals)

    def moves(self, index: int) -> bool:
        """Return whether node ``index``, or one above it, has keyframes, or its meshes change their shape."""
        return self._moving[index]

    @property
    def moving_objects(self) -> dict[int, int]:
        """Indices of the nodes of objects that can move, by object id."""
        objects = [index for index, node in enumerate(self.nodes) if node.meshes]
        return {number: index for number, index in enumerate(objects) if self._moving[index]}

    def node_box(self, index: int, time: float) -> np.ndarray:
        """Return a box around the meshes of node ``index`` at ``time`` [s]: low and high corner, float64 [2, 3]."""
        pose = poses.poses(self.nodes, time)[index]
        if index in self._hulls:
            return hulls.pose_box(pose, self._hulls[index])
        points = animation.box_corners(self.nodes[index]) @ pose.matrix[:3, :3].T + pose.matrix[:3, 3]
        return np.stack([points.min(axis=0), points.max(axis=0)])

    def shape_key(self, indices: Iterable[int], time: float) -> np.ndarray:
        """Return what decides where the vertices of nodes are at ``time`` [s], and their placements, float64 [n]."""
        placed = poses.poses(self.nodes, time)
        return np.concatenate([np.zeros(0), *(placed[index].key for index in indices)])

    def world_from_node(self, index: int, time: float) -> np.ndarray:
        """Return the placement of node ``index`` at ``time`` [s], float64 [4, 4]."""
        return animation.world_matrices(self.nodes, time)[index]

    def update(
        self,
        time: float,
        previous_time: float | None = None,
        device: str | wp.Device | None = None,
        trail: Trail | None = None,
    ) -> bool:
        """Move what is in ``data(device)`` to ``time`` [s]; return whether anything differs from the last call.

        ``previous_points`` get the pose of ``previous_time``, from which motion vectors follow; None is ``time``, no
        motion. They get that of the frame before instead where ``trail`` holds it (``trail_of``). Nothing is done for
        a scene in which nothing ever moved, and the tree is refit only if a vertex moved. The sky is moved by
        ``update_sky``.
        """
        with self.lock:
            self.data(device)
            there = self._devices[_device(device).alias]
            if not self.is_animated and not there.is_parted:
                return False
            return there.move(time, time if previous_time is None else previous_time, trail)

    def trail_of(self, index: int, device: str | wp.Device | None = None) -> Trail:
        """Return where frame ``index`` sees the scene, as ``data(device)`` is now, for ``update`` of the next one."""
        with self.lock:
            self.data(device)
            return self._devices[_device(device).alias].trail(index)

    # ---- what kernels read ----

    def data(self, device: str | wp.Device | None = None) -> types.SceneData:
        """Return the scene on a device, built at the first call and kept; at time 0 until ``update``.

        The alias tables of the emitters are empty: each light sampler fills its own.
        """
        device = _device(device)
        with self.lock:
            if device.alias not in self._devices:
                self._edits.check()
                self._devices[device.alias] = DeviceScene(self, device)
                if len(self._devices) == 1:
                    self._edits.in_use()
            return self._devices[device.alias].data

    def placed_emitters(self, device: str | wp.Device | None = None) -> emitters.PlacedEmitters:
        """Return where the emitters of ``data(device)`` are, from the copy on the host: nothing is downloaded."""
        with self.lock:
            self.data(device)
            return self._devices[_device(device).alias].placed_emitters()

    def check_unchanged(self) -> None:
        """Take edits over, or raise SceneError for one that cannot be followed: a line that says what, and the cure.

        Called for every frame. It reads all arrays of meshes and textures, and the pixels of the sky.
        """
        with self.lock:
            self._edits.check()

    def light_table(self, device: str | wp.Device | None = None) -> wp.array:
        """Return an alias table that picks emitters by power, AliasBucket [emitter_count]; built once a device."""
        with self.lock:
            self.data(device)
            return self._devices[_device(device).alias].light_table()

    def bvh(self, device: str | wp.Device | None = None) -> TriangleBvh:
        """Return the TriangleBvh behind ``data(device)``."""
        self.data(device)
        return self._devices[_device(device).alias].bvh

    def static_bvh(self, device: str | wp.Device | None = None) -> TriangleBvh:
        """Return the TriangleBvh of the nodes that never move; it is ``bvh`` itself if nothing moves."""
        with self.lock:
            self.data(device)
            return self._devices[_device(device).alias].static_bvh()


def _device(device: str | wp.Device | None) -> wp.Device:
    return device if isinstance(device, wp.Device) else get_device(device)
