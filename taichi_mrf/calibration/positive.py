"""Keeping fitted sigma positive: the nearest curve, by its own uncertainty, that stays above a floor."""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.calibration.curves import Curves

CHECKED_DEPTHS = 200
_STEPS = 2000


def kept_above(curves: Curves, floor: float, low: float, high: float) -> tuple[Curves, NDArray[np.bool_]]:
    """The curves, and which of them had to be changed to be at least ``floor`` from ``low`` to ``high``.

    A curve is moved as little as its covariance allows for: most where the samples said least. The
    covariance stays that of the samples.
    """
    depths = np.linspace(low, high, CHECKED_DEPTHS)
    changed = np.asarray((curves.at(depths) < floor).any(axis=1))
    coefficients = curves.coefficients.copy()
    rows = np.vander(depths, coefficients.shape[1], increasing=True)
    for patch in np.flatnonzero(changed):
        coefficients[patch] = _lifted(coefficients[patch], curves.covariance[patch], rows, floor)
    return Curves(coefficients, curves.covariance), changed


def _lifted(
    beta: NDArray[np.float64], covariance: NDArray[np.float64], rows: NDArray[np.float64], floor: float
) -> NDArray[np.float64]:
    """Minimise (b - beta)^T covariance^-1 (b - beta) so that rows b >= floor (Hildreth 1957).

    The dual has one multiplier, never negative, for each row; they are improved one at a time, always
    the one that gains most. What is missing at the end is added to the constant.
    """
    reach = covariance @ rows.T
    gain = np.maximum(np.einsum("ni,in->n", rows, reach), 1e-300)
    multipliers = np.zeros(len(rows))
    b = beta.copy()
    for _ in range(_STEPS):
        step = np.maximum((floor - rows @ b) / gain, -multipliers)
        best = int(np.argmax(step**2 * gain))
        if abs(step[best]) * gain[best] < 1e-3 * floor:
            break
        multipliers[best] += step[best]
        b += reach[:, best] * step[best]
    b[0] += max(0.0, floor - float((rows @ b).min()))
    return b
