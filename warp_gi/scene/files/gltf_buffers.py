"""The binary side of glTF: GLB containers, buffers, buffer views and accessors."""

from __future__ import annotations

import base64
import binascii
import re
import struct
import urllib.parse
from pathlib import Path

import numpy as np

from warp_gi.errors import SceneError
from warp_gi.scene.files.gltf_compressed import MESHOPT, is_installed, meshopt_view
from warp_gi.scene.files.gltf_document import Document, Part
from warp_gi.scene.files.images import OutsideError, find_file

COMPONENTS = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
LARGEST_EMPTY = 1 << 28  # numbers; an accessor without data is all zero
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


def is_data_uri(uri: str) -> bool:
    """Return whether a URI holds its data itself."""
    return uri[:5].lower() == "data:"


def decode_data_uri(uri: str, what: str) -> bytes:
    """Return the bytes of a ``data:`` URI (RFC 2397), of either alphabet of base64; raises SceneError about ``what``.

    Names of schemes and codings are those of any case, and base64 may be percent-encoded, in lines, or not padded.
    """
    header, comma, payload = uri.partition(",")
    if not comma:
        raise SceneError(f"{what}: its data URI ({header[:40]}) is damaged: it has no comma before its data")
    if not re.search(r";\s*base64\s*$", header, re.IGNORECASE):
        return urllib.parse.unquote_to_bytes(payload)
    if "%" in payload:
        payload = urllib.parse.unquote(payload)
    if any(one in payload for one in " \t\r\n"):
        payload = "".join(payload.split())
    payload = payload.rstrip("=")
    try:
        coded = payload.encode("ascii").translate(bytes.maketrans(b"-_", b"+/"))
        return base64.b64decode(coded + b"=" * (-len(coded) % 4), validate=True)
    except (binascii.Error, ValueError) as error:
        raise SceneError(f"{what}: its data URI ({header[:40]}) is damaged ({error}); export it again") from error


def find_uri(folder: Path, uri: str, what: str) -> Path:
    """Return the file of a relative URI, which writers encode or do not; raises SceneError if it is missing."""
    missing: SceneError | None = None
    for name in dict.fromkeys((urllib.parse.unquote(uri), uri, urllib.parse.unquote(re.split("[?#]", uri)[0]))):
        try:
            return find_file(folder, name, what)
        except OutsideError:
            raise
        except SceneError as error:
            missing = missing or error
    raise missing or SceneError(f"{what} {uri!r} is missing")


