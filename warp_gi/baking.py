"""Bakes: what an estimator computes before the first frame, in memory and on disk.

A file is in the safetensors format: mapped arrays, and no code runs on loading. It appears whole or
not at all, equal bakes write equal bytes, and any changed byte is found on loading. All that is not an
array is one entry of its metadata, in JSON: the library writes several in another order every time.
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
from warp_gi.files import replacing, user_path

Setting = str | int | float
"""Value of a setting in a bake; bool is an int."""

FORMAT = "warp_gi bake"
FORMAT_VERSION = 2
_TEXTS = ("technique", "scene_key", "scene_name")
_WHOLE = tuple(f"{kind}{bits}" for kind in ("uint", "int") for bits in (8, 16, 32, 64))
_TYPES = ("bool", *_WHOLE, "float16", "float32", "float64")
_SHARD = re.compile(r"(.+), shard (\d{1,7}) of (\d{1,7})")


@dataclass(eq=False)
class Bake:
    """Results that an estimator computed before the first frame, and the scene and settings that they are valid for."""

    technique: str
    """Class name of the estimator; of a shard with its number, as "VisibilityField, shard 2 of 3"."""
    scene_key: str
    """Hash of just what the bake depends on; for visibility ``Scene.geometry_hash``."""
    settings: dict[str, Any]
    """Settings of the estimator that the bake depends on: str, int, float or bool, by name."""
    arrays: dict[str, np.ndarray]
    """Arrays by name: bool, int8 to int64, uint8 to uint64 or float16 to float64, of any shape."""
    counts: dict[str, int | float] = field(default_factory=dict)
    """Numbers that say what was done, by name: samples, rays, cells, seconds."""
    scene_name: str = ""
    """Name of the scene, for messages only."""

    def __repr__(self) -> str:
        """Return a line; arrays by their shapes."""
        arrays = ", ".join(f"{name} {list(np.shape(array))}" for name, array in self.arrays.items())
        settings = ", ".join(f"{name}={value!r}" for name, value in self.settings.items())
        return f"<Bake {self.technique}({settings}) of {self.scene_name!r}, {self.nbytes / 1e6:.3g} MB: {arrays}>"

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
        from safetensors import SafetensorError
        from safetensors.numpy import save_file

        path = Path(path)
        arrays = {name: _stored(name, self.arrays[name]) for name in sorted(self.arrays)}
        record = {
            "format_version": FORMAT_VERSION,
            **{name: getattr(self, name) for name in _TEXTS},
            "settings": _plain("setting", self.settings),
            "counts": _plain("count", self.counts),
            "warp_gi": __version__,
        }
        record["sha256"] = _seal(record, _digest(arrays))
        with replacing(path, own_folder=True) as part:  # save_file writes to a file of another name first
            try:
                save_file(arrays, part, {FORMAT: json.dumps(record, sort_keys=True)})
            except SafetensorError as error:
                code = re.search(r"os error (\d+)", str(error))
                raise OSError(int(code[1]) if code else 0, str(error), str(path)) from error
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

    def check_whole(self) -> None:
        """Raise BakeError for a shard of a bake."""
        if found := shard_of(self.technique):
            name, number, count = found
            raise BakeError(
                f"this is shard {number} of {count} of a bake by {name!r}: merge all {count} first (warp-gi merge)"
            )

    def check(self, technique: str, scene_key: str, settings: Mapping[str, Setting], scene_name: str = "") -> None:
        """Raise BakeError saying why, unless the bake is by ``technique``, of this scene and with these settings.

        For a scene of the same name other settings come first: the hash of what a bake depends on may follow from them.
        """
        self.check_whole()
        if technique != self.technique:
            raise BakeError(
                f"this bake is by {self.technique!r}, not by {technique!r}: name its own file or bake it again"
            )
        differing = [
            f"{name}: bake has {_shown(self.settings, name)}, asked for {_shown(settings, name)}"
            for name in sorted({*self.settings, *settings})
            if name not in self.settings or name not in settings or self.settings[name] != settings[name]
        ]
        is_of_scene = bool(self.scene_name) and scene_name == self.scene_name
        if scene_key != self.scene_key and is_of_scene and not differing:
            raise BakeError(
                f"this bake is of scene {scene_name!r} as it was (hash {self.scene_key[:12]}, now {scene_key[:12]}): "
                "what it depends on has changed since; bake it again"
            )
        if scene_key != self.scene_key and not is_of_scene:
            raise BakeError(
                f"this bake is of {'scene ' if self.scene_name else ''}{_scene(self.scene_name, self.scene_key)}, "
                f"not of {_scene(scene_name, scene_key)}: bake it again"
            )
        if differing:
            raise BakeError(f"this bake has other settings ({'; '.join(differing)}): bake it again or ask for its own")


def load_bake(path: str | Path) -> Bake:
    """Read a bake back; its arrays are contiguous and may be written to.

    Raises BakeError when the file is missing, empty, truncated, damaged, by another program or of a
    newer format, and OSError when it may not be read.
    """
    from safetensors import SafetensorError, safe_open

    path = user_path(path)
    if not path.exists():
        raise BakeError(f"{path}: no such file; bake first, or correct the path")
    if not path.is_file():
        raise BakeError(f"{path}: is {'a folder' if path.is_dir() else 'no regular file'}, expected a bake file")
    if path.stat().st_size == 0:
        raise BakeError(f"{path}: is empty; delete it and bake again")
    try:
        with safe_open(path, framework="np") as file:
            metadata = file.metadata() or {}
            record = _record(path, metadata)
            arrays = {name: file.get_tensor(name) for name in sorted(file.keys())}
            digest = _digest(arrays)
    except SafetensorError as error:
        raise BakeError(
            f"{path}: is truncated, damaged or no bake at all ({' '.join(str(error).split())}); "
            "correct the path, or delete it and bake again"
        ) from error
    except (TypeError, AttributeError) as error:  # a type that a bake does not hold
        raise _damaged(path) from error
    seal = record.pop("sha256", None)
    if seal != (digest if FORMAT not in metadata else _seal(record, digest)):
        raise _damaged(path)
    try:
        technique, scene_key, scene_name = (str(record[name]) for name in _TEXTS)
        settings, counts = dict(record["settings"]), dict(record["counts"])
        if not (_are(settings, str | int | float) and _are(counts, int | float)):
            raise _damaged(path)
        return Bake(technique, scene_key, settings, arrays, counts, scene_name)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise _damaged(path) from error


def shard_of(technique: str) -> tuple[str, int, int] | None:
    """Return class name, number and count of a bake's ``technique`` that names a shard; None of a whole bake."""
    found = _SHARD.fullmatch(technique)
    return None if found is None else (found[1], int(found[2]), int(found[3]))


