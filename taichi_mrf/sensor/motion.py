"""Measurements of an accelerometer and a gyroscope beside the camera: which way is up if it is held still,
and how it turns.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

GRAVITY = 9.81
"""Metres per square second."""

AT_REST_S = 0.3
"""Seconds before and after the first image in which accelerations say which way is up."""

AT_REST = 0.4
"""Largest departure of the mean from GRAVITY, and largest standard deviation along an axis, of a camera that
is held still: then up is right to about 2 degrees."""

LEAST_SAMPLES = 10

MOST_SAMPLES = 2000
"""Samples beside a camera that runs, of a gyroscope as of an accelerometer, that are kept: at least 5 s."""


@dataclass(frozen=True)
class AccelerationSamples:
    """Accelerations (N, 3) in metres per square second along the axes of the camera frame, against free fall:
    at rest they point upwards. ``stamps_s`` (N,) are ascending seconds of the frames' clock, and
    ``position_m`` (3,) is the accelerometer's place in the camera frame."""

    stamps_s: NDArray[np.float64]
    accelerations_m_s2: NDArray[np.float64]
    position_m: NDArray[np.float64]


def upwards(accelerations: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Upwards, a unit vector (3,), by what an accelerometer measures (N, 3) in metres per square second; None
    if it does not rest."""
    measured = accelerations[np.isfinite(accelerations).all(axis=1)]
    if len(measured) < LEAST_SAMPLES:
        return None
    mean = measured.mean(axis=0)
    size = float(np.linalg.norm(mean))
    if abs(size - GRAVITY) > AT_REST or measured.std(axis=0).max() > AT_REST:
        return None
    return np.asarray(mean / size)


def upwards_at(samples: AccelerationSamples | None, first_s: float) -> NDArray[np.float64] | None:
    """Upwards as :func:`upwards` has it, by the samples around the first image, at ``first_s``; None without
    any."""
    if samples is None:
        return None
    return upwards(samples.accelerations_m_s2[np.abs(samples.stamps_s - first_s) <= AT_REST_S])


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
