"""The widgets of the tuning page, and where they stand. What they mean is decided in tune_page.py."""

import html
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser

from taichi_mrf.config.registry import METHODS
from taichi_mrf.config.schema import Config
from taichi_mrf.viewer.events import Chosen, Event, KnobMoved, OptionsMoved, Pressed
from taichi_mrf.viewer.live.options import ViewOptions
from taichi_mrf.viewer.messages import Notice
from taichi_mrf.viewer.notices import notices_html
from taichi_mrf.viewer.tune.knob_widgets import KnobWidgets
from taichi_mrf.viewer.tune.knobs import KNOBS
from taichi_mrf.viewer.tune.messages import Activity, FrameChoice, HeldOutView, Tried, Tuning
from taichi_mrf.viewer.tune.noise_plot import NoisePlot
from taichi_mrf.viewer.tune.score_board import score_board_html
from taichi_mrf.viewer.tune.table import changes, table_html
from taichi_mrf.viewer.widgets import OptionWidgets

TRY_BUTTONS = ("Restore", "Pin")
SAVE_BUTTONS = {
    "Save YAML": "The chosen try's parameters, with its scores as a comment: for `map --config` and `live "
    "--config`.",
    "Save CSV": "The table of all tries, with their parameters and scores.",
}
NONE_YET = "none yet"
MAP_OPTIONS = (
    "color_by", "threshold", "size", "shade", "cut_axis", "cut_at", "bricks", "pictures", "dark",
)  # fmt: skip

_FOLDERS = {"map": "Map", **{m.section: m.title for m in METHODS.values()}, "keyframes": "Keyframes"}
_FOLDED = ("keyframes",)
_MOST_NOTICES = 8
_MOST_TRIES = 200
"""So many of the latest tries can be chosen."""


