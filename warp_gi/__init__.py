"""Precomputed and temporally reused global illumination in NVIDIA Warp kernels.

Names load on first use, so that ``import warp_gi`` is fast and compiles nothing.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

# public name -> module that defines it
_PUBLIC = {
    "GiError": "warp_gi.errors",
    "SceneError": "warp_gi.errors",
    "OptionError": "warp_gi.errors",
    "BakeError": "warp_gi.errors",
    "UnsupportedWarning": "warp_gi.errors",
    "Bake": "warp_gi.baking",
    "load_bake": "warp_gi.baking",
    "BakeFolder": "warp_gi.kept",
    "TriangleBvh": "warp_gi.bvh",
    "Hits": "warp_gi.bvh",
    "CameraHits": "warp_gi.camera_rays",
    "trace_cameras": "warp_gi.camera_rays",
    "RayMeshIntersector": "warp_gi.trimesh_rays",
    "Scene": "warp_gi.scene.scene",
    "Mesh": "warp_gi.scene.model",
    "Material": "warp_gi.scene.model",
    "Texture": "warp_gi.scene.model",
    "Node": "warp_gi.scene.model",
    "Keyframe": "warp_gi.scene.model",
    "MorphKeyframe": "warp_gi.scene.model",
    "MorphTarget": "warp_gi.scene.model",
    "Skin": "warp_gi.scene.model",
    "PunctualLight": "warp_gi.scene.model",
    "load_scene": "warp_gi.scene.loading",
    "Environment": "warp_gi.scene.environment",
    "SunSky": "warp_gi.scene.environment",
    "SkySequence": "warp_gi.scene.sky_motion",
    "TurningSky": "warp_gi.scene.sky_motion",
    "builtin_scene": "warp_gi.scene.builtin",
    "Camera": "warp_gi.scene.pinhole",
    "CameraPath": "warp_gi.scene.camera",
    "CameraKey": "warp_gi.scene.camera",
    "Pipeline": "warp_gi.pipeline",
    "Estimator": "warp_gi.estimator",
    "RadianceCache": "warp_gi.radiance_cache",
    "Primary": "warp_gi.primary",
    "Service": "warp_gi.stateful",
    "Denoiser": "warp_gi.denoise",
    "SpatioTemporal": "warp_gi.denoise",
    "Oidn": "warp_gi.denoise",
    "bake": "warp_gi.rendering",
    "merge_bakes": "warp_gi.shards",
    "FrameScheduler": "warp_gi.scheduler",
    "Frame": "warp_gi.frame",
    "render": "warp_gi.rendering",
    "plan_sequence": "warp_gi.rendering",
    "Plan": "warp_gi.sequence.resume",
    "write_frame": "warp_gi.sequence.frames",
    "read_frame": "warp_gi.sequence.frames",
    "builtin_camera_path": "warp_gi.scene.builtin",
    "AlphaMasks": "warp_gi.bvh",
    "set_threads": "warp_gi.launch",
    "set_verbosity": "warp_gi.verbosity",
}
_MODULES = ("metrics",)
# classes and functions of techniques: the registry names them


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    if name in _MODULES:
        return importlib.import_module(f"warp_gi.{name}")
    registry = importlib.import_module("warp_gi.registry")
    if name == "__all__":
        return sorted([*_PUBLIC, *_MODULES, *registry.public()])
    if not name.startswith("_") and name in registry.public():
        return registry.find(name)
    raise AttributeError(f"module 'warp_gi' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__getattr__("__all__")])
