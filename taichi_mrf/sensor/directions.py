"""Directions on the unit sphere: how many lie in a cone wherever it points, and an order along which
neighbours are near each other."""

import math

import numpy as np
from numpy.typing import NDArray

_CELLS = 64
"""Cells along each side of the cube around the unit sphere in which directions are counted."""

_MORTON_BITS = 10


class DirectionCounts:
    """Counts of the directions (H, W, 3) of an image's pixels, of any length."""

    def __init__(self, directions: NDArray[np.float64]) -> None:
        units = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
        chords = [np.linalg.norm(np.diff(units, axis=axis), axis=-1).max(initial=0.0) for axis in (0, 1)]
        self.largest_turn = 2.0 * math.asin(min(1.0, 0.5 * max(chords)))
        """The largest angle between neighbouring pixels, in radians."""
        self._number = units.size // 3
        cells = _in_steps(units.reshape(-1, 3), _CELLS)
        flat = np.ravel_multi_index(tuple(cells.T), (_CELLS,) * 3)
        counts = np.bincount(flat, minlength=_CELLS**3).reshape((_CELLS,) * 3)
        # Sums from the first cell on along all axes, with a layer of zeros before it.
        sums = counts.cumsum(axis=0).cumsum(axis=1).cumsum(axis=2)
        self._sums = np.pad(sums, ((1, 0),) * 3)
        self._most: dict[int, int] = {}

    def most_in_cone(self, half_angle: float) -> int:
        """A bound on the directions within ``half_angle`` radians of any axis.

        These lie in a ball around the axis' end on the unit sphere, hence in a cube, and hence in the cells
        that it can touch. The sum over those is taken for every place of the cube.
        """
        if half_angle >= math.pi / 2:
            return self._number
        side = 4.0 * math.sin(half_angle / 2)
        span = min(_CELLS, math.ceil(side * _CELLS / 2) + 1)
        if span not in self._most:
            sums = self._sums
            for axis in range(3):
                upper, lower = slice(span, None), slice(None, -span)
                index = (slice(None),) * axis
                sums = sums[(*index, upper)] - sums[(*index, lower)]
            self._most[span] = int(sums.max())
        return self._most[span]


def morton_order(units: NDArray[np.float64]) -> NDArray[np.intp]:
    """The order (N,) of unit directions (N, 3) along a Morton curve through the cube around the sphere."""
    steps = _in_steps(units, 1 << _MORTON_BITS)
    key = np.zeros(len(units), np.int64)
    for bit in range(_MORTON_BITS):
        for axis in range(3):
            key |= (steps[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")


def _in_steps(units: NDArray[np.float64], steps: int) -> NDArray[np.int64]:
    """Which of so many steps from -1 to 1 each component lies in."""
    return np.clip(np.floor((units + 1.0) * (steps / 2)), 0, steps - 1).astype(np.int64)
