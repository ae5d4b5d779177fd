"""The ray plot (MRFMap, Fig. 7): p_occ, visibility and omega along a ray, with the measurement's one-sigma
band."""

import numpy as np
import viser
from numpy.typing import NDArray
from viser import uplot

from taichi_mrf.viewer.messages import RayAnswer
from taichi_mrf.viewer.scene.keyframe_layer import draw_lines
from taichi_mrf.viewer.scene.widgets import in_markdown

Curves = tuple[NDArray[np.float64], ...]

_STEP_M = 1e-6
"""Width of the edge of a step on the range axis."""

_BEFORE_M = 0.75
"""The plot begins this far in front of the surface."""

# Later series lie on top.
_SERIES = (
    uplot.Series(label="range (m)"),
    uplot.Series(label="measured ± sigma", stroke="#e69f00", fill="#e69f0055", width=1),
    uplot.Series(label="measured", stroke="#d55e00", width=2),
    uplot.Series(label="visibility", stroke="#5c7cfa", width=2),
    uplot.Series(label="omega (scaled to 1)", stroke="#e6007e", width=2),
    uplot.Series(label="p(occupied)", stroke="#1f968b", width=2),
)


class RayPlot:
    """Owns the plot and the line of the ray in the scene."""

    def __init__(self, gui: viser.GuiApi, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._text = gui.add_markdown("")
        nothing = tuple(np.zeros(2) for _ in _SERIES)
        self._plot = gui.add_uplot(
            nothing,
            _SERIES,
            scales={"x": uplot.Scale(time=False), "y": uplot.Scale(range=(0.0, 1.05))},
            aspect=1.5,
        )
        self.clear()

    def show(self, answer: RayAnswer) -> None:
        """Show the curves of a ray, and the ray in the scene."""
        self._plot.data = curves(answer)
        self._plot.visible = True
        self._text.content = f"**{in_markdown(answer.title)}**\n\n{in_markdown(_sentence(answer))}"
        start = np.array(answer.origin)
        end = start + np.array(answer.direction) * _end_m(answer)
        draw_lines(self._scene, "/ray", [[start, end]], (230, 0, 126), thickness=3.0)

    def clear(self) -> None:
        """Hide the plot and the ray."""
        self._plot.visible = False
        self._text.content = (
            "Click a voxel or the picture of a keyframe, or type a pixel of the chosen one. Drag with Shift "
            "held to ask about all voxels in a rectangle."
        )
        self._scene.remove_by_name("/ray")


def curves(answer: RayAnswer) -> Curves:
    """Range in metres, then by range: the measurement's band, the measurement, visibility, omega and the
    probability of being occupied, (n,) each. Each voxel is a step. The curves begin a little in front of the
    surface."""
    begins = (answer.distance - answer.length / 2).astype(np.float64)
    ends = (answer.distance + answer.length / 2).astype(np.float64)
    band = _band_m(answer)
    edges = np.concatenate([begins, ends, [] if band is None else [*band, answer.measured_m or 0.0]])
    last = _end_m(answer)
    first = max(0.0, _surface_m(answer) - _BEFORE_M)
    beside = [answer.measured_m + side * _STEP_M for side in (-3, 3)] if answer.measured_m else []
    x = np.unique(np.concatenate([[first, last], edges - _STEP_M, edges + _STEP_M, beside]))
    x = x[(x >= first) & (x <= last)]
    voxel = np.searchsorted(begins, x, side="right") - 1
    inside = (voxel >= 0) & (x < ends[voxel] if len(ends) else np.zeros(len(x), bool))
    omega = answer.omega / max(float(answer.omega.max(initial=0.0)), 1e-12)
    steps = [
        np.where(inside, values[voxel] if len(values) else 0.0, 0.0) for values in (answer.occupancy, omega)
    ]
    left = answer.visibility[np.maximum(voxel, 0)] if len(ends) else np.ones(len(x))
    visibility = np.where(voxel >= 0, left, 1.0)
    in_band = np.zeros(len(x)) if band is None else ((x >= band[0]) & (x <= band[1])).astype(float)
    measured_m = np.inf if answer.measured_m is None else answer.measured_m
    measured = (np.abs(x - measured_m) <= 1.5 * _STEP_M).astype(float)
    return x, in_band, measured, visibility.astype(np.float64), steps[1], steps[0]


def _band_m(answer: RayAnswer) -> tuple[float, float] | None:
    """The range of the surface within one sigma, from the measurement alone; None without one."""
    if answer.measured_m is None:
        return None
    middle = answer.measured_m - answer.bias_m
    return middle - answer.sigma_m, middle + answer.sigma_m


def _surface_m(answer: RayAnswer) -> float:
    """The range of the surface in the map or in the measurement, whichever is nearer."""
    band = _band_m(answer)
    places = [] if band is None else [band[0]]
    if len(answer.omega):
        places.append(float(answer.distance[np.argmax(answer.omega)]))
    return min(places, default=0.0)


def _end_m(answer: RayAnswer) -> float:
    """The end of the plot: behind the measurement, and where less than 1% of the ray is left."""
    seen = answer.distance[answer.visibility > 0.01]
    end = float(seen.max(initial=0.5)) + 2 * float(answer.length.max(initial=0.05))
    band = _band_m(answer)
    return end if band is None else max(end, band[1] + 2 * answer.sigma_m + 0.1)


def _sentence(answer: RayAnswer) -> str:
    if not len(answer.omega):
        return "The ray meets no voxel of the map."
    best = int(np.argmax(answer.omega))
    text = f"Likeliest surface at {answer.distance[best]:.3f} m (p = {answer.occupancy[best]:.2f})"
    if answer.measured_m is None:
        return text + ", nothing measured."
    sigma = f"{1000 * answer.sigma_m:.1f} mm"
    bias = f", bias {1000 * answer.bias_m:+.1f} mm" if answer.bias_m else ""
    return f"{text}, measured {answer.measured_m:.3f} m (sigma {sigma}{bias})."
