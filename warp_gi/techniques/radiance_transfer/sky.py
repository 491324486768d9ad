"""The present sky as transfer textures need it: few numbers, a matrix for lobes, and suns apart."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import warp as wp

from warp_gi.kernels import transfer_lobes
from warp_gi.kernels.transfer_light import TransferSky
from warp_gi.kernels.transfer_products import LIGHT_WIDTH, WIDTHS
from warp_gi.kernels.transfer_snippets import LIGHT_ORDER
from warp_gi.launch import get_device, on_device
from warp_gi.scene import harmonics
from warp_gi.scene.environment import Environment
from warp_gi.stateful import Ahead, Service
from warp_gi.techniques.radiance_transfer import products
from warp_gi.techniques.radiance_transfer.lobes import SMALLEST_ROUGHNESS, lobe_table, phong_table
from warp_gi.techniques.radiance_transfer.prefiltered import prefiltered, sky_lookups
from warp_gi.techniques.radiance_transfer.settings import TransferSettings

if TYPE_CHECKING:
    from warp_gi.baking import Bake
    from warp_gi.frame import Frame
    from warp_gi.scene.baked import BakedScene
    from warp_gi.scene.scene import Scene

CELLS = 32
"""Parts of a sky between its poles whose radiance bounds the light; features of 25 numbers are six times as wide."""


@dataclass(frozen=True, eq=False)
class SkyLight:
    """A sky on a device, ready for this frame's kernels."""

    appearance: tuple[object, ...] | None
    """What decides it: two skies with equal values look the same."""
    sky: TransferSky
    """The sky as kernels read it."""


@dataclass(frozen=True)
class TransferLight(Service):
    """Turns the present sky into what transfer is multiplied by: once a frame, for both terms.

    Two estimators that ask for it with different settings cannot share a bake; the pipeline says so.
    """

    name: ClassVar[str] = "transfer_light"

    bake_settings_of: TransferSettings
    """Settings of the bake that it is the light of."""
    sun: float
    """Radiance, in means of the sky, above which light is a sun's and gets a shadow ray; 0 keeps all in the sky."""
    window: float
    """Strength of the window on the light of glossy lobes."""
    lobe: str
    """Glossy lobe: "ggx" or "phong"."""

    def start(self, scene: Scene | BakedScene, device: str, bake: Bake | None = None, seed: int = 0) -> None:
        """Return None: what it makes of a sky follows from that sky alone."""
        return None

    def bake_key(self, scene: Scene | BakedScene) -> str:
        """Return what never changes: the sky is looked at in every frame."""
        return "sky of each frame"

    def preprocess(self, frame: Frame, state: SkyLight | None) -> SkyLight:
        """Offer a ``SkyLight`` for the frame's sky."""
        environment = getattr(frame.scene, "environment", None)
        appearance = None if environment is None else environment.appearance
        if state is None or state.appearance != appearance:
            state = SkyLight(appearance, self._on_device(environment, frame.device))
        frame.offer(state)
        return state

    def depends_on_past(self, scene: Scene | BakedScene, ahead: Ahead | None = None) -> bool:
        """Return False: it is made of the frame's own sky."""
        return False

    def _on_device(self, environment: Environment | None, device: wp.Device) -> TransferSky:
        order = self.bake_settings_of.order
        environment = environment or Environment()
        split = environment.split_sun(self.sun) if self.sun else None
        rest = split.rest if split else environment
        if split and split.warning:
            warnings.warn(split.warning, stacklevel=2)
        light = rest.harmonics_of(LIGHT_ORDER)
        matrix = products.light_matrix(
            light * harmonics.by_coefficient(products.window(LIGHT_ORDER, self.window)), order
        )
        count, width = order * order, WIDTHS[order]
        rows = np.zeros((count, 3, width), np.float32)
        rows[:, :, :count] = matrix.transpose(1, 0, 2)
        result = TransferSky()
        result.light = on_device(_padded(light, width), wp.float32, device)
        result.whole_light = on_device(_padded(environment.harmonics_of(LIGHT_ORDER), LIGHT_WIDTH), wp.float32, device)
        result.matrix = on_device(rows.reshape(-1), wp.float32, device)
        result.lobes = lobes_on_device(self.lobe, order, device.alias)
        result.environment_from_world = wp.mat33(*rest.world_from_environment.T.ravel())
        result.scale = rest.scale
        least, most = radiance_range(rest)
        result.least, result.most = wp.vec3(*least), wp.vec3(*most)
        maps = prefiltered(rest)
        result.prefiltered.texels = maps.on(device)
        result.prefiltered.levels, result.prefiltered.rows = maps.levels.shape[:2]
        if split:
            result.sun_count = len(split.directions)
            result.sun_directions = on_device(split.directions.astype(np.float32), wp.vec3, device)
            result.sun_irradiances = on_device(split.irradiances.astype(np.float32), wp.vec3, device)
            result.sun_discs = on_device(split.cos_discs.astype(np.float32), wp.float32, device)
        return result


@cache
def lobes_on_device(lobe: str, order: int, device: str) -> transfer_lobes.LobeTable:
    """Return the table of lobes for transfer of an order as kernels read it; made once a device."""
    table = transfer_lobes.LobeTable()
    table.entries = on_device(
        (phong_table if lobe == "phong" else lobe_table)(order).entries, wp.float32, get_device(device)
    )
    table.lookups = on_device(sky_lookups(), wp.float32, get_device(device))
    table.smallest, table.is_white = SMALLEST_ROUGHNESS, int(lobe != "phong")
    return table


def radiance_range(sky: Environment) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the most radiance of parts of a sky, W/(m^2 sr), float64 [3] each.

    Parts are means over CELLS x 2 CELLS pieces of the map, so that a black texel among others does not count.
    """
    found = sky.once_a_map("radiance transfer: range", _range_of)
    if found is None:
        color = np.array(sky.color or (0.0, 0.0, 0.0), np.float64)
        found = color, color
    return found[0] * sky.scale, found[1] * sky.scale


def _range_of(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    cells = pixels.astype(np.float64)
    for axis, most in ((0, CELLS), (1, 2 * CELLS)):
        count = cells.shape[axis]
        if count > most:
            starts = np.arange(most) * count // most
            sizes = np.diff(np.append(starts, count)).reshape((-1, 1) if axis else (-1, 1, 1))
            cells = np.add.reduceat(cells, starts, axis=axis) / sizes
    return cells.min(axis=(0, 1)), cells.max(axis=(0, 1))


def _padded(light: np.ndarray, width: int) -> np.ndarray:
    """Return coefficients [3, n] as float32 [3 * width], zeros behind."""
    rows = np.zeros((3, width), np.float32)
    rows[:, : light.shape[1]] = light
    return rows.reshape(-1)
