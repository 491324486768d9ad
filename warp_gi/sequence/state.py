"""The state of a sequence between two frames as plain arrays, to save and to go on from in another process.

States are dataclasses and kernel structs of arrays. Only arrays are saved; all else, as sizes of the scene, comes from
the state before the first frame, which is made anew. A state that knows better what there is to save has the methods
``saved_arrays`` and ``with_saved_arrays``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Literal

import numpy as np
import warp as wp

from warp_gi.launch import copied


@dataclass(frozen=True)
class Dependence:
    """How the frames of a sequence depend on those before them."""

    on_past: tuple[str, ...]
    """Places in the pipeline that make frames depend: terms, "indirect.ends_in", "denoiser", names of services."""
    unsaved: tuple[str, ...]
    """Places among ``on_past`` whose state no file keeps."""

    @property
    def kind(self) -> Literal["independent", "saved", "unsaved"]:
        """Kind of dependence. "independent" frames are the same alone and in any order. A "saved" sequence goes on from
        a state file, an "unsaved" one only from its first frame."""
        return "unsaved" if self.unsaved else "saved" if self.on_past else "independent"

    @property
    def is_saved(self) -> bool:
        """Whether frames depend on those before, and a saved state holds all that they left."""
        return bool(self.on_past) and not self.unsaved


def state_arrays(state: Any, name: str = "") -> dict[str, np.ndarray]:
    """Return every array in a state, by the names of the fields that lead to it, joined by dots."""
    if isinstance(state, wp.array):
        return {name: state.numpy()}
    if isinstance(state, np.ndarray):
        return {name: state}
    if hasattr(state, "saved_arrays"):
        return {f"{name}.{key}": array for key, array in state.saved_arrays().items()}
    found: dict[str, np.ndarray] = {}
    for key, value in _parts(state):
        found |= state_arrays(value, f"{name}.{key}" if name else key)
    return found


def with_arrays(state: Any, arrays: Mapping[str, np.ndarray], device: wp.Device, name: str = "") -> Any:
    """Return a state like ``state`` with its arrays replaced by those of ``state_arrays``.

    Raises KeyError where ``arrays`` lacks one, ValueError where its items do not fit.
    """
    if isinstance(state, wp.array):
        restored: wp.array = wp.array(arrays[name], dtype=state.dtype, device=device)
        if restored.ndim != state.ndim:
            raise ValueError(f"{name} has {arrays[name].ndim} dimensions")
        return restored
    if isinstance(state, np.ndarray):
        return arrays[name]
    if hasattr(state, "with_saved_arrays"):
        prefix = f"{name}."
        mine = {key.removeprefix(prefix): array for key, array in arrays.items() if key.startswith(prefix)}
        return state.with_saved_arrays(mine)
    parts = {key: with_arrays(value, arrays, device, f"{name}.{key}" if name else key) for key, value in _parts(state)}
    if isinstance(state, dict):
        return parts
    if is_dataclass(state) and not isinstance(state, type):
        return replace(state, **parts)
    if _is_struct(state):
        struct = copied(state, state._cls)
        for key, value in parts.items():
            setattr(struct, key, value)
        return struct
    return state


def _parts(state: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(state, dict):
        yield from state.items()
    elif is_dataclass(state):
        yield from (
            (field.name, getattr(state, field.name)) for field in fields(state) if "derived" not in field.metadata
        )
    elif _is_struct(state):
        yield from ((key, getattr(state, key)) for key in state._cls.vars)


def _is_struct(value: Any) -> bool:
    return hasattr(getattr(value, "_cls", None), "vars")
