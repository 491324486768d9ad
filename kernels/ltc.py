"""How much of a triangle's light a surface reflects, in closed form: weights for selecting area lights.

The Lambert part is the irradiance of a polygon, edge by edge (Lambert 1760; Baum, Rushmeier, Winget 1989, "Improving
Radiosity Solutions Through the Use of Analytically Determined Form-Factors"). The GGX part is the same integral after
a linear transform of the directions (Heitz, Dupuy, Hill, Neubelt 2016, "Real-Time Polygonal-Light Shading with
Linearly Transformed Cosines"), from a table that assets/fit_ltc.py writes. Corners are relative to the shading point,
in the shading frame (z is the normal); their distances should lie in 1e-9 to 1e9.

These are weights, not shading: good to 1e-3 (Lambert) and positive wherever there is something to reflect.
"""

import warp as wp

from warp_gi.kernels.bsdf import Bsdf, luminance

wp.set_module_options({"enable_backward": False})

# (longest edge / distance)^2 below which three samples integrate a triangle, mostly to 1e-4
SMALL_TRIANGLE = wp.constant(wp.float32(0.01))
# what rounding can leave of a triangle seen from the side; weights do not fall below it
ROUNDING = wp.constant(wp.float32(1.0e-7))
SMALLEST_WEIGHT = wp.constant(wp.float32(1.0e-30))
SMALLEST_SQUARE = wp.constant(wp.float32(1.0e-18))


# Linearly transformed cosines of the GGX lobe: rows by sqrt(alpha), columns by sqrt(1 - cos_o), both 0 to 1.
@wp.struct
class LtcTable:
    size: wp.int32
    # [row * size + column] (xx, xz, zx, zz) of the matrix, yy = 1, that takes directions into the cosine's space; they
    # are in the frame whose z is the mirror direction of wo, y across both
    matrices: wp.array(dtype=wp.vec4)
    # the integral of D V cos (F = f0 + (f90 - f0) s) is f0 * amplitude[0] + f90 * amplitude[1]
    amplitudes: wp.array(dtype=wp.vec2)


# What the loop over lights needs to know of a shading point.
@wp.struct
class LobeWeights:
    diffuse: wp.float32  # luminance reflected, of radiance 1 from everywhere, by Lambert and by the GGX lobe's tail
    specular: wp.float32  # and by the rest of the GGX lobe
    matrix: wp.mat33  # from the shading frame into the cosine's space of the GGX lobe
    has_specular: wp.int32


# (theta / sin(theta) - 1) * (u x v).z of unit u, v with the angle theta between them.
@wp.func
def edge_excess(u: wp.vec3, v: wp.vec3) -> wp.float32:
    cross_z = u[0] * v[1] - u[1] * v[0]
    cos_theta = wp.dot(u, v)
    t = 1.0 - wp.abs(cos_theta)
    # Chebyshev fit in t; theta / sin(theta) is good to 8e-6
    high = 0.05003715 + t * (-0.02905657 + t * 0.03178888)
    excess = t * (0.3333248 + t * (0.13391773 + t * (0.05077252 + t * high)))
    if cos_theta < 0.0:
        # by the supplement of theta; 1 - cos^2 would lose the digits of a small sine
        excess = wp.pi / wp.max(wp.length(wp.cross(u, v)), 1.0e-12) - 2.0 - excess
    return excess * cross_z


