"""The binary side of glTF: GLB containers, buffers, buffer views and accessors."""

from __future__ import annotations

import base64
import binascii
import struct
import urllib.parse
from pathlib import Path

import numpy as np
import pygltflib

from warp_gi.errors import SceneError
from warp_gi.scene.files.images import find_file

COMPONENTS = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942


def split_glb(data: memoryview, path: Path) -> tuple[bytes, memoryview | None]:
    """Return the JSON text and the binary chunk (None if there is none) of a GLB file; raises SceneError."""
    if len(data) < 12 or bytes(data[:4]) != b"glTF":
        raise SceneError(f"{str(path)!r} is not a GLB file: it does not begin with 'glTF'")
    version, length = struct.unpack("<II", data[4:12])
    if version != 2:
        raise SceneError(f"{str(path)!r} is glTF version {version}; only version 2 is supported, export it again")
    if length > len(data):
        raise SceneError(
            f"{str(path)!r} is truncated: it should have {length} bytes, it has {len(data)}; copy it again"
        )
    text, binary = None, None
    at = 12
    while at + 8 <= length:
        size, kind = struct.unpack("<II", data[at : at + 8])
        at += 8
        if at + size > length:
            raise SceneError(f"{str(path)!r} is truncated: a chunk of {size} bytes passes its end; copy it again")
        if kind == JSON_CHUNK and text is None:
            text = bytes(data[at : at + size])
        elif kind == BINARY_CHUNK and binary is None:
            binary = data[at : at + size]
        at += size
    if text is None:
        raise SceneError(f"{str(path)!r} is damaged: a GLB file must hold a JSON chunk")
    return text, binary


def decode_data_uri(uri: str) -> bytes:
    """Return the bytes of a ``data:`` URI; raises SceneError."""
    header, _, payload = uri.partition(",")
    try:
        return base64.b64decode(payload) if header.endswith(";base64") else urllib.parse.unquote_to_bytes(payload)
    except (binascii.Error, ValueError) as error:
        raise SceneError(f"a data URI ({header[:40]}) is damaged: {error}") from error


class Buffers:
    """Reads accessors and buffer views of one document (a pygltflib GLTF2)."""

    def __init__(self, document: pygltflib.GLTF2, path: Path, binary: memoryview | None) -> None:
        self.document, self.path, self.binary = document, path, binary
        self._loaded: dict[int, memoryview] = {}

    def buffer(self, index: int) -> memoryview:
        """Return the bytes of a buffer; raises SceneError if its file is missing or short."""
        if index not in self._loaded:
            description = self.document.buffers[index]
            if description.uri is None:
                if self.binary is None:
                    raise SceneError(f"{str(self.path)!r}: buffer {index} has no data")
                data = self.binary
            elif description.uri.startswith("data:"):
                data = memoryview(decode_data_uri(description.uri))
            else:
                name = urllib.parse.unquote(description.uri)
                data = memoryview(find_file(self.path.parent, name, f"{str(self.path)!r}: buffer file").read_bytes())
            if len(data) < description.byteLength:
                raise SceneError(
                    f"{str(self.path)!r}: buffer {index} is truncated: it should have {description.byteLength} bytes"
                    f" and has {len(data)}"
                )
            self._loaded[index] = data
        return self._loaded[index]

    def view(self, index: int) -> memoryview:
        """Return the bytes of a buffer view."""
        view = self.document.bufferViews[index]
        start = view.byteOffset or 0
        data = self.buffer(view.buffer)
        if start + view.byteLength > len(data):
            raise SceneError(f"{str(self.path)!r}: buffer view {index} passes the end of its buffer")
        return data[start : start + view.byteLength]

    def accessor(self, index: int) -> np.ndarray:
        """Return an accessor as [count] or [count, width]; normalized integers as float32 in -1 to 1."""
        description = self.document.accessors[index]
        dtype, width = np.dtype(COMPONENTS[description.componentType]), WIDTHS[description.type]
        count = description.count
        if description.bufferView is None:
            values = np.zeros((count, width), dtype)
        else:
            offset = description.byteOffset or 0
            stride = self.document.bufferViews[description.bufferView].byteStride
            values = self._read(description.bufferView, offset, count, width, dtype, stride, index)
        if description.sparse is not None:
            values = values.copy()
            where, what = description.sparse.indices, description.sparse.values
            kind = np.dtype(COMPONENTS[where.componentType])
            number = description.sparse.count
            rows = self._read(where.bufferView, where.byteOffset or 0, number, 1, kind, None, index)[:, 0]
            values[rows] = self._read(what.bufferView, what.byteOffset or 0, number, width, dtype, None, index)
        if description.normalized and dtype.kind in "iu":
            values = np.maximum(values.astype(np.float32) / np.iinfo(dtype.name).max, -1.0)
        return values[:, 0] if width == 1 else values

    def _read(
        self, view: int, offset: int, count: int, width: int, dtype: np.dtype, stride: int | None, accessor: int
    ) -> np.ndarray:
        data = self.view(view)
        stride = stride or width * dtype.itemsize
        needed = offset + stride * (count - 1) + width * dtype.itemsize if count else 0
        if needed > len(data):
            raise SceneError(
                f"{str(self.path)!r}: accessor {accessor} needs {needed} bytes, its buffer view has {len(data)};"
                " the file is damaged"
            )
        return np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize))
