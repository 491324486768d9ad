"""References of frames of a sequence, in two independent halves; kept in a folder, as they take long.

The folder is ``warp_gi/references`` in XDG_CACHE_HOME, or in ~/.cache; WARP_GI_REFERENCES names another. A file holds
one frame's halves. Its name is a hash of scene, sky, camera, time, samples and version. It can be deleted at any time.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

import warp_gi as gi
from warp_gi import metrics
from warp_gi.bench.compare import reference
from warp_gi.bench.harness.measure import Row
from warp_gi.bench.suites.clean import measures
from warp_gi.errors import OptionError
from warp_gi.files import replacing

FORMAT = "warp_gi reference 1"
"""Changes with what the files hold, and with what the path tracer's pictures converge to."""
SEED = 4_000
GUIDE_SPP = 16
"""Samples a pixel of the guides by which references are cleaned."""
TOO_NOISY = 0.05
"""FLIP between a reference's halves above which pictures are compared with a cleaned one."""
PLAIN, CLEANED = "plain", "cleaned by OIDN"
Halves = tuple[np.ndarray, np.ndarray]


def folder() -> Path:
    """Return where references are kept."""
    if given := os.environ.get("WARP_GI_REFERENCES"):
        return Path(given)
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "warp_gi" / "references"


@dataclass(frozen=True)
class Truth:
    """What a frame should be: the path tracer's mean in two halves, and what pictures are compared with."""

    halves: Halves
    """Float32 [height, width, 3], unbiased."""
    noise: float
    """FLIP between the halves."""
    cleaned: Halves | None
    """The halves, each cleaned by Open Image Denoise; None where that is not installed."""

    @cached_property
    def mean(self) -> float:
        """The mean of all pixels and channels."""
        return float(np.mean(self.halves, dtype=np.float64))

    @cached_property
    def mean_error(self) -> float:
        """The standard error of ``mean`` over it, from one difference of the halves."""
        one, other = (float(half.mean(dtype=np.float64)) for half in self.halves)
        return abs(one - other) / 2 / self.mean

    @cached_property
    def shown(self) -> np.ndarray:
        """The picture that FLIP is against, and that relative errors are over."""
        return np.mean(self.cleaned if self.is_cleaned and self.cleaned else self.halves, axis=0)

    @property
    def is_cleaned(self) -> bool:
        """Whether pictures are compared with the cleaned reference: the halves differ much, and less once cleaned."""
        return self.noise > TOO_NOISY and self.cleaned_noise is not None and self.cleaned_noise < self.noise

    @cached_property
    def cleaned_noise(self) -> float | None:
        """FLIP between the cleaned halves."""
        return None if self.cleaned is None else metrics.flip(*self.cleaned)

    def quality(self, picture: np.ndarray) -> Row:
        """Return FLIP, relMSE and the mean over the reference's."""
        return {
            "FLIP": metrics.flip(picture, self.shown),
            "relMSE": measures.rel_mse(picture, self.halves, self.shown),
            "mean": float(picture.mean(dtype=np.float64)) / self.mean,
        }

    def row(self) -> Row:
        """Return what the reference is worth: FLIP between its halves, and between the cleaned ones."""
        row: Row = {"reference": CLEANED if self.is_cleaned else PLAIN, "mean error": self.mean_error}
        row["FLIP of its halves"] = self.noise
        row["FLIP of cleaned halves"] = "" if self.cleaned_noise is None else self.cleaned_noise
        return row


def truth(
    build: Callable[[], gi.Scene], path: gi.CameraPath, frame: int, spp: int, device: str, moment: int | None = None
) -> Truth:
    """Return the reference of a frame, from the folder or computed and put there.

    ``build`` returns a scene of its own. ``moment`` is the frame whose light and poses are shown, if not this one's.
    """
    moment = frame if moment is None else moment
    scene, camera = still(build(), moment / path.fps), path.camera(frame)
    halves = kept(scene, camera, moment, spp, device)
    return Truth(halves, metrics.flip(*halves), cleaned(scene, camera, moment, halves, device))


