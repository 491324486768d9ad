"""The bake of radiance transfer (prt_textures.txt): charts, rays, bounces."""

from __future__ import annotations

import hashlib
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from warp_gi.baking import Bake
from warp_gi.errors import BakeError, SceneError
from warp_gi.kernels.transfer_bake import BLACK
from warp_gi.launch import get_device
from warp_gi.scene.scene import Scene
from warp_gi.techniques.radiance_transfer.bounces import (
    gather_bounces,
    gather_light,
    lamp_irradiance,
    slot_reflectance,
)
from warp_gi.techniques.radiance_transfer.buried import without_buried
from warp_gi.techniques.radiance_transfer.rays import (
    Progress,
    TracedTransfer,
    TransferWork,
    trace_slots,
    transfer_work,
)
from warp_gi.techniques.radiance_transfer.settings import TransferSettings
from warp_gi.techniques.radiance_transfer.textures import LIGHT_NUMBERS, TECHNIQUE, TransferTextures, transfer_textures
from warp_gi.techniques.radiance_transfer.vertices import vertex_atlas
from warp_gi.techniques.shared.atlas.atlas import Atlas
from warp_gi.techniques.shared.atlas.build import NO_SURFACE, make_atlas
from warp_gi.techniques.shared.lamps import lamps_move

OTHERWISE = 'keep transfer at vertices (storage="vertices")'
"""What can be done where no charts can be made."""
STAGES = {"charts": 0.4, "rays": 0.4, "bounces": 0.2}
"""Shares of the work of a bake's stages, for progress alone."""


class _Stages:
    """Tells progress over all stages, and counts their seconds."""

    def __init__(self, progress: Progress | None) -> None:
        self.progress = progress
        self.counts: dict[str, int | float] = {}
        self.before = 0.0

    @contextmanager
    def run(self, name: str) -> Iterator[Callable[[float], None]]:
        """Give the progress of one stage, and count the seconds that it takes."""
        before, share = self.before, STAGES[name]

        def told(done: float) -> None:
            if self.progress is not None:
                self.progress(min(before + share * done, 1.0))

        wall, cpu = time.perf_counter(), time.process_time()
        yield told
        self.counts[f"{name}_seconds"] = time.perf_counter() - wall
        self.counts[f"{name}_cpu_seconds"] = time.process_time() - cpu
        self.before += share
        told(1.0)


def transfer_key(scene: Scene, bounces: bool = True) -> str:
    """Return the hash of what a bake depends on, which is never the sky.

    With bounces these are all surfaces, materials, textures and lamps, as what surfaces reflect is baked. Without, they
    are the geometry and the normals, those of normal maps included: albedo and roughness are free.
    """
    if bounces:
        return hashlib.sha256(b"warp_gi transfer 1" + scene.contents_hash.encode()).hexdigest()
    digest, flat = hashlib.sha256(b"warp_gi transfer 1 direct" + scene.geometry_hash.encode()), scene._flat
    digest.update(flat.normals.tobytes())
    for index, material in enumerate(scene.materials):
        texture = material.normal_texture
        if texture is not None:
            triangles = flat.materials == index
            digest.update(repr((texture.wrap, texture.pixels.shape, material.normal_scale)).encode())
            for array in (texture.pixels, triangles, flat.uvs[flat.indices[triangles]]):
                digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def bake_transfer(
    scene: Scene,
    settings: TransferSettings,
    device: str,
    seed: int = 0,
    progress: Progress | None = None,
    keep_hits: bool = False,
) -> Bake:
    """Return transfer textures of a scene, as ``TransferTextures.arrays`` has them.

    What moves has no slots and casts no shadow: a warning says so. Light of lamps is left out where any of them moves.
    Counts are slots; rays of all slots; bounces, and the share of all light under a white sky that the last of them
    added; hits of surfaces without a slot, as a share of all; and the seconds of charts, rays and bounces, by the clock
    and of this process's CPU.

    Args:
        scene: The scene; its sky has no part in it.
        settings: What decides the bake.
        device: Where kernels run.
        seed: Decides all directions of rays. One seed gives one result, whatever the number of threads.
        progress: Called with the share that is done.
        keep_hits: Whether to keep the hits for ``regather``, in 4 bytes a ray of bounces.

    Raises OptionError where charts fail, SceneError where no surface in the scene rests and has an area.
    """
    target = get_device(device)
    stages = _Stages(progress)
    with scene.lock:
        scene.check_unchanged()
        _check_motion(scene)
        with stages.run("charts") as told:
            vertices = settings.storage == "vertices"
            atlas = vertex_atlas(scene) if vertices else make_atlas(scene, settings, device, told, OTHERWISE)
        if atlas.count == 0:
            raise SceneError(NO_SURFACE)
        with stages.run("rays") as told:
            work = transfer_work(scene, atlas, settings, target, seed)
            lamps = _lamps(work, scene, seed)
            traced = without_buried(work, atlas, trace_slots(work, told))
        stages.counts |= {"slots": atlas.count, "rays": int(traced.rays.sum(dtype=np.int64))}
        bake = _bounced(scene, work, atlas, traced, lamps, settings, stages)
    if keep_hits:
        bake.arrays |= {"hits": traced.hits, "hits_key": _hits_key(scene)}
    return bake


