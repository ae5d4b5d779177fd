"""The scores of the shown try: numbers, differences from the reference, and sparklines."""

import math
from collections.abc import Sequence

from taichi_mrf.viewer.scene.safe_text import in_html
from taichi_mrf.viewer.tune.messages import Tried
from taichi_mrf.viewer.tune.scores import KINDS, ScoreKind

MOST_POINTS = 60
"""Of the latest tries, how many a sparkline shows."""

_WIDTH, _HEIGHT, _MARGIN = 84, 18, 2
_GOOD, _BAD, _LINE, _REFERENCE = "#0072b2", "#d55e00", "#5c677d", "#a0a8b5"
_SAME = 0.005
"""Differences below this share of the range over all tries get no colour."""


def score_board_html(tries: Sequence[Tried], shown: int | None, pinned: int | None) -> str:
    """A table with a row for each figure that any try has. ``shown`` and ``pinned`` are numbers of tries."""
    by_number = {each.number: each for each in tries}
    here, reference = by_number.get(-1 if shown is None else shown), by_number.get(pinned or 0)
    if here is None:
        return _table('<tr><td style="opacity:0.6">no scores yet</td></tr>')
    rows = [
        _row(kind, tries, here, reference)
        for kind in KINDS
        if any(math.isfinite(kind.value(each.scores)) for each in tries)
    ]
    coarse = (
        f", first look (1 pixel in {here.scores.pixel_stride**2})" if here.scores.pixel_stride > 1 else ""
    )
    against = "" if reference is None or reference is here else f", against try {reference.number}"
    head = (
        f'<tr><td colspan="4"><b>Try {here.number}</b>'
        f'<span style="opacity:0.65">{in_html(coarse + against)}</span></td></tr>'
    )
    return _table(head + "".join(rows))


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
        drawn += (
            f'<line x1="0" x2="{_WIDTH}" y1="{y}" y2="{y}" stroke="{_REFERENCE}" stroke-dasharray="2 2"/>'
        )
    if 0 <= shown < len(values) and math.isfinite(values[shown]):
        x = _MARGIN + shown * step
        drawn += f'<circle cx="{x:.1f}" cy="{height(values[shown]):.1f}" r="2.2" fill="{_BAD}"/>'
    return f'<svg width="{_WIDTH}" height="{_HEIGHT}" style="vertical-align:middle">{drawn}</svg>'


def _row(kind: ScoreKind, tries: Sequence[Tried], here: Tried, reference: Tried | None) -> str:
    latest = list(tries)[-MOST_POINTS:]
    values = [kind.value(each.scores) for each in latest]
    value = kind.value(here.scores)
    against = float("nan") if reference is None else kind.value(reference.scores)
    change, color = "", "inherit"
    if reference is not here and math.isfinite(against) and math.isfinite(value):
        difference = value - against
        known = [each for each in values if math.isfinite(each)]
        change = f"{difference * kind.factor:+{kind.form.lstrip('+')}}"
        worth_it = abs(difference) > _SAME * (max(known) - min(known))
        if worth_it and float(change.replace(",", "")) != 0 and kind.better != "neither":
            color = _GOOD if (difference > 0) == (kind.better == "higher") else _BAD
    shown = next((i for i, each in enumerate(latest) if each is here), -1)
    line = sparkline_svg(values, shown, against)
    cells = (
        f'<td style="white-space:nowrap">{in_html(kind.label)}</td>'
        f'<td style="text-align:right;white-space:nowrap"><b>{kind.text(here.scores)}</b></td>'
        f'<td style="text-align:right;white-space:nowrap;color:{color}">{change}</td>'
        f"<td>{line}</td>"
    )
    return f"<tr>{cells}</tr>"


def _table(rows: str) -> str:
    return (
        '<table style="margin:0 0.6em 0.8em;font-size:0.8em;border-spacing:0.45em 0;line-height:1.25">'
        f"{rows}</table>"
    )
