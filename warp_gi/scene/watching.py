"""Watches objects for edits: tells which of their fields changed, in-place edits of arrays and lists included.

A field counts as changed when it holds another object, another list of the same objects, or an array with other
bytes. Whether that matters is for the caller to find out: an equal copy of an array counts as changed, too.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import fields
from operator import attrgetter, is_
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warp_gi.kernels import checksum
from warp_gi.launch import get_device, launch

CHUNK = 65536  # bytes
_PLAIN = (bool, int, float, str, tuple, type(None))


class Change(NamedTuple):
    """A field that may have been edited."""

    owner: object
    """Object whose field may have been edited."""
    field: str
    """Name of the field."""


Owner = object | tuple[object, tuple[str, ...]]
"""A dataclass instance, all of whose fields count; or an object and the names of those that do."""


class Watch:
    """Remembers the fields of objects, and tells which have changed since.

    Args:
        owners: Dataclass instances, or pairs of an object and the names of its fields. ``name`` is left out.
        bare: Whether contents of arrays are remembered by CRC-32, for which no kernel is compiled and the watch
            can be copied and pickled; else by 64-bit checksums, as fast as memory is read.
    """

    def __init__(self, owners: Sequence[Owner], bare: bool = False) -> None:
        pairs = [owner if isinstance(owner, tuple) else (owner, _field_names(owner)) for owner in owners]
        # attrgetter returns a tuple for two or more names, and every owner has so many
        self._owners = [(owner, names, attrgetter(*names)) for owner, names in pairs]
        self._values: list[tuple[Any, ...]] = [get(owner) for owner, _, get in self._owners]
        self._lists: list[tuple[Change, list[object], list[object]]] = []
        self._arrays: list[tuple[Change, np.ndarray]] = []
        self._others: list[tuple[Change, object, int]] = []
        self._shared: dict[tuple[int, str], list[Change]] = {}  # others that have what a field has
        seen: dict[int, Change] = {}
        for (owner, names, _), values in zip(self._owners, self._values, strict=True):
            for name, value in zip(names, values, strict=True):
                if isinstance(value, _PLAIN):
                    continue
                change = Change(owner, name)
                first = seen.setdefault(id(value), change)
                if first is change:
                    self._add(change, value, bare)
                else:
                    self._shared.setdefault((id(first.owner), first.field), []).append(change)
        self._sums = None if bare else _Checksums([array for _, array in self._arrays])

    def _add(self, change: Change, value: object, bare: bool) -> None:
        if isinstance(value, np.ndarray):
            if _is_immutable(value):
                return
            if not bare and (value.flags.c_contiguous or value.flags.f_contiguous):
                self._arrays.append((change, value))
                return
        elif isinstance(value, list) and not (value and isinstance(value[0], (*_PLAIN, list, np.generic, np.ndarray))):
            self._lists.append((change, value, list(value)))
            return
        elif not (isinstance(value, list) or hasattr(value, "__array__") or hasattr(value, "__array_interface__")):
            return  # an object that is watched by itself, or a number
        self._others.append((change, value, _crc(value)))

    @property
    def nbytes(self) -> int:
        """Number of bytes that are read to find edits of arrays."""
        return sum(array.nbytes for _, array in self._arrays)

    def changes(self) -> list[Change]:
        """Return the fields that differ; empty if nothing was edited."""
        found = []
        for (owner, names, get), old in zip(self._owners, self._values, strict=True):
            new = get(owner)
            if not all(map(is_, new, old)):
                found += [Change(owner, name) for name, a, b in zip(names, new, old, strict=True) if a is not b]
        found += [c for c, now, old in self._lists if len(now) != len(old) or not all(map(is_, now, old))]
        found += [change for change, value, crc in self._others if _crc(value) != crc]
        if self._sums is not None:
            found += [self._arrays[index][0] for index in self._sums.changed()]
        return found + [other for one in found for other in self._shared.get((id(one.owner), one.field), ())]


class _Checksums:
    """Checksums of arrays in host memory, in chunks."""

    def __init__(self, arrays: Sequence[np.ndarray]) -> None:
        self.arrays = arrays
        self.sizes = [array.nbytes for array in arrays]
        counts = [-(-size // CHUNK) for size in self.sizes]
        self.index = np.repeat(np.arange(len(arrays)), counts)  # index in `arrays` of each chunk's array
        table = np.zeros(len(self.index), checksum.MemoryChunk.numpy_dtype())
        starts = np.array([array.__array_interface__["data"][0] for array in arrays], np.uint64)
        sizes = np.array(self.sizes, np.int64)
        number = np.arange(len(table)) - np.repeat(np.cumsum(counts) - counts, counts) if counts else np.zeros(0)
        offset = CHUNK * number.astype(np.int64)
        if counts:
            table["address"] = starts[self.index] + offset.astype(np.uint64)
            table["size"] = np.minimum(sizes[self.index] - offset, CHUNK)
        self.device = get_device("cpu")
        self.chunks: wp.array = wp.array(table, dtype=checksum.MemoryChunk, device=self.device, copy=False)
        self.sums = self._compute()

    def _compute(self) -> np.ndarray:
        sums = np.zeros(len(self.index), np.uint64)
        if len(sums):  # one launch: memory limits it, not a core
            target: wp.array = wp.array(sums, dtype=wp.uint64, device=self.device, copy=False)
            launch(checksum.sum_chunks, len(sums), [self.chunks, target], self.device, smallest_slice=len(sums))
        return sums

    def changed(self) -> list[int]:
        """Return the numbers of the arrays that differ."""
        resized = [
            i for i, (array, size) in enumerate(zip(self.arrays, self.sizes, strict=True)) if array.nbytes != size
        ]
        if resized:  # ndarray.resize in place: their memory is elsewhere
            return resized
        return np.unique(self.index[self._compute() != self.sums]).tolist()


def _field_names(owner: Any) -> tuple[str, ...]:
    return tuple(field.name for field in fields(owner) if field.name != "name" and not field.name.startswith("_"))


def _is_immutable(array: np.ndarray) -> bool:
    """Whether the array's memory is that of a bytes object, as in arrays that come from files: nobody can write it."""
    base: Any = array
    while isinstance(base, np.ndarray):
        if base.flags.writeable:
            return False
        base = base.base
    return isinstance(base, bytes)


def _crc(value: object) -> int:
    array = np.asarray(value)
    if array.dtype.kind not in "biuf":
        return 0
    return zlib.crc32(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data, array.nbytes)
