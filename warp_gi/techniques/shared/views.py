"""Cameras that a bake is made for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warp_gi.scene.camera import Camera, CameraPath

ROW = 17
"""Numbers of a row of ``camera_rows``."""
PLAIN_LENS = (0.0, 0.0, 1.0, 0.0)
"""The last numbers of the row of a perspective camera without a lens shift and with square pixels."""
SPREAD = 32
"""Largest number of frames of a path that stand for all of it."""
MOST = 4096
"""Largest number of frames where every one is asked for."""


def cameras_of(camera: Camera | CameraPath | None, every: bool = False) -> list[Camera]:
    """Return the cameras of a path's frames: of ``every`` frame up to ``MOST``, or of ``SPREAD`` spread over it."""
    if camera is None:
        return []
    if isinstance(camera, Camera):
        return [camera]
    count = camera.frame_count
    spread = [np.linspace(0, count - 1, min(count, most)) for most in ((MOST, SPREAD) if every else (SPREAD,))]
    return [camera.camera(int(frame)) for frame in np.unique(np.round(np.concatenate(spread)))]


def known_rows(rows: np.ndarray) -> np.ndarray:
    """Return rows of ``camera_rows`` of a bake; those of earlier versions have no lens but a field of view."""
    if rows.shape[1] != ROW - len(PLAIN_LENS):
        return rows
    return np.concatenate([rows, np.tile(np.array(PLAIN_LENS, np.float32), (len(rows), 1))], axis=1)


def camera_rows(cameras: Sequence[Camera]) -> np.ndarray:
    """Return placement and lens of cameras, float32 [camera, 17], but not the shape of their pictures."""
    rows = [
        [
            *camera.world_from_camera[:3].ravel(),
            camera.hfov,
            *camera.lens_shift,
            camera.pixel_aspect,
            camera.ortho_width,
        ]
        for camera in cameras
    ]
    return np.array(rows, np.float32).reshape(-1, ROW)
