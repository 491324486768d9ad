"""Node animation of glTF as keyframes."""

from __future__ import annotations

import numpy as np
import pygltflib

from warp_gi.scene.animation import slerp
from warp_gi.scene.files.gltf_buffers import Buffers
from warp_gi.scene.model import Keyframe

CUBIC_STEPS = 16  # linear pieces that a cubic spline becomes between two of its keys
STEP_SECONDS = 1e-5  # how long before its next key a STEP value is last held


class _Channel:
    """One animated property: times [key] and values [key, width], to be read at any time."""

    def __init__(self, times: np.ndarray, values: np.ndarray, interpolation: str, is_rotation: bool) -> None:
        self.times, self.is_rotation, self.interpolation = times.astype(np.float64), is_rotation, interpolation
        values = values.astype(np.float64).reshape(len(times), -1, 4 if is_rotation else 3)
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

    def value(self, time: float) -> np.ndarray:
        """Return the property at ``time`` [s]."""
        after = int(np.searchsorted(self.times, time, side="right"))
        if after == 0 or after == len(self.times) or self.interpolation == "STEP":
            return self.values[max(after - 1, 0)]
        span = self.times[after] - self.times[after - 1]
        t = (time - self.times[after - 1]) / span
        a, b = self.values[after - 1], self.values[after]
        if self.tangents is not None:
            out, into = span * self.tangents[after - 1, 2], span * self.tangents[after, 0]
            t2, t3 = t * t, t * t * t
            return (2 * t3 - 3 * t2 + 1) * a + (t3 - 2 * t2 + t) * out + (3 * t2 - 2 * t3) * b + (t3 - t2) * into
        return slerp(a, b, t) if self.is_rotation else (1.0 - t) * a + t * b


def read_keyframes(document: pygltflib.GLTF2, buffers: Buffers) -> dict[int, list[Keyframe]]:
    """Return the keyframes of each animated node; where several animations move one property, the first counts."""
    channels: dict[int, dict[str, _Channel]] = {}
    for animation in document.animations:
        for channel in animation.channels:
            node, path = channel.target.node, channel.target.path
            if node is None or path not in ("translation", "rotation", "scale"):
                continue
            sampler = animation.samplers[channel.sampler]
            times, values = buffers.accessor(sampler.input), buffers.accessor(sampler.output)
            if len(times) and path not in channels.setdefault(node, {}):
                kind = sampler.interpolation or "LINEAR"
                channels[node][path] = _Channel(times, values, kind, path == "rotation")
    return {node: _merge(document.nodes[node], paths) for node, paths in channels.items() if paths}


def _merge(node: pygltflib.Node, channels: dict[str, _Channel]) -> list[Keyframe]:
    """Return keyframes at all times of the node's channels; a property without one keeps its value at rest."""
    rest = {
        "translation": np.array(node.translation or (0.0, 0.0, 0.0)),
        "rotation": np.array(node.rotation or (0.0, 0.0, 0.0, 1.0)),
        "scale": np.array(node.scale or (1.0, 1.0, 1.0)),
    }
    times = sorted({time for channel in channels.values() for time in channel.key_times()})
    keyframes = []
    for time in times:
        pose = {path: channels[path].value(time) if path in channels else value for path, value in rest.items()}
        keyframes.append(Keyframe(float(time), **{path: tuple(value.tolist()) for path, value in pose.items()}))
    return keyframes
