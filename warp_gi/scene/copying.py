"""Copies of scenes, by pickle and ``copy``, and what a scene says of itself."""

from __future__ import annotations

from typing import Any

import numpy as np


def contents(scene: Any) -> tuple[Any, ...]:
    """Return what makes a scene: its arguments, and its offset. Device buffers are made anew from it."""
    sky = scene.sky_at or scene.environment
    given = scene.nodes, scene.lights, sky, scene.cameras, scene.name, scene.camera_nodes
    return type(scene), given, scene.offset


def made(kind: type, given: tuple[Any, ...], offset: np.ndarray) -> Any:
    """Return a scene of ``contents``."""
    scene = kind(*given)
    scene.offset = offset
    return scene


def description(scene: Any) -> str:
    """Return a line that says what a scene holds."""
    low, high = scene.bounds.astype(np.float64)
    size = " x ".join(f"{side:.3g}" for side in high - low)
    sky = scene.environment
    parts = [
        f"{scene.triangle_count:,} triangles",
        f"{len(scene.materials)} materials",
        f"{scene.emitter_count:,} emitters",
        "no sky" if sky is None else "sky that moves" if scene.is_sky_animated else "sky",
        f"{size} m",
        *([f"{scene.duration:g} s of animation"] if scene.is_animated else []),
        *([f"cameras {', '.join(scene.cameras)}"] if scene.cameras else []),
    ]
    return f"<Scene {scene.name!r}: {', '.join(parts)}>"
