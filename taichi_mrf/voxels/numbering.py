"""Numbers of voxels and cells in kernels; the levels themselves are in layout.py, which needs no Taichi."""

from taichi_mrf.kernels.types import I32, IVec3
from taichi_mrf.system.compiler import ti
from taichi_mrf.voxels.layout import BRICK


@ti.func
def voxel_number(cell: IVec3) -> I32:
    """Number (0..511) of a voxel in its brick, from its coordinates there (0..7)."""
    return (cell[0] * BRICK + cell[1]) * BRICK + cell[2]


@ti.func
def flat(cell: IVec3, shape: IVec3) -> I32:
    """Row-major number of a cell in a box of cells."""
    return (cell[0] * shape[1] + cell[1]) * shape[2] + cell[2]
