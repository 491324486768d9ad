"""What a surface cache holds at the points that a camera sees, for pictures of it."""

import warp as wp

from warp_gi.kernels.gbuffer import PrimaryHits
from warp_gi.kernels.surface import surface_at
from warp_gi.kernels.surface_cache import READ_LEVELS, SurfaceCells, cell_level, known_slot, object_grid
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})

MIDDLE = wp.constant(wp.float32(0.5))


# Thread: a pixel. Writes the slot of the finest cell that is known at the point that it sees, -1 where none is, and -2
# where it sees no surface.
@wp.kernel
def view_slots(
    first: wp.int32, scene: SceneData, cells: SurfaceCells, hits: PrimaryHits, slots: wp.array(dtype=wp.int32)
):
    pixel = first + wp.tid()
    face = hits.face[pixel]
    slots[pixel] = -2
    if face < 0:
        return
    s = surface_at(scene, face, hits.u[pixel], hits.v[pixel], -hits.direction[pixel])
    grid = object_grid(cells, scene, face)
    slots[pixel] = known_slot(cells, grid, s, cell_level(cells, s.position), READ_LEVELS, wp.vec2(MIDDLE, MIDDLE))