class TunePanel:
    """Makes the widgets once; everything that a viewer does with them goes to ``tell``."""

    def __init__(self, gui: viser.GuiApi, config: Config, tell: Callable[[Event], None]) -> None:
        self._gui, self._tell = gui, tell
        self._notices: list[Notice] = []
        self._names: dict[str, int] = {}
        self._last_shown: int | None = None
        self._knobs: list[KnobWidgets] = []
        self._folders: dict[str, Any] = {}
        self._activity = gui.add_markdown("Starting …")
        self._progress: Any = gui.add_progress_bar(0.0, animated=True)
        self._stop = gui.add_button("Stop the search", visible=False)
        self._stop.on_click(lambda event: self._pressed(event, "Stop the search"))
        self._shown = gui.add_markdown("0 voxels shown")
        self._scores = gui.add_html("")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Parameters", viser.Icon.ADJUSTMENTS):
            for section, title in _FOLDERS.items():
                folder = gui.add_folder(title, expand_by_default=section not in _FOLDED)
                self._folders[section] = folder
                with folder:
                    self._add_knobs(section, config)
        with tabs.add_tab("Noise", viser.Icon.CHART_DOTS):
            self.noise = NoisePlot(gui)
            self._add_knobs("sensor", config)
        with tabs.add_tab("Views", viser.Icon.PHOTO):
            self._views_tab()
        with tabs.add_tab("Tries", viser.Icon.HISTORY):
            self._tries_tab()
        with tabs.add_tab("Map", viser.Icon.CUBE):
            self._legend = gui.add_html("")
            self._options = OptionWidgets(gui, ViewOptions(), lambda: tell(OptionsMoved()), MAP_OPTIONS)
        with tabs.add_tab("Frames", viser.Icon.MOVIE):
            self._frame_text = gui.add_markdown("")
            self._frames = OptionWidgets(gui, FrameChoice(), lambda: None)
            self._button("Use these frames", "Begin anew with these frames; the table of tries starts over.")
        with tabs.add_tab("About", viser.Icon.INFO_CIRCLE):
            self._about = gui.add_html("")
            self._notice_list = gui.add_html("")

    def options(self) -> ViewOptions:
        """The view options as the widgets stand."""
        return self._options.value()

    def frame_choice(self) -> FrameChoice:
        """The working set as the widgets have it. Raises ConfigError."""
        return self._frames.value()

    def applied(self, name: str, config: Config) -> Config:
        """The configuration with one parameter as its widget stands. Raises ConfigError."""
        return next(each for each in self._knobs if name in each).applied(name, config)

    def show_config(self, config: Config) -> None:
        """Set all sliders and boxes, and the curves of the noise plot."""
        for each in self._knobs:
            each.show(config)
        self.follow(config)

    def follow(self, config: Config) -> None:
        """Show what belongs to a configuration: its method's sliders, its noise curves."""
        for each in self._knobs:
            each.follow(config)
        for method in METHODS.values():
            folder = self._folders[method.section]
            if folder.visible != (config.method == method.name):
                folder.visible = config.method == method.name
        self.noise.follow(config.sensor)

    def show_tuning(self, tuning: Tuning) -> None:
        """What is tuned, on which frames."""
        choice = tuning.choice
        for name, handle in self._frames.handles.items():
            if name == "first":
                handle.max = max(1, tuning.frames - 1)
            handle.value = getattr(choice, name)
        self._frame_text.content = _plain(
            f"{len(tuning.training)} frames make the map, {len(tuning.held_out)} are held out to score it"
            + (f", {len(tuning.unseen)} are kept back until the search has ended" if tuning.unseen else "")
            + f"; the sequence has {tuning.frames}."
        )
        self.view.options = list(dict.fromkeys(tuning.held_out)) or [NONE_YET]
        self.view.value = self.view.options[0]
        rows = {"source": tuning.source, "backend": f"{tuning.backend} ({tuning.device})"}
        rows |= {"training": ", ".join(tuning.training), "held out": ", ".join(tuning.held_out)}
        self._about.content = _rows(rows)
        self._notices.clear()
        self._list_notices()

    def show_activity(self, activity: Activity) -> None:
        """How the work stands."""
        self._activity.content = _plain(activity.text)
        self._progress.value = 100.0 * min(max(activity.share, 0.0), 1.0)
        self._progress.animated = activity.busy
        searching = activity.text.startswith("search")
        if self._stop.visible != searching:
            self._stop.visible = searching

    def show_tries(self, tries: Sequence[Tried], shown: int | None, pinned: int | None) -> None:
        """The scores, and the table. The dropdown goes to a try that is newly shown, else it stays."""
        self._scores.content = score_board_html(tries, shown, pinned)
        self._table.content = table_html(tries, shown, pinned)
        if not tries:
            self._names = {}
            self.attempt.options = [NONE_YET]
            return
        first, chosen = tries[0].config, self.chosen_try()
        if shown != self._last_shown or chosen is None:
            chosen = self._last_shown = shown
        latest = list(tries)[-_MOST_TRIES:]
        self._names = {f"{t.number}: {changes(first, t.config)}"[:80]: t.number for t in latest[::-1]}
        if list(self.attempt.options) != list(self._names):
            self.attempt.options = list(self._names)
        name = next((name for name, number in self._names.items() if number == chosen), None)
        if name is not None and self.attempt.value != name:
            self.attempt.value = name

    def chosen_try(self) -> int | None:
        """The try that the dropdown stands at."""
        return self._names.get(self.attempt.value)

    def show_view(self, view: HeldOutView) -> None:
        """The accuracy image of a held-out view beside that of the reference."""
        self._measured.image, self._accuracy.image = view.measured, view.accuracy
        if view.reference is not None:
            self._reference.image = view.reference
        if view.change is not None:
            self._change.image = view.change
        self._measured.visible = self._accuracy.visible = True
        self._change.visible = view.change is not None
        self._change_text.content = _plain(view.change_title)
        self._reference.visible = view.reference is not None
        self._accuracy_text.content = f"**B** · {_plain(view.title)}"
        self._reference_text.content = (
            f"**A** · reference, {_plain(view.reference_title)}" if view.reference is not None else ""
        )

    def show_counts(self, voxels: int) -> None:
        """How many voxels the page shows."""
        self._shown.content = f"{voxels:,} voxels shown"

    def show_legend(self, legend_html: str) -> None:
        """The scale of the colours."""
        self._legend.content = legend_html

    def show_notice(self, notice: Notice) -> None:
        """Keep a sentence for the page."""
        self._notices = [notice, *self._notices][:_MOST_NOTICES]
        self._list_notices()

    def _add_knobs(self, section: str, config: Config) -> None:
        knobs = [knob for knob in KNOBS if knob.section == section]
        self._knobs.append(KnobWidgets(self._gui, knobs, config, lambda name: self._tell(KnobMoved(name))))

    def _views_tab(self) -> None:
        gui = self._gui
        self.view: Any = gui.add_dropdown(
            "Held-out view", [NONE_YET], hint="Frames that no map has been made of; they score it."
        )
        self.view.on_update(lambda event: self._chosen(event, "view"))
        gui.add_markdown("Right (blue), wrong (orange), no answer (light), not judged (dark).")
        black = np.zeros((2, 2, 3), np.uint8)
        self._reference_text = gui.add_markdown("")
        self._reference = gui.add_image(black, visible=False)
        self._accuracy_text = gui.add_markdown("")
        self._accuracy = gui.add_image(black, visible=False)
        self._change_text = gui.add_markdown("")
        self._change = gui.add_image(black, visible=False)
        self._measured = gui.add_image(black, label="measured depth", visible=False)

    def _tries_tab(self) -> None:
        gui = self._gui
        self._table = gui.add_html("")
        self.attempt: Any = gui.add_dropdown(
            "Try", [NONE_YET], hint="The buttons act on this one. What it says is what it changed."
        )
        group = gui.add_button_group("Do", TRY_BUTTONS)
        group.on_click(lambda event: self._pressed(event, event.target.value))
        for name, hint in SAVE_BUTTONS.items():
            self._button(name, hint)
        gui.add_markdown(
            "**Restore** sets the sliders to the try and maps with it again. **Pin** makes it the reference "
            "(A) that scores and pictures are compared with."
        )

    def _button(self, name: str, hint: str) -> None:
        button = self._gui.add_button(name, hint=hint)
        button.on_click(lambda event: self._pressed(event, name))

    def _pressed(self, event: viser.GuiEvent, name: str) -> None:
        if event.client_id is not None:
            self._tell(Pressed(name, event.client_id))

    def _chosen(self, event: viser.GuiEvent, widget: str) -> None:
        if event.client_id is not None:  # not one of our own changes
            self._tell(Chosen(widget))

    def _list_notices(self) -> None:
        self._notice_list.content = notices_html(self._notices)


def _rows(rows: dict[str, str]) -> str:
    cells = "".join(
        f'<tr><td style="vertical-align:top">{html.escape(k)}</td><td>{html.escape(v)}</td></tr>'
        for k, v in rows.items()
    )
    return f'<table style="margin:0 0.75em;font-size:0.85em;border-spacing:0.5em 0">{cells}</table>'


def _plain(text: str) -> str:
    """Text for a markdown widget, in which nothing is markup; names of frames may hold anything."""
    return "".join("\\" + c if c in "\\`*_{}[]<>#|!&" else c for c in text)
