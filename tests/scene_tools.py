"""Small scenes and files for tests, made by code."""

from __future__ import annotations

import io
import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import warp_gi as gi
from warp_gi.bench.harness.scenes import light, sphere
from warp_gi.bench.harness.scenes import quad as parallelogram
from warp_gi.scene.model import Material, Mesh

__all__ = ["GREY", "GlbBuilder", "card", "light", "loss_by_depth", "png", "quad", "sphere", "triangle", "unit"]

GREY = Material("grey", (0.7, 0.6, 0.5), specular=0.0)

TRIANGLE_POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
TRIANGLE_UVS = np.array([[0, 0], [1, 0], [0, 1]], np.float32)


def triangle(material: Material | None = None, **fields: Any) -> Mesh:
    """Return a right triangle in the xy plane, facing +z, with unit legs."""
    defaults = {"points": TRIANGLE_POINTS.copy(), "indices": np.array([[0, 1, 2]], np.int32)}
    return Mesh(**{**defaults, "material": material or Material(), **fields})


def quad(corner: Any, edge_u: Any, edge_v: Any, material: Material = GREY, name: str = "quad") -> Mesh:
    """Return a parallelogram whose front is the side that ``edge_u`` x ``edge_v`` points to."""
    return parallelogram(corner, edge_u, edge_v, material, name)


def card(z: float = 0.0, half: float = 1.0, material: Material | None = None) -> Mesh:
    """Return a square in the plane of z, facing +z; 0.5, 0.25, 0.125 Lambert unless told."""
    material = material or Material(base_color=(0.5, 0.25, 0.125), specular=0.0)
    return quad((-half, -half, z), (2 * half, 0, 0), (0, 2 * half, 0), material)


def unit(vectors: Any) -> np.ndarray:
    """Return vectors [..., 3] of length one, in float64 unless they are float32."""
    vectors = np.asarray(vectors)
    if vectors.dtype != np.float32:
        vectors = vectors.astype(np.float64)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def png(pixels: np.ndarray) -> bytes:
    """Return uint8 pixels [height, width, 3 or 4] as the bytes of a PNG file."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


def loss_by_depth(scene: gi.Scene, camera: gi.Camera, paths: gi.BsdfPaths) -> float:
    """Return the share of the mean indirect light that is lost to ``paths.max_depth``.

    Frames of one seed follow the same paths, so that only their ends differ, and little noise is left.
    """
    kept, whole = (
        next(gi.render(scene, camera.at_resolution(48, 27), gi.Pipeline(indirect=one, spp=32), seed=3))
        .numpy("indirect")
        .mean(dtype=np.float64)
        for one in (paths, replace(paths, max_depth=256))
    )
    return 1.0 - kept / whole


class GlbBuilder:
    """Gathers accessors, images and JSON, and writes a GLB file."""

    def __init__(self) -> None:
        self.json: dict[str, Any] = {"asset": {"version": "2.0"}, "scene": 0, "accessors": [], "bufferViews": []}
        self.binary = b""

    def view(self, data: bytes) -> int:
        """Add bytes and return their buffer view."""
        self.binary += b"\0" * (-len(self.binary) % 4)
        self.json["bufferViews"].append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)})
        self.binary += data
        return len(self.json["bufferViews"]) - 1

    def accessor(self, values: Any, dtype: Any = np.float32, **fields: Any) -> int:
        """Add an array [count] or [count, width] and return its accessor."""
        values = np.asarray(values, dtype)
        width = 1 if values.ndim == 1 else values.shape[1]
        codes = {"f4": 5126, "u4": 5125, "u2": 5123, "u1": 5121, "i2": 5122}
        accessor = {
            "bufferView": self.view(values.tobytes()),
            "componentType": codes[np.dtype(dtype).str[1:]],
            "count": len(values),
            "type": {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}[width],
            **fields,
        }
        self.json["accessors"].append(accessor)
        return len(self.json["accessors"]) - 1

    def add(self, kind: str, item: dict[str, Any]) -> int:
        """Append to a top-level list and return the index."""
        self.json.setdefault(kind, []).append(item)
        return len(self.json[kind]) - 1

    def mesh(self, material: int | None = None, points: Any = TRIANGLE_POINTS, indices: Any = (0, 1, 2)) -> int:
        """Add a mesh with the uvs of a right triangle."""
        primitive = {
            "attributes": {"POSITION": self.accessor(points), "TEXCOORD_0": self.accessor(TRIANGLE_UVS)},
            "indices": self.accessor(indices, np.uint16),
        }
        if material is not None:
            primitive["material"] = material
        return self.add("meshes", {"name": "tri", "primitives": [primitive]})

    def bytes(self) -> bytes:
        """Return the file."""
        self.json["buffers"] = [{"byteLength": len(self.binary)}]
        self.json.setdefault("scenes", [{"nodes": list(range(len(self.json.get("nodes", []))))}])
        text = json.dumps(self.json).encode()
        text += b" " * (-len(text) % 4)
        binary = self.binary + b"\0" * (-len(self.binary) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def write(self, path: Path) -> Path:
        """Write the file and return its path."""
        path.write_bytes(self.bytes())
        return path
