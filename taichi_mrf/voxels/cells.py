"""The rule for cells of 2, 4 and 8 voxels a side: how likely each holds something, and which stand in for
voxels.

Where a surface's depth is uncertain no voxel is likely to be occupied, but a cell that reaches across the
uncertainty is. The probability of a cell follows from the marginals of its voxels by the rule of
queries/within.py: the likeliest line of voxels along an axis, of the axis that gives the least.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.voxels.layout import BRICK

SIDES = (2, 4, 8)
"""Sides of the cells, in voxels."""

SUREST = 1 - 1e-6
"""Probability of a cell beyond which its log-odds do not grow."""


def cell_probabilities(
    marginals: NDArray[np.float32], evidence: NDArray[np.bool_]
) -> dict[int, NDArray[np.float32]]:
    """The probability of each cell of some bricks, by side: (n, 512) marginals -> (n, (8 / side)^3),
    row-major. ``evidence`` (n, 512) are the voxels with evidence of a surface: those that are likelier than
    the prior."""
    n = len(marginals)
    # Bricks come last, so that neighbouring voxels of all bricks are added up at once.
    grid = (BRICK, BRICK, BRICK, n)
    in_one = np.where(evidence, marginals, np.float32(0)).T.reshape(grid)
    in_none = np.where(evidence, np.float32(1), 1 - marginals).T.reshape(grid)
    likely = {side: np.ones((BRICK // side,) * 3 + (n,), np.float32) for side in SIDES}
    for axis in range(3):
        surface, free = in_one, in_none
        for side in SIDES:
            # Lines of so many voxels along the axis, each from two of half the length.
            first, second = _halves(surface, axis)
            surface = first + second
            first, second = _halves(free, axis)
            free = first * second
            rarest = free * np.maximum(1 - surface, 0)
            for across in range(3):
                for _ in range(0 if across == axis else side.bit_length() - 1):
                    rarest = np.minimum(*_halves(rarest, across))
            np.minimum(likely[side], 1 - rarest, out=likely[side])
    return {side: found.reshape((BRICK // side) ** 3, n).T for side, found in likely.items()}


def standing_in(
    marginals: NDArray[np.float32], evidence: NDArray[np.bool_], threshold: float
) -> Iterator[tuple[int, NDArray[np.bool_], NDArray[np.float32]]]:
    """For some bricks, (n, 512), and each side: which cells stand in for voxels, and the probability of all
    cells, (n, cells) in row-major order each.

    A cell stands in for its voxels if it reaches ``threshold``, and no voxel and no smaller cell in it does.
    Voxels without evidence of a surface do not count.
    """
    known = np.where(evidence, marginals, np.float32(0))
    reached = known >= threshold
    for side, likely in cell_probabilities(known, evidence).items():
        reached = _any_of_eight(reached)
        standing = (likely >= threshold) & ~reached
        reached |= standing
        yield side, standing, likely


def lowest_voxels(side: int) -> NDArray[np.int32]:
    """The lowest voxel of each cell of a brick, (cells, 3), 0 to 7."""
    return np.indices((BRICK // side,) * 3, np.int32).reshape(3, -1).T * side


def voxels_of_cells(side: int) -> NDArray[np.int64]:
    """The numbers in a brick of each cell's voxels, (cells, side^3)."""
    across = BRICK // side
    numbers = np.arange(BRICK**3).reshape(across, side, across, side, across, side)
    return numbers.transpose(0, 2, 4, 1, 3, 5).reshape(across**3, side**3)


def _halves(values: NDArray[np.float32], axis: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The even and the odd places along an axis."""
    before = (slice(None),) * axis
    return values[(*before, slice(0, None, 2))], values[(*before, slice(1, None, 2))]


def _any_of_eight(flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """True for a cell if any of its eight parts has a flag: (n, k^3) of the parts -> (n, (k / 2)^3)."""
    half = round(flags.shape[1] ** (1 / 3)) // 2
    parts = flags.reshape(-1, half, 2, half, 2, half, 2)
    return parts.any(axis=(2, 4, 6)).reshape(len(flags), half**3)
