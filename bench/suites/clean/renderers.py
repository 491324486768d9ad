"""Other renderers as the suite calls them: frames of a scene of Lambert materials, and what these took.

Each raises PeerMissing where it is not installed. Seconds are of rendering a frame and denoising it. What only a first
frame takes is in a run before: Mitsuba compiles, Cycles loads, LuxCore fills its cache. The last two have processes of
their own.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness import scenes
from warp_gi.bench.harness.measure import clocked
from warp_gi.bench.peers import blender_peer, luxcore_peer, mitsuba_peer
from warp_gi.bench.peers.mitsuba_peer import PeerMissing
from warp_gi.bench.suites.clean.contenders import Shots
from warp_gi.bench.suites.clean.references import cleaner

MITSUBA, CYCLES, GUIDED, LUXCORE = "Mitsuba, OIDN", "Cycles, OIDN", "Cycles, guiding, OIDN", "LuxCore, PhotonGI, OIDN"
DEPTH = scenes.REFERENCE_DEPTH
Render = Callable[[gi.Scene, gi.CameraPath, Sequence[int], int, str], Shots]


def mitsuba(scene: gi.Scene, path: gi.CameraPath, frames: Sequence[int], spp: int, device: str) -> Shots:
    """Render by Mitsuba's LLVM variant, and denoise with our guides, whose seconds do not count."""
    shots = Shots(MITSUBA, spp)
    integrator = {"type": "path", "max_depth": DEPTH, "rr_depth": 5}
    for frame in frames:
        camera = path.camera(frame)
        render = mitsuba_peer.renderer(scene, camera, integrator, spp)
        clean = cleaner(scene, camera, frame, device)
        if clean is None:
            raise PeerMissing("Open Image Denoise is not installed; pip install 'warp-gi[denoise]'")
        render(1_000 + frame)  # compiles
        picture, times, _ = clocked(partial(_denoised, render, clean, frame))
        shots.add(frame, picture, times, frames)
    return shots


def _denoised(render: Callable[[int], np.ndarray], clean: Callable[[np.ndarray], np.ndarray], seed: int) -> np.ndarray:
    return clean(render(seed))


def cycles(
    scene: gi.Scene, path: gi.CameraPath, frames: Sequence[int], spp: int, device: str, guiding: bool = False
) -> Shots:
    """Render by Blender Cycles and its denoiser; its first frame is rendered twice, as that loads."""
    if not blender_peer.is_installed():
        raise PeerMissing(blender_peer.HOW_TO_INSTALL)
    shots = Shots(GUIDED if guiding else CYCLES, spp)
    order = [frames[0], *frames]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        blender_peer.write_glb(scene, folder / "scene.glb")
        cameras = [path.camera(frame) for frame in order]
        found = blender_peer.render(folder, cameras, spp, scene.environment, DEPTH - 2, denoise=True, guiding=guiding)
        for index in range(1, len(order)):
            times = found["frames"][index], found["cpu"][index]
            shots.add(order[index], blender_peer.rendered(folder, index), times, frames)
    return shots


def luxcore(scene: gi.Scene, path: gi.CameraPath, frames: Sequence[int], spp: int, device: str) -> Shots:
    """Render by LuxCore with its cache of indirect light and its denoiser; a first frame fills the cache."""
    if not luxcore_peer.is_installed():
        raise PeerMissing(luxcore_peer.HOW_TO_INSTALL)
    shots = Shots(LUXCORE, spp)
    order = [frames[0], *frames]
    with tempfile.TemporaryDirectory() as name:
        found = luxcore_peer.render(scene, [path.camera(frame) for frame in order], spp, DEPTH, Path(name))
        for index in range(1, len(order)):
            shots.add(order[index], found.pictures[index], found.times[index], frames)
    return shots


RENDERERS: dict[str, Render] = {
    MITSUBA: mitsuba,
    CYCLES: cycles,
    GUIDED: partial(cycles, guiding=True),
    LUXCORE: luxcore,
}
"""Other renderers by their names in rows."""
