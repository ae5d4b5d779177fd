"""How sure the matching of a stereo pair is of each disparity: a standard deviation for each pixel.

Two things that a matcher leaves behind predict its errors. One is the cost of the match: with c(x) the mean
squared difference of the two blocks when the disparity is moved by x pixels, sqrt(c(0) / c'') is about the
move that doubles the cost. It is small where the images agree and have texture, and large where either is
missing. The other is the spread of the disparities around: at an edge, and on a slope, a block holds several
depths.

    sigma_d = SIGMA_PX * move^MOVE_POWER * (SPREAD_OFFSET_PX + spread)^SPREAD_POWER
"""

import cv2
import numpy as np
from numpy.typing import NDArray

SIGMA_PX, MOVE_POWER, SPREAD_POWER = 0.47, 0.3, 1 / 3
"""Fitted on the first 12 pairs of a street (KITTI sequence 1): the likelihood of what the next pair measures
at the same points. The scale, 1.2 times the fitted one, was chosen on pairs 25 to 38 by the likelihood of
those that were held out of the map."""

SPREAD_OFFSET_PX = 0.1
"""A spread that is no spread: disparities come in sixteenths of a pixel."""

BLOCK = 5
"""Side in pixels of the blocks whose difference and whose spread are taken."""

MOVE_RANGE_PX = (0.1, 3.0)
SPREAD_RANGE_PX = (0.06, 3.0)
"""Beyond these they predict no more."""


def disparity_sigma(
    left: NDArray[np.uint8], right: NDArray[np.uint8], disparity_px: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Standard deviation of each pixel's disparity, (H, W) float32 in pixels, 0 where there is none.

    ``left`` and ``right`` are the grey pair, (H, W), ``disparity_px`` that of the left image, 0 = none.
    """
    before, here, behind = (_cost(left, right, disparity_px, shift) for shift in (-1.0, 0.0, 1.0))
    curvature = np.maximum(before + behind - 2 * here, np.float32(1e-6))
    move = np.clip(np.sqrt(here / curvature), *MOVE_RANGE_PX)
    spread = np.clip(_spread(disparity_px), *SPREAD_RANGE_PX)
    sigma = SIGMA_PX * move**MOVE_POWER * (SPREAD_OFFSET_PX + spread) ** SPREAD_POWER
    return np.where(disparity_px > 0, sigma, 0.0).astype(np.float32)


def _cost(
    left: NDArray[np.uint8], right: NDArray[np.uint8], disparity_px: NDArray[np.float32], shift_px: float
) -> NDArray[np.float32]:
    """Mean squared difference of the blocks around each pixel and its partner, ``shift_px`` beside it. The
    mean difference does not count: the two cameras may be exposed differently."""
    rows, columns = np.indices(disparity_px.shape, dtype=np.float32)
    partner = columns - disparity_px - np.float32(shift_px)
    moved = cv2.remap(
        right.astype(np.float32), partner, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    difference = left.astype(np.float32) - moved
    difference -= cv2.boxFilter(difference, -1, (BLOCK, BLOCK))
    # OpenCV's running sums may come out just below zero.
    return np.maximum(cv2.boxFilter(difference**2, -1, (BLOCK, BLOCK)), np.float32(0.0))


def _spread(disparity_px: NDArray[np.float32]) -> NDArray[np.float32]:
    """The largest minus the smallest disparity of the block around each pixel."""
    block = np.ones((BLOCK, BLOCK), np.uint8)
    nearest = cv2.dilate(disparity_px, block)
    farthest = cv2.erode(np.where(disparity_px > 0, disparity_px, np.float32(1e4)), block)
    spread: NDArray[np.float32] = nearest - farthest
    return spread
