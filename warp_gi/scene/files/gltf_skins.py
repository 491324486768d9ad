"""Skins of glTF: joints with their inverse bind matrices, and the joints and weights of vertices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_gi.scene.files.gltf_buffers import Buffers
from warp_gi.scene.files.gltf_document import Document, Part
from warp_gi.scene.model import Skin


@dataclass(eq=False)
class Bones:
    """A skin, whose joints are numbers in the file."""

    name: str
    joints: list[int]
    joint_from_mesh: np.ndarray
    made: Skin | None = None
    """The skin in the scene, once a node uses it."""

    def placed(self, document: Document, numbers: dict[int, int], owner: str) -> Skin:
        """Return the skin with the numbers that its joints have in the scene; ``owner`` is a node that uses it."""
        for joint in self.joints:
            if joint not in numbers:
                raise document.error(
                    self.name, f"its joint {document.name('nodes', joint)} is not in the scene, as {owner} is"
                )
        if self.made is None:  # one for all nodes: what follows from it is computed once
            self.made = Skin([numbers[joint] for joint in self.joints], self.joint_from_mesh, self.name)
        return self.made


class SkinReader:
    """Reads the skins of a document, each once. Their ``skeleton`` is a hint for editors, and is not read."""

    def __init__(self, document: Document, buffers: Buffers) -> None:
        self.document, self.buffers = document, buffers
        self._skins: dict[int, Bones] = {}

    def bones(self, index: int, owner: str) -> Bones:
        """Return skin ``index``, which ``owner`` asks for."""
        document = self.document
        source = document.item("skins", index, owner)
        if index not in self._skins:
            name = document.name("skins", index)
            joints = document.indices(source, "joints", name)
            if not joints:
                raise document.error(name, "joints must list at least one node")
            for joint in joints:
                document.item("nodes", joint, f"{name}: joints")
            self._skins[index] = Bones(name, joints, self._inverse_binds(source, name, len(joints)))
        return self._skins[index]

    def _inverse_binds(self, source: Part, name: str, count: int) -> np.ndarray:
        """Return the matrices from the mesh to each joint, float64 [joint, 4, 4]; identities if there are none."""
        if source.get("inverseBindMatrices") is None:
            return np.tile(np.eye(4), (count, 1, 1))
        owner = f"inverseBindMatrices of {name}"
        values = self.buffers.accessor(source["inverseBindMatrices"], owner, (16,))
        if len(values) < count:
            raise self.document.error(name, f"has {count} joints and {len(values)} inverse bind matrices")
        matrices = np.asarray(values[:count], np.float64).reshape(-1, 4, 4).transpose(0, 2, 1)
        if not np.isfinite(matrices).all():
            wrong = int(np.argmin(np.isfinite(matrices).all(axis=(1, 2))))
            raise self.document.error(owner, f"the matrix of joint {wrong} is not finite")
        matrices[:, 3] = (0.0, 0.0, 0.0, 1.0)
        return matrices


def vertex_joints(
    document: Document, buffers: Buffers, attributes: Part, owner: str, count: int, bones: Bones
) -> tuple[np.ndarray, np.ndarray]:
    """Return the joints and weights of ``count`` vertices, int32 and float32 [vertex, influence].

    A vertex without any weight follows its first joint.
    """
    found: list[tuple[np.ndarray, np.ndarray]] = []
    sets = {
        int(name.partition("_")[2])
        for name in attributes
        if name.startswith(("JOINTS_", "WEIGHTS_")) and name.partition("_")[2].isdecimal()
    }
    for number in sorted(sets | {0}):
        pair = []
        for name, other in ((f"JOINTS_{number}", "WEIGHTS"), (f"WEIGHTS_{number}", "JOINTS")):
            if attributes.get(name) is None:
                has = f"has {other}_{number} without {name}" if sets else f"has no {name}"
                raise document.error(owner, f"{has}, and {bones.name} needs both")
            values = buffers.accessor(attributes[name], f"{name} of {owner}", (4,))
            if len(values) != count:
                raise document.error(owner, f"has {count} positions and {len(values)} values of {name}")
            pair.append(values)
        if pair[0].dtype.kind not in "iu":
            raise document.error(owner, f"JOINTS_{number} must be whole numbers")
        found.append((pair[0], pair[1]))
    joints = np.concatenate([one.astype(np.int64) for one, _ in found], axis=1)
    weights = np.concatenate([_unit_weights(one) for _, one in found], axis=1)
    if not (np.isfinite(weights).all() and (weights >= 0.0).all()):
        vertex = int(np.argmin((np.isfinite(weights) & (weights >= 0.0)).all(axis=1)))
        raise document.error(owner, f"weights must be from 0 up, got {weights[vertex].tolist()} at vertex {vertex}")
    bare = weights.sum(axis=1) == 0.0
    weights[bare, 0] = 1.0
    wrong = (weights > 0.0) & ((joints < 0) | (joints >= len(bones.joints)))
    if wrong.any():
        vertex, which = (int(one[0]) for one in np.nonzero(wrong))
        raise document.error(
            owner, f"vertex {vertex} names joint {joints[vertex, which]}, and {bones.name} has {len(bones.joints)}"
        )
    used = [k for k in range(weights.shape[1]) if k == 0 or (weights[:, k] > 0.0).any()]
    return np.where(weights > 0.0, joints, 0)[:, used].astype(np.int32), np.ascontiguousarray(weights[:, used])


def _unit_weights(values: np.ndarray) -> np.ndarray:
    """Return weights as float32; glTF asks for normalized integers, and some writers forget to say so."""
    if values.dtype.kind in "iu":
        return (values / np.float32(np.iinfo(values.dtype.name).max)).astype(np.float32)
    return np.array(values, np.float32)
