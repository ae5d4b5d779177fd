"""Quality against time: one picture for each scene, a column for each voxel size."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from taichi_mrf.evaluation.pictures.figures import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BUDGET_MS = 10.0
"""Processor time of two cores in 5 ms: the smallest budget that a user is taken to have."""

SHOWN_NATS = 2.2
"""Log-likelihoods that are this much below the best are off the picture."""

MARKERS = "osD^vPX"


@dataclass(frozen=True)
class Point:
    """One setting of a system: processor milliseconds a frame, and what its map is worth. ``selected``: only
    keyframes were mapped; ``standard``: as its makers would run it."""

    system: str
    voxel_size: float
    cpu_ms: float
    right: float
    log_likelihood: float
    selected: bool
    standard: bool


def frontier(points: Sequence[Point], quality: str) -> list[Point]:
    """The settings that no other beats in both time and quality, from fast to slow."""
    best: list[Point] = []
    for point in sorted(points, key=lambda p: (p.cpu_ms, -getattr(p, quality))):
        if not best or getattr(point, quality) > getattr(best[-1], quality):
            best.append(point)
    return best


def curves(scene: str, points: Sequence[Point]) -> "Figure":
    """Two rows, the share of right pixels and the log-likelihood, over the time of a frame. A line joins the
    settings of a system that no other of its own beats; hollow: keyframes alone; ringed: the standard."""
    sizes = sorted({p.voxel_size for p in points}, reverse=True)
    names = list(dict.fromkeys(p.system for p in points))
    figure = new_figure(4.4 * len(sizes) + 0.6, 7.6)
    rows = (("right", "pixels within 1.5 voxels"), ("log_likelihood", "log-likelihood of a pixel, nats"))
    grid = figure.subplots(len(rows), len(sizes), squeeze=False)
    for line, (quality, label) in zip(grid, rows, strict=True):
        for axes, size in zip(line, sizes, strict=True):
            for number, name in enumerate(names):
                here = [p for p in points if p.system == name and p.voxel_size == size]
                _draw(axes, here, quality, name, number)
            _dress(axes)
            if quality == "log_likelihood":
                best = max(p.log_likelihood for p in points if p.voxel_size == size)
                axes.set_ylim(bottom=max(axes.get_ylim()[0], best - SHOWN_NATS))
        line[0].set_ylabel(label)
    for axes, size in zip(grid[0], sizes, strict=True):
        axes.set_title(f"{scene}, {size * 100:g} cm")
    for axes in grid[-1]:
        axes.set_xlabel("processor ms a frame")
    handles, labels = grid[0][0].get_legend_handles_labels()
    columns = 4 if len(sizes) > 1 else 2
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize=9, frameon=False)
    return figure


def _draw(axes: "Axes", here: Sequence[Point], quality: str, name: str, number: int) -> None:
    """One system's settings."""
    color, marker = f"C{number}", MARKERS[number % len(MARKERS)]
    best = frontier(here, quality)
    axes.plot(
        [p.cpu_ms for p in best], [getattr(p, quality) for p in best], color=color, marker=marker,
        markersize=5, label=name, linewidth=2.6 if number == 0 else 1.3, zorder=5 if number == 0 else 2,
    )  # fmt: skip
    for point in here:
        face = "white" if point.selected else color
        size = 9 if point.standard else 5
        axes.plot(
            point.cpu_ms, getattr(point, quality), marker, color=color, markerfacecolor=face, markersize=size,
            alpha=0.9, zorder=6 if number == 0 else 3,
        )  # fmt: skip


def _dress(axes: "Axes") -> None:
    """A logarithmic axis with plain numbers, and the smallest budget."""
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.axvline(BUDGET_MS, color="0.6", linestyle=":", linewidth=1)
    axes.grid(alpha=0.3)
