"""The picture of ``taichi-mrf bench``: stages of a new keyframe beside OctoMap."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from taichi_mrf.evaluation.bench import BenchRow
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
TARGET_NAMES = "target without re-inference", "target of all three"
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
    legend_below(figure, panels)
    return figure


def legend_below(figure: "Figure", panels: "Iterable[Axes]") -> None:
    """Draw one legend for all panels, each name once."""
    once: dict[str, Any] = {}
    for axes in panels:
        handles, labels = axes.get_legend_handles_labels()
        once |= dict(zip(labels, handles, strict=True))
    names = list(once)
    figure.legend(list(once.values()), names, loc="outside lower center", ncols=3, frameon=False, fontsize=8)
