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

from warp_gi.errors import one_line
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
        return wp.array(_fitting(arrays[name], state, name), dtype=state.dtype, device=device)
    if isinstance(state, np.ndarray):
        if arrays[name].dtype != state.dtype or arrays[name].ndim != state.ndim:
            raise ValueError(f"{name} is {arrays[name].dtype} {list(arrays[name].shape)}, expected {state.dtype}")
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


def loaded_states(before: Mapping[str, Any], arrays: Mapping[str, np.ndarray], device: wp.Device) -> dict[str, Any]:
    """Return states like those ``before`` the first frame, with the arrays of a file that says it is of their kind.

    The file may be forged: arrays have the types and shapes of what they replace, and states with a method ``fault``
    say what else is wrong before a kernel follows an index. Raises ValueError where one cannot be.
    """
    try:
        with np.errstate(all="ignore"):
            states: dict[str, Any] = with_arrays(before, arrays, device)
            for place, state in states.items():
                if hasattr(state, "fault") and (problem := state.fault(before[place], states)):
                    raise ValueError(f"{place}: {problem}")
    except KeyError as error:
        raise ValueError(f"it has no array {error}") from error
    except (ValueError, TypeError, IndexError, AttributeError, OverflowError, RuntimeError, MemoryError) as error:
        raise ValueError(one_line(error, type(error).__name__)) from error
    return states


def _fitting(array: np.ndarray, like: wp.array, name: str) -> np.ndarray:
    """Return an array of a file; raises ValueError unless it has the type and the rank of what it replaces."""
    kind = like.numpy()
    if array.dtype != kind.dtype or array.ndim != kind.ndim or array.shape[like.ndim :] != kind.shape[like.ndim :]:
        raise ValueError(f"{name} is {array.dtype} {list(array.shape)}, expected {kind.dtype} as {list(kind.shape)}")
    return array


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
