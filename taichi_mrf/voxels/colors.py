"""The colours of voxels in files and pictures: of marginals on one scale, and where there are none."""

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

LOWEST = 0.5
"""The marginal at the dark end of the scale; below it a voxel counts as free and is not shown."""

MARGINAL_NOTE = f"color is viridis from occupancy {LOWEST} to 1"

NO_COLOR = 128
"""Each of red, green and blue of a voxel whose colour no camera saw, beside others that have one."""

PHOTO_NOTE = f"color is what cameras saw, {NO_COLOR} {NO_COLOR} {NO_COLOR} where none did"
"""Meaning of the colours in a file, for its header."""


def viridis() -> NDArray[np.uint8]:
    """The 256 colours of viridis, dark to bright, (256, 3) RGB."""
    ramp = np.arange(256, dtype=np.uint8)[:, None]
    return np.ascontiguousarray(cv2.applyColorMap(ramp, cv2.COLORMAP_VIRIDIS)[:, 0, ::-1])


def marginal_colors(probability: ArrayLike) -> NDArray[np.uint8]:
    """Marginals to colours, (...) to (..., 3) RGB: viridis from LOWEST to 1."""
    share = (np.asarray(probability, dtype=np.float32) - LOWEST) / (1.0 - LOWEST)
    return viridis()[np.rint(255 * np.clip(share, 0.0, 1.0)).astype(np.uint8)]
