"""Reliability of a map's probabilities, where it is known which voxels are occupied.

Two questions. Do occupied voxels get higher probabilities than free ones (precision and recall, the ROC curve
and its area)? And is what is given 0.8 occupied in 80% of all cases (Brier score, reliability diagram,
expected calibration error: Guo et al., On Calibration of Modern Neural Networks, ICML 2017)?

Free voxels are by far the most, and most of them are known to be free: read the calibration error beside the
counts of the diagram's bins.
"""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.errors import ConfigError

Vector = NDArray[np.float64]

BINS = 20
"""Of the reliability diagram, all of the same width."""

ROC_STEPS = 200
"""The curve is thinned until neither rate changes by more than about one in so many between its points."""

_BLOCK = 1 << 22
"""Voxels that are converted to float64 at a time: a map may hold hundreds of millions."""


@dataclass(frozen=True)
class RocCurve:
    """Receiver operating characteristic, from nothing taken for occupied, (0, 0), to everything, (1, 1).

    Voxels of at least ``threshold`` are taken for occupied. It falls, is infinite at the first point, and
    that of the scores is one of them. All (K,); a rate is NaN if there are no voxels of its kind.
    """

    false_positive_rate: Vector
    true_positive_rate: Vector
    threshold: Vector


@dataclass(frozen=True)
class ReliabilityBins:
    """Voxels by probability: ``edges`` (B + 1,), and for each bin [edge, next edge), the last one closed, the
    ``count`` of voxels, their mean probability ``predicted`` and the ``observed`` share that is occupied,
    (B,) each; NaN in a bin without voxels."""

    edges: Vector
    count: NDArray[np.int64]
    predicted: Vector
    observed: Vector

    @property
    def calibration_error(self) -> float:
        """Mean absolute difference of observed share and mean probability, bins weighed by their count."""
        filled = self.count > 0
        gap = np.abs(self.observed - self.predicted)[filled]
        return float(np.average(gap, weights=self.count[filled]))


@dataclass(frozen=True)
class OccupancyScores:
    """All figures of one map; those that need voxels of a kind that there is none of are NaN.

    ``precision`` needs a voxel taken for occupied, ``recall`` and ``average_precision`` an occupied voxel,
    ``f1`` one of either, ``roc_area`` an occupied and a free one.
    """

    count: int
    occupied: int
    threshold: float
    precision: float
    recall: float
    f1: float
    roc_area: float
    """Probability that an occupied voxel is given more than a free one; ties count half."""

    average_precision: float
    """Area under precision over recall, as steps: each occupied voxel's probability as the threshold, and
    the mean of the precisions."""

    brier: float
    """Mean squared difference of probability and truth."""

    calibration_error: float
    """Of ``reliability``'s bins."""

    roc: RocCurve
    reliability: ReliabilityBins

    def to_json(self) -> dict[str, Any]:
        """Plain values, for :meth:`from_json`."""
        return dataclasses.asdict(self, dict_factory=_plain)

    @staticmethod
    def from_json(values: dict[str, Any]) -> "OccupancyScores":
        """Scores from what :meth:`to_json` has given."""
        bins, roc = values["reliability"], values["roc"]
        reliability = ReliabilityBins(
            np.asarray(bins["edges"], np.float64),
            np.asarray(bins["count"], np.int64),
            np.asarray(bins["predicted"], np.float64),
            np.asarray(bins["observed"], np.float64),
        )
        curve = RocCurve(**{name: np.asarray(rate, np.float64) for name, rate in roc.items()})
        return OccupancyScores(**{**values, "roc": curve, "reliability": reliability})


def score_occupancy(
    probability: ArrayLike, occupied: ArrayLike, *, threshold: float = 0.5, bins: int = BINS
) -> OccupancyScores:
    """Compare (N,) probabilities of voxels with (N,) whether each is occupied.

    ``threshold`` is the least probability that is taken for occupied in precision, recall and F1.
    Raises ConfigError if there is no voxel, the shapes differ, a value is no probability or a truth is not
    boolean.
    """
    p, truth = np.asarray(probability), np.asarray(occupied)
    _check(p, truth, bins)
    p = p.astype(np.promote_types(p.dtype, np.float32), copy=False)
    # Sorted apart, so that each question is a search for the few occupied voxels among the many free ones.
    hits, misses = np.sort(p[truth]), np.sort(p[~truth])
    least = p.dtype.type(threshold)
    true_positives, false_positives = (int(_at_least(kind, least)) for kind in (hits, misses))
    reliability = reliability_bins(p, truth, bins)
    return OccupancyScores(
        count=len(p),
        occupied=len(hits),
        threshold=threshold,
        precision=_share(true_positives, true_positives + false_positives),
        recall=_share(true_positives, len(hits)),
        f1=_share(2 * true_positives, true_positives + false_positives + len(hits)),
        roc_area=_roc_area(hits, misses),
        average_precision=_average_precision(hits, misses),
        brier=sum(float(np.sum((each - is_hit) ** 2)) for each, is_hit in _blocks(p, truth)) / len(p),
        calibration_error=reliability.calibration_error,
        roc=_roc_curve(hits, misses, least),
        reliability=reliability,
    )


