"""Angular rates that a gyroscope beside the camera has measured, and the turns that follow from them."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

LARGEST_GAP_S = 0.05
"""Seconds between neighbouring samples, and before the first and after the last, that may be bridged."""


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
        turns = self.turns(np.array([begin_s, end_s]), bias_rad_s)
        return None if turns is None else turns[1]

    def turns(
        self, times_s: NDArray[np.float64], bias_rad_s: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64] | None:
        """(M, 3, 3): the same from the camera frames at ascending times (M,) to that at the first."""
        within = times_within(self.stamps_s, times_s[0], times_s[-1])
        if within is None:
            return None
        times = np.union1d(within, times_s)
        at_times = np.stack([np.interp(times, self.stamps_s, rate) for rate in self.rates_rad_s.T], axis=1)
        means = (at_times[1:] + at_times[:-1]) / 2 - (0.0 if bias_rad_s is None else bias_rad_s)
        turns = [np.eye(3)]
        for step in means * np.diff(times)[:, None]:
            turns.append(turns[-1] @ cv2.Rodrigues(step)[0])
        return np.stack(turns)[np.searchsorted(times, times_s)]


def times_within(stamps_s: NDArray[np.float64], begin_s: float, end_s: float) -> NDArray[np.float64] | None:
    """The stamps of samples between two times, and these; None if they leave gaps above LARGEST_GAP_S."""
    if not begin_s < end_s or not len(stamps_s):
        return None
    first, last = np.searchsorted(stamps_s, [begin_s, end_s])
    stamps = stamps_s[max(0, first - 1) : last + 1]
    apart = np.diff([min(begin_s, stamps[0]), *stamps, max(end_s, stamps[-1])])
    if apart.max() > LARGEST_GAP_S:
        return None
    return np.array([begin_s, *stamps[(stamps > begin_s) & (stamps < end_s)], end_s])
