"""Weighted least squares for bias and sigma of many patches, from the sums of their cells, as polynomials.

Each polynomial has the covariance of its coefficients, and is kept above a floor where it must: sigma is
positive. Bias: the errors regressed on powers of the true depth, each cell weighted with 1 / sigma^2. Sigma:
the standard deviation of each cell's residuals, regressed likewise, with the weight 2 n / sigma^2 that the
standard deviation of n normal samples has. Each of the two needs the other, so they are fitted in turns.
"""

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


ROUNDS = 4
"""Turns of bias and sigma. The weights then move the result by far less than its standard error."""

_SIGMA_ROUNDS = 5
_LEAST_SHARE = 0.1
"""Lower bound of the sigma that weights a cell, as a share of the cell's own spread: a polynomial may pass
near zero before it converges."""

_TINY_M = 1e-7


@dataclass(frozen=True)
class Sums:
    """The sums of samples.Moments for the cells that count; all others are zero.

    (patches, bins, 2 degree + 1), (patches, bins, degree + 1) and (patches, bins).
    """

    powers: NDArray[np.float64]
    products: NDArray[np.float64]
    squares: NDArray[np.float64]

    @property
    def counts(self) -> NDArray[np.float64]:
        return self.powers[..., 0]

    @property
    def terms(self) -> int:
        return self.products.shape[-1]

    def of(self, patches: NDArray[np.bool_]) -> "Sums":
        """The sums of some patches only."""
        return Sums(self.powers[patches], self.products[patches], self.squares[patches])

    def merged(self) -> "Sums":
        """The sums of all patches together."""
        return Sums(*(each.sum(axis=0, keepdims=True) for each in (self.powers, self.products, self.squares)))

    def outer(self) -> NDArray[np.float64]:
        """The sums of t^(j + k), (patches, bins, terms, terms)."""
        j, k = np.indices((self.terms, self.terms))
        return self.powers[..., j + k]


@dataclass(frozen=True)
class Fit:
    """Bias and sigma over the scaled depth, and how well the bias polynomial fits.

    ``misfit`` is, for each patch, the mean square of the distance of its bins' mean errors from the curve,
    in their own standard errors and corrected for the fitted terms: about 1 if errors are independent and
    the polynomial has the right shape; NaN for patches without bins to spare.
    """

    bias: Curves
    sigma: Curves
    misfit: NDArray[np.float64]


def fit_curves(sums: Sums, bias_prior: Prior, sigma_prior: Prior) -> Fit:
    """Fit all patches. Each must have enough bins, or a prior, to determine its curves."""
    n, outer = np.maximum(sums.counts, 1.0), sums.outer()
    mean = sums.products[..., 0] / n
    variance = np.maximum((sums.squares - n * mean**2) / np.maximum(n - 1, 1.0), _TINY_M**2)
    for _ in range(ROUNDS):
        weight = np.where(sums.counts > 0, 1.0 / variance, 0.0)
        bias = _solve(
            np.einsum("pb,pbij->pij", weight, outer),
            np.einsum("pb,pbi->pi", weight, sums.products),
            bias_prior,
        )
        squares, freedom = _residuals(sums, outer, weight, bias)
        sigma, variance = _fit_sigma(sums, outer, squares, freedom, sigma_prior)
    return Fit(bias, sigma, _misfit(sums, bias, variance))


def _residuals(
    sums: Sums, outer: NDArray[np.float64], weight: NDArray[np.float64], bias: Curves
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Each cell's sum of squared residuals, and its samples minus the degrees of freedom of the fit."""
    beta = bias.coefficients
    squares = (
        sums.squares
        - 2 * np.einsum("pi,pbi->pb", beta, sums.products)
        + np.einsum("pi,pbij,pj->pb", beta, outer, beta)
    )
    leverage = weight * np.einsum("pbij,pij->pb", outer, bias.covariance)
    return np.maximum(squares, 0.0), np.maximum(sums.counts - leverage, 1.0)


def _fit_sigma(
    sums: Sums,
    outer: NDArray[np.float64],
    squares: NDArray[np.float64],
    freedom: NDArray[np.float64],
    prior: Prior,
) -> tuple[Curves, NDArray[np.float64]]:
    """The sigma polynomials, and the variance that they predict for each cell."""
    n = np.maximum(sums.counts, 1.0)
    x = sums.powers[..., : sums.terms] / n[..., None]
    # The root of an unbiased variance is too small by 1 / (4 n).
    shown = np.maximum(np.sqrt(squares / freedom) * (1 + 0.25 / freedom), _TINY_M)
    value, excess = shown, np.zeros_like(shown)
    for _ in range(_SIGMA_ROUNDS):
        weight = np.where(sums.counts > 0, 2 * freedom / value**2, 0.0)
        sigma = _solve(
            np.einsum("pb,pbi,pbj->pij", weight, x, x),
            np.einsum("pb,pbi,pb->pi", weight, x, shown - excess),
            prior,
        )
        beta = sigma.coefficients
        mean = np.einsum("pi,pbi->pb", beta, x)
        root = np.sqrt(np.maximum(np.einsum("pi,pbij,pj->pb", beta, outer, beta) / n, 0.0))
        # A cell measures the root of its mean variance: more than its mean sigma where sigma is steep.
        excess = root - np.abs(mean)
        value = np.maximum(root, _LEAST_SHARE * shown)
    return sigma, value**2


def _solve(information: NDArray[np.float64], vector: NDArray[np.float64], prior: Prior) -> Curves:
    total = information + prior.information
    covariance = np.asarray(np.linalg.inv(total), np.float64)
    vector = vector + np.einsum("pij,pj->pi", prior.information, prior.mean)
    return Curves(np.einsum("pij,pj->pi", covariance, vector), covariance)


def _misfit(sums: Sums, bias: Curves, variance: NDArray[np.float64]) -> NDArray[np.float64]:
    predicted = np.einsum("pi,pbi->pb", bias.coefficients, sums.powers[..., : sums.terms])
    n = np.maximum(sums.counts, 1.0)
    square = np.where(sums.counts > 0, (sums.products[..., 0] - predicted) ** 2 / (n * variance), 0.0)
    spare = (sums.counts > 0).sum(axis=1) - sums.terms
    return np.where(spare > 0, square.sum(axis=1) / np.maximum(spare, 1), np.nan)
