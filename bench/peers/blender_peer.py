"""Blender Cycles as a peer for whole sequences: the same file, camera path, samples and bounces, on the CPU.

Both get Lambert materials, a constant sky or a map, and no denoiser unless one is asked for. Cycles runs in a process
of its own, by this Python or by the one that WARP_GI_BLENDER_PYTHON names.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import warp_gi as gi
from warp_gi import launch, metrics
from warp_gi.bench.harness import scenes
from warp_gi.bench.harness.measure import Row
from warp_gi.bench.harness.places import PLACES, WHITE
from warp_gi.sequence.exr import read_exr

PYTHON = os.environ.get("WARP_GI_BLENDER_PYTHON", sys.executable)
HOW_TO_INSTALL = (
    "no module bpy; install it with: pip install '.[blender]' (or bpy alone), which has wheels for Python 3.11 "
    "(bpy 4.2 to 5.0) and 3.13 (bpy 5.1 and later); WARP_GI_BLENDER_PYTHON names another Python that has it"
)
SKY = WHITE
"""Radiance of the constant sky, W/(m^2 sr)."""
MAX_DEPTH = 6
Sky = gi.Environment | tuple[float, float, float] | None


@dataclass(frozen=True)
class Job:
    """A sequence that Blender and we render."""

    scene: str
    """Key in `PLACES` of a built-in scene, which is rendered along its camera path."""
    frames: int
    size: tuple[int, int]
    spp: int


FULL, QUICK = Job("atrium", 48, (480, 270), 16), Job("cornell_box", 2, (64, 48), 16)


def rows(job: Job) -> list[Row]:
    """Return a row of speed and of differences of the pictures, or one that says what is missing or failed."""
    if not is_installed():
        return [{"table": "Blender", "scene": job.scene, "skipped": HOW_TO_INSTALL}]
    with tempfile.TemporaryDirectory() as folder:
        try:
            return [compare(job, Path(folder))]
        except subprocess.CalledProcessError as error:
            lines = (error.stderr or "").strip().splitlines()
            return [{"table": "Blender", "scene": job.scene, "failed": lines[-1] if lines else str(error)}]


def is_installed() -> bool:
    """Return whether the Python that is to run Blender has bpy."""
    try:
        return subprocess.run([PYTHON, "-c", "import bpy"], capture_output=True, check=False).returncode == 0
    except OSError:  # no such Python
        return False


def compare(job: Job, folder: Path) -> Row:
    """Render the sequence by both; raises CalledProcessError if one fails."""
    scene = scenes.peer_scene(PLACES[job.scene].scene(), diffuse=True, masks=False)
    path = PLACES[job.scene].path().at_resolution(*job.size)
    write_glb(scene, folder / "scene.glb")
    path.save(folder / "camera.json")
    ours = _ours(job, folder)
    theirs = _blender(job, path, folder)
    last = f"{job.frames - 1:04d}.exr"
    mine = read_exr(folder / "ours" / last)[0]["beauty"]
    a, b = mine.astype(np.float64), rendered(folder, job.frames - 1).astype(np.float64)
    row: Row = {"table": "Blender", "scene": job.scene, "pixels": f"{job.size[0]}x{job.size[1]}", "spp": job.spp}
    row |= {"frames": job.frames, "ours frames a minute": 60 * job.frames / ours}
    row |= {"blender frames a minute": 60 * job.frames / theirs["wall s"], "faster": theirs["wall s"] / ours}
    row |= {"blender load s": theirs["load s"], "blender s a frame": float(np.median(theirs["frames"]))}
    row |= {"means differ": float(a.mean() / b.mean() - 1), "relMSE of tiles": tiles_differ(a, b)}
    return row | {"blender": theirs["version"]}


def tiles_differ(a: np.ndarray, b: np.ndarray, tile: int = 8) -> float:
    """Return the relMSE between means over tiles of pixels, which have little noise left."""
    height, width = (size // tile * tile for size in a.shape[:2])
    means = [x[:height, :width].reshape(height // tile, tile, width // tile, tile, 3).mean(axis=(1, 3)) for x in (a, b)]
    return metrics.rel_mse(*means)


def _ours(job: Job, folder: Path) -> float:
    size, sky = f"{job.size[0]}x{job.size[1]}", ",".join(map(str, SKY))
    command = [sys.executable, "-m", "warp_gi.cli", "render", str(folder / "scene.glb"), "--environment", sky]
    command += ["--camera", str(folder / "camera.json"), "--resolution", size, "--spp", str(job.spp), "--precision"]
    command += ["float", "--frames", f"0-{job.frames - 1}", "--indirect.max-depth", str(MAX_DEPTH), "--quiet"]
    command += ["--threads", str(launch.thread_count()), "-o", str(folder / "ours" / "####.exr")]
    return _timed(command)[0]


def _blender(job: Job, path: gi.CameraPath, folder: Path) -> dict[str, Any]:
    return render(folder, [path.camera(index) for index in range(job.frames)], job.spp, SKY, MAX_DEPTH - 2)


def render(
    folder: Path, cameras: Sequence[gi.Camera], spp: int, sky: Sky, bounces: int, **settings: bool
) -> dict[str, Any]:
    """Render ``folder/scene.glb`` to ``folder/blender/0000.exr`` and so on; return what that took.

    Args:
        folder: Holds the scene, which ``write_glb`` wrote; frames and the job go there.
        cameras: One a frame, of one size.
        spp: Number of samples a pixel.
        sky: Radiance of a constant sky, a map, or None for a black one.
        bounces: Number of bounces after the first surface; direct light is none.
        settings: ``denoise`` by Open Image Denoise, ``guiding`` of paths; both are off if not given.

    Raises CalledProcessError if Blender fails.
    """
    (folder / "blender").mkdir(exist_ok=True)
    about = {
        "scene": str(folder / "scene.glb"),
        "output": str(folder / "blender"),
        "resolution": cameras[0].resolution,
        "spp": spp,
        "bounces": bounces,
        "threads": launch.thread_count(),
        "sky": _sky_of(sky, folder),
        "cameras": [(camera.world_from_camera.tolist(), math.radians(camera.hfov)) for camera in cameras],
        **settings,
    }
    (folder / "job.json").write_text(json.dumps(about), encoding="utf-8")
    wall, text = _timed([PYTHON, str(Path(__file__).with_name("blender_render.py")), str(folder / "job.json")])
    found = next(line for line in reversed(text.splitlines()) if line.startswith("{"))
    return json.loads(found) | {"wall s": wall}


def rendered(folder: Path, frame: int) -> np.ndarray:
    """Return a frame that ``render`` wrote, linear, float32 [height, width, 3]."""
    layers = read_exr(folder / "blender" / f"{frame:04d}.exr")[0]
    return np.asarray(next(iter(layers.values()))[..., :3], np.float32)


def _sky_of(sky: Sky, folder: Path) -> list[float] | str:
    """Return a constant radiance, or the file of a map with its columns where Blender looks for them."""
    if not isinstance(sky, gi.Environment):
        return list(map(float, sky or (0.0, 0.0, 0.0)))
    if sky.pixels is None:
        return list(map(float, sky.mean_radiance))
    import OpenImageIO as oiio

    quarter = (
        sky.pixels.shape[1] / 4 - sky.rotation / 360 * sky.pixels.shape[1]
    )  # its first column looks along -x, y up
    pixels = np.ascontiguousarray(np.roll(sky.pixels, round(quarter), axis=1) * np.float32(sky.scale))
    image = oiio.ImageBuf(pixels)
    image.write(str(folder / "sky.exr"))
    return str(folder / "sky.exr")


def _timed(command: list[str]) -> tuple[float, str]:
    """Return the wall seconds of a process and what it printed."""
    started = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return time.perf_counter() - started, done.stdout


def write_glb(scene: gi.Scene, path: Path) -> None:
    """Write a scene at time 0 as GLB, with Lambert materials, and without normals, cameras and sky."""
    import pygltflib
    import trimesh
    from PIL import Image

    exported = trimesh.Scene()
    materials: list[gi.Material] = []
    for index, node in enumerate(scene.nodes):
        for mesh in node.meshes:
            image = mesh.material.base_color_texture
            name = f"{len(materials)} {mesh.material.name}"
            materials.append(mesh.material)
            picture = None if image is None else Image.fromarray(image.pixels[..., :3])
            look = trimesh.visual.material.PBRMaterial(name=name, baseColorTexture=picture)
            visual = trimesh.visual.TextureVisuals(uv=mesh.uvs, material=look)
            body = trimesh.Trimesh(mesh.points, mesh.indices, visual=visual, process=False)
            exported.add_geometry(body, geom_name=name, transform=_world_from_node(scene, index))
    exported.export(str(path), file_type="glb", include_normals=False)
    document = pygltflib.GLTF2().load(str(path))
    for material in document.materials:
        _describe(material, materials[int(material.name.split()[0])])
    used = ["KHR_materials_emissive_strength", "KHR_materials_specular"]
    document.extensionsUsed = sorted({*(document.extensionsUsed or []), *used})
    document.save(str(path))


def _describe(material: Any, source: gi.Material) -> None:
    """Write into the file the material numbers that trimesh rounds to bytes or leaves out."""
    from pygltflib import PbrMetallicRoughness

    strength = max(*source.emission, 0.0)
    surface = material.pbrMetallicRoughness = material.pbrMetallicRoughness or PbrMetallicRoughness()
    surface.baseColorFactor = [*map(float, source.base_color), 1.0]
    surface.metallicFactor, surface.roughnessFactor = 0.0, 1.0
    material.doubleSided = bool(source.double_sided)
    material.extensions = {"KHR_materials_specular": {"specularFactor": float(source.specular)}}
    if strength:
        material.emissiveFactor = [float(value / strength) for value in source.emission]
        material.extensions["KHR_materials_emissive_strength"] = {"emissiveStrength": float(strength)}


def _world_from_node(scene: gi.Scene, index: int) -> np.ndarray:
    node = scene.nodes[index]
    above = np.eye(4) if node.parent is None else _world_from_node(scene, node.parent)
    return above @ node.parent_from_node