def settings_in(path: str | Path) -> dict[str, Setting]:
    """Return the settings that a bake file names, without its arrays; ``load_bake`` checks that it is whole.

    Raises BakeError when the file is no bake, or damaged at its beginning.
    """
    from safetensors import SafetensorError, safe_open

    path = user_path(path)
    try:
        with safe_open(path, framework="np") as file:
            return dict(_record(path, file.metadata() or {})["settings"])
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise _damaged(path) from error


def _are(values: Mapping[str, Any], kinds: Any) -> bool:
    """Return whether all values are of some kinds, and finite."""
    return all(
        isinstance(value, kinds) and (isinstance(value, str) or math.isfinite(value)) for value in values.values()
    )


def _record(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    """Return all that a file holds beside arrays; raises BakeError unless it is a bake that this version reads."""
    if FORMAT not in metadata and metadata.get("format") != FORMAT:
        raise BakeError(
            f"{path}: is a safetensors file by another program, not a warp_gi bake; "
            "correct the path, or bake to another file"
        )
    try:
        if FORMAT in metadata:
            record = json.loads(metadata[FORMAT])
            version = int(record["format_version"])
        else:  # version 1 had an entry for each
            version = int(metadata["format_version"])
            texts = {key: text for key, text in metadata.items() if key not in ("format", "metadata_sha256")}
            record = texts | {key: json.loads(texts[key]) for key in ("settings", "counts")}
            if metadata["metadata_sha256"] != hashlib.sha256(json.dumps(texts, sort_keys=True).encode()).hexdigest():
                raise _damaged(path)
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise _damaged(path) from error
    if version > FORMAT_VERSION:
        raise BakeError(
            f"{path}: is a bake of format version {version}, this warp_gi ({__version__}) reads "
            f"up to {FORMAT_VERSION}; update warp_gi or bake again"
        )
    return record


def _damaged(path: Path) -> BakeError:
    return BakeError(f"{path}: is damaged: it does not hold what was written; delete it and bake again")


def _stored(name: str, array: np.ndarray) -> np.ndarray:
    """Return ``array`` contiguous and little-endian, itself where it is so already.

    Raises TypeError for a type that a bake does not hold, BakeError for a name that a file cannot hold.
    """
    if not isinstance(name, str) or not name.isprintable() or name == "__metadata__":
        raise BakeError(f"array name {name!r} cannot be stored; expected printable text other than '__metadata__'")
    array = np.asarray(array)
    if array.dtype.name not in _TYPES:
        raise TypeError(f"array {name!r} is {array.dtype}; a bake holds {', '.join(_TYPES)}: convert it first")
    return np.asarray(array, array.dtype.newbyteorder("<"), order="C")


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    """Return a SHA-256 over names, types, shapes and values, in hexadecimal digits."""
    digest = hashlib.sha256(b"warp_gi bake arrays 1")
    for name in sorted(arrays):
        array = _stored(name, arrays[name])
        digest.update(json.dumps([name, array.dtype.name, array.shape]).encode())
        digest.update(array.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def _seal(record: Mapping[str, Any], digest: str) -> str:
    """Return a SHA-256 over all that a file holds, in hexadecimal digits; ``digest`` is that of its arrays."""
    return hashlib.sha256((json.dumps(record, sort_keys=True) + digest).encode()).hexdigest()


def _plain(kind: str, values: Mapping[str, Any]) -> dict[str, str | int | float]:
    """Return settings or counts as JSON has them; raises TypeError or BakeError for what would not come back equal."""
    plain = {name: value.item() if isinstance(value, np.generic) else value for name, value in values.items()}
    for name, value in plain.items():
        if not isinstance(name, str) or not isinstance(value, (str, int, float)):
            raise TypeError(
                f"{kind} {name!r} is a {type(value).__name__}; a bake holds str, int, float and bool by name"
            )
        if isinstance(value, float) and not math.isfinite(value):
            raise BakeError(f"{kind} {name!r} is {value}; a bake holds finite numbers only")
    return plain


def _scene(name: str, key: str) -> str:
    return f"{repr(name) if name else 'an unnamed scene'} (hash {key[:12]})"


def _shown(settings: Mapping[str, Setting], name: str) -> str:
    if name not in settings:
        return "none"
    return repr(settings[name]) if isinstance(settings[name], str) else str(settings[name])
