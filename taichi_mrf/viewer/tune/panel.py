"""The widgets of the tuning page, with the sliders of parameters and the table of all tries. page.py decides
what they do.

A slider has steps and the configuration has not: only the widget that a user has moved changes its parameter.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Annotated, Any, get_args

import numpy as np
import viser

from taichi_mrf.config.registry import METHODS
from taichi_mrf.config.schema import Config
from taichi_mrf.config.text import differences
from taichi_mrf.viewer.scene.base_panel import BasePanel, Event, Tell, rows_html
from taichi_mrf.viewer.scene.viewpoint import Side
from taichi_mrf.viewer.scene.widgets import OptionWidgets, add_widget, change, in_html, in_markdown
from taichi_mrf.viewer.tune import messages as t
from taichi_mrf.viewer.tune.knobs import KNOBS, Knob
from taichi_mrf.viewer.tune.plots import NoisePlot, one_size, score_board_html, verdict_html


@dataclass(frozen=True)
class KnobMoved(Event):
    """The slider or box of the parameter of this name was used."""

    name: str


NONE_YET = "none yet"

_OWN = {m.section: m.title for m in METHODS.values() if m.sliders}
_FOLDERS = {"map": "Map", **_OWN, "keyframes": "Keyframes"}
LEAST_DECADE = 1e-300
"""Shown in place of 0 by a slider of powers of ten."""

MOST_TRIES = 150
"""Of the latest tries, how many the table and the dropdown have."""


class TunePanel(BasePanel):
    """Adds the widgets, and shows values in them."""

    def __init__(self, gui: viser.GuiApi, config: Config, tell: Tell) -> None:
        super().__init__(gui, tell)
        self._names: dict[str, int] = {}
        self._last_shown: int | None = None
        self.knobs = KnobWidgets(gui, config, lambda name: tell(KnobMoved(name)))
        self._folders: dict[str, Any] = {}
        self._stop = self.add_button("Stop the search", visible=False)
        self.add_counts()
        self._scores = gui.add_html("")
        with gui.add_folder("More scores", expand_by_default=False):
            self._more_scores = gui.add_html("")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Parameters"):
            for section, title in _FOLDERS.items():
                folder = gui.add_folder(title, expand_by_default=section != "keyframes")
                self._folders[section] = folder
                with folder:
                    self.knobs.add(section)
        with tabs.add_tab("Search"):
            self._search_tab()
        with tabs.add_tab("Views"):
            self._views_tab()
        with tabs.add_tab("Tries"):
            self._tries_tab()
        with tabs.add_tab("Noise"):
            self.noise = NoisePlot(gui)
            self.knobs.add("sensor")
        with tabs.add_tab("Map"):
            self.add_buttons("Look from", [side.capitalize() for side in get_args(Side)])
            self.add_legend()
            self.add_layers("changes", "points", "baseline", "follow")
            self.add_button(*self.DARK_OR_LIGHT)
        with tabs.add_tab("Frames"):
            self._frame_text = gui.add_markdown("")
            self.frames = OptionWidgets(gui, t.FrameChoice(), lambda: None)
            self.frames.add()
            hint = "Start again with these frames. The table of tries is emptied."
            self.add_button("Use these frames", hint)
            self._about = gui.add_html("")
            self.add_notices()

    def show_config(self, config: Config) -> None:
        """Set all sliders and boxes, and the curves of the noise plot."""
        self.knobs.show(config)
        self.follow(config)

    def follow(self, config: Config) -> None:
        """Show what belongs to a configuration: its method's sliders, its noise curves."""
        self.knobs.follow(config)
        for section in _OWN:
            folder, visible = self._folders[section], METHODS[config.method].section == section
            change(folder, visible=visible)
        self.noise.follow(config.sensor)

    def show_tuning(self, tuning: t.Tuning) -> None:
        """Show what is tuned, on which frames."""
        for name, handle in self.frames.handles.items():
            if name == "first":
                handle.max = max(1, tuning.frames - 1)
            handle.value = getattr(tuning.choice, name)
        self._frame_text.content = in_markdown(
            f"{len(tuning.training)} frames make the map, {len(tuning.held_out)} are held out to score it"
            + (f", {len(tuning.unseen)} are kept back until the search has ended" if tuning.unseen else "")
            + f"; the sequence has {tuning.frames}."
        )
        self.view.options = list(dict.fromkeys(tuning.held_out)) or [NONE_YET]
        self.view.value = self.view.options[0]
        rows = {"source": tuning.source, "backend": f"{tuning.backend} ({tuning.device})"}
        rows |= {"training": ", ".join(tuning.training), "held out": ", ".join(tuning.held_out)}
        self._about.content = rows_html(rows)
        self._verdict.content = ""
        change(self._save_best, visible=False)
        self.clear_notices()

    def show_tuning_activity(self, activity: t.Activity) -> None:
        """Show what is being done, and a button that ends a search."""
        self.show_activity(activity.text, activity.share, activity.busy)
        searching = activity.text.startswith("search,")
        change(self._stop, visible=searching)
        change(self._start, disabled=searching)

    def show_verdict(self, verdict: t.Verdict) -> None:
        """Show what the search has gained, and offer its parameters."""
        title = f"<b>Verdict</b> on views that the search has not seen ({verdict.views}):"
        self._verdict.content = f'<p style="margin:0.5em 0.75em">{title}</p>{verdict_html(verdict)}'
        change(self._save_best, visible=True)

    def show_tries(self, tries: Sequence[t.Tried], shown: int | None, pinned: int | None) -> None:
        """The scores, and the table. The dropdown goes to a try that is newly shown, else it stays."""
        self._scores.content = score_board_html(tries, shown, pinned)
        self._more_scores.content = score_board_html(tries, shown, pinned, first=False)
        self._table.content = table_html(tries, shown, pinned)
        if not tries:
            self._names = {}
            self.attempt.options = [NONE_YET]
            return
        first, chosen = tries[0].config, self.chosen_try()
        if shown != self._last_shown or chosen is None:
            chosen = self._last_shown = shown
        latest = list(tries)[-MOST_TRIES:]
        self._names = {
            f"{each.number}: {changes(first, each.config)}"[:80]: each.number for each in latest[::-1]
        }
        change(self.attempt, options=tuple(self._names))
        name = next((name for name, number in self._names.items() if number == chosen), None)
        if name is not None:
            change(self.attempt, value=name)

    def chosen_try(self) -> int | None:
        """The try that the dropdown stands at."""
        return self._names.get(self.attempt.value)

    def show_view(self, view: t.HeldOutView) -> None:
        """Accuracy in a held-out view, beside the reference; changes beside the depths."""
        self._accuracy.image, self._measured.image = view.accuracy, view.measured
        self._accuracy.visible = self._measured.visible = True
        title, reference, changed = map(in_markdown, (view.title, view.reference_title, view.change_title))
        both = f"**A** (left): {reference}.\n\n**B** (right): {title}."
        self._accuracy_text.content = both if reference else f"**B**: {title}."
        both = f"{changed} (left); measured depth (right)."
        self._measured_text.content = both if changed else "Measured depth."

    def _search_tab(self) -> None:
        self.gui.add_markdown(
            "The search moves the sliders of prior, outliers and noise for you, starting where they are. "
            "Half of the held-out views are kept from it, to judge its result."
        )
        self.search = OptionWidgets(self.gui, t.StartSearch(), lambda: None)
        self.search.add()
        self._start = self.add_button("Start a search", "The table of tries is emptied.")
        self._verdict = self.gui.add_html("")
        hint = "What the search has found, with the verdict as a comment: for `map --config`."
        self._save_best = self.add_button("Save best.yaml", hint, visible=False)

    def _views_tab(self) -> None:
        gui = self.gui
        hint = "A frame that is not in the map and scores it."
        self.view = self.watch(gui.add_dropdown("Held-out view", [NONE_YET], hint=hint))
        black = np.zeros((2, 2, 3), np.uint8)
        self._accuracy_text = gui.add_markdown("")
        self._accuracy = gui.add_image(black, visible=False)
        gui.add_markdown("Right (blue), wrong (orange), no surface (light), not judged (dark).")
        self._measured_text = gui.add_markdown("")
        self._measured = gui.add_image(black, visible=False)

    def _tries_tab(self) -> None:
        gui = self.gui
        self._table = gui.add_html("")
        self.attempt: Any = gui.add_dropdown(
            "Selected try", [NONE_YET], hint="The try that the buttons use, with what it changed."
        )
        self.add_buttons("Try", ("Restore", "Pin"))
        self.add_button("Save YAML", "The parameters of the selected try and its scores, for `map --config`.")
        self.add_button("Save CSV", "The table of all tries with their parameters and scores.")
        gui.add_markdown(
            "**Restore** sets the sliders to the selected try and maps with it again. **Pin** makes it the "
            "reference (A): scores and pictures of other tries are compared with it."
        )


