"""Angular rates that a gyroscope beside the camera has measured, and the turns that follow from them."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

LARGEST_GAP_S = 0.05
"""Seconds between neighbouring samples, and before the first and after the last, that a turn may bridge."""


@dataclass(frozen=True)
class GyroSamples:
    """Angular rates (N, 3) in radians a second about the axes of the camera frame, at ascending ``stamps_s``
    (N,) in seconds, those of the frames' clock."""

    stamps_s: NDArray[np.float64]
    rates_rad_s: NDArray[np.float64]

    def turn(
        self, begin_s: float, end_s: float, bias_rad_s: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64] | None:
        """(3, 3): the rotation from the camera frame at ``end_s`` to that at ``begin_s``, None where samples
        are missing. ``bias_rad_s`` (3,) is taken off the rates. A constant rate gives the exact turn."""
        if not begin_s < end_s or not len(self.stamps_s):
            return None
        first, last = np.searchsorted(self.stamps_s, [begin_s, end_s])
        used = slice(max(0, first - 1), last + 1)
        stamps, rates = self.stamps_s[used], self.rates_rad_s[used]
        apart = np.diff([min(begin_s, stamps[0]), *stamps, max(end_s, stamps[-1])])
        if apart.max() > LARGEST_GAP_S:
            return None
        times = np.array([begin_s, *stamps[(stamps > begin_s) & (stamps < end_s)], end_s])
        at_times = np.stack([np.interp(times, stamps, rate) for rate in rates.T], axis=1)
        means = (at_times[1:] + at_times[:-1]) / 2 - (0.0 if bias_rad_s is None else bias_rad_s)
        R = np.eye(3)
        for step in means * np.diff(times)[:, None]:
            R = R @ cv2.Rodrigues(step)[0]
        return R