def regather(scene: Scene, settings: TransferSettings, bake: Bake, device: str, seed: int = 0) -> Bake:
    """Return a bake of a scene whose materials or lamps are others than in ``bake``, from the hits kept there.

    Only shadow rays of lamps are traced. Raises BakeError for a bake without hits, with other settings, or of other
    geometry or normals.
    """
    target = get_device(device)
    textures, stages = transfer_textures(bake), _Stages(None)
    if "hits" not in bake.arrays:
        raise BakeError("this bake has no hits to gather from again: bake it again, with keep_hits")
    with scene.lock:
        scene.check_unchanged()
        if not np.array_equal(_hits_key(scene), bake.arrays["hits_key"]):
            raise BakeError("this bake is of other geometry or normals, so its hits do not hold: bake it again")
        bake.check(TECHNIQUE, bake.scene_key, settings.stored())
        traced = TracedTransfer(textures.transfer, bake.arrays["hits"], np.zeros(0, np.int32))
        work = transfer_work(scene, textures.atlas, settings, target, seed)
        stages.counts |= {name: bake.counts[name] for name in ("slots", "rays")}
        lamps = _lamps(work, scene, seed)
        result = _bounced(scene, work, textures.atlas, traced, lamps, settings, stages)
    result.arrays |= {name: bake.arrays[name] for name in ("hits", "hits_key")}
    return result


def _bounced(
    scene: Scene,
    work: TransferWork,
    atlas: Atlas,
    traced: TracedTransfer,
    direct: np.ndarray | None,
    settings: TransferSettings,
    stages: _Stages,
) -> Bake:
    """Return a bake with all bounces of what was traced."""
    textures = TransferTextures(
        atlas, traced.transfer, np.zeros((0, 3, LIGHT_NUMBERS), np.float16), np.zeros((0, 3), np.float32)
    )
    if settings.bounces > 0:
        with stages.run("bounces") as told:
            reflectance = slot_reflectance(work)
            bounced = gather_bounces(work, traced, reflectance, settings, told)
            textures = replace(textures, bounces=bounced.transfer)
            stages.counts |= {"bounces": bounced.count, "last_share": bounced.share}
            if direct is not None:
                lamps = gather_light(work, traced, reflectance, direct, settings.bounces, settings.tolerance)
                textures = replace(textures, lamps=np.sum(lamps, axis=0, dtype=np.float32) + np.zeros_like(direct))
                stages.counts["lamp_bounces"] = len(lamps)
        stages.counts["black_share"] = float(np.count_nonzero(traced.hits == BLACK) / max(traced.hits.size, 1))
    key = transfer_key(scene, settings.bounces > 0)
    return Bake(TECHNIQUE, key, settings.stored(), textures.arrays(), stages.counts, scene.name)


def _lamps(work: TransferWork, scene: Scene, seed: int) -> np.ndarray | None:
    """Return the irradiance that comes straight from lamps, float32 [slots, 3]; None without, or where one moves."""
    if scene.emitter_count == 0 or lamps_move(scene):
        return None
    return lamp_irradiance(work, scene, seed)


def _hits_key(scene: Scene) -> np.ndarray:
    """Return the hash of what decides hits, uint8 [32]."""
    return np.frombuffer(bytes.fromhex(transfer_key(scene, bounces=False)), np.uint8).copy()


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
