"""The sensor's noise as the map sees it: how measurements scatter around the expected depth."""

from collections.abc import Sequence

import numpy as np

from taichi_mrf.evaluation.accuracy import JudgedView
from taichi_mrf.viewer.tune.messages import Residuals

MOST_POINTS = 1500
BINS = 12
FEWEST_IN_A_BIN = 20

FURTHEST_SPREADS = 8.0
"""Residuals larger than this many times the middle bin's spread are outliers, and not drawn."""


def residuals_of(number: int, views: Sequence[JudgedView]) -> Residuals:
    """Measured minus expected depth at the measured pixels of some views for which the map predicts a depth.

    The map was made of other measurements of the same sensor, so a constant bias that the noise model lacks
    is in both and cancels; one that grows with depth shows where the views are further away.
    """
    depth, residual = np.zeros(0, np.float32), np.zeros(0, np.float32)
    for view in views:
        there = view.measured & view.answered & (view.survey.expected > 0)
        depth = np.concatenate([depth, view.survey.expected[there]])
        residual = np.concatenate([residual, (view.measured_m - view.survey.expected)[there]])
    order = np.argsort(depth, kind="stable")
    depth, residual = depth[order], residual[order]
    # Bins of the same number of pixels, so that each one's spread is known about equally well.
    bins = [b for b in np.array_split(np.arange(len(depth)), BINS) if len(b) >= FEWEST_IN_A_BIN]
    low, middle, high = (
        np.array([np.quantile(residual[each], q) for each in bins]) for q in (0.16, 0.5, 0.84)
    )
    bin_m = np.array([np.median(depth[each]) for each in bins])
    if bins:
        limit = FURTHEST_SPREADS * max(float(np.median(high - low)) / 2, 1e-4)
        near = np.abs(residual - np.median(residual)) <= limit
        depth, residual = depth[near], residual[near]
    some = slice(None, None, -(-len(depth) // MOST_POINTS) or 1)
    return Residuals(
        number=number,
        depth_m=depth[some].copy(),
        residual_m=residual[some].copy(),
        bin_m=bin_m,
        median_m=middle,
        spread_m=(high - low) / 2,
    )
