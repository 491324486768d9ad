"""Directions as they would be seen from a region's anchor: one quadtree fits all points that see the same light.

A direction w at x is the anchor's direction v = (y - c) / R towards the point y where the ray from x meets the sphere
of radius R around the anchor c. If the light comes from about R away, its direction from the anchor hardly depends on
x, and what one point learnt is right for its neighbours. (Ruppert, Herholz and Lensch 2020, "Robust Fitting of
Parallax-Aware Mixtures for Path Guiding", move each lobe of a mixture by its own distance. A quadtree has one for all
of its leaves, which keeps the map between both spheres one to one.)

With t = |y - x|, the area around y is t^2 / dot(v, w) per solid angle at x and R^2 at the anchor, so
dv / dw = t^2 / (R^2 dot(v, w)). An anchor is (c, 1 / R); where 1 / R is 0, and outside of the sphere, v = w.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

NEAREST = wp.constant(wp.float32(0.95))  # distance from the anchor over R, beyond which there is no parallax


# A direction, and the solid angle at the anchor per solid angle at the point.
@wp.struct
class Seen:
    direction: wp.vec3
    stretch: wp.float32


@wp.func
def has_parallax(anchor: wp.vec4, away: wp.vec3) -> wp.bool:
    return anchor[3] > 0.0 and wp.length(away) * anchor[3] < NEAREST


# Direction `w` at `position`, as seen from the anchor.
@wp.func
def seen_from_anchor(anchor: wp.vec4, position: wp.vec3, w: wp.vec3) -> Seen:
    r = Seen()
    r.direction = w
    r.stretch = 1.0
    away = position - wp.vec3(anchor[0], anchor[1], anchor[2])
    if has_parallax(anchor, away):
        away = away * anchor[3]  # in units of R
        along = wp.dot(away, w)
        across = away - along * w
        half = wp.sqrt(1.0 - wp.length_sq(across))
        r.direction = across + half * w
        t = half - along
        r.stretch = t * t / half  # dot(v, w) = half
    return r


# Direction `v` at the anchor, as seen from `position`.
@wp.func
def seen_from_point(anchor: wp.vec4, position: wp.vec3, v: wp.vec3) -> Seen:
    r = Seen()
    r.direction = v
    r.stretch = 1.0
    away = position - wp.vec3(anchor[0], anchor[1], anchor[2])
    if has_parallax(anchor, away):
        way = v - away * anchor[3]
        t = wp.length(way)
        r.direction = way / t
        r.stretch = t * t / wp.dot(v, r.direction)
    return r
