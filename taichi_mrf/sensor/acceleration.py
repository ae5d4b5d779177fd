"""Measurements of an accelerometer beside the camera, and which way is up if the camera is held still."""

from dataclasses import dataclass

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


def upwards_at(samples: AccelerationSamples, first_s: float) -> NDArray[np.float64] | None:
    """Upwards as :func:`upwards` has it, by the samples around the first image, at ``first_s``."""
    return upwards(samples.accelerations_m_s2[np.abs(samples.stamps_s - first_s) <= AT_REST_S])
