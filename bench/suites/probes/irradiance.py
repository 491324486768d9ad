"""The irradiance where camera rays end, by paths and as light field probes have it.

In a picture errors of the irradiance and of the reflectance may cancel. This is the diffuse term alone: W/m^2 by
reflected light, as if a Lambert surface of albedo 1 were there, while all others keep their materials.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_gi.bench.harness.scenes import REFERENCE_DEPTH
from warp_gi.bench.harness.stages import Stage
from warp_gi.bench.suites.probes.kernels import gather_irradiance, read_irradiance
from warp_gi.kernels.path_trace import TERM_INDIRECT
from warp_gi.techniques.light_field.estimator import VISIBILITIES
from warp_gi.techniques.light_field.state import path_settings
from warp_gi.techniques.shared.lamps import lit_data


def path_traced(stage: Stage, spp: int, seed: int) -> np.ndarray:
    """Return the irradiance by ``spp`` paths a pixel, float32 [height, width, 3]; 0 where nothing is hit.

    ``stage`` is one of LightFieldProbes; paths start at the first hits of its frame.
    """
    frame = stage.frame
    width, height = frame.camera.resolution
    paths = path_settings(frame.scene)
    paths.terms, paths.max_depth, paths.spp = int(TERM_INDIRECT), REFERENCE_DEPTH, spp
    found = wp.zeros(width * height, dtype=wp.vec3, device=frame.device)
    bits = (spp - 1).bit_length()
    data = lit_data(frame.scene, frame.device)
    frame.launch(gather_irradiance, [data, width, paths, bits, wp.uint32(seed), frame.hits, found])
    return found.numpy().reshape(height, width, 3)


def of_probes(stage: Stage, visibility: str) -> tuple[np.ndarray, np.ndarray]:
    """Return what the stage's probes say, float32 [height, width, 3], and how many see a point, int32 [height, width].

    -1 probes where there is no surface, 0 where too few see it.
    """
    frame = stage.frame
    width, height = frame.camera.resolution
    found = wp.zeros(width * height, dtype=wp.vec3, device=frame.device)
    probes = wp.empty(width * height, dtype=wp.int32, device=frame.device)
    inputs = [frame.data, stage.state.field, VISIBILITIES[visibility], frame.hits, found, probes]
    frame.launch(read_irradiance, inputs)
    return found.numpy().reshape(height, width, 3), probes.numpy().reshape(height, width)
