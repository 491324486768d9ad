"""Embree 4 at its best: trees of medium and high quality, single rays and packets of 16, through ctypes.

The library is the one that embreex brings; embreex itself builds trees of medium quality alone. Rays are traced in a
native loop (kernels.py), so no call of Python is counted.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.bench.suites.rays import kernels

QUALITIES = {"medium": 1, "high": 2}  # of enum RTCBuildQuality
ROBUST = 1 << 2  # of enum RTCSceneFlags
VERTICES, FLOAT3 = 1, 0x9003  # of enum RTCBufferType, RTCFormat
INDICES, UINT3 = 0, 0x5003
SHARE = 256  # rays that a thread traces, as in kernels.py


@functools.cache
def library() -> ctypes.CDLL:
    """Return Embree's library; raises ImportError without embreex."""
    found = find_spec("embreex")
    if found is None or not found.submodule_search_locations:
        raise ImportError("embreex is not installed")
    import embreex.rtcore_scene  # noqa: F401  # loads what the library needs

    folder = Path(next(iter(found.submodule_search_locations)))
    places = (folder.parent / "embreex.libs", folder / ".dylibs", folder)
    files = [
        file
        for place in places
        for pattern in ("*embree4*.so*", "*embree4*.dylib", "*embree4*.dll")
        for file in sorted(place.glob(pattern))
    ]
    if not files:
        raise ImportError(f"embreex in {folder} brings no library of Embree 4")
    loaded = ctypes.CDLL(str(files[0]))
    pointer, whole, size = ctypes.c_void_p, ctypes.c_uint, ctypes.c_size_t
    for name, result, *arguments in (
        ("rtcNewDevice", pointer, ctypes.c_char_p),
        ("rtcGetDeviceError", ctypes.c_int, pointer),
        ("rtcReleaseDevice", None, pointer),
        ("rtcNewScene", pointer, pointer),
        ("rtcSetSceneFlags", None, pointer, ctypes.c_int),
        ("rtcSetSceneBuildQuality", None, pointer, ctypes.c_int),
        ("rtcNewGeometry", pointer, pointer, ctypes.c_int),
        ("rtcSetSharedGeometryBuffer", None, pointer, ctypes.c_int, whole, ctypes.c_int, pointer, size, size, size),
        ("rtcCommitGeometry", None, pointer),
        ("rtcAttachGeometry", whole, pointer, pointer),
        ("rtcReleaseGeometry", None, pointer),
        ("rtcCommitScene", None, pointer),
        ("rtcReleaseScene", None, pointer),
    ):
        function = getattr(loaded, name)
        function.restype, function.argtypes = result, arguments
    return loaded


class EmbreeScene:
    """A tree of Embree's over triangles, built on one thread.

    Args:
        points: Vertex positions, float32 [vertex, 3].
        indices: Vertices of each triangle, int32 [triangle, 3].
        quality: "medium" is Embree's default, "high" splits triangles between boxes.
        robust: Whether edges are watertight, as ours always are.

    Raises ImportError without embreex, RuntimeError if Embree reports an error.
    """

    def __init__(self, points: np.ndarray, indices: np.ndarray, quality: str = "medium", robust: bool = False) -> None:
        found = library()
        padded = np.concatenate([points, points[:1]]).astype(np.float32)  # Embree reads 16 bytes of the last vertex
        self._kept = padded, np.ascontiguousarray(indices, dtype=np.uint32)
        self._device = found.rtcNewDevice(b"threads=1")
        self._scene = found.rtcNewScene(self._device)
        found.rtcSetSceneFlags(self._scene, ROBUST if robust else 0)
        found.rtcSetSceneBuildQuality(self._scene, QUALITIES[quality])
        geometry = found.rtcNewGeometry(self._device, 0)  # triangles
        buffers = (VERTICES, FLOAT3, len(points)), (INDICES, UINT3, len(indices))
        for (kind, form, count), values in zip(buffers, self._kept, strict=True):
            found.rtcSetSharedGeometryBuffer(geometry, kind, 0, form, values.ctypes.data, 0, 12, count)
        found.rtcCommitGeometry(geometry)
        found.rtcAttachGeometry(self._scene, geometry)
        found.rtcReleaseGeometry(geometry)
        found.rtcCommitScene(self._scene)
        if error := found.rtcGetDeviceError(self._device):
            raise RuntimeError(f"Embree reports error {error} as it builds {len(indices):,} triangles")

    def __del__(self) -> None:
        if hasattr(self, "_scene"):
            library().rtcReleaseScene(self._scene)
            library().rtcReleaseDevice(self._device)

    def trace(
        self, query: str, origins: np.ndarray, directions: np.ndarray, t_max: Any = np.inf, packets: bool = False
    ) -> np.ndarray:
        """Return int32 [ray]: 0 or 1 for the query "any", the face or -1 for "closest".

        ``origins`` and ``directions`` are float32 [ray, 3]; ``t_max`` a number or float32 [ray]. ``packets`` traces 16
        neighbours at once and says that they are coherent.
        """
        device = wp.get_device("cpu")
        count = len(origins)
        rays: list[wp.array] = [wp.array(x, dtype=wp.vec3, device=device, copy=False) for x in (origins, directions)]
        limits = np.broadcast_to(np.float32(t_max), count) if np.ndim(t_max) == 0 else t_max
        far: wp.array = wp.array(np.ascontiguousarray(limits, np.float32), dtype=wp.float32, device=device, copy=False)
        found = wp.empty(count, dtype=wp.int32, device=device)
        name = ("rtcIntersect" if query == "closest" else "rtcOccluded") + ("16" if packets else "1")
        function = ctypes.cast(getattr(library(), name), ctypes.c_void_p).value or 0
        kernel = kernels.trace_packets if packets else kernels.trace_rays
        inputs = [wp.uint64(function), wp.uint64(self._scene), *rays, far, int(query == "closest"), found]
        launch.launch(kernel, -(-count // SHARE), inputs, device, 1)
        return found.numpy()


def builder(points: np.ndarray, indices: np.ndarray, quality: str, robust: bool) -> Callable[[], EmbreeScene]:
    """Return what builds a scene; raises ImportError without embreex."""
    library()
    return functools.partial(EmbreeScene, points, indices, quality, robust)
