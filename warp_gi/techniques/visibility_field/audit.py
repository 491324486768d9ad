"""Audits of baked visibility fields: which rays of a view a field is sure of, traces, or is wrong about."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_gi.kernels import visibility_field as field_kernels
from warp_gi.kernels import visibility_field_audit as audit_kernels

if TYPE_CHECKING:
    from warp_gi.frame import Frame
    from warp_gi.techniques.visibility_field.estimator import VisibilityField
    from warp_gi.techniques.visibility_field.state import FieldState

STATES = ("visible", "occluded", "mixed", "unknown")
"""What a cell may say of a ray."""


def audit(frame: Frame, state: FieldState) -> dict[str, np.ndarray]:
    """Trace every cosine-weighted ray of a frame's last camera sample, and compare with what the field says of it.

    Returns counts of rays, int32 [pixel], by name: one for each of the ``STATES``; "lost", rays that were called
    occluded but reach the sky; "leaked", rays that were called visible but are blocked. With them comes "label", the
    slot of the pixel's cell with its flags (``SLOT_LABEL``), -1 where nothing was baked or nothing is seen.
    """
    buffers, count = audit_kernels.AuditBuffers(), int(np.prod(frame.camera.resolution))
    for name in audit_kernels.AuditBuffers.vars:
        setattr(buffers, name, wp.zeros(count, dtype=wp.int32, device=frame.device))
    inputs = [frame.data, frame.camera_data, frame.pass_settings, state.data, state.query, frame.hits, buffers]
    frame.launch_tiled(audit_kernels.audit_field, inputs)
    return {name: getattr(buffers, name).numpy() for name in audit_kernels.AuditBuffers.vars}


def occlusion_labels(counts: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the occlusion label of each pixel's cell (dvf.txt, Eq. 8), int32 [pixel]; -1 where there is none."""
    slots = counts["label"]
    return np.where(slots < 0, -1, (slots & int(field_kernels.SLOT_LABEL)) != 0).astype(np.int32)


def rays_asked(counts: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return how many rays of each pixel the audit of ``counts`` looked at, int64 [pixel]."""
    return np.sum([counts[name].astype(np.int64) for name in STATES], axis=0)


def rays_traced(counts: Mapping[str, np.ndarray], settings: VisibilityField) -> np.ndarray:
    """Return how many rays of each pixel diffuse light traces in the mode of ``settings``, float64 [pixel].

    ``counts`` are those of ``audit``. In the mode "unbiased", which verifies sure rays at random, it is the expected
    number.
    The paper's mode traces inside one mask: the visibility mask under label 1, the occlusion mask under label 0, where
    what is blocked is subtracted from all of the sky (dvf.txt, Algorithm 2). A mixed ray is in both masks, an unknown
    one in none. Without a cell all rays are traced.
    """
    asked = rays_asked(counts)
    if not settings.uses_cells:
        return asked.astype(np.float64)
    visible, occluded, mixed = (counts[name].astype(np.float64) for name in ("visible", "occluded", "mixed"))
    if settings.mode == "paper":
        label = occlusion_labels(counts)
        return np.where(label < 0, asked, mixed + np.where(label == 1, visible, occluded))
    verified = settings.verify if settings.mode == "unbiased" else 0.0
    return mixed + counts["unknown"] + verified * (visible + occluded)
