"""Learning a sensor's noise from pairs of measured and true depth: two passes over them, then the fit of a
noise table with own polynomials, borrowed ones, sigma kept positive.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.calibration.least_squares import Curves, Fit, Prior, Sums, fit_curves, kept_above
from taichi_mrf.calibration.options import CalibrationConfig
from taichi_mrf.calibration.pairs import PairSource
from taichi_mrf.calibration.samples import Cells, ErrorHistograms, Moments
from taichi_mrf.errors import DatasetError
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PatchNoise

NEIGHBOURS = 8
"""Least number of patches that a borrowing one learns from: enough to estimate how much neighbours differ."""

BEST_COVERED = 0.9
"""Spans are compared with that of the patch at this quantile, which a stray bin far away does not move."""


@dataclass(frozen=True)
class LearntNoise:
    """Bias and sigma of each patch over depth in metres, with the data they follow from.

    ``counts`` are the samples of each cell, (patches, bins); ``covered`` the cells that counted; ``own`` the
    patches that needed no neighbour; ``lifted`` those whose sigma had to be kept from falling to zero;
    ``misfit`` as in least_squares.Fit. ``mean_error`` and ``spread`` are mean and standard deviation of
    the errors of each cell that counted, in metres, NaN elsewhere: what the curves go through.
    """

    cells: Cells
    bias: Curves
    sigma: Curves
    counts: NDArray[np.int64]
    covered: NDArray[np.bool_]
    own: NDArray[np.bool_]
    lifted: NDArray[np.bool_]
    misfit: NDArray[np.float64]
    mean_error: NDArray[np.float64]
    spread: NDArray[np.float64]

    def model(self) -> PatchNoise:
        """The noise as MRFMap takes it."""
        return PatchNoise(
            self.sigma.coefficients, self.bias.coefficients, self.cells.options.patch, self.cells.camera
        )


def learn(moments: Moments, counts: NDArray[np.int64]) -> LearntNoise:
    """Fit every patch; ``counts`` are all samples, outliers included, for the report.

    A patch stands on its own if its bins are enough and span enough depth. For any other, the mean and
    spread of the curves of its nearest neighbours that do are the prior, which its own samples update.
    With fewer than NEIGHBOURS patches of that kind in the image, the others get one curve made from all
    samples.

    Raises DatasetError if there are too few samples for a single polynomial.
    """
    cells, options = moments.cells, moments.cells.options
    covered = moments.counts >= options.least_count
    sums = Sums(
        moments.powers * covered[..., None], moments.products * covered[..., None], moments.squares * covered
    )
    _check_enough(covered, counts, options)
    own = _standing_alone(covered, options)
    fit = _fit_all(sums, own, cells.columns)
    low, high = options.min_depth, options.max_depth
    sigma, lifted = kept_above(fit.sigma.in_metres(low, high), options.least_sigma, low, high)
    mean_error, spread = _shown(moments, covered)
    return LearntNoise(
        cells,
        fit.bias.in_metres(low, high),
        sigma,
        counts,
        covered,
        own,
        lifted,
        fit.misfit,
        mean_error,
        spread,
    )


def _shown(moments: Moments, covered: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    n = np.where(covered, moments.counts, np.nan)
    mean = moments.products[..., 0] / n
    return mean, np.sqrt(np.maximum(moments.squares - n * mean**2, 0) / (n - 1))


def _check_enough(covered: NDArray[np.bool_], counts: NDArray[np.int64], options: CalibrationConfig) -> None:
    bins, needed = int(covered.any(axis=0).sum()), options.degree + 1
    if bins < needed:
        raise DatasetError(
            f"too few samples: {int(counts.sum()):,} pixels have measured and true depth from "
            f"{options.min_depth:g} to {options.max_depth:g} m, but they fill only {bins} depth bins of "
            f"{options.bin_width:g} m with {options.least_count} in one patch; a polynomial of degree "
            f"{options.degree} needs {needed}"
        )


def _standing_alone(covered: NDArray[np.bool_], options: CalibrationConfig) -> NDArray[np.bool_]:
    """Patches with a bin more than the polynomial has terms, which span enough of the depth."""
    bins = covered.sum(axis=1)
    first = np.argmax(covered, axis=1)
    last = covered.shape[1] - 1 - np.argmax(covered[:, ::-1], axis=1)
    span = np.where(bins > 0, last - first + 1, 0)
    wanted = options.least_span * np.quantile(span[bins > 0], BEST_COVERED)
    return (bins >= options.degree + 2) & (span >= wanted)


def _fit_all(sums: Sums, own: NDArray[np.bool_], columns: int) -> Fit:
    """The curves over scaled depth of all patches, own and borrowed."""
    patches, terms = len(own), sums.terms
    bias, sigma = _blank(patches, terms), _blank(patches, terms)
    misfit = np.full(patches, np.nan)
    if own.any():
        none = Prior.none(int(own.sum()), terms)
        alone = fit_curves(sums.of(own), none, none)
        _put(bias, own, alone.bias)
        _put(sigma, own, alone.sigma)
        misfit[own] = alone.misfit
    rest = ~own
    if rest.any() and own.sum() >= NEIGHBOURS:
        groups = _nearest(own, rest, columns)
        borrowed = fit_curves(sums.of(rest), _prior(bias, groups), _prior(sigma, groups))
        _put(bias, rest, borrowed.bias)
        _put(sigma, rest, borrowed.sigma)
    elif rest.any():
        none = Prior.none(1, terms)
        shared = fit_curves(sums.merged(), none, none)
        _put(bias, rest, shared.bias)
        _put(sigma, rest, shared.sigma)
    return Fit(bias, sigma, misfit)


def _blank(patches: int, terms: int) -> Curves:
    return Curves(np.zeros((patches, terms)), np.zeros((patches, terms, terms)))


def _put(target: Curves, where: NDArray[np.bool_], curves: Curves) -> None:
    target.coefficients[where] = curves.coefficients
    target.covariance[where] = curves.covariance


def _nearest(own: NDArray[np.bool_], rest: NDArray[np.bool_], columns: int) -> list[NDArray[np.int64]]:
    """For each borrowing patch, the patches to learn from: those in the smallest square around it that
    holds NEIGHBOURS of them."""
    givers = np.flatnonzero(own)
    rows_of, columns_of = np.divmod(givers, columns)
    groups = []
    for patch in np.flatnonzero(rest):
        row, column = divmod(int(patch), columns)
        distance = np.maximum(np.abs(rows_of - row), np.abs(columns_of - column))
        reach = np.partition(distance, NEIGHBOURS - 1)[NEIGHBOURS - 1]
        groups.append(givers[distance <= reach])
    return groups


def _prior(curves: Curves, groups: list[NDArray[np.int64]]) -> Prior:
    """Mean of each group's curves, and how far one more patch may lie from it: their spread, and their own
    errors once more, so that neighbours that agree by chance do not count as certain."""
    mean = np.stack([curves.coefficients[group].mean(axis=0) for group in groups])
    covariance = np.stack(
        [
            np.atleast_2d(np.cov(curves.coefficients[group].T)) + curves.covariance[group].mean(axis=0)
            for group in groups
        ]
    )
    return Prior(mean, np.linalg.inv(covariance))


@dataclass(frozen=True)
class Calibration:
    """The learnt noise, the numbers of samples and frames, and the number of outliers."""

    noise: LearntNoise
    frames: int
    empty_frames: list[str]
    samples: int
    outliers: int


def calibrate(
    source: PairSource,
    camera: PinholeCamera,
    options: CalibrationConfig,
    progress: Callable[[int], None] = lambda number: None,
) -> Calibration:
    """Learn bias and sigma for each patch of the camera's image.

    ``progress`` gets the number of images read, twice the number of pairs at the end. Raises
    DatasetError if an image cannot be read or has the wrong size, if no pixel has both depths, or if
    there are too few samples.
    """
    cells = Cells(camera, options)
    histograms = ErrorHistograms(cells)
    empty = []
    measured = False
    for number, name in enumerate(source.names, start=1):
        pair = source.read(name)
        measured = measured or bool((pair.measured_m > 0).any())
        if histograms.add(pair) == 0:
            empty.append(name)
        progress(number)
    if not measured:
        raise DatasetError(f"none of the {len(source.names)} depth images contains a measurement")
    if histograms.samples == 0:
        raise DatasetError(
            f"no pixel of the {len(source.names)} images has both measured and true depth from "
            f"{options.min_depth:g} to {options.max_depth:g} m"
        )
    moments = Moments(cells, histograms.limits())
    for number, name in enumerate(source.names, start=1):
        moments.add(source.read(name))
        progress(len(source.names) + number)
    counts = histograms.counts()
    noise = learn(moments, counts)
    return Calibration(noise, len(source.names) - len(empty), empty, histograms.samples, moments.outliers)
