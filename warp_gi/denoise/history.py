"""The state of ``SpatioTemporal`` between two frames, and how files hold it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.kernels import denoise
from warp_gi.layout import Layout, misfit
from warp_gi.scene.hashing import light_now, light_of

if TYPE_CHECKING:
    from warp_gi.frame import Frame
    from warp_gi.scene.baked import BakedScene
    from warp_gi.scene.scene import Scene


MOST = 1e30
"""Largest radiance of a saved state."""


@dataclass(frozen=True)
class ApartHistory:
    """What ``SpatioTemporal`` keeps of the light of suns and of lights without size."""

    average: wp.array
    """Light and the number of frames in it, vec4 [height * width]."""
    directions: np.ndarray
    """Unit directions towards the suns, float64 [suns, 3]."""


@dataclass(frozen=True)
class History:
    """State of ``SpatioTemporal``: what it keeps of the last frame."""

    index: int
    """Number of the frame."""
    resolution: tuple[int, int]
    """Width and height of the frame in pixels."""
    scene: tuple[Scene | BakedScene, str]
    """Scene and the hash of what must not have changed: ``light_of``."""
    guides: denoise.Guides
    """Geometry of the surfaces in the frame's pixels: ``READ_GUIDES``."""
    average: denoise.Signals
    """Averages over frames of diffuse and glossy light, and the number of frames in them."""
    apart: ApartHistory | None = None
    """Diffuse light of lights that are apart, if there are any."""
    picture: wp.array | None = None
    """Average of the reflected light of pictures, vec3 [height * width], if pictures are averaged."""

    @staticmethod
    def empty(scene: Scene | BakedScene, device: wp.Device) -> History:
        """Return the state before the first frame, which leads to none."""
        return History(-1, (0, 0), (scene, ""), _empty(denoise.Guides, device), _empty(denoise.Signals, device))

    def saved_arrays(self) -> dict[str, np.ndarray]:
        """Return what the next frame reads, as arrays."""
        parts = {name: getattr(struct, name) for struct, name in _read_next(self.guides, self.average)}
        parts |= {} if self.picture is None else {"picture": self.picture}
        parts |= {} if self.apart is None else {"apart": self.apart.average}
        frame = {
            "frame": np.array([self.index, *self.resolution]),
            "light": np.frombuffer(self._light().encode(), np.uint8),
        }
        if self.apart is not None:
            frame["apart_directions"] = self.apart.directions
        return frame | {name: array.numpy() for name, array in parts.items()}

    def with_saved_arrays(self, arrays: Mapping[str, np.ndarray]) -> History:
        """Return the state that ``saved_arrays`` is of; raises KeyError or ValueError where it cannot be one."""
        device = self.average.length.device
        index, *size = (int(number) for number in arrays["frame"].reshape(3))
        guides, average = _empty(denoise.Guides, device), _empty(denoise.Signals, device)
        for struct, name in _read_next(guides, average):
            setattr(struct, name, _loaded(arrays[name], getattr(struct, name).dtype, size[0] * size[1], device))
        picture, apart = None, None
        if "picture" in arrays:
            picture = _loaded(arrays["picture"], wp.vec3, size[0] * size[1], device)
        if "apart" in arrays:
            lights = _loaded(arrays["apart"], wp.vec4, size[0] * size[1], device)
            apart = ApartHistory(lights, arrays["apart_directions"].reshape(-1, 3))
        light = arrays["light"].tobytes().decode("ascii")
        if light == light_now(self.scene[0]):
            light = light_of(self.scene[0])
        return History(index, (size[0], size[1]), (self.scene[0], light), guides, average, apart, picture)

    def _light(self) -> str:
        """Return the hash of the light for other processes, in which nothing is known of edits before."""
        scene, known = self.scene
        return light_now(scene) if known == light_of(scene) else known

    def fault(self, before: History, states: Mapping[str, Any]) -> str:
        """Return why a state that was read from a file cannot be; "" if it can."""
        width, height = self.resolution
        if not (-1 <= self.index < 1 << 31 and 0 <= width < 1 << 20 and 0 <= height < 1 << 20):
            return f"its last frame is {self.index} of {width}x{height}"
        signals = {name: getattr(self.average, name).numpy() for name in launch.fields_of(denoise.Signals)}
        layouts = {name: Layout("float32", np.shape(values), -MOST, MOST) for name, values in signals.items()}
        layouts["length"] = Layout("float32", np.shape(signals["length"]), 0, 1 << 20)
        apart = None if self.apart is None else self.apart.average
        for name, values in (("picture", self.picture), ("apart", apart)):
            if values is not None:
                signals[name] = values.numpy()
                layouts[name] = Layout("float32", np.shape(signals[name]), -MOST, MOST)
        if self.apart is not None:
            signals["apart_directions"] = self.apart.directions
            layouts["apart_directions"] = Layout("float64", (None, 3), -1.001, 1.001)
        return misfit(signals, layouts)

    def leads_to(self, frame: Frame) -> bool:
        """Return whether the frame's motion is towards the last frame, of the same scene and size."""
        return (
            frame.previous_index == self.index != frame.index
            and frame.camera.resolution == self.resolution
            and frame.scene is self.scene[0]
            and light_of(frame.scene) == self.scene[1]
        )


READ_GUIDES = ("guide_object", "guide_normal", "guide_position", "guide_reflected")
"""Guides that the next frame reads (``denoise.same_surface``)."""


def read_guides(guides: denoise.Guides) -> denoise.Guides:
    """Return guides with nothing but what the next frame reads: 32 of 96 bytes a pixel."""
    kept = _empty(denoise.Guides, guides.guide_object.device)
    for name in READ_GUIDES:
        setattr(kept, name, getattr(guides, name))
    return kept


def _read_next(guides: denoise.Guides, average: denoise.Signals) -> list[tuple[Any, str]]:
    """Return what the next frame reads of a frame's structs: a struct, and the name of an array in it."""
    return [(guides, name) for name in READ_GUIDES] + [(average, name) for name in launch.fields_of(denoise.Signals)]


def _empty(struct: type[launch.Struct], device: wp.Device) -> launch.Struct:
    """Return a kernel struct whose arrays have no items."""
    empty = struct()
    for name, variable in struct.vars.items():  # type: ignore[attr-defined]
        setattr(empty, name, wp.empty(0, dtype=variable.type.dtype, device=device))
    return empty


def _loaded(array: np.ndarray, dtype: type, count: int, device: wp.Device) -> wp.array:
    """Return an array on a device; raises ValueError unless it has ``count`` items."""
    kind = wp.empty(1, dtype=dtype, device="cpu").numpy()
    if array.dtype != kind.dtype or array.shape != (count, *kind.shape[1:]):
        raise ValueError(f"an array of {count} pixels is {array.dtype} {list(array.shape)}, expected {kind.dtype}")
    return wp.array(array, dtype=dtype, device=device)
