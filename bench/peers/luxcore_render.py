"""Renders frames with LuxCore; run by a Python that has `pyluxcore`, and not by others: see `luxcore_peer`.

Its one argument is a folder with a job in JSON and the meshes; frames go there as arrays.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

PHOTONS = 500_000
"""Photons of the cache of indirect light at most; fewer where it is even before."""


def main(folder: Path) -> None:
    """Render every frame, and print seconds as JSON on the last line."""
    import pyluxcore

    pyluxcore.Init()
    job = json.loads((folder / "job.json").read_text(encoding="utf-8"))
    scene = _scene(pyluxcore, job)
    frames = []
    for index, camera in enumerate(job["cameras"]):
        scene.Parse(_properties(pyluxcore, _camera(camera)))
        wall, cpu = time.perf_counter(), time.process_time()
        picture = _render(pyluxcore, scene, job)
        frames.append((time.perf_counter() - wall, time.process_time() - cpu))
        np.save(folder / f"{index:04d}.npy", picture)
    print(json.dumps({"frames": frames, "version": pyluxcore.Version()}), flush=True)
    os._exit(0)  # its own end crashes in the interpreter's


def _properties(pyluxcore: Any, values: dict[str, Any]) -> Any:
    found = pyluxcore.Properties()
    for name, value in values.items():
        found.Set(pyluxcore.Property(name, value))
    return found


def _scene(pyluxcore: Any, job: dict[str, Any]) -> Any:
    scene = pyluxcore.Scene()
    values: dict[str, Any] = _camera(job["cameras"][0])
    for index, material in enumerate(job["materials"]):
        arrays = np.load(material["mesh"])
        points, uvs = ([tuple(map(float, row)) for row in arrays[name]] for name in ("points", "uvs"))
        faces = [tuple(map(int, row)) for row in arrays["faces"]]
        scene.DefineMesh(f"mesh{index}", points, faces, None, uvs, None, None)
        name = f"scene.materials.m{index}"
        values |= {f"{name}.type": "matte", f"{name}.kd": material["color"]}
        if material["texture"]:
            image = f"scene.textures.t{index}"
            values |= {f"{image}.type": "imagemap", f"{image}.file": material["texture"], f"{image}.gamma": 1.0}
            values[f"{name}.kd"] = f"t{index}"
        if any(material["emission"]):
            values |= {f"{name}.emission": material["emission"]}
        values |= {f"scene.objects.o{index}.shape": f"mesh{index}", f"scene.objects.o{index}.material": f"m{index}"}
    if isinstance(job["sky"], str):
        values |= {"scene.lights.sky.type": "infinite", "scene.lights.sky.file": job["sky"]}
        values |= {"scene.lights.sky.gamma": 1.0, "scene.lights.sky.transformation": SKY}
    elif job["sky"]:
        values |= {"scene.lights.sky.type": "constantinfinite", "scene.lights.sky.color": job["sky"]}
    scene.Parse(_properties(pyluxcore, values))
    return scene


SKY = [0.0, 0.0, -1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
"""Columns of the matrix that stands a map upright: LuxCore's maps have z up."""


def _camera(camera: dict[str, Any]) -> dict[str, Any]:
    return {
        "scene.camera.type": "perspective",
        "scene.camera.lookat.orig": camera["eye"],
        "scene.camera.lookat.target": camera["target"],
        "scene.camera.up": camera["up"],
        "scene.camera.fieldofview": camera["angle"],
        "scene.camera.screenwindow": camera["window"],
    }


def _render(pyluxcore: Any, scene: Any, job: dict[str, Any]) -> np.ndarray:
    width, height = job["resolution"]
    settings: dict[str, Any] = {
        "renderengine.type": "PATHCPU",
        "sampler.type": "SOBOL",
        "native.threads.count": job["threads"],
        "path.pathdepth.total": job["depth"],
        "path.pathdepth.diffuse": job["depth"],
        "path.photongi.photon.maxcount": PHOTONS,
        "path.photongi.persistent.file": job["cache"],
        "path.photongi.indirect.enabled": True,
        "path.photongi.caustic.enabled": False,
        "film.width": width,
        "film.height": height,
        "film.filter.type": "BOX",
        "film.filter.width": 0.5,
        "film.imagepipelines.0.0.type": "INTEL_OIDN",
        "film.outputs.0.type": "RGB_IMAGEPIPELINE",
        "film.outputs.0.index": 0,
        "film.outputs.0.filename": "unused.exr",
        "batch.haltspp": job["spp"],
    }
    session = pyluxcore.RenderSession(pyluxcore.RenderConfig(_properties(pyluxcore, settings), scene))
    session.Start()
    while not session.HasDone():
        time.sleep(0.01)
        session.UpdateStats()
    session.Stop()
    picture = np.zeros((height, width, 3), np.float32)
    film = session.GetFilm()
    film.GetOutputFloat(pyluxcore.FilmOutputType.RGB_IMAGEPIPELINE, picture, 0, True)
    return picture[::-1].copy()  # rows from the bottom


if __name__ == "__main__":
    main(Path(sys.argv[1]))
