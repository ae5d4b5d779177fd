"""The colours of marginals: one scale for files and pictures."""

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

LOWEST = 0.5
"""The marginal at the dark end of the scale; below it a voxel counts as free and is not shown."""


def viridis() -> NDArray[np.uint8]:
    """The 256 colours of viridis, dark to bright, (256, 3) RGB."""
    ramp = np.arange(256, dtype=np.uint8)[:, None]
    return np.ascontiguousarray(cv2.applyColorMap(ramp, cv2.COLORMAP_VIRIDIS)[:, 0, ::-1])


def marginal_colors(probability: ArrayLike) -> NDArray[np.uint8]:
    """Marginals to colours, (...) to (..., 3) RGB: viridis from LOWEST to 1."""
    share = (np.asarray(probability, dtype=np.float32) - LOWEST) / (1.0 - LOWEST)
    return viridis()[np.rint(255 * np.clip(share, 0.0, 1.0)).astype(np.uint8)]
