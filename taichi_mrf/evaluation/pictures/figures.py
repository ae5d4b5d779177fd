"""The parts that all figures share, and many maps on one. Matplotlib takes long to import, so only drawing
imports it.
"""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.system.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_PATH_COLOR = "#e6007e"
"""Magenta: on none of the colour scales."""

_DPI = 120


def new_figure(width_in: float, height_in: float) -> "Figure":
    """An empty white figure, sizes in inches."""
    # The object interface: pyplot would keep global state and may look for a display.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    layout = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.1)
    figure = Figure(figsize=(width_in, height_in), layout=layout, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def notice(text: str) -> "Figure":
    """A figure without data, with the reason as text."""
    figure = new_figure(8.0, 3.0)
    figure.text(0.5, 0.5, text, ha="center", va="center")
    return figure


def write_figure(figure: "Figure", path: Path) -> None:
    """Write a figure that :func:`new_figure` made as a PNG. Raises MapFileError."""
    figure.set_dpi(_DPI)
    with atomic_path(path) as temporary:
        # Figure.savefig would draw everything twice, for files whose layout needs it. Level 2 of 9 takes
        # half of the default's time, and the files are a fifth larger.
        figure.canvas.print_png(temporary, pil_kwargs={"compress_level": 2})  # type: ignore[attr-defined]


def draw_camera_path(axes: "Axes", points: NDArray[np.floating]) -> None:
    """Draw the camera path through the keyframes, (N, 2) in the axes' units, and its legend."""
    if len(points) == 0:
        return
    axes.plot(*points.T, color="white", linewidth=3.0)
    axes.plot(*points.T, color=_PATH_COLOR, linewidth=1.4, marker=".", markersize=3.0, label="camera path")
    axes.plot(
        *points[0], "o", color=_PATH_COLOR, markeredgecolor="white", markersize=8.0, label="first keyframe"
    )
    axes.figure.legend(loc="outside lower center", ncols=2, frameon=False)


def color_bar(axes: "Axes", colors: Any, low: float, high: float, label: str) -> None:
    """A colour bar for a picture that was coloured before it was drawn."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    axes.figure.colorbar(
        ScalarMappable(Normalize(low, high), colors), ax=axes, label=label, shrink=0.8, pad=0.02
    )


MOST_TILES = 64
"""More than that could not be made out on one picture."""

_COLUMNS = 4
_TILE_IN = 4.2
_LETTERS = 44
"""That fit beside each other on a tile."""

_LINES = 10
"""Of text that fit below each other on a tile; the first ones say what went wrong."""


@dataclass(frozen=True)
class Tile:
    """One map: its name, a line of figures, and its picture from above, or why there is none."""

    name: str
    caption: str
    picture: Path | None
    instead: str = ""


def write_contact_sheet(path: Path, tiles: Sequence[Tile]) -> None:
    """Write the first MOST_TILES tiles as a PNG, row by row, and note how many are left out. Raises
    MapFileError."""
    shown = tiles[:MOST_TILES]
    columns = max(1, min(_COLUMNS, math.ceil(math.sqrt(len(shown)))))
    rows = max(1, math.ceil(len(shown) / columns))
    figure = new_figure(columns * _TILE_IN, rows * (_TILE_IN * 0.82 + 0.5) + 0.3)
    for number, axes in enumerate(figure.subplots(rows, columns, squeeze=False).flat):
        axes.set_axis_off()
        if number >= len(shown):
            continue
        tile = shown[number]
        name = tile.name if len(tile.name) <= _LETTERS else f"{tile.name[: _LETTERS - 3]}..."
        axes.set_title(f"{name}\n{tile.caption}", fontsize=10)
        picture = None if tile.picture is None else _read(tile.picture)
        if picture is None:
            text = textwrap.fill(tile.instead or "no picture", _LETTERS, max_lines=_LINES, placeholder=" ...")
            axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes, fontsize=9)
        else:
            axes.imshow(picture)
    if len(shown) < len(tiles):
        figure.suptitle(f"the first {len(shown)} of {len(tiles)} maps")
    write_figure(figure, path)


def _read(path: Path) -> NDArray[np.uint8] | None:
    """The picture, made as small as its tile; None if it cannot be read."""
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        return None
    scale = min(1.0, _TILE_IN * _DPI / max(picture.shape[:2]))
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2RGB), np.uint8)
