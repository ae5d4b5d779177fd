"""Blending inside kernels, as voxels/distance_field.py has it: one voxel's sums with those around it."""

from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import I32, IVec3, Template, Vec2
from taichi_mrf.voxels.distance_field import BLENDED_BELOW
from taichi_mrf.voxels.layout import BRICK, VOXELS
from taichi_mrf.voxels.numbering import flat, voxel_number

AROUND = 27
"""Bricks in and around one, its own in the middle (layout.rows_around)."""


@ti.func
def voxel_around(around: Template, place: I32, cell: IVec3) -> I32:
    """Index of the voxel ``cell`` among those of some rows of bricks, -1 where there is none. ``cell`` counts
    from the first voxel of the brick at ``place``, from -8 to 15 along each axis; ``around`` (places * 27)
    are the rows of the bricks around each place."""
    row = around[place * AROUND + flat((cell >> 3) + 1, IVec3(3))]
    found = -1
    if row >= 0:
        found = row * VOXELS + voxel_number(cell & 7)
    return found


@ti.func
def cell_of(number: I32) -> IVec3:
    """The voxel of each number within a brick, the inverse of ``voxel_number``."""
    return IVec3(number // (BRICK * BRICK), number // BRICK % BRICK, number % BRICK)


@ti.func
def blended(weight: Template, distance: Template, around: Template, place: I32, cell: IVec3) -> Vec2:
    """The sums of weights and of distances times weight of a voxel, blended with its surroundings;
    ``weight`` and ``distance`` are (rows * 512)."""
    own, sums = Vec2(0.0), Vec2(0.0)
    for x, y, z in ti.static(ti.ndrange((-1, 2), (-1, 2), (-1, 2))):
        voxel = voxel_around(around, place, cell + IVec3(x, y, z))
        if voxel >= 0:
            here = Vec2(weight[voxel], distance[voxel])
            sums += here * 0.5 ** (abs(x) + abs(y) + abs(z))
            if ti.static(x == y == z == 0):
                own = here
    return own + BLENDED_BELOW / (BLENDED_BELOW + own[0]) * sums
