"""A hand-made frame for tests of files and commands."""

from types import SimpleNamespace

import numpy as np

from warp_gi.scene.camera import Camera


def make_frame(index=3, width=24, height=16, seed=5, spp=8, peak=4.0):
    """Return a frame with every buffer that a render has, filled with reproducible numbers."""
    rng = np.random.default_rng(seed + index)
    color = lambda scale: (scale * rng.random((height, width, 3))).astype(np.float32)  # noqa: E731
    buffers = {
        "beauty": color(peak),
        "emission": color(1),
        "environment": color(1),
        "emitters": color(1),
        "indirect": color(1),
        "albedo": color(1),
        "normal": color(2) - 1,
        "position": color(1000),
        "depth": np.where(rng.random((height, width)) < 0.1, np.inf, 1000 * rng.random((height, width))).astype("f4"),
        "motion": (rng.random((height, width, 2)) - 0.5).astype(np.float32),
        "object_id": rng.integers(-1, 2**24, (height, width), dtype=np.int32),
        "material_id": rng.integers(-1, 70, (height, width), dtype=np.int32),
        "variance": color(1e-6),
    }
    return SimpleNamespace(
        names=tuple(buffers),
        numpy=buffers.__getitem__,
        index=index,
        time=index / 24,
        camera=Camera.look_at((index, 2, 5), (0, 1, 0), hfov=50, resolution=(width, height)),
        timings={"environment": 0.25, "compile": 1.5},
        metadata={
            "seed": seed,
            "spp": spp,
            "scene_hash": "ab12",
            "indirect.max_depth": 4,
            "epsilon": 0.1,
            "large": 2**40,
            "note": "",
            "flag": True,
        },
    )
