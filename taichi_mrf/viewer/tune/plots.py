"""Plots of the tuning page: the scores of the shown try as numbers, differences from the reference and
sparklines, the verdict on a search, and the residuals of the held-out views against depth, with the curves
of bias and sigma.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray
from viser import uplot

from taichi_mrf.config.schema import SensorConfig
from taichi_mrf.config.text import field_help
from taichi_mrf.errors import ConfigError
from taichi_mrf.sensor.noise import Curves, curves_of, is_model
from taichi_mrf.viewer.scene.widgets import in_html, in_markdown
from taichi_mrf.viewer.tune.messages import KINDS, Residuals, ScoreKind, Scores, Tried, Verdict, headline

MOST_POINTS = 60
"""Of the latest tries, how many a sparkline shows."""

_WIDTH, _HEIGHT, _MARGIN = 84, 18, 2
_GOOD, _BAD = "light-dark(#0072b2, #56b4e9)", "light-dark(#b84a00, #f08a3c)"
_LINE, _DOT, _REFERENCE = "#7c879d", "#d55e00", "#a0a8b5"
_BETTER = {"higher": " ↑", "lower": " ↓", "neither": ""}
_SAME = 0.005
"""Differences below this share of the range over all tries get no colour."""


def one_size(tries: Sequence[Tried]) -> bool:
    """True if the voxels of all tries' maps have the same size."""
    return len({each.config.voxel_size for each in tries}) < 2


def score_board_html(
    tries: Sequence[Tried], shown: int | None, pinned: int | None, first: bool = True
) -> str:
    """A table with a row for each of the first scores, or for each other score that any try has. ``shown``
    and ``pinned`` are numbers of tries."""
    by_number = {each.number: each for each in tries}
    here, reference = by_number.get(-1 if shown is None else shown), by_number.get(pinned or 0)
    if here is None:
        return _table('<tr><td style="opacity:0.6">no scores yet</td></tr>')
    firsts = tuple(headline(one_size(tries)).values())
    rows = [
        _row(kind, tries, here, reference)
        for kind in (firsts if first else KINDS)
        if first or kind not in firsts
        if any(math.isfinite(kind.value(each.scores)) for each in tries)
    ]
    stride = here.scores.pixel_stride
    coarse = f", first look (1 pixel in {stride**2})" if stride > 1 else ""
    against = "" if reference is None or reference is here else f", against try {reference.number} (A)"
    head = (
        f'<tr><td colspan="4"><b>Try {here.number}</b>'
        f'<span style="opacity:0.65">{in_html(coarse + against)}</span></td></tr>'
    )
    return _table(head * first + "".join(rows))


def verdict_html(verdict: Verdict) -> str:
    """A table of the first scores of all contenders, with what the last gains over the first."""
    first, *_, last = verdict.scores.values()
    names = "".join(f'<th style="font-weight:500">{in_html(name)}</th>' for name in verdict.scores)
    rows = [f'<tr style="opacity:0.65;text-align:right"><th></th>{names}<th></th></tr>']
    for kind in headline(verdict.one_size).values():
        values = "".join(_cell(kind.text(scores)) for scores in verdict.scores.values())
        rows.append(f"<tr>{_label(kind)}{values}{_change(kind, last, first)}</tr>")
    return _table("".join(rows))


def sparkline_svg(values: Sequence[float], shown: int, reference: float) -> str:
    """The finite values over the tries as a line; the value at the index ``shown`` as a dot, the reference as
    a dashed line."""
    known = [value for value in values if math.isfinite(value)]
    if not known:
        return ""
    low, high = min(known), max(known)
    size = (high - low) or 1.0

    def height(value: float) -> float:
        share = (value - low) / size if high > low else 0.5
        return _HEIGHT - _MARGIN - share * (_HEIGHT - 2 * _MARGIN)

    step = (_WIDTH - 2 * _MARGIN) / max(1, len(values) - 1)
    points = " ".join(
        f"{_MARGIN + i * step:.1f},{height(value):.1f}"
        for i, value in enumerate(values)
        if math.isfinite(value)
    )
    drawn = f'<polyline points="{points}" fill="none" stroke="{_LINE}" stroke-width="1.2"/>'
    if math.isfinite(reference):
        y = f"{height(min(max(reference, low), high)):.1f}"
        ends = f'x1="0" x2="{_WIDTH}" y1="{y}" y2="{y}"'
        drawn += f'<line {ends} stroke="{_REFERENCE}" stroke-dasharray="2 2"/>'
    if 0 <= shown < len(values) and math.isfinite(values[shown]):
        x = _MARGIN + shown * step
        drawn += f'<circle cx="{x:.1f}" cy="{height(values[shown]):.1f}" r="2.2" fill="{_DOT}"/>'
    return f'<svg width="{_WIDTH}" height="{_HEIGHT}" style="vertical-align:middle">{drawn}</svg>'


