"""Pictures of 2D laser mapping: energy against time, one map, and the maps of all methods side by side."""

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.laser.scans import FloorPlan
from taichi_mrf.evaluation.floor_plan import LaserMap
from taichi_mrf.evaluation.pictures.figures import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

METHOD_NAMES = {
    "inverse": "inverse sensor model",
    "mh": "Metropolis-Hastings",
    "mh-heat": "Metropolis-Hastings with heat map",
    "bp": "belief propagation",
    "max-product": "max-product",
    "dd": "dual decomposition",
    "dd-block": "dual decomposition, block ascent",
}
"""Full names of the methods."""

_UNKNOWN_GREY = 0.8
_PATH_COLOR = "#1f4fd8"
_PANELS_ACROSS = 4


def method_name(method: str) -> str:
    """A run's name in full: that of its method, and its step if it has one; or as it is."""
    of_step = re.fullmatch(r"(.+)-step-(.+)", method)
    if of_step:
        return f"{METHOD_NAMES.get(of_step[1], of_step[1])}, step {of_step[2]}"
    return METHOD_NAMES.get(method, method)


def energy_figure(
    traces: Mapping[str, Sequence[tuple[float, float]]],
    duals: Mapping[str, Sequence[tuple[float, float]]],
    title: str,
) -> "Figure":
    """Energy against time (Fig. 3): points (seconds, energy) by method, and dual bounds, if any, below it.

    A method of one step is a level line. What methods only pass through at first is cut off where it would
    flatten all the rest: the axis ends a little above the highest energy that any of them ends with.
    """
    bounds = {method: dual for method, dual in duals.items() if dual}
    figure = new_figure(9.0, 8.0 if bounds else 6.0)
    colors = {method: f"C{number}" for number, method in enumerate(traces)}
    rows = 3 if bounds else 1
    # Bounds have an axis of their own: far below the energies, they would flatten these.
    axes = figure.add_subplot(rows, 1, (1, max(1, rows - 1)))
    drawn = {method: trace for method, trace in traces.items() if trace}
    for method, trace in drawn.items():
        if len(trace) == 1:
            axes.axhline(trace[0][1], color=colors[method], linestyle="-.", label=method_name(method))
            continue
        axes.plot(*zip(*trace, strict=True), color=colors[method], label=method_name(method))
        axes.plot(*trace[-1], "o", color=colors[method], markersize=4)
    latest = max((trace[-1][0] for trace in drawn.values()), default=0.0)
    axes.set(ylabel="Total energy of the graph", title=title, xlim=(0.0, max(1.02 * latest, 1e-3)))
    axes.grid(alpha=0.3)
    if drawn:
        axes.set_ylim(*_energy_limits(drawn))
        axes.legend(frameon=False)
    if bounds:
        below = figure.add_subplot(rows, 1, rows, sharex=axes)
        for method, bound in bounds.items():
            below.plot(
                *zip(*bound, strict=True), color=colors[method], linestyle=":", label=method_name(method)
            )
        below.set(ylabel="Lower bound")
        below.grid(alpha=0.3)
    figure.axes[-1].set_xlabel("Time (seconds)")
    return figure


def _energy_limits(traces: Mapping[str, Sequence[tuple[float, float]]]) -> tuple[float, float]:
    """The lowest energy of all and the highest end, or of a single method the whole of it, with a margin."""
    lowest = min(min(energy for _, energy in trace) for trace in traces.values())
    highest = max(trace[-1][1] for trace in traces.values())
    if len(traces) == 1:
        highest = max(energy for trace in traces.values() for _, energy in trace)
    margin = 0.08 * (highest - lowest) or 0.01 * abs(highest) or 1.0
    return lowest - margin, highest + margin


def map_figure(laser_map: LaserMap, path_x_y: NDArray[np.float64], title: str) -> "Figure":
    """One map: dark is occupied, grey is where no beam went; the robot's path (P, 2) is drawn over it."""
    x0, x1, y0, y1 = laser_map.extent
    width = 10.0
    figure = new_figure(width, float(np.clip(width * (y1 - y0) / max(x1 - x0, 1e-9), 3.0, 16.0)) + 0.8)
    axes = figure.add_subplot()
    _draw_map(axes, laser_map, title)
    _draw_path(axes, path_x_y)
    axes.set(xlabel="x (m)", ylabel="y (m)")
    return figure


def comparison_figure(
    maps: Mapping[str, LaserMap], path_x_y: NDArray[np.float64], plan: FloorPlan | None
) -> "Figure":
    """The maps side by side (Fig. 4), and before them the floor plan (if any) with the robot's path."""
    first = next(iter(maps.values()))
    x0, x1, y0, y1 = first.extent
    panels = len(maps) + 1
    across = min(panels, _PANELS_ACROSS)
    down = -(-panels // across)
    width = 4.0
    height = float(np.clip(width * (y1 - y0) / max(x1 - x0, 1e-9), 1.5, 8.0)) + 0.4
    figure = new_figure(width * across, height * down)
    truth = figure.add_subplot(down, across, 1)
    if plan is not None:
        extent = (plan.lower_x_y[0], plan.upper_x_y[0], plan.lower_x_y[1], plan.upper_x_y[1])
        # Averaged on the way to the screen, or walls one pixel thick would be lost.
        truth.imshow(~plan.wall, cmap="gray", vmin=0, vmax=1, extent=extent, interpolation="antialiased")
    _draw_path(truth, path_x_y)
    truth.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal")
    truth.set_title("floor plan and path" if plan is not None else "path of the robot", fontsize=10)
    axes_of_maps = [figure.add_subplot(down, across, number + 2) for number in range(len(maps))]
    for axes, (method, laser_map) in zip(axes_of_maps, maps.items(), strict=True):
        _draw_map(axes, laser_map, method_name(method))
    for axes in (truth, *axes_of_maps):
        axes.set(xticks=[], yticks=[])
    return figure


def _draw_map(axes: "Axes", laser_map: LaserMap, title: str) -> None:
    probability = laser_map.marginals if laser_map.marginals is not None else laser_map.occupied
    shown = np.where(laser_map.seen, 1.0 - probability.astype(np.float32), _UNKNOWN_GREY)
    axes.imshow(shown, cmap="gray", vmin=0.0, vmax=1.0, origin="lower", extent=laser_map.extent)
    axes.set_title(title, fontsize=10)
    axes.set_aspect("equal")


def _draw_path(axes: "Axes", path_x_y: NDArray[np.float64]) -> None:
    axes.plot(*path_x_y.T, color=_PATH_COLOR, linewidth=1.0, alpha=0.7)
    axes.plot(*path_x_y[0], "o", color=_PATH_COLOR, markersize=4.0)
