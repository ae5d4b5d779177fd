"""Signed distances from a surface for the voxels of some bricks, as sums over measurements."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class DistanceField:
    """``bricks`` (n, 3) ascending, and for their voxels ``weight`` (n, 512), and ``distance`` (n, 512) in
    voxels times weight, positive in front of the surface. A weight of 1 is that of a pixel whose standard
    deviation is far below the voxel size; one of standard deviation s, in voxels, has 1 / (16 s^2 + 1)."""

    bricks: NDArray[np.int32]
    weight: NDArray[np.float32]
    distance: NDArray[np.float32]
