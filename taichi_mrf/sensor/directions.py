"""Directions on the unit sphere: how many lie in a cone wherever it points, and an order along which
neighbours are near each other."""

import math

import numpy as np
from numpy.typing import NDArray

_CELLS = 64
"""Cells along each side of the cube around the unit sphere in which directions are counted."""

_MORTON_BITS = 10


def largest_turn(directions: NDArray[np.float64]) -> float:
    """The largest angle between neighbouring pixels of directions (H, W, 3) of any length, in radians."""
    units = _units(directions)
    chords = [np.linalg.norm(np.diff(units, axis=axis), axis=-1).max(initial=0.0) for axis in (0, 1)]
    return 2.0 * math.asin(min(1.0, 0.5 * max(chords)))


def cone_span(half_angle: float) -> int | None:
    """Most cells along each side that a cone of ``half_angle`` radians can touch, for
    :func:`most_in_span`; None if that may be all.

    The directions in a cone lie in a ball around its axis' end on the unit sphere, hence in a cube, and hence
    in the cells that the cube can touch.
    """
    if half_angle >= math.pi / 2:
        return None
    span = math.ceil(2.0 * math.sin(half_angle / 2) * _CELLS) + 1
    return span if span < _CELLS else None


def most_in_span(directions: NDArray[np.float64], span: int) -> int:
    """The most directions (H, W, 3) that lie in any cube of ``span`` cells a side. Nothing is kept: the sums
    are larger than the directions of a scan."""
    cells = _in_steps(_units(directions).reshape(-1, 3), _CELLS)
    flat = np.ravel_multi_index(tuple(cells.T), (_CELLS,) * 3)
    sums = np.bincount(flat, minlength=_CELLS**3).reshape((_CELLS,) * 3)
    for axis in range(3):
        # From the first cell on, with a zero before it; then differences over the span.
        sums = np.insert(sums.cumsum(axis=axis), 0, 0, axis=axis)
        index = (slice(None),) * axis
        sums = sums[(*index, slice(span, None))] - sums[(*index, slice(None, -span))]
    return int(sums.max())


def _units(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def morton_order(units: NDArray[np.float64]) -> NDArray[np.intp]:
    """The order (N,) of unit directions (N, 3) along a Morton curve through the cube around the sphere."""
    steps = _in_steps(units, 1 << _MORTON_BITS)
    key = np.zeros(len(units), np.int64)
    for bit in range(_MORTON_BITS):
        for axis in range(3):
            key |= (steps[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")


def _in_steps(units: NDArray[np.float64], steps: int) -> NDArray[np.int64]:
    """The one of so many steps from -1 to 1 that each component lies in."""
    return np.clip(np.floor((units + 1.0) * (steps / 2)), 0, steps - 1).astype(np.int64)
