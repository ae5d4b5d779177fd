"""A finished 2D map as arrays whose rows go from the lowest y up: the form that pictures, files and scores
use."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class LaserMap:
    """States of the cells, (rows, columns); row 0 lies at the lowest y, column 0 at the lowest x."""

    occupied: NDArray[np.bool_]
    """The label of the cell."""

    seen: NDArray[np.bool_]
    """True if a beam touches the cell; the others are unknown."""

    marginals: NDArray[np.float32] | None
    """Probability of occupied, for the methods that give one."""

    cell_size: float
    """Metres."""

    lower_cell: tuple[int, int]
    """Integer coordinate along x and y of the first cell, which covers [coordinate, coordinate + 1) times
    the cell size."""

    @property
    def lower_x_y(self) -> tuple[float, float]:
        """The outer corner of the first cell in metres."""
        return self.lower_cell[0] * self.cell_size, self.lower_cell[1] * self.cell_size

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Lowest and highest x, lowest and highest y in metres, the order of matplotlib's imshow."""
        rows, columns = self.occupied.shape
        x, y = self.lower_x_y
        return x, x + columns * self.cell_size, y, y + rows * self.cell_size
