"""Straight lines on octahedral maps: the cells that a ray passes through, and when.

Seen from a probe a ray is p(t) = o + t d. Between its crossings of the planes x = 0, y = 0 and z = 0 it stays in one
face of the octahedron; with the signs s of that octant S = s . p = |x| + |y| + |z| is linear in t, and the coordinates
in the map, in [-1, 1], are quotients of linear functions:

    upper half: U = x / S, V = z / S        lower half: U = (x - s_x y) / S, V = (z - s_z y) / S

so U is monotonic and crosses the border u of a texel where its numerator N(t) = u S(t), at
t = (u S_0 - N_0) / (N_1 - u S_1). Going from border to border visits the texels of the ray, all and no others.
"""

import warp as wp

from warp_gi.kernels.octahedral import octahedral_encode, octahedral_wrap, sign_of

wp.set_module_options({"enable_backward": False})


# A piece of a ray in one face of the octahedron: numerators of U and V and their denominator, at t = 0 and per metre.
@wp.struct
class MapLine:
    start: wp.vec3
    slope: wp.vec3


# Place of a ray on a grid of cells: the cell, the ways it leaves it and when.
@wp.struct
class MapCell:
    x: wp.int32
    y: wp.int32
    step_x: wp.int32
    step_y: wp.int32
    next_x: wp.float32
    next_y: wp.float32


# The line in the face of the point at `t`.
@wp.func
def map_line(origin: wp.vec3, direction: wp.vec3, t: wp.float32) -> MapLine:
    p = origin + direction * t
    s = wp.vec3(sign_of(p[0]), sign_of(p[1]), sign_of(p[2]))
    fold = wp.min(s[1], 0.0)
    return MapLine(
        wp.vec3(origin[0] + fold * s[0] * origin[1], origin[2] + fold * s[2] * origin[1], wp.dot(s, origin)),
        wp.vec3(
            direction[0] + fold * s[0] * direction[1], direction[2] + fold * s[2] * direction[1], wp.dot(s, direction)
        ),
    )


# When U (axis 0) or V (axis 1) leaves cell `cell` `width` wide by going `step`, -1 or 1; infinite if it never does.
@wp.func
def leaving_time(line: MapLine, axis: wp.int32, cell: wp.int32, step: wp.int32, width: wp.float32) -> wp.float32:
    border = wp.float32(cell + ((step + 1) >> 1)) * width - 1.0
    way = wp.float32(step)
    # beyond the border where before + speed t > 0
    speed = (line.slope[axis] - border * line.slope[2]) * way
    if speed <= 0.0:
        return wp.inf
    return (border * line.start[2] - line.start[axis]) * way / speed


# The cell at `t_in`, among `span` x `span` from (x, y) on, on the way to `t_out`. Steps go to the cell there: signs of
# derivatives would be noise where a line passes by the probe.
@wp.func
def enter_cells(
    line: MapLine, t_in: wp.float32, t_out: wp.float32, width: wp.float32, x: wp.int32, y: wp.int32, span: wp.int32
) -> MapCell:
    p = line.start + line.slope * t_in
    q = line.start + line.slope * t_out
    size = 1.0 / width
    p_scale = size / wp.max(p[2], 1.0e-30)
    q_scale = size / wp.max(q[2], 1.0e-30)
    cell = MapCell()
    cell.x = wp.clamp(wp.int32(p[0] * p_scale + size), x, x + span - 1)
    cell.y = wp.clamp(wp.int32(p[1] * p_scale + size), y, y + span - 1)
    cell.step_x = wp.where(q[0] * q_scale + size < wp.float32(cell.x), -1, 1)
    cell.step_y = wp.where(q[1] * q_scale + size < wp.float32(cell.y), -1, 1)
    cell.next_x = leaving_time(line, 0, cell.x, cell.step_x, width)
    cell.next_y = leaving_time(line, 1, cell.y, cell.step_y, width)
    return cell


# The cell after this one: whole numbers move, so that rounding never holds the ray up.
@wp.func
def next_cell(line: MapLine, cell: MapCell, width: wp.float32) -> MapCell:
    if cell.next_x < cell.next_y:
        cell.x += cell.step_x
        cell.next_x = leaving_time(line, 0, cell.x, cell.step_x, width)
    else:
        cell.y += cell.step_y
        cell.next_y = leaving_time(line, 1, cell.y, cell.step_y, width)
    return cell


# The texel next to one on the side of a point in its cone.
@wp.struct
class SideTexel:
    texel: wp.int32
    away: wp.float32  # of the point from the first texel's middle, in texels


@wp.func
def side_texel(texel: wp.int32, resolution: wp.int32, point: wp.vec3) -> SideTexel:
    uv = octahedral_encode(point) * wp.float32(resolution)
    row = texel / resolution
    column = texel - row * resolution
    x = uv[0] - wp.float32(column) - 0.5
    y = uv[1] - wp.float32(row) - 0.5
    if wp.abs(x) > wp.abs(y):
        column += wp.where(x < 0.0, -1, 1)
    else:
        row += wp.where(y < 0.0, -1, 1)
    return SideTexel(octahedral_wrap(column, row, resolution), wp.max(wp.abs(x), wp.abs(y)))
