"""Bakes: what an estimator computes before the first frame, in memory and on disk.

A file is in the safetensors format: mapped arrays, and no code runs on loading. It appears whole or
not at all, equal bakes write equal bytes, and any changed byte is found on loading. The header is
written here, because the library's own writer puts metadata in another order every time.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warp_gi import __version__
from warp_gi.errors import BakeError
from warp_gi.files import replacing

Setting = str | int | float
"""Value of a setting in a bake; bool is an int."""

FORMAT = "warp_gi bake"
FORMAT_VERSION = 1
MOST_HEADER = 100_000_000  # bytes; safetensors reads no longer one
_OPENING = f'{{"__metadata__":{{"format":"{FORMAT}"'.encode()  # how the header of every bake begins
_TEXTS = ("format_version", "technique", "scene_key", "scene_name", "settings", "counts", "warp_gi", "sha256")
_SEAL = "metadata_sha256"
_CODES = {"bool": "BOOL"} | {
    f"{kind}{bits}": f"{code}{bits}"
    for kind, code, sizes in (
        ("uint", "U", (8, 16, 32, 64)),
        ("int", "I", (8, 16, 32, 64)),
        ("float", "F", (16, 32, 64)),
    )
    for bits in sizes
}  # NumPy's name of a type -> that of safetensors


@dataclass(eq=False)
class Bake:
    """Results that an estimator computed before the first frame, and the scene and settings that they are valid for."""

    technique: str
    """Class name of the estimator."""
    scene_key: str
    """Hash of just what the bake depends on; for visibility ``Scene.geometry_hash``."""
    settings: dict[str, Setting]
    """Settings of the estimator that the bake depends on: str, int, float or bool, by name."""
    arrays: dict[str, np.ndarray]
    """Arrays by name: bool, int8 to int64, uint8 to uint64 or float16 to float64, of any shape."""
    counts: dict[str, int | float] = field(default_factory=dict)
    """Numbers that say what was done, by name: samples, rays, cells, seconds."""
    scene_name: str = ""
    """Name of the scene, for messages only."""

    @property
    def nbytes(self) -> int:
        """Size of all arrays, in bytes."""
        return sum(np.asarray(array).nbytes for array in self.arrays.values())

    @property
    def digest(self) -> str:
        """SHA-256 over all arrays, hexadecimal."""
        return _digest(self.arrays)

    def save(self, path: str | Path) -> Path:
        """Write the bake to ``path``, whole or not at all, and return the path; missing folders are made.

        Raises OSError when it cannot be written, TypeError for an array or a value of a type
        that a bake does not hold, BakeError for a number that is not finite.
        """
        path = Path(path)
        arrays = {name: _stored(name, self.arrays[name]) for name in sorted(self.arrays)}
        texts = {
            "format_version": str(FORMAT_VERSION),
            "technique": self.technique,
            "scene_key": self.scene_key,
            "scene_name": self.scene_name,
            "settings": _json("setting", self.settings),
            "counts": _json("count", self.counts),
            "warp_gi": __version__,
            "sha256": _digest(arrays),
        }
        # a name that came from a file name may hold what UTF-8 cannot
        texts = {key: text.encode("utf-8", "backslashreplace").decode() for key, text in texts.items()}
        ordered = sorted(arrays.items(), key=lambda item: -item[1].itemsize)  # so that each is aligned
        header = _header({"format": FORMAT, **texts, _SEAL: _seal(texts)}, ordered)
        with replacing(path) as part:
            try:
                with open(part, "wb") as file:
                    file.write(header)
                    for _, array in ordered:
                        file.write(_bytes(array))
            except OSError as error:
                raise OSError(error.errno, error.strerror, str(path)) from error
        return path

    @staticmethod
    def load(path: str | Path) -> Bake:
        """Read a bake; see ``load_bake``."""
        return load_bake(path)

    def has(self, settings: Mapping[str, Setting]) -> bool:
        """Return whether the bake was made with these settings."""
        return self.settings == dict(settings)

    def check(self, technique: str, scene_key: str, settings: Mapping[str, Setting], scene_name: str = "") -> None:
        """Raise BakeError saying why, unless the bake is by ``technique``, of this scene and with these settings."""
        if technique != self.technique:
            raise BakeError(
                f"this bake is by {self.technique!r}, not by {technique!r}: name its own file or bake it again"
            )
        if scene_key != self.scene_key:
            raise BakeError(
                f"this bake is of {'scene ' if self.scene_name else ''}{_scene(self.scene_name, self.scene_key)}, "
                f"not of {_scene(scene_name, scene_key)}: bake it again"
            )
        differing = [
            f"{name}: bake has {_shown(self.settings, name)}, asked for {_shown(settings, name)}"
            for name in sorted({*self.settings, *settings})
            if name not in self.settings or name not in settings or self.settings[name] != settings[name]
        ]
        if differing:
            raise BakeError(f"this bake has other settings ({'; '.join(differing)}): bake it again or ask for its own")


def load_bake(path: str | Path) -> Bake:
    """Read a bake back; its arrays are contiguous and may be written to.

    Raises BakeError when the file is missing, empty, truncated, damaged, by another program or of a
    newer format, and OSError when it may not be read.
    """
    from safetensors import SafetensorError, safe_open

    path = Path(path)
    if not path.exists():
        raise BakeError(f"{path}: no such file; bake first, or correct the path")
    if not path.is_file():
        raise BakeError(f"{path}: is {'a folder' if path.is_dir() else 'no regular file'}, expected a bake file")
    if path.stat().st_size == 0:
        raise BakeError(f"{path}: is empty; delete it and bake again")
    try:
        with safe_open(path, framework="np") as file:
            metadata = file.metadata() or {}
            _check_format(path, metadata)
            arrays = {name: file.get_tensor(name) for name in sorted(file.keys())}
    except SafetensorError as error:
        raise _unreadable(path) from error
    except (TypeError, AttributeError) as error:  # a type that NumPy lacks
        raise _damaged(path, "its arrays are not of a type that a bake holds") from error
    texts = {key: metadata[key] for key in _TEXTS if key in metadata}
    if len(texts) < len(_TEXTS) or _SEAL not in metadata:
        missing = ", ".join(key for key in (*_TEXTS, _SEAL) if key not in metadata)
        raise _damaged(path, f"its metadata lack {missing}")
    if metadata[_SEAL] != _seal(texts):
        raise _damaged(path, "its metadata are not those that were written")
    try:
        settings, counts = json.loads(texts["settings"]), json.loads(texts["counts"])
    except (ValueError, RecursionError) as error:
        raise _damaged(path, "its settings or counts are unreadable") from error
    if not isinstance(settings, dict) or not isinstance(counts, dict):
        raise _damaged(path, "its settings or counts are unreadable")
    try:
        is_same = texts["sha256"] == _digest(arrays)
    except (TypeError, BakeError):
        is_same = False
    if not is_same:
        raise _damaged(path, "its arrays are not those that were written")
    return Bake(texts["technique"], texts["scene_key"], settings, arrays, counts, texts["scene_name"])


def _check_format(path: Path, metadata: Mapping[str, str]) -> None:
    """Raise BakeError unless ``metadata`` are those of a bake in a format that this version reads."""
    if metadata.get("format") != FORMAT:
        raise BakeError(
            f"{path}: is a safetensors file by another program, not a warp_gi bake; "
            "correct the path, or bake to another file"
        )
    version = str(metadata.get("format_version", ""))
    if not re.fullmatch("[1-9][0-9]{0,8}", version):
        raise _damaged(path, f"its format version is {version!r}")
    if int(version) > FORMAT_VERSION:
        raise BakeError(
            f"{path}: is a bake of format version {version}, this warp_gi ({__version__}) reads "
            f"{FORMAT_VERSION}; update warp_gi or bake again"
        )


def _unreadable(path: Path) -> BakeError:
    """Return why ``path``, a file that safetensors refused, is no whole bake."""
    with open(path, "rb") as file:
        length = int.from_bytes(file.read(8), "little")
        header = file.read(min(length, MOST_HEADER))
    body = path.stat().st_size - 8 - length  # bytes
    try:
        fields = json.loads(header)
        metadata = fields.pop("__metadata__", {})
        is_ours = metadata.get("format") == FORMAT
        missing = max((entry["data_offsets"][1] for entry in fields.values()), default=0) - body
        is_safetensors = is_ours or bool(fields)
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
        is_safetensors = False
    if is_safetensors:  # its header is whole
        try:
            _check_format(path, metadata)
        except BakeError as error:
            return error
        if missing > 0:
            return _truncated(path, f"{missing} bytes are missing")
        return _damaged(path, "its header is wrong")
    if header.startswith(_OPENING):
        if len(header) < length <= MOST_HEADER:
            return _truncated(path, "it ends inside its header")
        return _damaged(path, "its header is unreadable")
    if header and len(header) < length <= MOST_HEADER and _OPENING.startswith(header):
        return _truncated(path, f"it has only {len(header) + 8} bytes")
    if not header and 0 < length <= MOST_HEADER:
        return BakeError(f"{path}: has only {path.stat().st_size} bytes: truncated, or not a warp_gi bake; bake again")
    return BakeError(f"{path}: is not a warp_gi bake; correct the path, or bake to another file")


def _truncated(path: Path, why: str) -> BakeError:
    return BakeError(f"{path}: is truncated: {why}; delete it and bake again")


def _damaged(path: Path, why: str) -> BakeError:
    return BakeError(f"{path}: is damaged: {why}; delete it and bake again")


def _stored(name: str, array: np.ndarray) -> np.ndarray:
    """Return ``array`` contiguous and little-endian, itself where it is so already.

    Raises TypeError for a type that a bake does not hold, BakeError for a name that a file cannot hold.
    """
    if not isinstance(name, str) or not name.isprintable() or name == "__metadata__":
        raise BakeError(f"array name {name!r} cannot be stored; expected printable text other than '__metadata__'")
    array = np.asarray(array)
    if array.dtype.name not in _CODES:
        raise TypeError(f"array {name!r} is {array.dtype}; a bake holds {', '.join(_CODES)}: convert it first")
    return np.asarray(array, array.dtype.newbyteorder("<"), order="C")


def _bytes(array: np.ndarray) -> memoryview:
    """Return a view of a contiguous array's bytes."""
    return array.reshape(-1).view(np.uint8).data


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    """Return a SHA-256 over names, types, shapes and values, in hexadecimal digits."""
    digest = hashlib.sha256(b"warp_gi bake arrays 1")
    for name in sorted(arrays):
        array = _stored(name, arrays[name])
        digest.update(json.dumps([name, array.dtype.name, array.shape]).encode())
        digest.update(_bytes(array))
    return digest.hexdigest()


