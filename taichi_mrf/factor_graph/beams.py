"""Beams, as every reader of scans makes them, and the box of cells that they cross. NumPy alone."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import DatasetError
from taichi_mrf.voxels.layout import BRICK, VOXELS, offsets_in_brick


@dataclass(frozen=True)
class Beams:
    """F range measurements in the world frame.

    ``origins`` (F, 3) float64 in metres, ``directions`` (F, 3) of length 1, ``range_m`` (F,) float32 and
    ``hit`` (F,) bool: False where nothing returned up to ``range_m``. Raises DatasetError for arrays that do
    not belong together, or that hold what is not a beam.
    """

    origins: NDArray[np.float64]
    directions: NDArray[np.float64]
    range_m: NDArray[np.float32]
    hit: NDArray[np.bool_]

    def __post_init__(self) -> None:
        number = len(self.range_m)
        shapes = (self.origins.shape, self.directions.shape, self.range_m.shape, self.hit.shape)
        if shapes != ((number, 3), (number, 3), (number,), (number,)):
            raise DatasetError(f"beams need arrays of shapes (F, 3), (F, 3), (F,) and (F,), not {shapes}")
        bad = ~(np.isfinite(self.range_m) & (self.range_m > 0))
        bad |= ~np.isfinite(self.origins).all(axis=1)
        bad |= np.abs(np.linalg.norm(self.directions, axis=1) - 1) > 1e-3
        if bad.any():
            raise DatasetError(
                f"beam {int(np.flatnonzero(bad)[0])} has no finite origin, no direction of length 1 or no "
                "positive, finite range"
            )

    def __len__(self) -> int:
        return len(self.range_m)

    @property
    def ends(self) -> NDArray[np.float64]:
        """(F, 3) where the beams end, in metres."""
        return self.origins + self.directions * self.range_m[:, None].astype(np.float64)


@dataclass(frozen=True)
class Grid:
    """A box of cells, aligned to the world: cell (i, j, k) begins at (i, j, k) times the cell size.

    ``lower`` is the coordinate of the first cell and ``shape`` counts them along x, y and z; a 2D grid is one
    layer. A cell's number is row-major in ``shape``.
    """

    cell_size: float
    lower: tuple[int, int, int]
    shape: tuple[int, int, int]

    @staticmethod
    def around(beams: Beams, cell_size: float) -> "Grid":
        """The smallest box that holds all beams, with a cell to spare along every axis in which they run."""
        if len(beams) == 0:
            return Grid(cell_size, (0, 0, 0), (1, 1, 1))
        ends = beams.ends
        lowest = np.minimum(beams.origins.min(axis=0), ends.min(axis=0))
        highest = np.maximum(beams.origins.max(axis=0), ends.max(axis=0))
        spare = (highest > lowest).astype(np.float64)
        first = np.floor(lowest / cell_size) - spare
        last = np.floor(highest / cell_size) + spare
        lower, shape = first.astype(np.int64).tolist(), (last - first + 1).astype(np.int64).tolist()
        return Grid(cell_size, tuple(lower), tuple(shape))

    @property
    def cells(self) -> int:
        """Number of cells."""
        return self.shape[0] * self.shape[1] * self.shape[2]

    def to_cells(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (n, 3) in metres, in cell sizes from the box's lowest corner."""
        return points / self.cell_size - np.asarray(self.lower, np.float64)

    def image(self, values: NDArray) -> NDArray:
        """Values of all cells, (cells,), as (y, x) with the lowest y first for a layer, else (x, y, z)."""
        box = values.reshape(self.shape)
        return box[:, :, 0].T if self.shape[2] == 1 else box


@dataclass(frozen=True)
class BrickCells:
    """The voxels of some bricks of a map, brick by brick: cell i is voxel i % 512 of brick i // 512.

    ``bricks`` (n, 3) int32 are brick coordinates in the world.
    """

    cell_size: float
    bricks: NDArray[np.int32]

    @property
    def shape(self) -> tuple[int, int, int]:
        """As Grid.shape, though only the product means anything."""
        return len(self.bricks), VOXELS, 1

    @property
    def cells(self) -> int:
        """Number of cells."""
        return len(self.bricks) * VOXELS

    def centres(self) -> NDArray[np.float64]:
        """(cells, 3) in metres."""
        corners = self.bricks[:, None].astype(np.float64) * BRICK
        return ((corners + offsets_in_brick()[None]).reshape(-1, 3) + 0.5) * self.cell_size

    def image(self, values: NDArray) -> NDArray:
        """Values of all cells, (cells,), as (bricks, 8, 8, 8)."""
        return values.reshape(-1, BRICK, BRICK, BRICK)