# Times pi: integral of cos(theta) over a triangle that is nowhere below the horizon.
@wp.func
def upper_triangle_cosine(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.float32:
    ab = b - a
    ac = c - a
    bc = c - b
    square = wp.dot(a, a)
    edge = wp.max(wp.max(wp.dot(ab, ab), wp.dot(ac, ac)), wp.dot(bc, bc))
    if edge < SMALL_TRIANGLE * square:
        # the sum over edges would cancel: |n . p| p.z / |p|^4 at the middles of the edges instead (exact for
        # quadratics); n . p is the same everywhere on the triangle
        volume = wp.max(wp.abs(wp.dot(a, wp.cross(ab, ac))), ROUNDING * edge * wp.sqrt(square))
        p = a + b
        q = b + c
        r = c + a
        weight_p = 1.0 / wp.max(wp.dot(p, p), SMALLEST_SQUARE)
        weight_q = 1.0 / wp.max(wp.dot(q, q), SMALLEST_SQUARE)
        weight_r = 1.0 / wp.max(wp.dot(r, r), SMALLEST_SQUARE)
        return (
            volume
            * (p[2] * weight_p * weight_p + q[2] * weight_q * weight_q + r[2] * weight_r * weight_r)
            * (4.0 / 3.0)
        )
    u = a / wp.sqrt(wp.max(square, SMALLEST_SQUARE))
    v = b / wp.sqrt(wp.max(wp.dot(b, b), SMALLEST_SQUARE))
    w = c / wp.sqrt(wp.max(wp.dot(c, c), SMALLEST_SQUARE))
    # the sum of theta * (u x v) / |u x v|; where theta = sin(theta) it is one cross product
    total = (w[0] - u[0]) * (w[1] - v[1]) - (w[1] - u[1]) * (w[0] - v[0])
    total += edge_excess(u, v) + edge_excess(v, w) + edge_excess(w, u)
    return wp.max(0.5 * wp.abs(total), ROUNDING)


# Where the edge from a (above) to b (not above) crosses the horizon.
@wp.func
def horizon_crossing(a: wp.vec3, b: wp.vec3) -> wp.vec3:
    t = a[2] / (a[2] - b[2])
    return wp.vec3(a[0] + (b[0] - a[0]) * t, a[1] + (b[1] - a[1]) * t, 0.0)


# Integral of cos(theta) / pi over the triangle's solid angle above the horizon, in [0, 1]; 0 only if that is empty.
@wp.func
def triangle_cosine(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.float32:
    p = a
    q = b
    r = c
    value = float(0.0)
    if wp.min(wp.min(a[2], b[2]), c[2]) <= 0.0:
        # sorted by height, the highest first
        if p[2] < q[2]:
            p = b
            q = a
        if q[2] < r[2]:
            r = q
            q = c
            if p[2] < q[2]:
                q = p
                p = c
        if p[2] <= 0.0:
            return 0.0
        s = horizon_crossing(p, r)
        if q[2] > 0.0:
            value = upper_triangle_cosine(q, horizon_crossing(q, r), s)
            r = s
        else:
            q = horizon_crossing(p, q)
            r = s
    value += upper_triangle_cosine(p, q, r)
    return wp.clamp(value * (1.0 / wp.pi), SMALLEST_WEIGHT, 1.0)


# Share of light from everywhere that the coat takes from the Lambert lobe below: Fresnel's mean over
# cosine-weighted directions of wi, seen from wo. The cubic is that of (1 - wo.h)^5, to 1e-4.
@wp.func
def coat_fresnel(b: Bsdf, cos_o: wp.float32) -> wp.vec3:
    x = 1.0 - cos_o
    s = x * (4.4e-3 + x * (-2.0e-3 + x * 2.57e-2))
    return b.f0 * (1.0 - s) + wp.vec3(b.f90 * s, b.f90 * s, b.f90 * s)


# What the GGX lobe reflects of light from a direction with this cosine: f0 times the first, f90 times the second.
@wp.func
def lobe_albedo(table: LtcTable, alpha: wp.float32, cosine: wp.float32) -> wp.vec2:
    last = wp.float32(table.size - 1)
    x = wp.clamp(wp.sqrt(wp.max(1.0 - cosine, 0.0)) * last, 0.0, last - 1.0e-3)
    y = wp.clamp(wp.sqrt(alpha) * last, 0.0, last - 1.0e-3)
    i = wp.int32(y) * table.size + wp.int32(x)
    j = i + table.size
    fx = x - wp.floor(x)
    fy = y - wp.floor(y)
    low = (1.0 - fx) * table.amplitudes[i] + fx * table.amplitudes[i + 1]
    return (1.0 - fy) * low + fy * ((1.0 - fx) * table.amplitudes[j] + fx * table.amplitudes[j + 1])


# Weights of the lobes at a point that is seen from wo; nothing is reflected where wo is not above the surface.
@wp.func
def lobe_weights(table: LtcTable, bsdf: Bsdf, wo: wp.vec3) -> LobeWeights:
    w = LobeWeights()
    if wo[2] <= 0.0:
        return w
    if bsdf.f90 <= 0.0:
        w.diffuse = luminance(bsdf.diffuse)
        return w
    coat = coat_fresnel(bsdf, wo[2])
    w.diffuse = luminance(wp.cw_mul(wp.vec3(1.0, 1.0, 1.0) - coat, bsdf.diffuse))
    last = wp.float32(table.size - 1)
    x = wp.clamp(wp.sqrt(wp.max(1.0 - wo[2], 0.0)) * last, 0.0, last - 1.0e-3)
    y = wp.clamp(wp.sqrt(bsdf.alpha) * last, 0.0, last - 1.0e-3)
    column = wp.int32(x)
    row = wp.int32(y)
    fx = x - wp.float32(column)
    fy = y - wp.float32(row)
    i = row * table.size + column
    j = i + table.size
    low = (1.0 - fx) * table.matrices[i] + fx * table.matrices[i + 1]
    m = (1.0 - fy) * low + fy * ((1.0 - fx) * table.matrices[j] + fx * table.matrices[j + 1])
    faint = (1.0 - fx) * table.amplitudes[i] + fx * table.amplitudes[i + 1]
    a = (1.0 - fy) * faint + fy * ((1.0 - fx) * table.amplitudes[j] + fx * table.amplitudes[j + 1])
    reflected = luminance(bsdf.f0) * a[0] + bsdf.f90 * a[1]
    # the transformed cosine is zero or far too small in the tail of the lobe, which is about alpha^2 cos / 4
    tail = reflected * bsdf.alpha * bsdf.alpha / (1.0 + 50.0 * bsdf.alpha * bsdf.alpha)
    w.diffuse += tail
    w.specular = reflected - tail
    w.has_specular = 1
    side = wp.vec2(1.0, 0.0)
    across = wp.sqrt(wo[0] * wo[0] + wo[1] * wo[1])
    if across > 0.0:
        side = wp.vec2(wo[0] / across, wo[1] / across)
    # from the shading frame to the one with the mirror direction as z
    mirror = wp.mat33(
        wo[2] * side[0], wo[2] * side[1], across, -side[1], side[0], 0.0, -across * side[0], -across * side[1], wo[2]
    )
    w.matrix = wp.mat33(m[0], 0.0, m[1], 0.0, 1.0, 0.0, m[2], 0.0, m[3]) * mirror
    return w


# Luminance of what is reflected of a triangle of radiance 1, unoccluded; 0 only where it is nowhere above the horizon.
@wp.func
def triangle_weight(w: LobeWeights, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.float32:
    cosine = triangle_cosine(a, b, c)
    if w.has_specular == 0 or cosine <= 0.0:
        return w.diffuse * cosine
    return w.diffuse * cosine + w.specular * triangle_cosine(w.matrix * a, w.matrix * b, w.matrix * c)
