"""What one frame says of the surfaces that another one saw."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose


class Projection(Protocol):
    """The part of a camera (sensor/camera.py) that is needed here."""

    def project(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Column, row and depth at which points (N, 3) are seen, (N, 3), NaN for those that no pixel sees."""


@dataclass(frozen=True)
class SeenAgain:
    """Points of one frame in another: the depths that they should have there and those that it measured, 0
    where it sees or measures nothing, and the ``rows`` and ``columns`` of the latter, -1 if it does not see
    the point; (N,) each."""

    expected: NDArray[np.float64]
    measured: NDArray[np.float64]
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]


def seen_again(
    points: NDArray[np.float64], T_second_first: Pose, second: NDArray[np.floating], camera: Projection
) -> SeenAgain:
    """Points (N, 3) of the first frame, in the frame of its camera, in a second depth image (H, W)."""
    u, v, expected = camera.project(points @ T_second_first[:3, :3].T + T_second_first[:3, 3]).T
    inside = ~np.isnan(expected)
    rows, columns = (np.where(inside, np.rint(each), -1).astype(np.int64) for each in (v, u))
    return SeenAgain(expected, np.where(inside, second[rows, columns], 0.0), rows, columns)
