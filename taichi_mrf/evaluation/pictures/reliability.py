"""Pictures of how far probabilities can be trusted: the reliability diagram and the ROC curve."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.occupancy_scores import OccupancyScores, ReliabilityBins
from taichi_mrf.evaluation.pictures.figures import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLUMNS = 4
_IDEAL: dict[str, Any] = {"color": "0.4", "linestyle": "--", "linewidth": 1.0}


def reliability_figure(methods: Mapping[str, OccupancyScores]) -> "Figure":
    """The observed share of occupied voxels against their probability, a panel for each method, and below it
    how many voxels that rests on. Raises ConfigError if there is no method."""
    _require_some(methods)
    rows = -(-len(methods) // _COLUMNS)
    columns = -(-len(methods) // rows)
    figure = new_figure(3.6 * columns + 0.4, 4.9 * rows + 0.4)
    axes = figure.subplots(
        2 * rows, columns, squeeze=False, sharey="row", gridspec_kw={"height_ratios": (2.8, 1.0) * rows}
    )
    for unused in range(len(methods), rows * columns):
        axes[-2, unused % columns].axis("off")
        axes[-1, unused % columns].axis("off")
    for number, (name, scores) in enumerate(methods.items()):
        row, column = 2 * (number // columns), number % columns
        _draw_shares(axes[row, column], scores.reliability)
        figures = f"calibration error {scores.calibration_error:.2g}, Brier score {scores.brier:.2g}"
        axes[row, column].set_title(f"{_wrapped(name)}\n{figures}", fontsize="medium")
        _draw_counts(axes[row + 1, column], scores.reliability)
        if column == 0:
            axes[row, column].set_ylabel("share that is occupied")
            axes[row + 1, column].set_ylabel("voxels")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


def roc_figure(methods: Mapping[str, OccupancyScores]) -> "Figure":
    """The share of occupied voxels found against that of free voxels mistaken, over all thresholds; the
    latter on a logarithmic scale too, because there are so many of them. The mark is the threshold of the
    scores. Raises ConfigError if there is no method."""
    _require_some(methods)
    figure = new_figure(10.0, 5.4)
    whole, low = figure.subplots(1, 2, sharey=True)
    for name, scores in methods.items():
        roc = scores.roc
        label = f"{name} ({scores.roc_area:.4f})"
        at = np.argmin(np.abs(roc.threshold - scores.threshold))
        for axes in (whole, low):
            (line,) = axes.plot(roc.false_positive_rate, roc.true_positive_rate, linewidth=1.6, label=label)
            axes.plot(roc.false_positive_rate[at], roc.true_positive_rate[at], "o", color=line.get_color(),
                      markersize=5)  # fmt: skip
    ideal = np.geomspace(1e-6, 1, 100)
    for axes in (whole, low):
        axes.plot(ideal, ideal, **_IDEAL)
        axes.set(xlabel="share of free voxels taken for occupied", ylim=(0, 1.01))
        axes.grid(alpha=0.3)
    whole.set(xlim=(-0.01, 1), ylabel="share of occupied voxels found")
    least = min(1.0 / max(scores.count - scores.occupied, 1) for scores in methods.values())
    low.set(xscale="log", xlim=(max(least, 1e-6), 1))
    figure.legend(
        *whole.get_legend_handles_labels(), loc="outside lower center", ncols=min(3, len(methods)),
        frameon=False,
        title=f"area under the curve in brackets; marks: a probability of {_threshold(methods)}",
    )  # fmt: skip
    return figure


def _require_some(methods: Mapping[str, OccupancyScores]) -> None:
    if not methods:
        raise ConfigError("there are no scores to draw")


def _threshold(methods: Mapping[str, OccupancyScores]) -> str:
    return " or ".join(sorted({f"{scores.threshold:g}" for scores in methods.values()}))


def _wrapped(name: str) -> str:
    """A long name over two lines, broken at a comma."""
    return name.replace(", ", ",\n", 1) if len(name) > 24 else name


def _draw_shares(axes: "Axes", bins: ReliabilityBins) -> None:
    filled = bins.count > 0
    predicted, observed = bins.predicted[filled], bins.observed[filled]
    axes.bar(
        bins.edges[:-1][filled], observed, np.diff(bins.edges)[filled], align="edge", color="tab:blue",
        alpha=0.75, edgecolor="white", linewidth=0.5, label="observed share",
    )  # fmt: skip
    # From what was promised to what came true, at the mean probability of the bin's voxels.
    axes.vlines(predicted, predicted, observed, color="tab:red", linewidth=1.8, label="miscalibration")
    axes.plot((0, 1), (0, 1), **_IDEAL, label="calibrated")
    axes.set(xlim=(0, 1), ylim=(0, 1))


def _draw_counts(axes: "Axes", bins: ReliabilityBins) -> None:
    filled = bins.count > 0
    axes.bar(
        bins.edges[:-1][filled], bins.count[filled], np.diff(bins.edges)[filled], align="edge", color="0.55",
        edgecolor="white", linewidth=0.5,
    )  # fmt: skip
    axes.set(xlim=(0, 1), yscale="log", ylim=(0.7, None), xlabel="probability of being occupied")