def still(scene: gi.Scene, time: float) -> gi.Scene:
    """Return the scene with its sky as it is at a time in seconds, if that is a function of time."""
    if scene.is_sky_animated:
        scene.update_sky(time)
        scene.environment = scene.environment
    return scene


def kept(scene: gi.Scene, camera: gi.Camera, moment: int, spp: int, device: str) -> Halves:
    """Return the halves from their file, or computed and put there; a file that is damaged is made again."""
    name = key(scene, camera, moment, spp)
    file = folder() / f"{name}.safetensors"
    try:
        found = load_file(file)
        return found["first"], found["second"]
    except (OSError, SafetensorError, KeyError):
        seed = SEED + int(name[:6], 16)  # noise of one frame is not that of the next
        made = reference.computed(scene, camera, device, seed, spp, moment).halves
    first, second = (half.astype(np.float32) for half in made)
    with replacing(file) as part:
        save_file({"first": first, "second": second}, part)
    return first, second


def key(scene: gi.Scene, camera: gi.Camera, moment: int, spp: int) -> str:
    """Return a hash of all that a reference depends on."""
    moment = moment if scene.is_animated else 0
    values = (FORMAT, gi.__version__, scene.hash, moment, spp, camera.resolution, f"{camera.hfov:.9g}")
    digest = hashlib.sha256(repr(values).encode())
    digest.update(np.asarray(camera.world_from_camera, np.float64).round(9).tobytes())
    return digest.hexdigest()[:32]


def cleaned(scene: gi.Scene, camera: gi.Camera, moment: int, halves: Halves, device: str) -> Halves | None:
    """Return both halves cleaned; None where Open Image Denoise is not installed."""
    clean = cleaner(scene, camera, moment, device)
    return None if clean is None else (clean(halves[0]), clean(halves[1]))


def cleaner(scene: gi.Scene, camera: gi.Camera, moment: int, device: str) -> Callable[[np.ndarray], np.ndarray] | None:
    """Return Open Image Denoise at its best quality, with guides of this frame; None where it is not installed.

    It gets light without emission, as with bright lamps in it light would be lost. Pixels of lamps stay as they are.
    """
    try:
        library = gi.Oidn().start(scene, device).library
    except OptionError:
        return None
    pipeline = _no_light(GUIDE_SPP)
    guides = gi.FrameScheduler(scene, camera, pipeline, device, SEED).frame(moment, moment)
    albedo, normal = np.clip(guides.numpy("albedo"), 0.0, 1.0), guides.numpy("normal")
    emission = guides.numpy("emission").copy()
    lamps = grown(emission.max(-1) > 0)[..., None]

    def clean(picture: np.ndarray) -> np.ndarray:
        light = library.denoise(np.maximum(picture - emission, 0.0), albedo, normal, hdr=True, quality="high")
        return np.asarray(np.where(lamps, picture, light + emission), np.float32)

    return clean


def _no_light(spp: int) -> gi.Pipeline:
    """Return a pipeline whose frames have guides and emission alone."""
    return gi.Pipeline(environment=None, emitters=None, indirect=None, spp=spp, camera_samples=spp)


def grown(pixels: np.ndarray) -> np.ndarray:
    """Return which pixels [height, width] are chosen, or have one of the eight around them that is."""
    padded = np.pad(pixels, 1)
    height, width = pixels.shape
    return np.any([padded[y : y + height, x : x + width] for y in range(3) for x in range(3)], axis=0)


@dataclass(frozen=True)
class Guides:
    """What pixels' centres show in a frame, and where it was in the frame before."""

    motion: np.ndarray
    wall: np.ndarray

    @classmethod
    def of(cls, scene: gi.Scene, path: gi.CameraPath, frame: int, device: str) -> Guides:
        """Return those of a frame."""
        found = gi.FrameScheduler(scene, path, _no_light(1), device).frame(frame)
        surfaces = (found.numpy(name) for name in ("object_id", "normal", "albedo"))
        return cls(found.numpy("motion"), measures.walls(*surfaces))
