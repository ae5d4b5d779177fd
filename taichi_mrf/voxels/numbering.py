"""Numbers of voxels and cells in kernels, and the strips of voxels that their parallel loops take.

The levels themselves are in layout.py, which needs no Taichi. On a CPU an iteration of a Taichi loop costs
more than what is done to a voxel, and neighbouring voxels share cache lines. On a GPU an iteration is a
thread, and neighbouring threads should take neighbouring voxels.
"""

from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import I32, I32Array, IVec3, Template
from taichi_mrf.voxels.layout import BRICK, VOXELS


@ti.func
def voxel_number(cell: IVec3) -> I32:
    """Number (0..511) of a voxel in its brick, from its coordinates there (0..7)."""
    return (cell[0] * BRICK + cell[1]) * BRICK + cell[2]


@ti.func
def flat(cell: IVec3, shape: IVec3) -> I32:
    """Row-major number of a cell in a box of cells."""
    return (cell[0] * shape[1] + cell[1]) * shape[2] + cell[2]


CPU_STRIP = 64
"""A divisor of VOXELS, so that a strip lies in one brick."""


def strip_length() -> int:
    """Voxels in a strip on the backend that runs."""
    return CPU_STRIP if runtime.active() == "cpu" else 1


@ti.func
def strip_begin(part: I32, slots: I32Array, strip: Template):
    """The first voxel of strip number ``part``: its place among the voxels of the bricks in ``slots``, and in
    the pool."""
    begin = part * strip
    return begin, slots[begin // VOXELS] * VOXELS + begin % VOXELS
