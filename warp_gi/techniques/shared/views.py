"""Cameras that a bake is made for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warp_gi.scene.camera import Camera, CameraPath

SPREAD = 32
"""Largest number of frames of a path that stand for all of it."""


def cameras_of(camera: Camera | CameraPath | None, every: bool = False) -> list[Camera]:
    """Return the cameras of a path's frames: of ``every`` frame, or of ``SPREAD`` frames spread over it."""
    if camera is None:
        return []
    if isinstance(camera, Camera):
        return [camera]
    count = camera.frame_count
    frames = np.linspace(0, count - 1, count if every else min(count, SPREAD))
    return [camera.camera(int(frame)) for frame in np.unique(np.round(frames))]


def camera_rows(cameras: Sequence[Camera]) -> np.ndarray:
    """Return placement and field of view of cameras, float32 [camera, 13], but not the shape of their pictures."""
    rows = [[*camera.world_from_camera[:3].ravel(), camera.hfov] for camera in cameras]
    return np.array(rows, np.float32).reshape(-1, 13)
