"""What light field probes say of the light at a point: the irradiance between those that see it, and a radiance cache.

Probes hold light that surfaces reflect: what the sky and emitters send to the point directly is not in it.
"""

import warp as wp

from warp_gi.kernels.bsdf import average_reflectance
from warp_gi.kernels.bvh import BvhHit, bvh_occluded
from warp_gi.kernels.light_field import (
    LightField,
    blend_weight,
    cage_of,
    cage_probe,
    grid_position,
    is_outside,
    map_visibility,
    probe_irradiance,
)
from warp_gi.kernels.octahedral import octahedral_encode
from warp_gi.kernels.path_samplers import KnownRadiance, PathCache
from warp_gi.kernels.surface import Surface, ray_origin, shading_normal
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})

VISIBILITY_PROBES = wp.constant(0)
VISIBILITY_EXACT = wp.constant(1)
IN_SIGHT = wp.constant(wp.float32(0.3))  # chance by the maps from which on a probe counts as seeing a point


# Light at a point as probes know it.
@wp.struct
class SeenLight:
    irradiance: wp.vec3  # W/m^2, by reflected light; 0 where nothing is known
    probes: wp.int32  # number of probes in front of the surface that see the point
    trust: wp.float32  # 1 where enough probes see the point, 0 where none does, and between in between


# Irradiance between the probes that see a point with a unit normal, by their maps or by shadow rays (`visibility`).
@wp.func
def seen_light(
    scene: SceneData, field: LightField, visibility: wp.int32, position: wp.vec3, normal: wp.vec3, origin: wp.vec3
) -> SeenLight:
    r = SeenLight()
    at = grid_position(field, position)
    if is_outside(field, at):
        return r
    cage = cage_of(field, at)
    uv = octahedral_encode(normal)
    weights = float(0.0)
    around = float(0.0)
    corners = int(8)
    for corner in range(corners):
        probe = cage_probe(field, cage, corner)
        weight = blend_weight(field, cage, corner, at, position, normal)
        around += weight
        sight = float(0.0)
        if weight > 0.0:
            if visibility == VISIBILITY_PROBES:
                sight = map_visibility(field, probe, position, normal)
            elif not bvh_occluded(scene.bvh, origin, field.positions[probe] - origin, 1.0):
                sight = 1.0
        if sight > 0.0:
            r.irradiance = r.irradiance + probe_irradiance(field, probe, uv) * (weight * sight)
            weights = weights + weight * sight
        if sight >= IN_SIGHT and wp.dot(field.positions[probe] - position, normal) > 0.0:
            r.probes += 1
    if weights <= 0.0:
        return r
    r.irradiance = r.irradiance / weights
    r.trust = wp.min(weights / (around * field.least_seen), 1.0)
    return r


# Radiance [W/(m^2 sr)] that a surface reflects of that irradiance, in every direction alike.
@wp.func
def cached_radiance(s: Surface, seen: SeenLight) -> wp.vec3:
    return wp.cw_mul(average_reflectance(s.bsdf), seen.irradiance) / wp.pi


@wp.struct
class ProbeCache:
    field: LightField
    visibility: wp.int32  # VISIBILITY_*: how probes that see a point are found


@wp.func
def probe_lookup(
    data: ProbeCache, scene: SceneData, s: Surface, wo: wp.vec3, hit: BvhHit, pdf: wp.float32, u: wp.vec2
) -> KnownRadiance:
    seen = seen_light(scene, data.field, data.visibility, s.position, shading_normal(s), ray_origin(s))
    return KnownRadiance(cached_radiance(s, seen), seen.trust, 0.0)


PROBE_CACHE = PathCache("probes", ProbeCache, probe_lookup)