def reliability_bins(
    probability: NDArray[np.floating], occupied: NDArray[np.bool_], bins: int = BINS
) -> ReliabilityBins:
    """Sort (N,) probabilities from 0 to 1 into bins of the same width."""
    count, predicted, observed = np.zeros(bins, np.int64), np.zeros(bins), np.zeros(bins)
    for p, truth in _blocks(probability, occupied):
        place = np.minimum((p * bins).astype(np.int64), bins - 1)
        count += np.bincount(place, minlength=bins)
        predicted += np.bincount(place, p, bins)
        observed += np.bincount(place, truth, bins)
    some = np.where(count > 0, count, np.nan)
    return ReliabilityBins(np.linspace(0.0, 1.0, bins + 1), count, predicted / some, observed / some)


def _check(p: NDArray[Any], truth: NDArray[Any], bins: int) -> None:
    if p.ndim != 1 or p.shape != truth.shape:
        raise ConfigError(
            f"probabilities of shape {p.shape} and truths of shape {truth.shape} do not match: "
            "both must have the shape (N,)"
        )
    if truth.dtype != np.bool_:
        raise ConfigError(f"whether voxels are occupied must be boolean, not {truth.dtype}")
    if len(p) == 0:
        raise ConfigError("there is no voxel to score")
    if not (p.min() >= 0 and p.max() <= 1):
        raise ConfigError(f"a probability of {p[~((p >= 0) & (p <= 1))][0]} does not lie between 0 and 1")
    if bins < 1:
        raise ConfigError(f"a reliability diagram needs at least one bin, not {bins}")


def _blocks(p: NDArray[np.floating], truth: NDArray[np.bool_]) -> Iterator[tuple[Vector, NDArray[np.bool_]]]:
    for begin in range(0, len(p), _BLOCK):
        yield p[begin : begin + _BLOCK].astype(np.float64), truth[begin : begin + _BLOCK]


def _at_least(ascending: NDArray[np.floating], values: ArrayLike) -> NDArray[np.int64]:
    """Number of some sorted numbers that are at least each value."""
    return len(ascending) - np.asarray(np.searchsorted(ascending, values, side="left"), np.int64)


def _share(part: float, whole: float) -> float:
    return float(part / whole) if whole > 0 else float("nan")


def _roc_area(hits: NDArray[np.floating], misses: NDArray[np.floating]) -> float:
    """The Mann-Whitney statistic, which is the area under the whole curve, thinned or not."""
    below = np.searchsorted(misses, hits, side="left").astype(np.float64)
    not_above = np.searchsorted(misses, hits, side="right")
    return _share(0.5 * float(np.sum(below + not_above)), float(len(hits)) * len(misses))


def _average_precision(hits: NDArray[np.floating], misses: NDArray[np.floating]) -> float:
    true_positives = _at_least(hits, hits)
    precision = true_positives / (true_positives + _at_least(misses, hits))
    return _share(float(np.sum(precision)), len(hits))


def _roc_curve(hits: NDArray[np.floating], misses: NDArray[np.floating], least: np.floating) -> RocCurve:
    chosen = [
        kind[np.unique(np.linspace(0, len(kind) - 1, ROC_STEPS).astype(np.int64))]
        for kind in (hits, misses)
        if len(kind)
    ]
    threshold = np.unique(np.concatenate([*chosen, [least]]))[::-1]
    return RocCurve(
        false_positive_rate=_rate(misses, threshold),
        true_positive_rate=_rate(hits, threshold),
        threshold=np.concatenate([[np.inf], threshold.astype(np.float64)]),
    )


def _rate(kind: NDArray[np.floating], threshold: NDArray[np.floating]) -> Vector:
    """Shares of some voxels of one kind that reach thresholds, after that of none."""
    if len(kind) == 0:
        return np.full(len(threshold) + 1, np.nan)
    return np.concatenate([[0.0], _at_least(kind, threshold) / len(kind)])


def _plain(items: list[tuple[str, Any]]) -> dict[str, Any]:
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in items}
