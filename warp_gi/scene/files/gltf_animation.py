"""Animation of glTF as keyframes: poses of nodes, and weights of morph targets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_gi.scene.animation import slerp, turned_quaternion
from warp_gi.scene.files.gltf_buffers import Buffers
from warp_gi.scene.files.gltf_document import Document, Part
from warp_gi.scene.model import Keyframe, MorphKeyframe

CUBIC_STEPS = 16  # linear pieces that a cubic spline becomes between two of its keys
WIDTHS = {"translation": 3, "rotation": 4, "scale": 3}
WEIGHTS = "weights"
STEP_SECONDS = 1e-5  # how long before its next key a STEP value is last held


class _Channel:
    """One animated property: times [key] and values [key, width], to be read at any time."""

    def __init__(self, times: np.ndarray, values: np.ndarray, interpolation: str, is_rotation: bool) -> None:
        """Take values [key, width], or [3 * key, width] of a cubic spline."""
        self.times, self.is_rotation, self.interpolation = times.astype(np.float64), is_rotation, interpolation
        values = values.astype(np.float64).reshape(len(times), -1, values.shape[1])
        self.values = values[:, 1] if interpolation == "CUBICSPLINE" else values[:, 0]
        self.tangents = values if interpolation == "CUBICSPLINE" else None

    def key_times(self) -> list[float]:
        """Return the times at which linear pieces of the property must begin or end."""
        if self.interpolation == "STEP":
            gaps = np.minimum(STEP_SECONDS, np.diff(self.times) / 2)
            return [*self.times, *(self.times[1:] - gaps)]
        if self.interpolation == "CUBICSPLINE" and len(self.times) > 1:
            steps = np.arange(len(self.times) * CUBIC_STEPS - CUBIC_STEPS + 1) / CUBIC_STEPS
            return list(np.interp(steps, np.arange(len(self.times)), self.times))
        return list(self.times)

    def values_at(self, times: np.ndarray) -> np.ndarray:
        """Return the property at ``times`` [s], float64 [time, width]."""
        after = np.searchsorted(self.times, times, side="right")
        before = np.maximum(after - 1, 0)
        if self.interpolation == "STEP" or len(self.times) == 1:
            return self.values[before]
        last = len(self.times) - 1
        after = np.minimum(np.maximum(after, 1), last)
        start = after - 1
        span = (self.times[after] - self.times[start])[:, None]
        t = np.clip((times - self.times[start])[:, None] / span, 0.0, 1.0)
        a, b = self.values[start], self.values[after]
        if self.tangents is not None:
            out, into = span * self.tangents[start, 2], span * self.tangents[after, 0]
            t2, t3 = t * t, t * t * t
            return (2 * t3 - 3 * t2 + 1) * a + (t3 - 2 * t2 + t) * out + (3 * t2 - 2 * t3) * b + (t3 - t2) * into
        return slerp(a, b, t) if self.is_rotation else (1.0 - t) * a + t * b


@dataclass
class Animations:
    """All that moves in a file, by the number of its node."""

    keyframes: dict[int, list[Keyframe]]
    """Poses of nodes."""
    morphs: dict[int, list[MorphKeyframe]]
    """Weights of morph targets."""


def read_animations(document: Document, buffers: Buffers) -> Animations:
    """Return what moves; where several animations move one property, the first counts."""
    channels: dict[int, dict[str, _Channel]] = {}
    animations = document.items("animations")
    if len(animations) > 1:
        document.findings.add("several animations")
    for index, animation in enumerate(animations):
        name = document.name("animations", index)
        samplers = document.objects(animation, "samplers", name)
        for channel in document.objects(animation, "channels", name):
            target = document.part(channel, "target", name) or {}
            path = target.get("path")
            if target.get("node") is None or path == "pointer":
                continue  # what extensions aim at
            if not isinstance(path, str) or path not in (*WIDTHS, WEIGHTS):
                document.findings.add("animation of other properties", f"{path!r:.40} of {name}")
                continue
            node = document.whole(target, "node", name)
            document.item("nodes", node, name)
            if path in channels.setdefault(node, {}):
                continue
            number = document.whole(channel, "sampler", name)
            if number >= len(samplers):
                raise document.error(name, f"names sampler {number}, and it has {len(samplers)}")
            values = 1
            if path == WEIGHTS:
                values = _target_count(document, node, name)
            found = _channel(document, buffers, samplers[number], path, name, values)
            if found is not None:
                channels[node][path] = found
    morphs = {node: _morphs(paths.pop(WEIGHTS)) for node, paths in channels.items() if WEIGHTS in paths}
    return Animations({node: _merge(document, node, paths) for node, paths in channels.items() if paths}, morphs)


def _target_count(document: Document, node: int, name: str) -> int:
    """Return the number of morph targets of a node's mesh; raises SceneError if it has none."""
    source, owner = document.items("nodes")[node], document.name("nodes", node)
    count = 0
    if source.get("mesh") is not None:
        mesh = document.item("meshes", document.whole(source, "mesh", owner), owner)
        primitives = document.objects(mesh, "primitives", owner)
        count = max((len(document.objects(one, "targets", owner)) for one in primitives), default=0)
    if not count:
        raise document.error(name, f"moves weights of {owner}, whose mesh has no morph targets")
    return count


