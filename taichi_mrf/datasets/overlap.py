"""What one frame says of the surfaces that another one saw."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose


class Projection(Protocol):
    """The part of a camera (sensor/camera.py) that is needed here."""

    def project(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Column, row and depth at which points (N, 3) are seen, (N, 3), NaN for those that no pixel sees."""


def seen_again(
    points: NDArray[np.float64], T_second_first: Pose, second: NDArray[np.floating], camera: Projection
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (N, 3) of the first frame in a second depth image (H, W): the depths (N,) that they should have
    there, and those that it measured, 0 where it sees or measures nothing."""
    u, v, expected = camera.project(points @ T_second_first[:3, :3].T + T_second_first[:3, 3]).T
    measured = np.zeros(len(points))
    inside = ~np.isnan(expected)
    measured[inside] = second[np.rint(v[inside]).astype(int), np.rint(u[inside]).astype(int)]
    return expected, measured
