"""Compressed data of glTF: Draco meshes and meshopt's buffer views, by decoders that are installed apart."""

from __future__ import annotations

import importlib
from types import ModuleType

import numpy as np

from warp_gi.errors import SceneError
from warp_gi.scene.files.gltf_document import Document, Part

DRACO, MESHOPT, BASISU = "KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_texture_basisu"
INSTALL = {DRACO: ("DracoPy", "pip install 'warp-gi[draco]'"), MESHOPT: ("meshoptimizer", "pip install meshoptimizer")}
"""Module of the decoder of an extension, and how to install it."""
LARGEST_VIEW = 1 << 31
"""Largest number of bytes of a decoded buffer view."""
STRIDES = {"ATTRIBUTES": range(4, 257, 4), "TRIANGLES": (2, 4), "INDICES": (2, 4)}
"""Bytes of an element that a mode of meshopt can have."""
FILTERS = {
    "OCTAHEDRAL": ("decode_filter_oct", (4, 8)),
    "QUATERNION": ("decode_filter_quat", (8,)),
    "EXPONENTIAL": ("decode_filter_exp", range(4, 257, 4)),
}
"""Function of a filter, and the bytes of an element that it can have."""


def decoder(document: Document, extension: str) -> ModuleType:
    """Return the module that decodes an extension; raises SceneError, which says how to install it."""
    name, command = INSTALL[extension]
    try:
        return importlib.import_module(name)
    except (ImportError, OSError) as error:
        raise SceneError(
            f"{str(document.path)!r} is compressed by {extension}, which needs the package {name}: {command},"
            " or export the file without compression"
        ) from error


def is_installed(extension: str) -> bool:
    """Return whether there is a decoder of an extension."""
    try:
        importlib.import_module(INSTALL[extension][0])
    except (ImportError, OSError):
        return False
    return True


def draco_attributes(document: Document, data: memoryview, names: Part, owner: str) -> dict[str, np.ndarray]:
    """Return the decoded attributes [vertex, width] by their glTF names, and "indices" [3 * triangle].

    ``names`` are the numbers of the attributes in the Draco mesh. Raises SceneError.
    """
    module = decoder(document, DRACO)
    try:
        mesh = module.decode(bytes(data))
        faces = np.asarray(mesh.faces, np.uint32).reshape(-1)
    except Exception as error:  # of a type of its own, and of others for what is cut off
        raise document.error(owner, f"its Draco data is damaged ({error}); export it again") from error
    found: dict[str, np.ndarray] = {"indices": faces}
    known = {int(one["unique_id"]): one["data"] for one in mesh.attributes}
    for name, number in names.items():
        if not isinstance(number, int) or number not in known:
            raise document.error(owner, f"{name} is attribute {number!r:.20} of its Draco data, which has none of it")
        values = np.asarray(known[number])
        found[name] = values.reshape(len(values), -1)
    if len(faces) and int(faces.max()) >= min(map(len, found.values())):
        raise document.error(owner, "its Draco data names vertices that it does not have; export it again")
    return found


def meshopt_view(document: Document, data: memoryview, about: Part, name: str) -> memoryview:
    """Return the bytes of a buffer view that ``data`` holds compressed, as ``about`` says; raises SceneError."""
    mode, how = about.get("mode"), about.get("filter") or "NONE"
    stride, count = (document.whole(about, key, name) for key in ("byteStride", "count"))
    if not isinstance(mode, str) or mode not in STRIDES:
        raise document.error(name, f"mode of {MESHOPT} must be one of {', '.join(STRIDES)}, got {mode!r:.40}")
    if stride not in STRIDES[mode]:
        raise document.error(name, f"byteStride of {MESHOPT} cannot be {stride} where mode is {mode}")
    if not isinstance(how, str) or (how != "NONE" and (how not in FILTERS or mode != "ATTRIBUTES")):
        raise document.error(name, f"filter of {MESHOPT} cannot be {how!r:.40} where mode is {mode}")
    if how != "NONE" and stride not in FILTERS[how][1]:
        raise document.error(name, f"byteStride of {MESHOPT} cannot be {stride} where filter is {how}")
    if count * stride > LARGEST_VIEW:
        raise document.error(name, f"has {count * stride} bytes once decoded; {LARGEST_VIEW} can be read")
    module, packed = decoder(document, MESHOPT), np.frombuffer(data, np.uint8)
    try:
        if mode == "ATTRIBUTES":
            values = module.decode_vertex_buffer(count, stride, packed, dtype=np.dtype((np.void, stride)))
            if how != "NONE":
                values = getattr(module, FILTERS[how][0])(values, count, stride)
        else:
            decode = module.decode_index_buffer if mode == "TRIANGLES" else module.decode_index_sequence
            values = decode(count, stride, packed)  # of uint32 in any case: two bytes an index fill half of it
    except (RuntimeError, ValueError) as error:
        raise document.error(name, f"its data by {MESHOPT} is damaged ({error}); export it again") from error
    return memoryview(values.tobytes())[: count * stride]
