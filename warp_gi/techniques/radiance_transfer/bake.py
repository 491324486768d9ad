"""The bake of radiance transfer (prt_textures.txt): charts, rays, bounces."""

from __future__ import annotations

import hashlib
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from warp_gi.baking import Bake
from warp_gi.errors import SceneError
from warp_gi.launch import get_device
from warp_gi.scene.scene import Scene
from warp_gi.techniques.radiance_transfer.atlas import make_atlas
from warp_gi.techniques.radiance_transfer.rays import trace_slots, transfer_work
from warp_gi.techniques.radiance_transfer.settings import TransferSettings
from warp_gi.techniques.radiance_transfer.textures import LIGHT_NUMBERS, TECHNIQUE, TransferTextures

Progress = Callable[[float], None]
"""Called with the share of the work that is done."""
STAGES = {"charts": 0.3, "rays": 0.4, "bounces": 0.3}
"""Shares of the work of a bake's stages, for progress alone."""


@dataclass
class _Stages:
    """Tells progress over all stages, and counts seconds of CPU and wall."""

    progress: Progress | None
    counts: dict[str, int | float] = field(default_factory=dict)

    def run(self, name: str, work: Callable[[Progress], object]) -> None:
        """Call ``work`` with the progress of one stage, and count its seconds."""
        before = 0.0
        for stage, share in STAGES.items():
            if stage == name:
                break
            before += share

        def told(done: float) -> None:
            if self.progress is not None:
                self.progress(before + STAGES[name] * done)

        wall, cpu = time.perf_counter(), time.process_time()
        work(told)
        self.counts[f"{name}_seconds"] = time.perf_counter() - wall
        self.counts[f"{name}_cpu_seconds"] = time.process_time() - cpu
        told(1.0)


def transfer_key(scene: Scene, bounces: bool = True) -> str:
    """Return the hash of what a bake depends on, which is never the sky.

    With bounces these are all surfaces, materials, textures and lamps: what surfaces reflect is baked. Without, geometry
    and normals, those of normal maps included.
    """
    if bounces:
        return hashlib.sha256(b"warp_gi transfer 1" + scene.contents_hash.encode()).hexdigest()
    digest = hashlib.sha256(b"warp_gi transfer 1 direct" + scene.geometry_hash.encode())
    for node in scene.nodes:
        for mesh in node.meshes:
            texture = mesh.material.normal_texture
            arrays = [mesh.normals]
            if texture is not None:
                arrays += [mesh.uvs, texture.pixels]
                digest.update(repr((mesh.material.normal_scale, texture.wrap)).encode())
            for array in arrays:
                digest.update(b"none" if array is None else repr(array.shape).encode() + np.ascontiguousarray(array))
    return digest.hexdigest()


def bake_transfer(
    scene: Scene, settings: TransferSettings, device: str, seed: int = 0, progress: Progress | None = None
) -> Bake:
    """Return transfer textures of a scene, as ``TransferTextures.arrays`` has them.

    What moves has no slots, and casts no shadow: a warning says so. Counts are slots, rays of all slots, the seconds
    [s] of charts, rays and bounces, wall and CPU, the bounces, and the share of all light that the last of them added.

    Args:
        scene: The scene; its sky has no part in it.
        settings: What decides the bake.
        device: Where kernels run.
        seed: Decides all directions of rays. One seed gives one result, whatever the number of threads.
        progress: Called with the share that is done.

    Raises OptionError where charts fail, SceneError where nothing in the scene rests.
    """
    target = get_device(device)
    with scene.lock:
        _check_motion(scene)
        stages = _Stages(progress)
        found: dict[str, object] = {}

        def charts(told: Progress) -> None:
            found["atlas"] = make_atlas(scene, settings, device, told)

        stages.run("charts", charts)
        atlas = found["atlas"]
        work = transfer_work(scene, atlas, settings, target, seed)

        def rays(told: Progress) -> None:
            found["traced"] = trace_slots(work, told)

        stages.run("rays", rays)
        traced = found["traced"]
        bounces = np.zeros((0, 3, LIGHT_NUMBERS), np.float16)
        lamps = np.zeros((0, 3), np.float32)
        textures = TransferTextures(atlas, traced.transfer, bounces, lamps)
        counts = {"slots": atlas.count, "rays": int(traced.rays.sum(dtype=np.int64)), **stages.counts}
        key = transfer_key(scene, settings.bounces > 0)
        return Bake(TECHNIQUE, key, settings.stored(), textures.arrays(), counts, scene.name)


def _check_motion(scene: Scene) -> None:
    """Warn of what moves; raise SceneError where all does."""
    moving = [scene.nodes[index].name for index in scene.moving_objects.values()]
    if len(moving) == len(scene.object_names):
        raise SceneError("everything in this scene moves; nothing can be baked")
    if moving:
        warnings.warn(
            f"baked transfer knows nothing of what moves: {', '.join(map(repr, moving[:5]))}"
            f"{' and others' if len(moving) > 5 else ''} will cast no shadow and reflect no light on what rests",
            stacklevel=3,
        )
