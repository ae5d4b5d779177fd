"""Samples of depth error, gathered frame by frame into cells: a patch of pixels and a bin of true depth.

Two passes over the frames bound the memory, independent of their number. The first counts errors in
histograms, from whose quartiles the outliers of each cell are known. The second sums what least
squares needs of the others: powers of depth, and their products with the error.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.calibration.options import CalibrationConfig
from taichi_mrf.calibration.pairs import DepthPair
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import LEAST_SIGMA_M

HISTOGRAM_BINS = 128
FINEST_ERROR_M = 1e-3
"""Histogram bins are even below this error and grow with it above."""

LARGEST_ERROR_M = 2.0
"""Errors beyond this all fall into the last bin."""

_QUARTILES_PER_SIGMA = 1.349
"""The distance of the quartiles of a normal distribution, in standard deviations."""


@dataclass(frozen=True)
class Cells:
    """Division of pixels and depths into cells; cell = patch * bins + bin, patches row by row."""

    camera: PinholeCamera
    options: CalibrationConfig

    @property
    def columns(self) -> int:
        return -(-self.camera.width // self.options.patch)

    @property
    def rows(self) -> int:
        return -(-self.camera.height // self.options.patch)

    @property
    def patches(self) -> int:
        return self.rows * self.columns

    @cached_property
    def edges(self) -> NDArray[np.float64]:
        """Limits of the depth bins in metres, (bins + 1,); the last bin may be narrower."""
        low, high, width = self.options.min_depth, self.options.max_depth, self.options.bin_width
        count = max(1, int(np.ceil((high - low) / width - 1e-9)))
        return np.append(low + width * np.arange(count), high)

    @property
    def bins(self) -> int:
        return len(self.edges) - 1

    @cached_property
    def patch_of_pixel(self) -> NDArray[np.int64]:
        """The patch that each pixel belongs to, (H, W)."""
        v, u = np.indices(self.camera.shape)
        return (v // self.options.patch) * self.columns + u // self.options.patch

    def scaled(self, depth_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """Depth as -1 to 1 over the working range, in which powers are well apart."""
        low, high = self.options.min_depth, self.options.max_depth
        return (np.asarray(depth_m, np.float64) - 0.5 * (low + high)) / (0.5 * (high - low))

    def samples(self, pair: DepthPair) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Cell, true depth and error (measured minus true), of the pixels that have both depths."""
        true = pair.true_m.astype(np.float64)
        has_both = (pair.measured_m > 0) & (true >= self.options.min_depth) & (true < self.options.max_depth)
        true = true[has_both]
        depth_bin = np.minimum(np.searchsorted(self.edges, true, side="right") - 1, self.bins - 1)
        cell = self.patch_of_pixel[has_both] * self.bins + depth_bin
        return cell, true, pair.measured_m[has_both].astype(np.float64) - true


class ErrorHistograms:
    """First pass: how the errors of each cell are distributed."""

    def __init__(self, cells: Cells) -> None:
        self.cells = cells
        self.samples = 0
        self._counts = np.zeros((cells.patches * cells.bins, HISTOGRAM_BINS), np.int32)
        self._scale = np.arcsinh(LARGEST_ERROR_M / FINEST_ERROR_M) / (HISTOGRAM_BINS / 2)

    def add(self, pair: DepthPair) -> int:
        """Count the pixels of one pair; returns how many had both depths."""
        cell, _, error = self.cells.samples(pair)
        position = np.arcsinh(error / FINEST_ERROR_M) / self._scale + HISTOGRAM_BINS / 2
        column = np.clip(position, 0, HISTOGRAM_BINS - 1).astype(np.int64)
        np.add.at(self._counts, (cell, column), 1)
        self.samples += len(cell)
        return len(cell)

    def counts(self) -> NDArray[np.int64]:
        """Samples in each cell, (patches, bins)."""
        return self._counts.sum(axis=1, dtype=np.int64).reshape(self.cells.patches, self.cells.bins)

    def limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The least and the largest error of each cell that is no outlier, two of (patches * bins,).

        They lie ``outlier_sigmas`` robust standard deviations from the median, and at least as many
        times LEAST_SIGMA_M, so that rounding to whole millimetres removes no sample. A cell with too few
        samples gets an empty range.
        """
        low, median, high = (self._quantile(share) for share in (0.25, 0.5, 0.75))
        sigma = np.maximum((high - low) / _QUARTILES_PER_SIGMA, LEAST_SIGMA_M)
        reach = self.cells.options.outlier_sigmas * sigma
        enough = self.counts().ravel() >= self.cells.options.least_count
        return np.where(enough, median - reach, np.inf), np.where(enough, median + reach, -np.inf)

    def _quantile(self, share: float) -> NDArray[np.float64]:
        """The error below which ``share`` of each cell's samples lie; even within a histogram bin."""
        below = np.cumsum(self._counts, axis=1)
        wanted = share * below[:, -1]
        column = np.minimum((below < wanted[:, None]).sum(axis=1), HISTOGRAM_BINS - 1)
        rows = np.arange(len(column))
        inside = self._counts[rows, column]
        before = below[rows, column] - inside
        position = column + (wanted - before) / np.maximum(inside, 1)
        return FINEST_ERROR_M * np.sinh((position - HISTOGRAM_BINS / 2) * self._scale)


class Moments:
    """Second pass: the sums that the fits are made from, over the samples of each cell within its limits.

    With t the scaled depth and e the error of a sample:
    ``powers`` is sum t^k, (patches, bins, 2 degree + 1); ``products`` sum e t^k, (patches, bins, degree + 1);
    ``squares`` sum e^2, (patches, bins).
    """

    def __init__(self, cells: Cells, limits: tuple[NDArray[np.float64], NDArray[np.float64]]) -> None:
        self.cells = cells
        self.outliers = 0
        self._low, self._high = limits
        count, degree = cells.patches * cells.bins, cells.options.degree
        self._powers = np.zeros((2 * degree + 1, count))
        self._products = np.zeros((degree + 1, count))
        self._squares = np.zeros(count)

    def add(self, pair: DepthPair) -> None:
        """Add the pixels of one pair."""
        cell, true, error = self.cells.samples(pair)
        usable = self._low[cell] <= self._high[cell]
        kept = (error >= self._low[cell]) & (error <= self._high[cell])
        self.outliers += int(usable.sum() - kept.sum())
        cell, error, t = cell[kept], error[kept], self.cells.scaled(true[kept])
        power = np.ones_like(t)
        for k in range(len(self._powers)):
            self._powers[k] += np.bincount(cell, power, len(self._squares))
            if k < len(self._products):
                self._products[k] += np.bincount(cell, power * error, len(self._squares))
            power *= t
        self._squares += np.bincount(cell, error * error, len(self._squares))

    @property
    def powers(self) -> NDArray[np.float64]:
        return self._powers.T.reshape(self.cells.patches, self.cells.bins, -1)

    @property
    def products(self) -> NDArray[np.float64]:
        return self._products.T.reshape(self.cells.patches, self.cells.bins, -1)

    @property
    def squares(self) -> NDArray[np.float64]:
        return self._squares.reshape(self.cells.patches, self.cells.bins)

    @property
    def counts(self) -> NDArray[np.float64]:
        """Samples in each cell, (patches, bins), without outliers."""
        return self.powers[..., 0]
