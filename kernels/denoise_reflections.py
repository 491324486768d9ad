"""Averages over frames of what smooth surfaces reflect: they follow the mirror image, not the surface.

The mirror image of a point at a distance t beyond a surface is seen t behind it, along the same ray from the camera;
by a surface of curvature k it is at t', with 1/t' = 1/t + 2 k (the mirror equation at normal incidence). One ray a
pixel in the mirror direction finds t, without noise. The average of glossy light is taken from where that image was in
the frame before, if the surface there reflected the same point. Rough surfaces show no image, and follow the surface.
"""

import warp as wp

from warp_gi.kernels.bvh import bvh_intersect
from warp_gi.kernels.denoise import (
    LEAST_REFLECTANCE,
    LEAST_WEIGHT,
    DenoiseSettings,
    Gathered,
    Guides,
    Signals,
    saw_surface,
)
from warp_gi.kernels.gbuffer import CameraData, previous_position, project
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

MOST_ALPHA = wp.constant(wp.float32(0.3))  # GGX alpha of surfaces that show an image
BLURRED_FRAMES = wp.constant(wp.float32(20.0))  # frames kept of an average elsewhere, times alpha
NEAR = wp.constant(wp.float32(0.15))  # relative difference of the distances of one reflected point
FAR = wp.constant(wp.float32(1.0e6))  # metres: the sky


# The cameras of a frame and of the frame before.
@wp.struct
class Views:
    now: CameraData
    before: CameraData


# Mean curvature of the surface in pixel i, from the normals of the pixels beside it; positive if convex [1/m].
@wp.func
def curvature(settings: DenoiseSettings, guides: Guides, i: wp.int32) -> wp.float32:
    y = i / settings.width
    x = i - y * settings.width
    total = float(0.0)
    count = float(0.0)
    for k in range(4):
        tx = x + (k % 2) * (2 * (k / 2) - 1)
        ty = y + (1 - k % 2) * (2 * (k / 2) - 1)
        j = ty * settings.width + tx
        if tx >= 0 and ty >= 0 and tx < settings.width and ty < settings.height:
            if guides.guide_object[j] == guides.guide_object[i]:
                apart = guides.guide_position[j] - guides.guide_position[i]
                turned = guides.guide_normal[j] - guides.guide_normal[i]
                total += wp.dot(turned, apart) / wp.max(wp.length_sq(apart), 1.0e-20)
                count += 1.0
    return total / wp.max(count, 1.0)


# Mean of the average before over the four pixels around (x, y) that saw the surface of pixel i and that reflected
# `point`, as it was then.
@wp.func
def gather_image(
    settings: DenoiseSettings,
    now: Guides,
    before: Guides,
    history: Signals,
    i: wp.int32,
    x: wp.float32,
    y: wp.float32,
    point: wp.vec3,
) -> Gathered:
    r = Gathered()
    x0 = wp.int32(wp.floor(x))
    y0 = wp.int32(wp.floor(y))
    for k in range(4):
        px = x0 + k % 2
        py = y0 + k / 2
        w = (1.0 - wp.abs(x - wp.float32(px))) * (1.0 - wp.abs(y - wp.float32(py)))
        if w > 0.0 and saw_surface(settings, now, before, i, px, py):
            j = py * settings.width + px
            expected = wp.min(wp.length(point - before.guide_position[j]), FAR)
            if history.length[j][1] > 0.0 and wp.abs(before.guide_reflected[j] - expected) < NEAR * expected:
                r.weight += wp.vec2(0.0, w)
                r.length += wp.vec2(0.0, w * history.length[j][1])
                r.glossy += w * history.glossy[j]
                r.moments += wp.vec2(0.0, w * history.moments[j][1])
    return r


# Thread: a pixel. Finds what a smooth surface reflects; `out`, the average before as it moved with surfaces, gets the
# glossy light that moved with the image, where there is a frame before.
@wp.kernel
def reproject_reflections(
    first: wp.int32,
    scene: SceneData,
    views: Views,
    settings: DenoiseSettings,
    now: Guides,
    before: Guides,
    history: Signals,
    out: Signals,
):
    i = first + wp.tid()
    now.guide_reflected[i] = 0.0
    alpha = now.guide_alpha[i]
    if alpha <= 0.0 or alpha > MOST_ALPHA or wp.max(now.guide_specular[i]) <= LEAST_REFLECTANCE:
        return
    place = now.guide_position[i]
    view = wp.normalize(place - views.now.position)
    if views.now.spread == 0.0:
        view = views.now.forward
    normal = now.guide_normal[i]
    direction = view - 2.0 * wp.dot(view, normal) * normal
    if wp.dot(direction, now.guide_plane[i]) <= 0.0 or wp.dot(view, normal) >= 0.0:
        return
    origin = place + now.guide_plane[i] * (0.1 * settings.footprint * now.guide_distance[i])
    hit = bvh_intersect(scene.bvh, origin, direction, FAR)
    t = float(FAR)
    moved = wp.vec3(0.0, 0.0, 0.0)
    point = place + direction * FAR
    if hit.face >= 0:
        t = hit.t
        point = previous_position(scene.geometry, hit.face, hit.u, hit.v)
        moved = point - (origin + direction * t)
    now.guide_reflected[i] = t
    if settings.settles == 0:
        return
    behind = 1.0 / wp.max(1.0 / t + 2.0 * curvature(settings, now, i), 1.0 / FAR)
    image = place + view * (behind * views.now.spread)  # orthographic rays are parallel: no way along them moves it
    was = image + (moved - 2.0 * wp.dot(moved, normal) * normal) * (behind / t)
    was = was + 2.0 * wp.dot(now.guide_previous[i] - place, normal) * normal
    motion = project(views.before, was - views.before.position) - project(views.now, image - views.now.position)
    y = i / settings.width
    x = i - y * settings.width
    h = gather_image(settings, now, before, history, i, wp.float32(x) + motion[0], wp.float32(y) + motion[1], point)
    length = out.length[i]
    moments = out.moments[i]
    if h.weight[1] >= LEAST_WEIGHT:
        out.glossy[i] = h.glossy / h.weight[1]
        length[1] = h.length[1] / h.weight[1]
        moments[1] = h.moments[1] / h.weight[1]
    else:
        length[1] = wp.min(length[1], BLURRED_FRAMES * alpha)
    out.length[i] = length
    out.moments[i] = moments
