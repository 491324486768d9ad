"""LuxCore as a peer: Lambert scenes by its path tracer, its photon cache of indirect light, and its denoiser.

It runs in a process of its own, by this Python or by the one that WARP_GI_LUXCORE_PYTHON names.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import warp_gi as gi
from warp_gi import launch
from warp_gi.bench.harness.measure import Times
from warp_gi.color import decode_srgb

PYTHON = os.environ.get("WARP_GI_LUXCORE_PYTHON", sys.executable)
HOW_TO_INSTALL = (
    "no module pyluxcore; install it with: pip install '.[luxcore]' (or pyluxcore alone); "
    "WARP_GI_LUXCORE_PYTHON names another Python that has it"
)


@dataclass(frozen=True)
class Rendered:
    """Frames, and the wall and CPU seconds of each: samples and denoising, in the first one the cache, too."""

    pictures: list[np.ndarray]
    """Linear, float32 [height, width, 3]."""
    times: list[Times]
    version: str


def is_installed() -> bool:
    """Return whether the Python that is to run LuxCore has it."""
    try:
        return subprocess.run([PYTHON, "-c", "import pyluxcore"], capture_output=True, check=False).returncode == 0
    except OSError:  # no such Python
        return False


def render(scene: gi.Scene, cameras: Sequence[gi.Camera], spp: int, depth: int, folder: Path) -> Rendered:
    """Render a scene at time 0 from each camera, all of one size; files go to ``folder``.

    Raises CalledProcessError if LuxCore fails.
    """
    about = {
        "materials": write_meshes(scene, folder),
        "sky": _sky(scene.environment, folder),
        "cameras": [_camera(camera) for camera in cameras],
        "resolution": cameras[0].resolution,
        "spp": spp,
        "depth": depth,
        "cache": str(folder / "cache.pgi"),
        "threads": launch.thread_count(),
    }
    (folder / "job.json").write_text(json.dumps(about), encoding="utf-8")
    command = [PYTHON, str(Path(__file__).with_name("luxcore_render.py")), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = json.loads(next(line for line in reversed(done.stdout.splitlines()) if line.startswith("{")))
    pictures = [np.load(folder / f"{index:04d}.npy") for index in range(len(cameras))]
    return Rendered(pictures, list(map(tuple, found["frames"])), found["version"])


def write_meshes(scene: gi.Scene, folder: Path) -> list[dict[str, Any]]:
    """Write ``K.npz`` for the triangles of each material in use, and its texture as EXR; return the materials."""
    geometry = scene.data("cpu").geometry
    arrays = {name: getattr(geometry, name).numpy() for name in ("points", "uvs", "indices", "materials")}
    found: list[dict[str, Any]] = []
    for index, material in enumerate(scene.materials):
        faces = arrays["indices"][arrays["materials"] == index]
        if not len(faces):
            continue
        vertices, corners = np.unique(faces, return_inverse=True)
        path = folder / f"{len(found)}.npz"
        mesh = {"points": arrays["points"][vertices], "uvs": arrays["uvs"][vertices], "faces": corners.reshape(-1, 3)}
        np.savez(path, **mesh)
        found.append({"color": list(map(float, material.base_color[:3])), "texture": "", "mesh": str(path)})
        found[-1]["emission"] = list(map(float, material.emission))
        if material.base_color_texture is not None:
            found[-1]["texture"] = _texture(material, folder / f"{len(found)}.exr")
    return found


def _texture(material: gi.Material, path: Path) -> str:
    image = material.base_color_texture
    assert image is not None
    coded = image.pixels[..., :3].astype(np.float32) / 255.0
    linear = decode_srgb(coded) if image.srgb else coded
    _write(path, linear * np.asarray(material.base_color[:3], np.float32))
    return str(path)


def _sky(sky: gi.Environment | None, folder: Path) -> list[float] | str:
    """Return a constant radiance, or the file of a map; [] for a black sky."""
    if sky is None or sky.is_black:
        return []
    if sky.pixels is None:
        return list(map(float, sky.mean_radiance))
    turned = np.roll(sky.pixels, round(-sky.rotation / 360 * sky.pixels.shape[1]), axis=1)
    _write(folder / "sky.exr", turned[:, ::-1] * np.float32(sky.scale))  # LuxCore looks at the sphere from outside
    return str(folder / "sky.exr")


def _write(path: Path, pixels: np.ndarray) -> None:
    import OpenImageIO as oiio

    oiio.ImageBuf(np.ascontiguousarray(pixels, np.float32)).write(str(path))


def _camera(camera: gi.Camera) -> dict[str, Any]:
    matrix, (width, height) = camera.world_from_camera, camera.resolution
    eye = matrix[:3, 3]
    half = math.tan(math.radians(camera.hfov) / 2) * max(width, height) / width  # LuxCore's is of the longer side
    x, y, row = (size / max(width, height) for size in (width, height, 2))
    return {
        "window": [-x, x, -y - row, y - row],  # LuxCore 2.11 shows all one row lower than its window says
        "eye": eye.tolist(),
        "target": (eye - matrix[:3, 2]).tolist(),
        "up": matrix[:3, 1].tolist(),
        "angle": math.degrees(2 * math.atan(half)),
    }
