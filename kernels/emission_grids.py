"""Points on emissive triangles whose texture varies, sampled by what the texture emits there.

A grid cuts a triangle into side^2 equal cells: cell (i, j) with i + j < side has corners (i, j), (i + 1, j) and
(i, j + 1) in units of 1 / side of the barycentric weights of the second and the third corner; the square k x k holds
those that stand upside down in its other half, turned about its middle. An alias table selects a cell. Within it
the density is linear between the corners, plus a constant, so it follows a bilinear texture and is above zero wherever
that is. Triangles without a grid are sampled evenly. Grids come from ``warp_gi.scene.emission_grids``.
"""

import warp as wp

from warp_gi.kernels.alias import LARGEST_FLOAT_BELOW_ONE, alias_choice_of
from warp_gi.kernels.sampling import triangle_barycentrics
from warp_gi.kernels.types import AliasBucket, EmissionGrid, SceneData

wp.set_module_options({"enable_backward": False})


# A point on an emissive triangle.
@wp.struct
class EmitterPoint:
    b: wp.vec2  # barycentric weights of the second and third corner
    density: wp.float32  # of sampling it, over that of points uniform on the triangle


# Density of `grid_point` at the point (u, v) of its triangle. Both are calls of their own, as few paths come by them.
@wp.func(inline=False)
def grid_density(densities: wp.array(dtype=wp.vec4), grid: EmissionGrid, u: wp.float32, v: wp.float32) -> wp.float32:
    x = wp.clamp(u, 0.0, 1.0) * wp.float32(grid.side)
    y = wp.clamp(v, 0.0, 1.0) * wp.float32(grid.side)
    i = wp.min(wp.int32(x), grid.side - 1)
    j = wp.min(wp.int32(y), grid.side - 1 - i)
    a = wp.min(x - wp.float32(i), 1.0)
    b = wp.min(y - wp.float32(j), 1.0)
    if a + b > 1.0 and i + j < grid.side - 1:
        a = 1.0 - a
        b = 1.0 - b
        i = grid.side - 1 - i
        j = grid.side - 1 - j
    w = densities[grid.start + j * grid.side + i]
    return w[0] * wp.max(1.0 - a - b, 0.0) + w[1] * a + w[2] * b + w[3]


# Density of `emitter_point` at the point (u, v) of the triangle of an emitter.
@wp.func
def emitter_point_density(scene: SceneData, emitter: wp.int32, u: wp.float32, v: wp.float32) -> wp.float32:
    if scene.emitters.grids.shape[0] > 0:
        grid = scene.emitters.grids[emitter]
        if grid.side > 0:
            return grid_density(scene.emitters.densities, grid, u, v)
    return 1.0


# A point of a cell (barycentric weights in it) whose density is `w`: one of its four parts by its mass, then a point of
# this part. A part that rises from 0 at one side to a corner has the density 6 x (1 - x) of that corner's weight x.
@wp.func
def cell_point(w: wp.vec4, u: wp.float32, v: wp.float32) -> wp.vec2:
    left = u * (w[0] + w[1] + w[2] + 3.0 * w[3])
    if left < 3.0 * w[3]:
        return triangle_barycentrics(wp.vec2(left / (3.0 * w[3]), v))
    left = left - 3.0 * w[3]
    corner = int(0)
    if left >= w[0] and w[1] + w[2] > 0.0:
        left = left - w[0]
        corner = 1
        if left >= w[1] and w[2] > 0.0:
            left = left - w[1]
            corner = 2
    share = wp.clamp(left / wp.max(w[corner], 1.0e-30), 0.0, 1.0)
    x = wp.clamp(0.5 - wp.sin(wp.asin(1.0 - 2.0 * share) / 3.0), 0.0, 1.0)  # solves x^2 (3 - 2 x) = share
    rest = 1.0 - x
    if corner == 0:
        return wp.vec2(rest * (1.0 - v), rest * v)
    if corner == 1:
        return wp.vec2(x, rest * v)
    return wp.vec2(rest * v, x)


# A point on a triangle with a grid. A float32 holds too few digits for a cell and a point in it, so the last digits of
# u[1] follow those of u[0].
@wp.func(inline=False)
def grid_point(
    cells: wp.array(dtype=AliasBucket), densities: wp.array(dtype=wp.vec4), grid: EmissionGrid, u: wp.vec2
) -> EmitterPoint:
    r = EmitterPoint()
    digits = u[1] * 4096.0
    digits = digits - wp.floor(digits)
    drawn = alias_choice_of(cells, grid.start, grid.side * grid.side, u[0], digits)
    w = densities[grid.start + drawn.item]
    p = cell_point(w, drawn.remainder, wp.min(u[1], LARGEST_FLOAT_BELOW_ONE))
    r.density = w[0] * wp.max(1.0 - p[0] - p[1], 0.0) + w[1] * p[0] + w[2] * p[1] + w[3]
    i = drawn.item % grid.side
    j = drawn.item / grid.side
    if i + j >= grid.side:
        i = grid.side - i
        j = grid.side - j
        p = -p
    r.b = (wp.vec2(wp.float32(i), wp.float32(j)) + p) / wp.float32(grid.side)
    return r


# A point on the triangle of an emitter.
@wp.func
def emitter_point(scene: SceneData, emitter: wp.int32, u: wp.vec2) -> EmitterPoint:
    if scene.emitters.grids.shape[0] > 0:
        grid = scene.emitters.grids[emitter]
        if grid.side > 0:
            return grid_point(scene.emitters.cells, scene.emitters.densities, grid, u)
    r = EmitterPoint()
    r.b = triangle_barycentrics(u)
    r.density = 1.0
    return r
