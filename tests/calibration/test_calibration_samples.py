"""How samples are gathered: cells, quartiles from histograms, sums; against plain NumPy over all pixels."""

import numpy as np
import pytest
from calibration_scenes import CAMERA, Planes, random_tables
from numpy.typing import NDArray

from taichi_mrf.calibration.options import CalibrationConfig
from taichi_mrf.calibration.pairs import DepthPair
from taichi_mrf.calibration.samples import Cells, ErrorHistograms, Moments

OPTIONS = CalibrationConfig(patch=32, min_depth=0.5, max_depth=2.25, bin_width=0.5, least_count=10)
CELLS = Cells(CAMERA, OPTIONS)
"""160 x 120 pixels make 5 x 4 patches of 32, the lowest cut off; the last of 4 bins is half as wide."""


def pairs() -> list[DepthPair]:
    source = Planes(random_tables(CELLS.patches, 32, np.random.default_rng(3)), 12, 0.4, 2.6)
    return [source.read(name) for name in source.names]


def by_cell() -> dict[tuple[int, int], tuple[NDArray, NDArray]]:
    """(patch, bin) -> true depths and errors, pixel by pixel in double precision."""
    found: dict[tuple[int, int], list] = {}
    for pair in pairs():
        for (v, u), true in np.ndenumerate(pair.true_m):
            if 0.5 <= true < 2.25 and pair.measured_m[v, u] > 0:
                key = (v // 32 * 5 + u // 32, int((float(true) - 0.5) // 0.5))
                found.setdefault(key, []).append((float(true), float(pair.measured_m[v, u]) - float(true)))
    return {key: tuple(np.array(values).T) for key, values in found.items()}  # type: ignore[misc]


def test_cells_are_patches_times_bins() -> None:
    assert (CELLS.rows, CELLS.columns, CELLS.patches, CELLS.bins) == (4, 5, 20, 4)
    np.testing.assert_allclose(CELLS.edges, [0.5, 1.0, 1.5, 2.0, 2.25])
    np.testing.assert_allclose(CELLS.scaled(np.array([0.5, 1.375, 2.25])), [-1, 0, 1])


def test_histograms_and_sums_are_those_of_the_pixels() -> None:
    histograms = ErrorHistograms(CELLS)
    for pair in pairs():
        histograms.add(pair)
    low, high = histograms.limits()
    moments = Moments(CELLS, (low, high))
    for pair in pairs():
        moments.add(pair)
    counts, expected, outliers = histograms.counts(), by_cell(), 0
    assert counts.sum() == histograms.samples == sum(len(true) for true, _ in expected.values())
    for (patch, depth_bin), (true, error) in expected.items():
        cell = patch * CELLS.bins + depth_bin
        assert counts[patch, depth_bin] == len(true)
        if len(true) < 10:
            assert low[cell] > high[cell]
            continue
        quartiles = np.quantile(error, [0.25, 0.5, 0.75])
        reach = OPTIONS.outlier_sigmas * max((quartiles[2] - quartiles[0]) / 1.349, 1e-3)
        # A histogram bin is 0.13 of the error's own size or of a millimetre, whichever is more.
        blur = 0.13 * max(np.abs(quartiles).max(), 1e-3)
        assert low[cell] == pytest.approx(quartiles[1] - reach, abs=2 * OPTIONS.outlier_sigmas * blur)
        assert high[cell] == pytest.approx(quartiles[1] + reach, abs=2 * OPTIONS.outlier_sigmas * blur)
        kept = (error >= low[cell]) & (error <= high[cell])
        outliers += int((~kept).sum())
        t, e = CELLS.scaled(true[kept]), error[kept]
        np.testing.assert_allclose(moments.powers[patch, depth_bin], [(t**k).sum() for k in range(5)])
        np.testing.assert_allclose(
            moments.products[patch, depth_bin], [(e * t**k).sum() for k in range(3)], atol=1e-9
        )
        assert moments.squares[patch, depth_bin] == pytest.approx((e**2).sum())
    assert moments.outliers == outliers


def test_depth_in_whole_millimetres_is_not_taken_for_outliers() -> None:
    histograms = ErrorHistograms(CELLS)
    true = np.full(CAMERA.shape, 1.2, np.float32)
    random = np.random.default_rng(0)
    measured = np.round(true + 0.0004 * random.standard_normal(true.shape), 3).astype(np.float32)
    assert len(np.unique(measured)) >= 3
    histograms.add(DepthPair("steps", measured, true))
    moments = Moments(CELLS, histograms.limits())
    moments.add(DepthPair("steps", measured, true))
    assert moments.outliers == 0


def test_pixels_without_both_depths_do_not_count() -> None:
    histograms = ErrorHistograms(CELLS)
    depth = np.full(CAMERA.shape, 1.0, np.float32)
    assert histograms.add(DepthPair("no measurement", np.zeros_like(depth), depth)) == 0
    assert histograms.add(DepthPair("no truth", depth, np.zeros_like(depth))) == 0
    assert histograms.add(DepthPair("beyond", depth, np.full_like(depth, 2.25))) == 0
    assert histograms.add(DepthPair("both", depth, depth)) == depth.size
