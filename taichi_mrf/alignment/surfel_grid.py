"""Surfels where kernels find them: an index over cells, brick by brick, and the planes that it points to."""

import numpy as np
import taichi as ti

from taichi_mrf.alignment.surfels import Surfels
from taichi_mrf.system import runtime
from taichi_mrf.voxels.layout import BRICK, VOXELS
from taichi_mrf.voxels.window import Window, WindowIndex


class SurfelGrid:
    """The planes of some surfels in a window of bricks of cells.

    ``index`` gives the number of each brick, ``places`` (bricks * 512) the row of each cell or -1. A row of
    ``planes`` (M, 7) float32 is a weight, a point in cells from the window's corner, and a unit normal.
    """

    def __init__(self, surfels: Surfels) -> None:
        surface = surfels.planes()
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
        self.places = ti.ndarray(ti.i32, places.shape)
        self.places.from_numpy(places)
        self.planes = ti.ndarray(ti.f32, planes.shape)
        self.planes.from_numpy(planes)
        runtime.settle()
