"""Pictures of ``taichi-mrf bench``: stages beside OctoMap, kernels beside floors, growth."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from taichi_mrf.benchmark.bench import BenchRow
from taichi_mrf.benchmark.growth import Growth, Lap
from taichi_mrf.benchmark.profile import Profile
from taichi_mrf.evaluation.pictures.figures import new_figure
from taichi_mrf.system.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STAGE_COLORS = {"allocate": "#4477aa", "own_sweep": "#66ccee", "reinference": "#ccbb44"}
"""Paul Tol's bright scheme, which colour-blind people can tell apart."""

STAGE_NAMES = {
    "allocate": "allocate",
    "own_sweep": "its own sweep",
    "reinference": "re-inference of others",
}
OCTOMAP_COLOR, TARGET_COLOR = "#bbbbbb", "#ee6677"
KIND_COLORS = {"unseen": "#4477aa", "seen": "#ee6677"}
KIND_NAMES = {"unseen": "old keyframes that it does not see", "seen": "old keyframes that it sees"}
TARGET_NAMES = "target without re-inference", "target of all three"
KERNELS_DRAWN = 8
SHORTEST_MS = 0.01
"""Lower end of the logarithmic scale of kernels."""
_DPI = 120


def write_figure(figure: "Figure", path: Path) -> None:
    """Write a picture in the format of the file's suffix. Raises MapFileError."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=_DPI)


def draw_stages(rows: Sequence[BenchRow], title: str) -> "Figure":
    """Stacked bars of a new keyframe's stages at each voxel size, beside OctoMap."""
    figure = new_figure(3.2 * len(rows) + 1.2, 4.6)
    figure.suptitle(f"A new keyframe: {title}", fontsize=9, wrap=True)
    panels = figure.subplots(1, len(rows), squeeze=False)[0]
    for axes, row in zip(panels, rows, strict=True):
        foot = 0.0
        for name, color in STAGE_COLORS.items():
            height = getattr(row, name).wall * 1e3
            axes.bar(0, height, 0.7, bottom=foot, color=color, label=STAGE_NAMES[name])
            foot += height
        axes.text(0, foot, f"{foot:.0f}", ha="center", va="bottom")
        if row.octomap is not None:
            height = row.octomap.wall * 1e3
            axes.bar(1, height, 0.7, color=OCTOMAP_COLOR, label="OctoMap, a ray for each pixel")
            axes.text(1, height, f"{height:.0f}", ha="center", va="bottom")
            for share, style, name in zip(row.targets or (), (":", "--"), TARGET_NAMES, strict=False):
                axes.hlines(share * height, -0.45, 0.45, color=TARGET_COLOR, linestyle=style, label=name)
        axes.set(
            title=f"{row.voxel_size * 100:g} cm", xlim=(-0.6, 1.6), ylabel="ms, median of the steady state"
        )
        axes.set_xticks([0, 1], ["this map", "OctoMap"])
        axes.spines[["top", "right"]].set_visible(False)
    _legend_below(figure, panels)
    return figure


def draw_profiles(rows: Sequence[Profile], title: str) -> "Figure":
    """The most expensive kernels at each voxel size, and the floors under them, on a logarithmic scale."""
    figure = new_figure(4.4 * len(rows) + 1.0, 4.2)
    figure.suptitle(f"Kernels of a new keyframe: {title}", fontsize=9, wrap=True)
    panels = figure.subplots(1, len(rows), squeeze=False)[0]
    for axes, row in zip(panels, rows, strict=True):
        shown = row.kernels[:KERNELS_DRAWN][::-1]
        place = np.arange(len(shown))
        taken = [kernel.seconds * 1e3 for kernel in shown]
        floors = [(kernel.floor_bytes or 0.0) / row.bytes_per_second * 1e3 for kernel in shown]
        for stage in row.wall:
            width = [ms if kernel.stage == stage else 0.0 for ms, kernel in zip(taken, shown, strict=True)]
            axes.barh(place, width, 0.75, color=STAGE_COLORS[stage], label=STAGE_NAMES[stage])
        axes.barh(place, floors, 0.35, color=TARGET_COLOR, label="least that its bytes could take")
        axes.set_yticks(place, [kernel.name for kernel in shown])
        axes.set(
            xscale="log",
            xlim=(SHORTEST_MS, 2 * max(taken)),
            xlabel="ms a keyframe, logarithmic",
            title=f"{row.voxel_size * 100:g} cm",
        )
        axes.spines[["top", "right"]].set_visible(False)
    _legend_below(figure, panels)
    return figure


def draw_growth(rows: Sequence[Growth], title: str) -> "Figure":
    """Cost and memory against the number of old keyframes, seen and unseen, with straight lines fitted."""
    sizes = sorted({row.voxel_size for row in rows}, reverse=True)
    figure = new_figure(4.4 * len(sizes) + 0.6, 7.4)
    figure.suptitle(f"A new keyframe in a growing map: {title}", fontsize=9, wrap=True)
    panels = figure.subplots(2, len(sizes), squeeze=False)
    for column, size in enumerate(sizes):
        for row in (row for row in rows if row.voxel_size == size):
            _draw_line(panels[0, column], row, lambda lap: lap.whole.wall * 1e3, "ms")
            _draw_line(panels[1, column], row, lambda lap: lap.memory_mb, "MB")
        panels[0, column].set(title=f"{size * 100:g} cm", ylabel="whole cost of a new keyframe, ms")
        panels[1, column].set(ylabel="memory of the map, MB", xlabel="old keyframes")
    for axes in panels.flat:
        axes.set_ylim(bottom=0.0)
        axes.legend(fontsize=7, loc="best")
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def _draw_line(axes: "Axes", row: Growth, figure: Callable[[Lap], float], unit: str) -> None:
    color, old = KIND_COLORS[row.kind], [lap.old for lap in row.laps]
    line = row.line(figure)
    error = "" if line.slope_error is None else f" ± {line.slope_error:.2g}"
    label = f"{KIND_NAMES[row.kind]}: {line.slope:+.2g}{error} {unit} each"
    axes.plot(old, [figure(lap) for lap in row.laps], "o", color=color, markersize=4.0)
    ends = [old[0], old[-1]]
    axes.plot(ends, [line.at(x) for x in ends], color=color, label=label)


def _legend_below(figure: "Figure", panels: "Iterable[Axes]") -> None:
    """One legend for all panels, each name once."""
    once: dict[str, Any] = {}
    for axes in panels:
        handles, labels = axes.get_legend_handles_labels()
        once |= dict(zip(labels, handles, strict=True))
    names = list(once)
    figure.legend(list(once.values()), names, loc="outside lower center", ncols=3, frameon=False, fontsize=8)