def _channel(
    document: Document, buffers: Buffers, sampler: Part, path: str, name: str, each: int = 1
) -> _Channel | None:
    """Return one animated property with ``each`` values a key; None if it has no keys."""
    times = buffers.accessor(sampler.get("input"), name, (1,))
    values = buffers.accessor(sampler.get("output"), name, (WIDTHS.get(path, 1),))
    kind = sampler.get("interpolation") or "LINEAR"
    if kind not in ("LINEAR", "STEP", "CUBICSPLINE"):
        raise document.error(name, f"interpolation must be LINEAR, STEP or CUBICSPLINE, got {kind!r:.60}")
    needed = len(times) * (3 if kind == "CUBICSPLINE" else 1) * each
    if len(values) != needed:
        raise document.error(name, f"has {len(times)} times and {len(values)} values of {path}; expected {needed}")
    if len(times) and not (np.isfinite(times).all() and np.isfinite(values).all() and (np.diff(times) > 0.0).all()):
        raise document.error(name, f"the times of {path} must rise, and all numbers be finite")
    return _Channel(times, values.reshape(-1, WIDTHS.get(path, each)), kind, path == "rotation") if len(times) else None


def _morphs(channel: _Channel) -> list[MorphKeyframe]:
    """Return the keyframes of weights; one if they never change."""
    times = np.unique(np.asarray(channel.key_times()))
    values = channel.values_at(times)
    if (values == values[0]).all():
        times, values = times[:1], values[:1]
    return [MorphKeyframe(time, tuple(row)) for time, row in zip(times.tolist(), values.tolist(), strict=True)]


def _taken_apart(placed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return translation, rotation (x, y, z, w) and scale of a matrix [3, 4]; shear is lost."""
    linear = placed[:, :3]
    scale = np.linalg.norm(linear, axis=0)
    if np.linalg.det(linear) < 0.0:
        scale[0] = -scale[0]
    axes = np.divide(linear, scale, out=np.eye(3), where=np.abs(scale) > 0.0)
    left, _, right = np.linalg.svd(axes)  # the nearest rotation
    turn = left @ np.diag((1.0, 1.0, np.linalg.det(left @ right))) @ right
    return placed[:, 3], np.array(turned_quaternion(turn, (0.0, 0.0, 0.0, 1.0))), scale


def _merge(document: Document, index: int, channels: dict[str, _Channel]) -> list[Keyframe]:
    """Return keyframes at all times of the node's channels; a property without one keeps its value at rest."""
    node, owner = document.items("nodes")[index], document.name("nodes", index)
    rest = {
        "translation": np.array(document.numbers(node, "translation", owner, (0.0, 0.0, 0.0))),
        "rotation": np.array(document.numbers(node, "rotation", owner, (0.0, 0.0, 0.0, 1.0))),
        "scale": np.array(document.numbers(node, "scale", owner, (1.0, 1.0, 1.0))),
    }
    if node.get("matrix") is not None:
        matrix = np.array(document.numbers(node, "matrix", owner, (0.0,) * 16)).reshape(4, 4).T
        rest.update(zip(rest, _taken_apart(matrix[:3]), strict=True))
        document.findings.lost.append(
            f"{str(document.path)!r}: {owner} is animated and has a matrix, where it should have translation, rotation"
            " and scale; they are taken from it"
        )
    times = np.unique(np.concatenate([channel.key_times() for channel in channels.values()]))
    poses = {
        path: channels[path].values_at(times) if path in channels else np.tile(value, (len(times), 1))
        for path, value in rest.items()
    }
    rows = zip(times.tolist(), *(map(tuple, poses[path].tolist()) for path in rest), strict=True)
    return [Keyframe(*row) for row in rows]