def _row(kind: ScoreKind, tries: Sequence[Tried], here: Tried, reference: Tried | None) -> str:
    latest = list(tries)[-MOST_POINTS:]

    def comparable(other: Tried) -> bool:
        return not kind.in_voxels or other.config.voxel_size == here.config.voxel_size

    values = [kind.value(each.scores) if comparable(each) else float("nan") for each in latest]
    unlike = reference is not None and not comparable(reference)
    against = float("nan") if reference is None or unlike else kind.value(reference.scores)
    shown = next((i for i, each in enumerate(latest) if each is here), -1)
    known = [value for value in values if math.isfinite(value)]
    other = None if reference is None or reference is here else reference.scores
    change = _change(kind, here.scores, other, max(known, default=0.0) - min(known, default=0.0))
    change = _cell("other voxels") if unlike else change
    text = f"<b>{kind.text(here.scores)}</b>"
    return f"<tr>{_label(kind)}{_cell(text)}{change}<td>{sparkline_svg(values, shown, against)}</td></tr>"


def _label(kind: ScoreKind) -> str:
    """The name of a score, an arrow to where it is better, and its meaning as a tooltip."""
    meaning = in_html(field_help(Scores)[kind.name])
    return (
        f'<td style="white-space:nowrap" title="{meaning}">{in_html(kind.label)}{_BETTER[kind.better]}</td>'
    )


def _change(kind: ScoreKind, scores: Scores, before: Scores | None, spread: float = 0.0) -> str:
    """How a score differs, with an arrow and in the colour of better or worse; a difference that is small in
    the ``spread`` over all tries has neither."""
    difference = float("nan") if before is None else kind.value(scores) - kind.value(before)
    if before is None or not math.isfinite(difference):
        return "<td></td>"
    text = kind.difference(kind.value(scores), kind.value(before))
    if not float(text.replace(",", "")):
        return _cell("same")
    text = f"{text} {kind.unit}".rstrip()
    if abs(difference) <= _SAME * spread or kind.better == "neither":
        return _cell(text)
    word, color = ("better", _GOOD) if (difference > 0) == (kind.better == "higher") else ("worse", _BAD)
    return _cell(f"{word} {'▲' if difference > 0 else '▼'} {text}", color)


def _cell(text: str, color: str = "inherit") -> str:
    return f'<td style="text-align:right;white-space:nowrap;color:{color}">{text}</td>'


def _table(rows: str) -> str:
    return (
        '<table style="margin:0 0.6em 0.4em;font-size:0.8em;border-spacing:0.45em 0;line-height:1.3">'
        f"{rows}</table>"
    )


SPREADS_SHOWN = 4.0
"""Half the height of the plot: this many times the median spread, or the median sigma if that is larger. If
all outliers fitted into the plot, the curves would lie on each other."""

_SERIES = (
    uplot.Series(label="depth (m)"),
    uplot.Series(
        label="residual (mm)", stroke="#9aa5b1", width=0,
        points={"show": True, "size": 2.5, "fill": "#9aa5b1", "width": 0},
    ),
    uplot.Series(
        label="median of a bin", stroke="#0072b2", width=0,
        points={"show": True, "size": 7.0, "fill": "#0072b2"},
    ),
    uplot.Series(
        label="median ± spread", stroke="#56b4e9", width=0,
        points={"show": True, "size": 6.0, "fill": "#56b4e9"},
    ),
    uplot.Series(label="", stroke="#56b4e9", width=0, points={"show": True, "size": 6.0, "fill": "#56b4e9"}),
    uplot.Series(label="bias", stroke="#d55e00", width=2),
    uplot.Series(label="bias ± sigma", stroke="#e69f00", width=2),
    uplot.Series(label="", stroke="#e69f00", width=2),
)  # fmt: skip