class KnobWidgets:
    """One widget for each knob. ``moved`` is called, on any thread, with the name of a knob that a user has
    moved."""

    def __init__(self, gui: viser.GuiApi, config: Config, moved: Callable[[str], None]) -> None:
        self._gui, self._config, self._moved = gui, config, moved
        self._knobs: dict[str, Knob] = {}
        self._handles: dict[str, Any] = {}

    def add(self, section: str) -> None:
        """Add the widgets of a section's knobs at the place where the GUI stands."""
        for knob in (each for each in KNOBS if each.section == section):
            hint = knob.parameter.hint
            if knob.range is not None:
                hint = Annotated[hint, knob.range]
            value, text = shown_value(knob, self._config), f"{knob.parameter.help} ({knob.name})"
            handle = add_widget(self._gui, knob.label, hint, value, text)
            handle.on_update(
                lambda event, name=knob.name: self._moved(name) if event.client_id is not None else None
            )
            self._knobs[knob.name], self._handles[knob.name] = knob, handle
        self.follow(self._config)

    def applied(self, name: str, config: Config) -> Config:
        """The configuration with one parameter as its widget shows it. Raises ConfigError if the result is
        not valid."""
        knob = self._knobs[name]
        return knob.parameter.replaced(config, config_value(knob, self._handles[name].value))

    def show(self, config: Config) -> None:
        """Set all widgets to a configuration's values."""
        for name, knob in self._knobs.items():
            change(self._handles[name], value=shown_value(knob, config))

    def follow(self, config: Config) -> None:
        """Show the widgets of parameters that have an effect under this configuration, hide the others."""
        for name, knob in self._knobs.items():
            change(self._handles[name], visible=knob.applies(config))


