"""The parts that all pictures share. Matplotlib takes long to import, so only drawing imports it."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WAY_COLOR = "#e6007e"
"""Magenta: on none of the colour scales."""


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


def draw_way(axes: "Axes", points: NDArray[np.floating]) -> None:
    """Draw the way of the camera through the keyframes, (N, 2) in the axes' units, and its legend."""
    if len(points) == 0:
        return
    axes.plot(*points.T, color="white", linewidth=3.0)
    axes.plot(
        *points.T, color=_WAY_COLOR, linewidth=1.4, marker=".", markersize=3.0, label="way of the camera"
    )
    axes.plot(
        *points[0], "o", color=_WAY_COLOR, markeredgecolor="white", markersize=8.0, label="first keyframe"
    )
    axes.figure.legend(loc="outside lower center", ncols=2, frameon=False)


def color_bar(axes: "Axes", colors: Any, low: float, high: float, label: str) -> None:
    """A colour bar for a picture that was coloured before it was drawn."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    axes.figure.colorbar(
        ScalarMappable(Normalize(low, high), colors), ax=axes, label=label, shrink=0.8, pad=0.02
    )
