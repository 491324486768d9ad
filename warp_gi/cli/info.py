"""``warp-gi info``: what a scene holds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from warp_gi.cli.inputs import open_scene
from warp_gi.cli.options import parse_options
from warp_gi.cli.report import print_table, start_warp
from warp_gi.scene.model import Material, Mesh
from warp_gi.scene.pinhole import offset_text
from warp_gi.scene.scene import Scene
from warp_gi.scene.textures import distinct_textures


@dataclass
class Info:
    """Print what a scene holds: counts, bounds, materials, textures, lights, cameras and memory."""

    scene: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """A GLB, glTF, OBJ or PLY file, or the name of a built-in scene."""
    restrict_paths: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Let the scene's file name files in its own folder or below alone, for scenes of strangers."""


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    options = parse_options(Info, "info", arguments)
    start_warp()
    scene = open_scene(options.scene, restrict_paths=options.restrict_paths)
    print_table(options.scene, ("what", "value"), summary(scene))
    print_table(
        "materials",
        ("name", "base colour", "metallic", "roughness", "emission", "alpha", "textures"),
        [_material_row(material) for material in scene.materials],
    )
    textures = distinct_textures(scene.materials)
    if textures:
        rows: list[tuple[object, ...]] = [
            (t.name, f"{t.pixels.shape[1]}x{t.pixels.shape[0]}", "sRGB" if t.srgb else "linear", *t.wrap)
            for t in textures
        ]
        print_table("textures", ("name", "size", "coding", "wrap u", "wrap v"), rows)
    if scene.lights:
        rows = [(light.name, light.kind, _numbers(light.intensity), _numbers(light.position)) for light in scene.lights]
        print_table("lights", ("name", "kind", "intensity", "position [m]"), rows)
    if scene.cameras:
        rows = []
        for name, camera in scene.cameras.items():
            rows.append(
                (
                    name,
                    _numbers(camera.position + camera.offset),
                    _numbers(-camera.world_from_camera[:3, 2]),
                    f"{camera.ortho_width:g} m" if camera.is_orthographic else f"{camera.hfov:.4g}°",
                )
            )
        print_table("cameras", ("name", "position [m]", "direction", "hfov or width"), rows)
    return 0


def summary(scene: Scene) -> list[tuple[str, object]]:
    """Return (what, value) of a scene as a whole."""
    low, high = scene.bounds
    meshes = [mesh for node in scene.nodes for mesh in node.meshes]
    sky = scene.environment
    return [
        ("triangles", scene.triangle_count),
        ("vertices", sum(len(mesh.points) for mesh in meshes)),
        ("meshes", len(meshes)),
        *_shared(meshes),
        ("objects", len(scene.object_names)),
        *_deforming(scene),
        ("materials", len(scene.materials)),
        ("textures", len(distinct_textures(scene.materials))),
        ("emissive triangles", scene.emitter_count - len(scene.lights)),
        ("lights without size", len(scene.lights)),
        ("emitted power [W, luminance]", float(scene.emitter_powers().sum())),
        ("sky, mean radiance", "none" if sky is None else _numbers(sky.mean_radiance)),
        ("cameras", len(scene.cameras)),
        ("animation [s]", scene.duration if scene.is_animated else "none"),
        *([("recentred by [m]", offset_text(scene.offset))] if scene.offset.any() else []),
        ("lowest corner [m]", _numbers(low)),
        ("highest corner [m]", _numbers(high)),
        ("memory [MB]", scene.memory_bytes / 1e6),
        ("memory a triangle [B]", round(scene.memory_bytes / scene.triangle_count)),
        ("hash", scene.hash[:16]),
    ]


def _shared(meshes: Sequence[Mesh]) -> list[tuple[str, object]]:
    """Return a row about meshes that stand in several nodes, if there are any: each node has triangles of its own."""
    once = {id(mesh): mesh for mesh in meshes}
    if len(once) == len(meshes):
        return []
    needed, all_of_them = (sum(len(mesh.indices) for mesh in some) for some in (once.values(), meshes))
    return [("copies of shared meshes", f"{len(meshes) - len(once)}, with {all_of_them - needed} of the triangles")]


def _deforming(scene: Scene) -> list[tuple[str, object]]:
    """Return what there is of skins and morph targets."""
    skins = {id(node.skin): node.skin for node in scene.nodes if node.skin is not None and node.meshes}
    bent = sum(node.skin is not None for node in scene.nodes if node.meshes)
    morphing = [node for node in scene.nodes if node.morphs is not None]
    targets = sum(len(node.morphs[0].weights) for node in morphing if node.morphs)
    joints = sum(len(skin.joints) for skin in skins.values())
    return [
        *([("objects with a skin", f"{bent} ({joints} joints in {len(skins)} skins)")] if bent else []),
        *([("objects that morph", f"{len(morphing)} ({targets} morph targets)")] if morphing else []),
    ]


def _material_row(material: Material) -> tuple[object, ...]:
    textures = {
        "colour": material.base_color_texture,
        "metal-rough": material.metallic_roughness_texture,
        "normal": material.normal_texture,
        "emission": material.emission_texture,
    }
    alpha = "opaque" if material.alpha_cutoff is None else f"mask {material.alpha_cutoff:g}"
    if material.alpha_blend:
        alpha = f"blend {material.alpha:g}"
    if material.is_glass:
        alpha += f", glass {material.transmission:g}"
    emission = _numbers(material.emission) if any(material.emission) else ""
    used = ", ".join(name for name, texture in textures.items() if texture is not None)
    return material.name, _numbers(material.base_color), material.metallic, material.roughness, emission, alpha, used


def _numbers(values: Iterable[float]) -> str:
    """Return numbers with three digits each, spaces between."""
    return " ".join(f"{float(v) + 0.0:.3g}" for v in values)
