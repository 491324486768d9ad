"""Bounces of the bake: light of any sky, of the scene's lamps and of one given sky, gathered from stored hits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.errors import OptionError
from warp_gi.kernels import transfer_bake as ray_kernels
from warp_gi.kernels import transfer_bounces as kernels
from warp_gi.kernels import transfer_native as native
from warp_gi.kernels import types
from warp_gi.launch import on_device
from warp_gi.scene.scene import Scene
from warp_gi.techniques.radiance_transfer.rays import Progress, TracedTransfer, TransferWork, filled
from warp_gi.techniques.radiance_transfer.settings import TransferSettings
from warp_gi.techniques.radiance_transfer.textures import LIGHT_NUMBERS

LAMP_SAMPLES = 64
"""Samples of lamps at a slot. Where all are punctual and no more than these, each is taken once instead."""


@dataclass(frozen=True, eq=False)
class Bounces:
    """Light of any sky that reached slots after it was reflected."""

    transfer: np.ndarray
    """Sums over bounces of the transfer of reflected light by channel, float16 [slots, 3, 25]."""
    count: int
    """Number of bounces."""
    share: float
    """What the last of them added, as a share of all light under a white sky, direct light included."""


def slot_reflectance(work: TransferWork) -> np.ndarray:
    """Return what the surface at each slot reflects of light from everywhere, float32 [slots, 3]."""
    result = filled((work.count,), wp.vec3, work.device)
    launch.launch(kernels.reflect_slots, work.count, [work.data, work.atlas, work.slots, result], work.device)
    return result.numpy()


def gather_bounces(
    work: TransferWork,
    traced: TracedTransfer,
    reflectance: np.ndarray,
    settings: TransferSettings,
    progress: Progress | None = None,
) -> Bounces:
    """Return the light of any sky that bounces: T_b = mean of reflectance times T_(b-1) over hits, summed over b.

    It stops at the bounce that adds less than ``tolerance`` of all light of a white sky, or after ``bounces``.
    No ray is traced: ``reflectance`` [slots, 3] may be another than when the hits were found.
    """
    count, device = work.count, work.device
    state = kernels.BounceRows()
    state.hits = on_device(traced.hits, wp.int32, device)
    state.transfer = on_device(traced.transfer, wp.float16, device)
    state.reflectance = on_device(reflectance, wp.vec3, device)
    state.rows, state.next = (filled((count, native.ROW_NUMBERS), wp.float16, device) for _ in range(2))
    state.bounces = filled((count, 3 * LIGHT_NUMBERS), wp.float16, device)
    state.light = filled((count,), wp.vec2, device)
    direct = 3.0 * float(traced.transfer[:, 0].sum(dtype=np.float64))
    done, share = 0, 0.0
    for number in range(settings.bounces + 1 if direct > 0.0 else 0):
        # The first call gathers nothing: it only makes of transfer what the slots reflect of it.
        rays = 0 if number == 0 else traced.hits.shape[1]
        launch.launch(kernels.gather_bounces, count, [rays, state], device)
        state.rows, state.next = state.next, state.rows
        added, bounced = state.light.numpy().sum(axis=0, dtype=np.float64)
        if number:
            done, share = number, float(added / (direct + bounced))
            if progress is not None:
                progress(min(done / settings.bounces, 1.0))
            if share < settings.tolerance:
                break
    return Bounces(state.bounces.numpy().reshape(count, 3, LIGHT_NUMBERS), done, share)


def lamp_irradiance(work: TransferWork, scene: Scene, seed: int, progress: Progress | None = None) -> np.ndarray:
    """Return the irradiance [W/m^2] by light that comes straight from the scene's emitters, float32 [slots, 3].

    Emitters are chosen by power, and a point on them by area; beside each such sample is a ray of cosine density, as
    points on a lamp close by vary without bound.
    """
    data, lamps = launch.copied(scene.data(work.device), types.SceneData), ray_kernels.LampSamples()
    data.emitters.alias = scene.light_table(work.device)
    lamps.bvh, lamps.faces = work.data.bvh, work.rays.faces
    lamps.each = int(scene.emitter_count == len(scene.lights) <= LAMP_SAMPLES)
    lamps.count = scene.emitter_count if lamps.each else LAMP_SAMPLES
    lamps.seed = seed & 0xFFFFFFFF
    result = filled((work.count,), wp.vec3, work.device)

    def run(start: int, slots: int) -> None:
        inputs = [start, data, work.slots, lamps, result]
        launch.launch(ray_kernels.light_slots, slots, inputs, work.device, smallest_slice=16)

    work.each_batch(run, progress)
    return result.numpy()


def gather_light(
    work: TransferWork,
    traced: TracedTransfer,
    reflectance: np.ndarray,
    direct: np.ndarray,
    bounces: int,
    tolerance: float,
) -> list[np.ndarray]:
    """Return the irradiance after each bounce of light that first arrives as ``direct`` [slots, 3], float32 each.

    Ends with the bounce that adds less than ``tolerance`` of all light, or after ``bounces`` (prt_textures.txt, 4.2).
    """
    hits = on_device(traced.hits, wp.int32, work.device)
    found: list[np.ndarray] = []
    total, last = float(np.abs(direct).sum(dtype=np.float64)), direct
    while len(found) < bounces and total > 0.0:
        result = filled((work.count,), wp.vec3, work.device)
        source = on_device((reflectance * last).astype(np.float32), wp.vec3, work.device)
        launch.launch(kernels.gather_light, work.count, [hits, source, result], work.device)
        last = result.numpy()
        found.append(last)
        added = float(np.abs(last).sum(dtype=np.float64))
        total += added
        if added < tolerance * total:
            break
    return found


@dataclass(frozen=True, eq=False)
class FixedLight:
    """Light of one sky, fixed in the bake (prt_textures.txt, 4.2)."""

    irradiance: list[np.ndarray]
    """Irradiance by direct light, and by each bounce, float32 [slots, 3] each."""
    glossy: np.ndarray
    """I_k = int L cos y_k dw over the surfaces around each slot, L their radiance, float32 [slots, 3, 25]."""


def fixed_light_bounces(
    work: TransferWork, traced: TracedTransfer, reflectance: np.ndarray, light: np.ndarray, settings: TransferSettings
) -> FixedLight:
    """Return light of one sky of 25 coefficients a channel, ``light`` [3, 25]: the form that the paper bakes.

    Raises OptionError for a light of another shape.
    """
    if np.shape(light) != (3, LIGHT_NUMBERS):
        raise OptionError(f"expected a light of 3 x {LIGHT_NUMBERS} coefficients, got {list(np.shape(light))}")
    direct = traced.transfer[:, :LIGHT_NUMBERS].astype(np.float32) @ np.asarray(light, np.float32).T
    found = [direct, *gather_light(work, traced, reflectance, direct, settings.bounces, settings.tolerance)]
    radiance = (reflectance * np.sum(found, axis=0) / np.pi).astype(np.float32)
    glossy = filled((work.count, 3, LIGHT_NUMBERS), wp.float32, work.device)
    inputs = [
        work.data,
        work.slots,
        work.rays,
        on_device(traced.hits, wp.int32, work.device),
        on_device(radiance, wp.vec3, work.device),
        glossy,
    ]
    launch.launch(kernels.gather_glossy, work.count, inputs, work.device)
    return FixedLight(found, glossy.numpy())
