"""The polynomials of many patches at once, each with the covariance of its coefficients, and how they are
kept above a floor: sigma must be positive."""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import ArrayLike, NDArray

CHECKED_DEPTHS = 200
_STEPS = 2000


@dataclass(frozen=True)
class Curves:
    """Polynomials in ascending powers: ``coefficients`` (patches, terms), ``covariance`` (patches, terms,
    terms), the best estimate and its uncertainty."""

    coefficients: NDArray[np.float64]
    covariance: NDArray[np.float64]

    def at(self, x: ArrayLike) -> NDArray[np.float64]:
        """Values at each of ``x`` (N,), (patches, N)."""
        return np.asarray(self.coefficients @ self._powers(x).T, np.float64)

    def standard_error(self, x: ArrayLike) -> NDArray[np.float64]:
        """One standard deviation of what :meth:`at` gives, (patches, N)."""
        powers = self._powers(x)
        variance = np.einsum("ni,pij,nj->pn", powers, self.covariance, powers)
        return np.sqrt(np.maximum(variance, 0.0))

    def in_metres(self, low: float, high: float) -> "Curves":
        """The curves over depth, where these are over depth scaled to -1 at ``low``, 1 at ``high``."""
        terms = self.coefficients.shape[1]
        line = np.array([-(low + high), 2.0]) / (high - low)
        change = np.zeros((terms, terms))
        for k in range(terms):
            expanded = polynomial.polypow(line, k)
            change[: len(expanded), k] = expanded
        return Curves(self.coefficients @ change.T, change @ self.covariance @ change.T)

    def _powers(self, x: ArrayLike) -> NDArray[np.float64]:
        return np.vander(np.asarray(x, np.float64), self.coefficients.shape[1], increasing=True)


@dataclass(frozen=True)
class Prior:
    """The belief about each patch's curve before its own samples: mean (patches, terms) and information,
    the inverse of the covariance, (patches, terms, terms). Zero information is no belief."""

    mean: NDArray[np.float64]
    information: NDArray[np.float64]

    @classmethod
    def none(cls, patches: int, terms: int) -> "Prior":
        return cls(np.zeros((patches, terms)), np.zeros((patches, terms, terms)))


def kept_above(curves: Curves, floor: float, low: float, high: float) -> tuple[Curves, NDArray[np.bool_]]:
    """The curves, and which of them had to be changed to be at least ``floor`` from ``low`` to ``high``.

    A curve is moved as little as its covariance allows for: most where the samples determine it least. The
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
    the one that gains most. A remaining deficit is added to the constant.
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