@dataclass(frozen=True)
class NoiseCurves:
    """The current sigma and bias at depths. ``note`` (markdown) says where they come from, if not from the
    page's own sliders."""

    of_depth: Callable[[NDArray[np.float64]], Curves]
    note: str = ""

    @classmethod
    def of(cls, sensor: SensorConfig) -> "NoiseCurves":
        """Those of a configuration. If a table cannot be read any more, ``note`` says so and nothing is
        drawn."""
        tables = [name for name in ("sigma", "bias") if getattr(sensor, f"{name}_table") is not None]
        if not tables:
            return cls(curves_of(sensor))
        try:
            of_depth = curves_of(sensor)
        except ConfigError as error:
            nothing = in_markdown(f"The curves are not drawn: {error}.")
            return cls(lambda depth_m: (np.nan * depth_m[None],) * 2, nothing)
        if is_model(sensor.sigma_table):
            return cls(of_depth, "The curves are the mean of the noise model in force.")
        names = " and ".join(tables)
        return cls(of_depth, f"For {names} the curves are the mean over the patches of the table in force.")

    def at(self, depth_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Bias and sigma at some depths, in metres, means over all patches; (n,) each."""
        sigma, bias = self.of_depth(depth_m)
        return bias.mean(axis=0), sigma.mean(axis=0)


class NoisePlot:
    """Owns the plot. Curves follow the sliders at once; residuals come with each map."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._residuals: Residuals | None = None
        self._sensor = SensorConfig()
        self._curves = NoiseCurves.of(self._sensor)
        nothing = tuple(np.zeros(2) for _ in _SERIES)
        self._plot: Any = gui.add_uplot(
            nothing,
            _SERIES,
            scales={"x": uplot.Scale(time=False), "y": uplot.Scale(range=(-1.0, 1.0))},
            axes=(uplot.Axis(label="depth (m)"), uplot.Axis(label="residual (mm)")),
            legend={"show": False},
            aspect=1.25,
            visible=False,
        )
        self.text = gui.add_markdown("No map yet.")

    def show(self, residuals: Residuals) -> None:
        """Show the residuals of another map."""
        self._residuals = residuals
        self._draw()

    def follow(self, sensor: SensorConfig) -> None:
        """Draw the curves of this sensor."""
        if sensor != self._sensor:
            self._sensor, self._curves = sensor, NoiseCurves.of(sensor)
            self._draw()

    def _draw(self) -> None:
        if self._residuals is None:
            return
        data = plot_data(self._residuals, self._curves)
        reach = _reach_mm(self._residuals, self._curves)
        self._plot.scales = {"x": uplot.Scale(time=False), "y": uplot.Scale(range=(-reach, reach))}
        self._plot.data = data
        self._plot.visible = True
        self.text.content = sentence(self._residuals, self._curves)


def plot_data(residuals: Residuals, curves: NoiseCurves) -> tuple[NDArray[np.float64], ...]:
    """Depth in metres, and over it in millimetres: residuals, medians and spreads of bins, bias and
    bias ± sigma; NaN where a residual or a bin has no point. All (n,)."""
    depth, bins = residuals.depth_m.astype(np.float64), residuals.bin_m
    x = np.concatenate([depth, bins])
    order = np.argsort(x, kind="stable")

    def placed(begin: int, values_m: NDArray[np.floating]) -> NDArray[np.float64]:
        column = np.full(len(x), np.nan)
        column[begin : begin + len(values_m)] = 1000.0 * values_m
        return column[order]

    bias, sigma = (1000.0 * curve for curve in curves.at(x[order]))
    return (
        x[order],
        placed(0, residuals.residual_m),
        placed(len(depth), residuals.median_m),
        placed(len(depth), residuals.median_m + residuals.spread_m),
        placed(len(depth), residuals.median_m - residuals.spread_m),
        bias,
        bias + sigma,
        bias - sigma,
    )


def _reach_mm(residuals: Residuals, curves: NoiseCurves) -> float:
    """The largest residual that the plot shows, in millimetres."""
    if not len(residuals.bin_m):
        return 100.0
    bias, sigma = (np.nan_to_num(curve) for curve in curves.at(residuals.bin_m))
    usual_m = max(float(np.median(residuals.spread_m)), float(np.median(sigma)))
    offset_m = max(float(np.median(np.abs(residuals.median_m))), float(np.max(np.abs(bias))))
    return 1000.0 * (SPREADS_SHOWN * usual_m + offset_m)


def sentence(residuals: Residuals, curves: NoiseCurves) -> str:
    """The text below the plot, markdown."""
    if not len(residuals.bin_m):
        return "The map has no surface in the held-out views."
    points = "Grey: measured minus expected depth in held-out views, mm. Blue: its median and spread. "
    ratio = float(np.median(residuals.spread_m / curves.at(residuals.bin_m)[1]))
    if not np.isfinite(ratio):
        return points + curves.note
    return (
        f"{points}Orange: bias and bias ± sigma. The spread is **{ratio:.1f} times** sigma; the map's own "
        f"error, some tenths of a voxel, is part of it. {curves.note}"
    ).rstrip()
