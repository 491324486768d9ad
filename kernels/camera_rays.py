"""Camera rays: those of sixteen pixels go together on the CPU (bvh_packets_native.py), each alone on CUDA."""

import warp as wp

from warp_gi.kernels.bvh import mesh_intersect, runs_on_cuda
from warp_gi.kernels.bvh_packets_native import INTERSECT_PIXELS
from warp_gi.kernels.gbuffer import (
    TILE,
    CameraData,
    PassSettings,
    PrimaryHits,
    camera_origin,
    camera_ray,
    primary_sample,
    tiled_pixel,
)
from warp_gi.kernels.types import Bvh, SceneData

wp.set_module_options({"enable_backward": False})

SIDE = 4  # pixels; a packet is a square
PACKET = SIDE * SIDE


# CPU: closest hits of a square of pixels from x, y on. Of each, `hits` has the direction, and the origin as t, u, v.
@wp.func_native(INTERSECT_PIXELS)
def intersect_pixels(bvh: Bvh, hits: PrimaryHits, x: wp.int32, y: wp.int32, width: wp.int32, height: wp.int32): ...


# Left upper pixel of a packet: those of a tile follow each other.
@wp.func
def packet_corner(packet: wp.int32, width: wp.int32) -> wp.vec2i:
    per_tile = (TILE / SIDE) * (TILE / SIDE)
    tile = packet / per_tile
    corner = tiled_pixel(tile * (TILE * TILE), width)
    inside = packet - tile * per_tile
    row = inside / (TILE / SIDE)
    return wp.vec2i(corner[0] + (inside - row * (TILE / SIDE)) * SIDE, corner[1] + row * SIDE)


@wp.func
def start_ray(camera: CameraData, settings: PassSettings, hits: PrimaryHits, p: wp.vec2i):
    at = primary_sample(settings, p)
    origin = camera_origin(camera, at[0], at[1])
    pixel = p[1] * camera.width + p[0]
    hits.direction[pixel] = camera_ray(camera, at[0], at[1])
    hits.t[pixel] = origin[0]
    hits.u[pixel] = origin[1]
    hits.v[pixel] = origin[2]


# Thread: `share` pixels of a tile, PACKET on the CPU and one on CUDA. Traces a camera ray of each.
@wp.kernel
def trace_primary(
    first: wp.int32,
    scene: SceneData,
    camera: CameraData,
    settings: PassSettings,
    share: wp.int32,
    hits: PrimaryHits,
):
    i = first + wp.tid()
    if runs_on_cuda() != 0:
        p = tiled_pixel(i, camera.width)
        if p[0] >= camera.width or p[1] >= camera.height:
            return
        start_ray(camera, settings, hits, p)
        pixel = p[1] * camera.width + p[0]
        origin = wp.vec3(hits.t[pixel], hits.u[pixel], hits.v[pixel])
        hit = mesh_intersect(scene.bvh, origin, hits.direction[pixel], float(wp.inf))
        hits.t[pixel] = hit.t
        hits.u[pixel] = hit.u
        hits.v[pixel] = hit.v
        hits.face[pixel] = hit.face
    else:
        corner = packet_corner(i, camera.width)
        if corner[0] >= camera.width or corner[1] >= camera.height:
            return
        for k in range(share):
            p = wp.vec2i(corner[0] + k % SIDE, corner[1] + k / SIDE)
            if p[0] < camera.width and p[1] < camera.height:
                start_ray(camera, settings, hits, p)
        intersect_pixels(scene.bvh, hits, corner[0], corner[1], camera.width, camera.height)
