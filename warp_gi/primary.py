"""Primaries: what finds the points that a frame shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from warp_gi.kernels import camera_rays, gbuffer, layers
from warp_gi.layers import has_layers
from warp_gi.scene.baked import whole_scene
from warp_gi.stateful import Stateful

if TYPE_CHECKING:
    import warp as wp

    from warp_gi.frame import Frame
    from warp_gi.scene.baked import BakedScene
    from warp_gi.scene.scene import Scene


@dataclass(frozen=True)
class Primary(Stateful):
    """Base of every primary: finds the points that a frame shows, and fills ``Frame.hits`` and the surface buffers."""

    is_whole: ClassVar[bool] = False
    """Whether it fills the buffers of light, too. Then no estimator is asked, and no path is traced."""

    def trace(self, frame: Frame, state: Any) -> None:
        """Find the primary hits of the current camera sample, and fill the buffers of surfaces."""
        raise NotImplementedError


@dataclass(frozen=True)
class CameraRays(Primary):
    """Camera rays through the scene, jittered inside of each pixel."""

    def kernels(self, scene: Scene | BakedScene | None = None) -> tuple[wp.Kernel, ...]:
        """Return the kernels that trace rays and shade hits."""
        blends = scene is not None and any(one.has_chance for one in whole_scene(scene).materials)
        return camera_rays.trace_primary, layers.shade_layers if blends else gbuffer.shade_primary

    def trace(self, frame: Frame, state: Any) -> None:
        """Trace the rays and shade what they hit."""
        settings, cameras = frame.pass_settings, [frame.camera_data, frame.previous_camera_data]
        share = camera_rays.PACKET if frame.device.is_cpu else 1
        inputs: list[object] = [frame.data, frame.camera_data, settings, share, frame.hits]
        frame.launch_tiled(camera_rays.trace_primary, inputs, share)
        buffers = frame.struct(gbuffer.SurfaceBuffers)
        inputs = [frame.layer_data, *cameras, settings, frame.hits, buffers]
        if has_layers(frame.data):
            frame.launch(layers.shade_layers, [*inputs, frame.layer_emission()])
        else:
            frame.launch(gbuffer.shade_primary, inputs)
