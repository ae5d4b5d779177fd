"""Surfels where kernels find them: an index over cells, brick by brick, and the planes that it points to."""

from dataclasses import dataclass

import numpy as np

from taichi_mrf.alignment.surfels import Surfels
from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import Bundle
from taichi_mrf.system.resident import resident
from taichi_mrf.system.types import F32, F32Array2, I32Array, IVec3
from taichi_mrf.voxels.layout import BRICK, VOXELS
from taichi_mrf.voxels.window import Window, WindowIndex


@dataclass(frozen=True)
class SurfelPlanes(Bundle):
    """Surfels as kernels read them: bricks of cells, whose places point to rows of ``planes``."""

    cell_size_m: F32

    shape: IVec3
    """Of the window, in bricks."""

    bricks: I32Array
    """(shape) number of each brick of the window, -1 where it has none."""

    places: I32Array
    """(bricks * 512) row of each cell, -1 without a surfel."""

    planes: F32Array2
    """(M, 7) weight, a point in cells from the window's corner, and a unit normal."""


class SurfelGrid:
    """The planes of some surfels in a window of bricks of cells; :attr:`planes` has them on the device, and
    :attr:`surface` as they are."""

    def __init__(self, surfels: Surfels) -> None:
        self.surface = surface = surfels.planes()
        cells = surface.cells
        self.cell_size = surfels.cell_size
        self.count = len(cells)
        self.index = WindowIndex()
        bricks, number = np.unique(cells // BRICK, axis=0, return_inverse=True)
        places = np.full(max(1, len(bricks)) * VOXELS, -1, np.int32)
        planes = np.zeros((max(1, self.count), 7), np.float32)
        centres = (cells + 0.5) * self.cell_size if self.count else np.zeros((1, 3))
        self.window = Window.covering(centres.min(axis=0), centres.max(axis=0), self.cell_size)
        if self.count:
            x, y, z = (cells % BRICK).T
            places[number.reshape(-1) * VOXELS + (x * BRICK + y) * BRICK + z] = np.arange(self.count)
            planes[:, 0], planes[:, 4:] = surface.weights, surface.normals
            planes[:, 1:4] = self.window.to_voxels(surface.points_m)
            numbers = np.arange(len(bricks), dtype=np.int32)
            self.index.fill(self.window, self.window.cells_of(bricks), numbers)
        runtime.settle()
        self.planes = SurfelPlanes(
            self.cell_size, self.window.shape_vector, self.index.bricks, resident(places), resident(planes)
        )
