"""The JSON side of glTF: a document whose parts are checked when they are read.

Every message says which part of the file is wrong, what glTF asks for there, and what stands there.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from warp_gi.errors import SceneError
from warp_gi.scene.files.support import Findings

Part = dict[str, Any]
"""An object of the JSON text."""

LARGEST = sys.float_info.max
SINGULAR = {"meshes": "mesh", "bufferViews": "buffer view"}


class Document:
    """A glTF 2.0 document.

    Raises SceneError unless it is JSON of a version that this reader can read.
    """

    def __init__(self, text: bytes, path: Path) -> None:
        self.path, self.findings = path, Findings()
        self._checked: dict[str, list[Part]] = {}
        try:
            root = json.loads(text.decode("utf-8-sig"))
        except (ValueError, RecursionError) as error:
            raise SceneError(
                f"{str(path)!r} is not glTF: its JSON text is damaged ({error}); export it again"
            ) from error
        if not isinstance(root, dict):
            raise SceneError(f"{str(path)!r} is not glTF: its JSON text must be an object; export it again")
        self.root: Part = root
        asset = self.part(root, "asset", "the file")
        if asset is None:
            raise SceneError(f"{str(path)!r} is not glTF: it has no asset with a version; export it as glTF 2.0")
        self._check_version(asset)

    def _check_version(self, asset: Part) -> None:
        for key in ("version", "minVersion"):
            version = asset.get(key)
            if version is None and key == "minVersion":
                continue
            match = re.fullmatch(r"(\d+)\.(\d+)", version) if isinstance(version, str) else None
            if match is None:
                raise self.error("asset", f"{key} must be a text such as '2.0', got {version!r}")
            major, minor = int(match[1]), int(match[2])
            if major != 2 or (key == "minVersion" and minor > 0):
                needs = "needs glTF version" if key == "minVersion" else "is glTF version"
                raise SceneError(
                    f"{str(self.path)!r} {needs} {version}; only version 2.0 is supported, export it again"
                )

    def error(self, owner: str, what: str) -> SceneError:
        """Return an error about a part of the file."""
        return SceneError(f"{str(self.path)!r}: {owner}: {what}")

    # ---- parts ----

    def items(self, kind: str) -> list[Part]:
        """Return a list at the top of the document, such as "nodes"; empty if there is none."""
        if kind in self._checked:
            return self._checked[kind]
        values = self.root.get(kind) or []
        if not isinstance(values, list) or not all(isinstance(value, dict) for value in values):
            raise self.error(kind, "must be a list of objects")
        self._checked[kind] = values
        return values

    def item(self, kind: str, index: object, owner: str) -> Part:
        """Return one of a list at the top of the document; raises SceneError if there is none of that number."""
        values = self.items(kind)
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(values):
            name = SINGULAR.get(kind, kind[:-1])
            raise self.error(owner, f"names {name} {index!r}, and the file has {len(values)} {kind}")
        return values[index]

    def name(self, kind: str, index: int) -> str:
        """Return a part's name as messages show it, such as "material 'paint'"."""
        given = self.items(kind)[index].get("name")
        singular = SINGULAR.get(kind, kind[:-1])
        return f"{singular} {given!r}" if isinstance(given, str) and given else f"{singular} {index}"

    # ---- fields ----

    def part(self, source: Part, key: str, owner: str) -> Part | None:
        """Return a field that is an object, or None if it is absent."""
        value = source.get(key)
        if value is not None and not isinstance(value, dict):
            raise self.error(owner, f"{key} must be an object, got {value!r:.60}")
        return value

    def extension(self, source: Part, name: str, owner: str) -> Part | None:
        """Return an extension of a part, or None."""
        return self.part(self.part(source, "extensions", owner) or {}, name, owner)

    def number(self, source: Part, key: str, owner: str, default: float | None = None) -> float:
        """Return a field that is a number; None as the default says that it must be there."""
        value: Any = source.get(key, default)
        if not _is_number(value):
            raise self.error(owner, f"{key} must be a number, got {value!r:.60}" if key in source else f"lacks {key}")
        return float(value)

    def numbers(self, source: Part, key: str, owner: str, default: Sequence[float]) -> tuple[float, ...]:
        """Return a field that is a list of as many numbers as its default has."""
        value = source.get(key)
        if value is None:
            return tuple(default)
        if not isinstance(value, list) or len(value) != len(default) or not all(map(_is_number, value)):
            raise self.error(owner, f"{key} must be {len(default)} numbers, got {value!r:.60}")
        return tuple(float(one) for one in value)

    def weights(self, source: Part, owner: str) -> tuple[float, ...] | None:
        """Return the weights of morph targets, or None if there are none."""
        value = source.get("weights")
        if value is not None and (not isinstance(value, list) or not all(map(_is_number, value))):
            raise self.error(owner, f"weights must be a list of numbers, got {value!r:.60}")
        return None if value is None else tuple(float(one) for one in value)

    def objects(self, source: Part, key: str, owner: str) -> list[Part]:
        """Return a field that is a list of objects; empty if it is absent."""
        value = source.get(key)
        if value is not None and (not isinstance(value, list) or not all(isinstance(one, dict) for one in value)):
            raise self.error(owner, f"{key} must be a list of objects, got {value!r:.60}")
        return value or []

    def whole(self, source: Part, key: str, owner: str, default: int | None = None) -> int:
        """Return a field that is a whole number from 0 up; None as the default says that it must be there."""
        value = source.get(key, default)
        if isinstance(value, float) and value.is_integer():
            value = int(value)  # some writers have floats alone
        if isinstance(value, bool) or not isinstance(value, int) or value < 0:
            wrong = f"{key} must be a whole number from 0 up, got {value!r:.60}"
            raise self.error(owner, wrong if key in source else f"lacks {key}")
        return value

    def indices(self, source: Part, key: str, owner: str) -> list[int]:
        """Return a field that is a list of numbers of other parts; empty if it is absent."""
        value = source.get(key) or []
        if not isinstance(value, list) or any(isinstance(one, bool) or not isinstance(one, int) for one in value):
            raise self.error(owner, f"{key} must be a list of whole numbers, got {value!r:.60}")
        return value

    def text(self, source: Part, key: str) -> str:
        """Return a field that is a text; empty if it is absent or something else."""
        value = source.get(key)
        return value if isinstance(value, str) else ""

    # ---- extensions ----

    def listed_extensions(self, key: str) -> list[str]:
        """Return the names in ``extensionsUsed`` or ``extensionsRequired``."""
        names = self.root.get(key)
        if names is not None and (not isinstance(names, list) or not all(isinstance(name, str) for name in names)):
            raise self.error("the file", f"{key} must be a list of texts, got {names!r:.60}")
        return names or []

    def used_extensions(self) -> dict[str, list[str]]:
        """Return the extensions that parts of the file carry or that it says it uses, and the parts that carry them."""
        found: dict[str, list[str]] = {}
        for key in ("extensionsUsed", "extensionsRequired"):
            for name in self.listed_extensions(key):
                found.setdefault(name, [])
        for kind, values in self.root.items():
            if isinstance(values, list):
                for index, value in enumerate(values):
                    if isinstance(value, dict):
                        for name in _extensions(value):
                            places = found.setdefault(name, [])
                            place = self.name(kind, index)
                            if not places or places[-1] != place:
                                places.append(place)
        for name in self.part(self.root, "extensions", "the file") or {}:
            found.setdefault(name, [])
        return found


def _is_number(value: object) -> bool:
    """Return whether a value is a finite number; JSON of some programs has NaN, and whole numbers of any length."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -LARGEST <= value <= LARGEST


def _extensions(value: Any) -> Iterator[str]:
    """Yield the names of extensions in a part and in all below it; notes of programs ("extras") are no parts."""
    pending = [value]
    while pending:
        one = pending.pop()
        if isinstance(one, list):
            if one and isinstance(one[0], dict | list):
                pending.extend(one)
        elif isinstance(one, dict):
            for key, below in one.items():
                if key == "extensions" and isinstance(below, dict):
                    yield from below
                if key != "extras" and isinstance(below, dict | list):
                    pending.append(below)
