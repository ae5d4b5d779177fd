"""Turn of a tracked camera since its last frame, by its gyroscope, whose bias is learnt on the way."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.rules import RULES
from taichi_mrf.alignment.se3 import twist
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.frame import Frame


class GyroTurns:
    """Turns between frames. ``bias_rad_s`` (3,) is what the gyroscope measures when nothing turns."""

    def __init__(self) -> None:
        self.bias_rad_s = np.zeros(3)
        self._noted = 0

    def since(self, frame: Frame, stamp: float) -> NDArray[np.float64] | None:
        """(3, 3): the rotation from the frame's camera frame to that at ``stamp``; None if it is unknown."""
        if frame.gyro is None or not np.isfinite([stamp, frame.stamp]).all():
            return None
        return frame.gyro.turn(stamp, frame.stamp, self.bias_rad_s)

    def note(self, frame: Frame, stamp: float, T_before: Pose, T_now: Pose) -> None:
        """Learn from where tracking found the camera at ``stamp`` and at the frame, (4, 4)."""
        R = self.since(frame, stamp)
        if R is None:
            return
        beyond = np.eye(4)
        beyond[:3, :3] = T_now[:3, :3].T @ T_before[:3, :3] @ R
        rate = twist(beyond)[3:] / (frame.stamp - stamp)
        if np.abs(rate).max() < RULES.largest_bias_rad_s:
            self._noted += 1
            self.bias_rad_s = self.bias_rad_s + max(RULES.gyro_share, 1 / self._noted) * rate


def turned(guesses: Sequence[Pose], T_before: Pose, R_before_now: NDArray[np.float64] | None) -> list[Pose]:
    """Guesses that are reached from a pose, with the turn that is known, if it is."""
    if R_before_now is None:
        return list(guesses)
    found = []
    for guess in guesses:
        T = guess.copy()
        T[:3, :3] = T_before[:3, :3] @ R_before_now
        found.append(T)
    return found
