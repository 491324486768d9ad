"""The map of a sky: its pixels, and what is derived from them once, for all rotations and scales of it."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import warp as wp

from warp_gi.alias import AliasTable
from warp_gi.color import LUMINANCE, luminance_of
from warp_gi.kernels import apart_lights
from warp_gi.launch import on_device
from warp_gi.scene import harmonics
from warp_gi.scene.sky import node_solid_angles
from warp_gi.scene.sun import LEAST_SHARE as ANY_SHARE
from warp_gi.scene.sun import MapSplit, split_map
from warp_gi.scene.watching import Watch

T = TypeVar("T")


SUN_BRIGHTER_THAN = 30.0
"""Times the mean radiance of a sky above which a texel may be of a sun that is worth a ray of its own."""
MOST_RAYS = 4
"""Largest number of suns that are: each costs a ray a sample."""
LEAST_SHARE = 0.02
"""Share of the sky's light that each holds."""
CONE_MARGIN = 1e-6
"""By which the cosine of a cone about a sun is too small, for the rounding of directions."""
WIDEST = math.radians(1.0)
"""Largest half-angle of one: soft shadows are noisy, and better filtered with all other light."""


@dataclass(frozen=True, eq=False)
class SunTables:
    """Suns of a map that are worth a ray of their own, and what kernels read of them."""

    parts: MapSplit
    rest: SkyMap
    """The map without them."""
    suns: wp.array
    """apart_lights.Sun [suns]."""
    nodes: wp.array
    """Texels of suns, int32 [texels]."""
    sums: wp.array
    """Running sums of probabilities of a sun's texels, float32 [texels]."""


class SkyMap:
    """The pixels of a map, and what is derived from them once; shared by all rotations and scales of the map."""

    def __init__(self, pixels: np.ndarray) -> None:
        self.pixels = pixels
        self.arrays: dict[str, tuple[wp.array, wp.array, wp.array]] = {}
        self.watch: Watch | None = None
        self._derived: dict[Hashable, Any] = {}

    @cached_property
    def digest(self) -> bytes:
        digest = hashlib.sha256(np.array(self.pixels.shape, np.int64).tobytes())
        digest.update(np.ascontiguousarray(self.pixels).data)
        return digest.digest()

    @cached_property
    def mean(self) -> np.ndarray:
        """Radiance averaged over the sphere, W/(m^2 sr), float64 [3]; exact for the bilinear map."""
        height, width = self.pixels.shape[:2]
        return self.pixels.sum(1, dtype=np.float64).T @ node_solid_angles(height, width) / (4 * math.pi)

    def once(self, key: Hashable, make: Callable[[np.ndarray], T]) -> T:
        """Return ``make(pixels)``, computed once a key."""
        if key not in self._derived:
            self._derived[key] = make(self.pixels)
        return self._derived[key]

    def harmonics_of(self, order: int) -> np.ndarray:
        """Spherical harmonics in the map's own space, float64 [3, order^2]."""
        return self.once(("harmonics", order), lambda pixels: harmonics.project(pixels, order))

    def split(
        self, brighter_than: float, most: int, least_share: float = ANY_SHARE, widest: float = math.pi
    ) -> tuple[MapSplit, SkyMap]:
        """Return the map's suns, and the map without them; arguments are those of ``sun.split_map``."""

        def make(pixels: np.ndarray) -> tuple[MapSplit, SkyMap]:
            parts = split_map(pixels, brighter_than, most, least_share, widest)
            return parts, self if parts.pixels is pixels else SkyMap(parts.pixels)

        return self.once(("split", brighter_than, most, least_share, widest), make)

    def small_suns(self) -> tuple[MapSplit, SkyMap]:
        """Return the suns that are worth a ray, and the map without them."""
        return self.split(SUN_BRIGHTER_THAN, MOST_RAYS, LEAST_SHARE, WIDEST)

    def sun_tables(self, device: wp.Device) -> SunTables | None:
        """Return the suns that are worth a ray, made once a device; None if there are none."""
        parts, rest = self.small_suns()
        if not parts.nodes:
            return None
        return self.once(("sun tables", device.alias), lambda pixels: _sun_tables(pixels, parts, rest, device))

    def on(self, device: wp.Device) -> tuple[wp.array, wp.array, wp.array]:
        """Return texels, alias table over them and densities by row, arrays on the device."""
        if device.alias not in self.arrays:
            weights, row_pdfs = node_weights(self.pixels)
            texels = on_device(self.pixels.reshape(-1, 3), wp.vec3, device)
            rows = on_device(row_pdfs.astype(np.float32), wp.float32, device)
            table = AliasTable.build(weights, overwrite=True)
            del weights  # of a large map these are 0.3 GB
            self.arrays[device.alias] = (texels, table.on(device), rows)
            self.watch = self.watch or Watch([(self, ("pixels", "arrays"))])
        return self.arrays[device.alias]

    def is_edited(self) -> bool:
        """Whether the pixels differ from what is on devices."""
        return self.watch is not None and bool(self.watch.changes())


def node_areas(height: int, width: int) -> np.ndarray:
    """Return float64 [height]: the integral of a node's tent, sr, as ``node_weights`` counts it."""
    sines = _patch_sines(height)
    return 0.5 * (sines[:-1] + sines[1:]) * (math.pi / (height - 1)) * (2 * math.pi / width)


def _patch_sines(height: int) -> np.ndarray:
    """Return sines of the polar angle between rows of nodes, float64 [height + 1]; 0 beyond the poles."""
    sines = np.sin((np.arange(-1, height) + 0.5) * (math.pi / (height - 1)))
    sines[[0, -1]] = 0.0
    return sines


def node_weights(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return float64 [height, width]: luminance times the integral of the node's tent, and ``Environment.row_pdfs``.

    Steradians are those in the middle of a row of patches, for all of the patch: ``environment.patch_pdf`` counts the
    same. The densities are float64 [height + 1].
    """
    height, width = pixels.shape[:2]
    weights = luminance_of(pixels)
    weights *= node_areas(height, width)[:, None]
    return weights, _patch_sines(height) / weights.sum()


def _sun_tables(pixels: np.ndarray, parts: MapSplit, rest: SkyMap, device: wp.Device) -> SunTables:
    """Return the tables of a map's suns: each is what its texels have above those of the rest."""
    all_nodes = np.concatenate(parts.nodes)
    colors, others = pixels.reshape(-1, 3), rest.pixels.reshape(-1, 3)
    rows = all_nodes // pixels.shape[1]
    areas = node_areas(*pixels.shape[:2])
    weights = (colors[all_nodes] - others[all_nodes]).astype(np.float64) @ LUMINANCE * areas[rows]
    whole = float(luminance_of(rest.pixels).sum(1, dtype=np.float64) @ areas)
    suns = np.zeros(len(parts.nodes), apart_lights.Sun.numpy_dtype())
    ends = np.cumsum([len(nodes) for nodes in parts.nodes])
    sums = np.empty(len(all_nodes))
    for k, (stop, nodes) in enumerate(zip(ends, parts.nodes, strict=True)):
        mine = slice(stop - len(nodes), stop)
        running = np.cumsum(weights[mine])
        sums[mine] = running / running[-1]
        suns[k] = (parts.directions[k], parts.cos_cones[k] - CONE_MARGIN, mine.start, stop, whole / running[-1])
    return SunTables(
        parts,
        rest,
        on_device(suns, apart_lights.Sun, device),
        on_device(all_nodes.astype(np.int32), wp.int32, device),
        on_device(sums.astype(np.float32), wp.float32, device),
    )
