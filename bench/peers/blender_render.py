"""Renders a sequence with Blender Cycles; run by a Python that has `bpy`, and not by others: see `blender_peer`.

Its one argument is a JSON file with the scene (GLB), camera matrices, settings and where frames go.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any


def main(path: str) -> None:
    """Render every frame, and print seconds as JSON on the last line."""
    import bpy

    job = json.loads(Path(path).read_text(encoding="utf-8"))
    started = time.perf_counter()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=job["scene"])
    scene = bpy.context.scene
    _settings(scene, job)
    _light(bpy, scene, job["sky"])
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    camera.data.sensor_fit, camera.data.clip_start, camera.data.clip_end = "HORIZONTAL", 1e-3, 1e5
    loaded, frames, seconds = time.perf_counter(), [], []
    for index, (matrix, angle) in enumerate(job["cameras"]):
        begun, cpu = time.perf_counter(), time.process_time()
        camera.matrix_world = _from_rows(matrix)
        camera.data.angle = angle
        scene.cycles.seed = index
        scene.render.filepath = f"{job['output']}/{index:04d}.exr"
        bpy.ops.render.render(write_still=True)
        frames.append(time.perf_counter() - begun)
        seconds.append(time.process_time() - cpu)
    found = {"load s": loaded - started, "frames": frames, "cpu": seconds, "version": bpy.app.version_string}
    print(json.dumps(found))


def _settings(scene: Any, job: dict[str, Any]) -> None:
    """Set what makes the picture: samples, bounces, a box filter, a denoiser; no adaptive sampling, no clamping."""
    scene.render.engine = "CYCLES"
    cycles, render = scene.cycles, scene.render
    cycles.device, cycles.samples, cycles.use_adaptive_sampling = "CPU", job["spp"], False
    cycles.use_denoising, cycles.use_guiding = job.get("denoise", False), job.get("guiding", False)
    if cycles.use_denoising:
        cycles.denoiser, cycles.denoising_input_passes = "OPENIMAGEDENOISE", "RGB_ALBEDO_NORMAL"
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = job["bounces"]
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.pixel_filter_type, cycles.filter_width = "BOX", 1.0
    render.resolution_x, render.resolution_y = job["resolution"]
    render.resolution_percentage, render.use_persistent_data = 100, True
    render.threads_mode, render.threads = "FIXED", job["threads"]
    render.image_settings.file_format, render.image_settings.color_depth = "OPEN_EXR", "32"


def _light(bpy: Any, scene: Any, sky: list[float] | str) -> None:
    """Set a constant sky or a map, and let surfaces emit on their front alone."""
    scene.world = bpy.data.worlds.new("sky")
    scene.world.use_nodes = True
    background = next(node for node in scene.world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Strength"].default_value = 1.0
    if isinstance(sky, str):
        shown = scene.world.node_tree.nodes.new("ShaderNodeTexEnvironment")
        shown.image = bpy.data.images.load(sky)
        scene.world.node_tree.links.new(shown.outputs["Color"], background.inputs["Color"])
    else:
        background.inputs["Color"].default_value = (*sky, 1.0)
    for material in bpy.data.materials:
        shader = next((node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED"), None)
        if shader is None or not any(shader.inputs["Emission Color"].default_value[:3]):
            continue
        strength = shader.inputs["Emission Strength"]
        nodes, links = material.node_tree.nodes, material.node_tree.links
        facing, front = nodes.new("ShaderNodeNewGeometry"), nodes.new("ShaderNodeMath")
        front.operation = "MULTIPLY_ADD"  # strength times (1 - back facing)
        front.inputs[1].default_value = -strength.default_value
        front.inputs[2].default_value = strength.default_value
        links.new(facing.outputs["Backfacing"], front.inputs[0])
        links.new(front.outputs[0], strength)


def _from_rows(rows: list[list[float]]) -> object:
    """Return a camera's matrix in Blender's space, z up, from one with y up."""
    from mathutils import Matrix

    return Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1))) @ Matrix(rows)


if __name__ == "__main__":
    main(sys.argv[1])
