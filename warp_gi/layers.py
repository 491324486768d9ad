"""Layers of blended surfaces in a frame: the scene as its camera shows it, and light that fits the mean albedo."""

from __future__ import annotations

import warp as wp

from warp_gi import launch
from warp_gi.kernels import layers, types


def has_layers(data: types.SceneData) -> bool:
    """Return whether a scene has surfaces that let rays pass by chance."""
    return data.bvh.chance != 0


def solid_data(data: types.SceneData) -> types.SceneData:
    """Return a scene where rays stop at every layer, which kernels/layers.py walks through; or the scene itself."""
    if not has_layers(data):
        return data
    solid = launch.copied(data, types.SceneData)
    solid.bvh = launch.copied(data.bvh, types.Bvh)
    solid.bvh.chance = 2
    return solid


class LobeShares:
    """Makes the diffuse light that a denoiser divides by albedo that of the layers' mean, camera sample by sample.

    ``diffuse`` and ``apart`` are those of ``frame.Lobes``.
    """

    def __init__(self, ratio: wp.array) -> None:
        self.ratio = ratio
        """Albedo of the surface drawn over the mean albedo of its ray, vec3 [height * width]."""
        self._sums = layers.LobeSums()

    def begin(self, diffuse: wp.array, apart: wp.array | None) -> None:
        """Remember what is there before a camera sample."""
        self.ratio.zero_()
        self._sums.ratio, self._sums.apart = self.ratio, apart
        self._sums.diffuse_before = wp.clone(diffuse)
        self._sums.apart_before = None if apart is None else wp.clone(apart)

    def end(self, diffuse: wp.array, apart: wp.array | None) -> None:
        """Scale what the camera sample added; an array that is new by now held nothing before."""
        sums = self._sums
        if apart is not None and (sums.apart is None or apart.ptr != sums.apart.ptr):
            sums.apart_before = wp.zeros_like(apart)
        sums.diffuse, sums.apart = diffuse, apart
        launch.launch(layers.share_lobes, len(diffuse), [sums], wp.get_device(diffuse.device))
