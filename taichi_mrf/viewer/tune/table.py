"""The table of all tries, the newest first: what each changed, and its scores."""

import dataclasses
from collections.abc import Sequence

from taichi_mrf.config.schema import Config
from taichi_mrf.config.text import differences
from taichi_mrf.viewer.scene.safe_text import in_html
from taichi_mrf.viewer.tune.messages import Tried
from taichi_mrf.viewer.tune.scores import KINDS

MOST_ROWS = 150

_COLUMNS = ("accuracy_sigma", "median_abs_m", "log_likelihood", "depth_calibration", "seconds")
_HEADS = ("1.5 σ", "median", "log-lik.", "calib.", "time")
_MARKS = {"search": "◆", "hand": "", "start": ""}


def table_html(tries: Sequence[Tried], shown: int | None, pinned: int | None) -> str:
    """A row of scores for each try, and below it what it changed from the first."""
    if not tries:
        return ""
    kinds = {kind.name: kind for kind in KINDS}
    best = max(
        (each for each in tries if each.scores.pixel_stride == 1),
        key=lambda each: each.scores.log_likelihood,
        default=None,
    )
    head = "".join(f'<th style="text-align:right;font-weight:500">{name}</th>' for name in _HEADS)
    rows = [f'<tr style="opacity:0.65"><th></th>{head}</tr>']
    for each in list(tries)[: -MOST_ROWS - 1 : -1]:
        marks = "▸" if each.number == shown else ""
        marks += " A" if each.number == pinned else ""
        marks += "★" if each is best else ""
        about = "~" if each.scores.pixel_stride > 1 else ""
        numbers = "".join(
            f'<td style="text-align:right;white-space:nowrap">{about}{kinds[name].text(each.scores)}</td>'
            for name in _COLUMNS
        )
        shade = "background:rgba(0,114,178,0.12);" if each.number == shown else ""
        rows.append(
            f'<tr style="{shade}"><td style="white-space:nowrap"><b>{each.number}</b> {marks}'
            f"{_MARKS[each.by]}</td>{numbers}</tr>"
            f'<tr style="{shade}"><td></td>'
            f'<td colspan="{len(_COLUMNS)}" style="opacity:0.7;padding-bottom:3px">'
            f"{in_html(changes(tries[0].config, each.config))}</td></tr>"
        )
    key = "▸ shown · A reference · ★ highest likelihood · ◆ from the search · ~ some of the pixels"
    return (
        '<div style="max-height:22em;overflow:auto;margin:0 0.5em">'
        f'<table style="font-size:0.75em;border-spacing:0.4em 0;width:100%">{"".join(rows)}</table></div>'
        f'<div style="font-size:0.7em;opacity:0.65;margin:0.2em 0.9em">{key}</div>'
    )


def changes(first: Config, config: Config) -> str:
    """Changes of a configuration from the first, as text."""
    names = differences(first, config)
    if not names:
        return "first parameters"
    return ", ".join(f"{name.split('.')[-1].replace('_', ' ')} {_short(config, name)}" for name in names)


def _short(config: Config, name: str) -> str:
    value: object = dataclasses.asdict(config)
    for field in name.split("."):
        assert isinstance(value, dict)
        value = value[field]
    if isinstance(value, tuple):
        return "(" + ", ".join(f"{term:.4g}" for term in value) + ")"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
