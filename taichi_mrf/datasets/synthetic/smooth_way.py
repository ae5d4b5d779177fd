"""A walk along a line of corners: rounded, at eye height, looking ahead and a little to all sides.

Distances along the way in metres say where the walker is; how fast that goes is up to the caller.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose, look_at

STEP_M = 0.02
"""Between neighbouring points of the way."""

EYE_M = 1.5


class SmoothWay:
    """The way past some corners, (n, 2) in metres, over a floor at ``floor_z``."""

    def __init__(
        self, corners: Sequence[tuple[float, float]], rounding_m: float = 3.0, floor_z: float = 0.0
    ) -> None:
        """Positions and headings are averaged over ``rounding_m`` metres."""
        table = np.asarray(corners, np.float64)
        reached = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(table, axis=0), axis=1))])
        window = np.hanning(2 * round(rounding_m / STEP_M / 2) + 1)
        window /= window.sum()
        margin = len(window) // 2 * STEP_M
        along = np.arange(-2 * margin, reached[-1] + 2 * margin, STEP_M)
        line = np.stack([_beyond(along, reached, table[:, axis]) for axis in (0, 1)], axis=1)
        smooth = np.stack([np.convolve(line[:, axis], window, "valid") for axis in (0, 1)], axis=1)
        steps = np.diff(smooth, axis=0)
        heading = np.convolve(np.unwrap(np.arctan2(steps[:, 1], steps[:, 0])), window, "valid")
        kept = smooth[len(window) // 2 :][: len(heading)]
        self._places = kept
        self._headings = heading
        self._reached = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(kept, axis=0), axis=1))])
        self._eye_z = floor_z + EYE_M

    @property
    def length_m(self) -> float:
        """From its beginning to its end."""
        return float(self._reached[-1])

    def pose_at(self, metres: float) -> Pose:
        """T_world_camera, (4, 4), at so many metres from the beginning."""
        x, y = (np.interp(metres, self._reached, self._places[:, axis]) for axis in (0, 1))
        heading = np.interp(metres, self._reached, self._headings) + 0.25 * math.sin(metres / 0.9)
        pitch = -0.15 + 0.1 * math.sin(metres / 1.3)
        eye = np.array([x, y, self._eye_z + 0.03 * math.sin(metres / 0.4)])
        return look_at(eye, eye + np.array([math.cos(heading), math.sin(heading), math.tan(pitch)]))


def _beyond(
    along: NDArray[np.float64], reached: NDArray[np.float64], values: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Linear interpolation that goes on straight beyond both ends."""
    inside = np.interp(along, reached, values)
    first = (values[1] - values[0]) / (reached[1] - reached[0])
    last = (values[-1] - values[-2]) / (reached[-1] - reached[-2])
    return inside + first * np.minimum(along, 0.0) + last * np.maximum(along - reached[-1], 0.0)