class Buffers:
    """Reads accessors and buffer views of one document."""

    def __init__(self, document: Document, binary: memoryview | None) -> None:
        self.document, self.path, self.binary = document, document.path, binary
        self._loaded: dict[int, memoryview] = {}
        self._decoded: dict[int, memoryview] = {}  # buffer views of meshopt
        self._filled: dict[int, np.ndarray] = {}  # accessors whose numbers an extension has

    def buffer(self, index: int, owner: str) -> memoryview:
        """Return the bytes of a buffer; raises SceneError if its file is missing or short."""
        if index not in self._loaded:
            description = self.document.item("buffers", index, owner)
            length = self.document.whole(description, "byteLength", f"buffer {index}")
            uri = description.get("uri")
            if uri is None:
                if self.binary is None or index > 0:  # the chunk is buffer 0; others are filled by extensions
                    raise self.document.error(f"buffer {index}", "has neither a uri nor a binary chunk")
                data = self.binary
            elif not isinstance(uri, str):
                raise self.document.error(f"buffer {index}", f"uri must be a text, got {uri!r:.60}")
            elif is_data_uri(uri):
                data = memoryview(decode_data_uri(uri, f"{str(self.path)!r}: buffer {index}"))
            else:
                data = memoryview(find_uri(self.path.parent, uri, f"{str(self.path)!r}: buffer file").read_bytes())
            if len(data) < length:
                raise SceneError(
                    f"{str(self.path)!r}: buffer {index} is truncated: it should have {length} bytes"
                    f" and has {len(data)}"
                )
            self._loaded[index] = data
        return self._loaded[index]

    def view(self, index: object, owner: str) -> memoryview:
        """Return the bytes of a buffer view."""
        view = self.document.item("bufferViews", index, owner)
        name = f"buffer view {index}"
        packed = self.document.extension(view, MESHOPT, name)
        if packed is None or self._has_fallback(view, name):
            return self._bytes(view, name)
        number = int(index)  # type: ignore[call-overload]
        if number not in self._decoded:
            self._decoded[number] = meshopt_view(self.document, self._bytes(packed, name), packed, name)
        return self._decoded[number]

    def _has_fallback(self, view: Part, name: str) -> bool:
        """Return whether a compressed view is there uncompressed, too, and no decoder is installed."""
        document = self.document
        if MESHOPT in document.listed_extensions("extensionsRequired") or is_installed(MESHOPT):
            return False
        number = document.whole(view, "buffer", name)
        buffer = document.item("buffers", number, name)
        marked = (document.extension(buffer, MESHOPT, f"buffer {number}") or {}).get("fallback")
        return not marked and (buffer.get("uri") is not None or (number == 0 and self.binary is not None))

    def _bytes(self, view: Part, name: str) -> memoryview:
        start = self.document.whole(view, "byteOffset", name, 0)
        length = self.document.whole(view, "byteLength", name)
        data = self.buffer(self.document.whole(view, "buffer", name), name)
        if start + length > len(data):
            raise SceneError(
                f"{str(self.path)!r}: {name} passes the end of its buffer:"
                f" it ends at byte {start + length} of {len(data)}"
            )
        return data[start : start + length]

    def accessor(self, index: object, owner: str, widths: tuple[int, ...] = ()) -> np.ndarray:
        """Return an accessor as [count] or [count, width]; normalized integers as float32 in -1 to 1.

        ``owner`` is what asks for it, for messages; ``widths`` are the numbers of components that it can use.
        """
        document, name = self.document, f"accessor {index}"
        description = document.item("accessors", index, owner)
        dtype = self._component(description, name)
        kind = description.get("type")
        if not isinstance(kind, str) or kind not in WIDTHS:
            raise document.error(name, f"type must be one of {', '.join(WIDTHS)}, got {kind!r}")
        width = WIDTHS[kind]
        if widths and width not in widths:
            raise document.error(owner, f"{name} is {kind}, and has to have {' or '.join(map(str, widths))} components")
        count = document.whole(description, "count", name)
        if (filled := self._filled.get(int(index))) is not None:  # type: ignore[call-overload]
            if filled.shape != (count, width):
                shape = f"{filled.shape[0]} of {filled.shape[1]} numbers"
                raise document.error(name, f"has {count} of {width} numbers, and its compressed data {shape}")
            values = filled.astype(dtype)
        elif description.get("bufferView") is None:
            if count * width > LARGEST_EMPTY:
                raise document.error(name, f"has {count} elements and no data")
            values = np.zeros((count, width), dtype)
        else:
            offset = document.whole(description, "byteOffset", name, 0)
            values = self._read(description["bufferView"], offset, count, width, dtype, name)
        sparse = document.part(description, "sparse", name)
        if sparse is not None:
            values = self._sparse(values.copy(), sparse, dtype, name)
        if description.get("normalized") and dtype.kind in "iu":
            values = np.maximum(values.astype(np.float32) / np.iinfo(dtype.name).max, -1.0)
        return values[:, 0] if width == 1 else values

    def fill(self, index: object, owner: str, values: np.ndarray) -> None:
        """Give an accessor its numbers [count, width], which an extension holds."""
        self.document.item("accessors", index, owner)
        self._filled[int(index)] = values  # type: ignore[call-overload]

    def has_data(self, index: object, owner: str) -> bool:
        """Return whether an accessor has numbers in the file; without, it is all zero, or an extension fills it."""
        description = self.document.item("accessors", index, owner)
        if int(index) in self._filled:  # type: ignore[call-overload]
            return True
        return description.get("bufferView") is not None or description.get("sparse") is not None

    def _component(self, description: Part, name: str) -> np.dtype:
        component = description.get("componentType")
        if not isinstance(component, int | float) or component not in COMPONENTS:
            raise self.document.error(
                name, f"componentType must be one of {', '.join(map(str, COMPONENTS))}, got {component!r}"
            )
        return np.dtype(COMPONENTS[int(component)]).newbyteorder("<")

    def _sparse(self, values: np.ndarray, sparse: Part, dtype: np.dtype, name: str) -> np.ndarray:
        """Write the values of a sparse accessor over ``values`` [count, width], and return these."""
        document = self.document
        where, what = (document.part(sparse, key, name) for key in ("indices", "values"))
        if where is None or what is None:
            raise document.error(name, "its sparse part lacks indices or values")
        number = document.whole(sparse, "count", name)
        kind = self._component(where, name)
        if kind.kind not in "iu":
            raise document.error(name, "the indices of its sparse part must be whole numbers")
        offsets = [document.whole(one, "byteOffset", name, 0) for one in (where, what)]
        rows = self._read(where.get("bufferView"), offsets[0], number, 1, kind, name)[:, 0]
        if len(rows) and int(rows.max()) >= len(values):
            raise document.error(name, f"its sparse part names element {rows.max()}, and it has {len(values)}")
        values[rows] = self._read(what.get("bufferView"), offsets[1], number, values.shape[1], dtype, name)
        return values

    def _read(self, view: object, offset: int, count: int, width: int, dtype: np.dtype, name: str) -> np.ndarray:
        data = self.view(view, name)
        size = width * dtype.itemsize
        stride = self.document.whole(self.document.items("bufferViews")[int(view)], "byteStride", name, 0) or size  # type: ignore[call-overload]
        if stride < size and count > 1:
            raise self.document.error(
                name, f"values of {size} bytes overlap: byteStride of its buffer view is {stride}"
            )
        needed = offset + stride * (count - 1) + size if count else 0
        if needed > len(data):
            raise SceneError(
                f"{str(self.path)!r}: {name} needs {needed} bytes, its buffer view has {len(data)}; the file is damaged"
            )
        return np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize))
