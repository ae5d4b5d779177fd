"""Which way is up, by an accelerometer beside a camera that is held still."""

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


def upwards_at(
    stamps_s: NDArray[np.float64], accelerations: NDArray[np.float64], first_s: float
) -> NDArray[np.float64] | None:
    """The same by those samples (N, 3) that are around the first image, at ``first_s``; theirs are
    ``stamps_s`` (N,)."""
    return upwards(accelerations[np.abs(stamps_s - first_s) <= AT_REST_S])
