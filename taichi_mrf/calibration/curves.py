"""The polynomials of many patches at once, each with the covariance of its coefficients."""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Curves:
    """Polynomials in ascending powers: ``coefficients`` (patches, terms), ``covariance`` (patches, terms,
    terms), the first the best estimate and the second how far it may be off."""

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
        """The same curves over depth, where these are over depth scaled to -1 at ``low``, 1 at ``high``."""
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
    """What is believed of each patch's curve before its own samples: mean (patches, terms) and information,
    the inverse of the covariance, (patches, terms, terms). No information means no belief."""

    mean: NDArray[np.float64]
    information: NDArray[np.float64]

    @classmethod
    def none(cls, patches: int, terms: int) -> "Prior":
        return cls(np.zeros((patches, terms)), np.zeros((patches, terms, terms)))
