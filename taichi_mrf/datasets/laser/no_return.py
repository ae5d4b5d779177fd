"""Find in the scans which range a laser scanner reports for a beam without a return.

A scanner without a return reports its greatest range or an error code just below it: 81.91 and 81.83 m, 50 m,
32.77 m, ... Such beams pile up at one value, however far the robot moves; real surfaces do not.
"""

import numpy as np
from numpy.typing import NDArray

DEFAULT_M = 49.5
"""Without a peak in the scans, ranges from here on count as no return: no wall indoors is as far away."""

TOLERANCE = 0.003
"""Ranges within this share of the largest one mean no return too: 81.83 to 81.91 m are error codes."""

_STEP_M = 0.01
_LONGEST_M = 1e4
_LEAST_BEAMS = 20
_TIMES_ITS_NEIGHBOURS = 10
_LEAST_MOTION_M = 1.0
_STRAY_SHARE = 0.01


def find_no_return_m(range_m: NDArray[np.floating], pose_x_y_theta: NDArray[np.floating]) -> float | None:
    """The least range (metres) that means no return, or None if no value stands out.

    ``range_m`` (N, B) are all scans, ``pose_x_y_theta`` (N, 3) the poses of the scanner. The value has at
    least 20 beams, ten times as many as any bin of 1 cm between half of it and itself, is reported from
    places at least 1 m apart, and hardly any range (1% of those beams) is larger.
    """
    steps = np.rint(np.minimum(range_m[range_m > 0], _LONGEST_M) / _STEP_M).astype(np.int64)
    count = np.bincount(steps)
    above = np.concatenate([np.cumsum(count[::-1])[::-1][1:], [0]])
    peaks = np.flatnonzero((count >= _LEAST_BEAMS) & (above <= _STRAY_SHARE * count))
    if len(peaks) == 0:
        return None
    peak = int(peaks[-1])
    first = int(np.floor(peak * (1 - TOLERANCE)))
    below = count[peak // 2 : first]
    if len(below) == 0 or count[peak] < _TIMES_ITS_NEIGHBOURS * below.max():
        return None
    limit_m = (first - 0.5) * _STEP_M
    places = pose_x_y_theta[(range_m >= limit_m).any(axis=1), :2]
    return float(limit_m) if np.ptp(places, axis=0).max() >= _LEAST_MOTION_M else None