def shown_value(knob: Knob, config: Config) -> Any:
    """Value that a knob's widget shows: the parameter's or its power of ten, clamped to the range."""
    value = knob.parameter.value_of(config)
    if knob.range is None:
        return value
    if value is None:
        return knob.range.least
    if knob.decades:
        value = math.log10(max(value, LEAST_DECADE))
    within = min(max(value, knob.range.least), knob.range.most)
    return int(within) if knob.parameter.hint is int else round(float(within), 9)


def config_value(knob: Knob, shown: Any) -> Any:
    """The parameter's value for what a widget shows."""
    return float(f"{10.0**shown:.4g}") if knob.decades else shown


def table_html(tries: Sequence[t.Tried], shown: int | None, pinned: int | None) -> str:
    """A row of scores for each try, and below it what it changed from the first."""
    if not tries:
        return ""
    best = max(
        (each for each in tries if each.scores.pixel_stride == 1),
        key=lambda each: each.scores.log_likelihood,
        default=None,
    )
    kinds = t.headline(one_size(tries)).values()
    head = "".join(f'<th style="text-align:right;font-weight:500">{kind.label}</th>' for kind in kinds)
    rows = [f'<tr style="opacity:0.65"><th></th>{head}</tr>']
    for each in list(tries)[: -MOST_TRIES - 1 : -1]:
        marks = "▸" if each.number == shown else ""
        marks += " A" if each.number == pinned else ""
        marks += "★" if each is best else ""
        about = "~" if each.scores.pixel_stride > 1 else ""
        numbers = "".join(
            f'<td style="text-align:right;white-space:nowrap">{about}{kind.text(each.scores)}</td>'
            for kind in kinds
        )
        shade = "background:rgba(0,114,178,0.12);" if each.number == shown else ""
        rows.append(
            f'<tr style="{shade}"><td style="white-space:nowrap"><b>{each.number}</b> {marks}'
            f"{'◆' * (each.by == 'search')}</td>{numbers}</tr>"
            f'<tr style="{shade}"><td></td>'
            f'<td colspan="{len(kinds)}" style="opacity:0.7;padding-bottom:3px">'
            f"{in_html(changes(tries[0].config, each.config))}</td></tr>"
        )
    key = "▸ shown · A reference · ★ best fit · ◆ from the search · ~ some of the pixels"
    return (
        '<div style="max-height:22em;overflow:auto;margin:0 0.5em">'
        f'<table style="font-size:0.75em;border-spacing:0;width:100%">{"".join(rows)}</table></div>'
        f'<div style="font-size:0.7em;opacity:0.65;margin:0.2em 0.9em">{key}</div>'
    )


def changes(first: Config, config: Config) -> str:
    """Changes of a configuration from the first, as text."""
    names = differences(first, config)
    if not names:
        return "first parameters"
    return ", ".join(f"{name.split('.')[-1].replace('_', ' ')} {_short(config, name)}" for name in names)


def _short(config: Config, name: str) -> str:
    value = attrgetter(name)(config)
    if isinstance(value, tuple):
        return "(" + ", ".join(f"{term:.4g}" for term in value) + ")"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
