"""Artefacts against coverage: what a map's threshold trades for what, in numbers and as a figure."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from taichi_mrf.evaluation.artefacts import MAJORITY, Sightings
from taichi_mrf.evaluation.pictures.figures import new_figure
from taichi_mrf.experiments.ledger import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAJORITIES = (0.5, MAJORITY, 0.9)
"""Shares of rays from which on a voxel is seen through: the measure's own, one milder and one stricter."""

LOG_ODDS = np.arange(-3.5, 7.0, 0.05)
"""Thresholds of the sweep: finer than any update."""


def curve(seen: Sightings, least_probability: float) -> Result:
    """For each threshold from ``least_probability`` on: coverage, how many voxels are occupied, how many of
    them can be judged, and how many are artefacts under each majority."""
    thresholds = 1.0 / (1.0 + np.exp(-LOG_ODDS))
    thresholds = np.concatenate([[least_probability], thresholds[thresholds > least_probability]])
    artefacts = {majority: seen.artefacts(majority) for majority in MAJORITIES}
    occupied = [seen.probability >= threshold for threshold in thresholds]
    return {
        "threshold": thresholds.tolist(),
        "coverage": [seen.coverage(threshold) for threshold in thresholds],
        "occupied": [int(o.sum()) for o in occupied],
        "judged": [int((o & seen.judged).sum()) for o in occupied],
        "artefacts": {
            f"{majority:g}": [int((o & each).sum()) for o in occupied] for majority, each in artefacts.items()
        },
    }


def artefacts_at(result: Result, coverage: float, majority: float = MAJORITY) -> float | None:
    """Artefacts where the threshold leaves this coverage, between two thresholds in proportion; None if the
    map never has as much, or cannot be brought down to so little without being emptied."""
    covered = np.asarray(result["coverage"])
    covered = covered[covered > 0]
    if len(covered) == 0 or not covered[-1] <= coverage <= covered[0]:
        return None
    artefacts = np.asarray(result["artefacts"][f"{majority:g}"], float)[: len(covered)]
    # Coverage falls with the threshold; np.interp needs it to rise.
    return float(np.interp(coverage, covered[::-1], artefacts[::-1]))


def threshold_for(result: Result, coverage: float) -> int:
    """Place in the curve of the highest threshold that keeps this coverage, or else of the lowest one."""
    return max(0, int(np.sum(np.asarray(result["coverage"]) >= coverage)) - 1)


def curve_figure(results: Mapping[str, Result], marked: Sequence[float]) -> "Figure":
    """Artefacts over coverage, one line for each map; ``marked`` are coverages to compare at."""
    figure = new_figure(9.0, 5.6)
    axes = figure.add_subplot()
    for number, (name, result) in enumerate(results.items()):
        covered = np.asarray(result["coverage"])
        kept = covered > 0
        if not kept.any():
            axes.plot([], [], color=f"C{number}", label=f"{name}: covers nothing")
            continue
        artefacts = np.asarray(result["artefacts"][f"{MAJORITY:g}"])[kept]
        axes.plot(covered[kept], artefacts, ".-", color=f"C{number}", markersize=4, linewidth=1.0, label=name)
        half = int(np.argmax(np.asarray(result["threshold"])[kept] >= 0.5))
        axes.plot(
            covered[kept][half], artefacts[half], "o", color=f"C{number}", markersize=9, fillstyle="none"
        )
    for coverage in marked:
        axes.axvline(coverage, color="0.8", linewidth=0.8, zorder=0)
    axes.set(
        xlabel="coverage: held-out measurements with an occupied voxel near",
        ylabel="artefacts: occupied voxels that held-out views see through",
        title="Each line sweeps the probability from which a voxel is occupied; rings: 0.5",
        xlim=(0.0, 1.0),
    )
    axes.set_yscale("symlog", linthresh=10)
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8)
    return figure