def _seal(texts: Mapping[str, str]) -> str:
    """Return a SHA-256 over the metadata, in hexadecimal digits."""
    return hashlib.sha256(json.dumps(texts, sort_keys=True).encode()).hexdigest()


def _header(metadata: Mapping[str, str], arrays: list[tuple[str, np.ndarray]]) -> bytes:
    """Return what stands before the values in a safetensors file: length, JSON, spaces up to 8 bytes."""
    fields: dict[str, Any] = {"__metadata__": metadata}
    end = 0
    for name, array in arrays:
        start, end = end, end + array.nbytes
        fields[name] = {"dtype": _CODES[array.dtype.name], "shape": array.shape, "data_offsets": [start, end]}
    text = json.dumps(fields, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text


def _json(kind: str, values: Mapping[str, Any]) -> str:
    """Return settings or counts as JSON, sorted; raises TypeError or BakeError for what would not come back equal."""
    plain = {name: value.item() if isinstance(value, np.generic) else value for name, value in values.items()}
    for name, value in plain.items():
        if not isinstance(name, str) or not isinstance(value, (str, int, float)):
            raise TypeError(
                f"{kind} {name!r} is a {type(value).__name__}; a bake holds str, int, float and bool by name"
            )
        if isinstance(value, float) and not math.isfinite(value):
            raise BakeError(f"{kind} {name!r} is {value}; a bake holds finite numbers only")
    return json.dumps(plain, sort_keys=True, allow_nan=False)


def _scene(name: str, key: str) -> str:
    return f"{repr(name) if name else 'an unnamed scene'} (geometry {key[:12]})"


def _shown(settings: Mapping[str, Setting], name: str) -> str:
    if name not in settings:
        return "none"
    return repr(settings[name]) if isinstance(settings[name], str) else str(settings[name])
