"""The folder "Time" of a map whose world may change: a slider over the past, the colour of what is dynamic,
and the list of what has appeared and left."""

from typing import Any

import viser

from taichi_mrf.viewer.live.actions import Action
from taichi_mrf.viewer.messages import SceneChange, SceneChanges, TimeSpan
from taichi_mrf.viewer.scene.base_panel import BasePanel
from taichi_mrf.viewer.scene.coloring import dynamic_legend_html
from taichi_mrf.viewer.scene.safe_text import in_html

STEP_S = 0.1


class TimeFolder:
    """Adds the folder at the place where the GUI stands. Times on the page count from the first keyframe."""

    def __init__(self, gui: viser.GuiApi, panel: BasePanel) -> None:
        self._span: TimeSpan | None = None
        self._latest: tuple[SceneChange, ...] = ()
        self.folder = gui.add_folder("Time", visible=False)
        with self.folder:
            self.slider: Any = gui.add_slider(
                "Time (s)",
                min=0.0,
                max=STEP_S,
                step=STEP_S,
                initial_value=STEP_S,
                disabled=True,
                hint="Show the map as it was believed at this time, in all browsers. The right end is now "
                "and follows new keyframes. An edit returns to now.",
            )
            panel.watch(self.slider, Action.SHOW_TIME)
            self._list = gui.add_html("", visible=False)
            gui.add_html(dynamic_legend_html())

    def begin(self, has_dates: bool) -> None:
        """Start with an empty map; the folder is there if it ``has_dates``."""
        self._span, self._latest = None, ()
        self.slider.disabled = True
        self.folder.visible = has_dates
        self._show_list()

    def chosen_s(self) -> float | None:
        """The stamp of the time on the slider, None at its right end, which is now."""
        if self._span is None or self.slider.value >= self.slider.max - 0.5 * STEP_S:
            return None
        return max(self._span.first_s, self._span.start_s + float(self.slider.value))

    def show_span(self, span: TimeSpan) -> None:
        """Set the slider's ends, and the time that is shown."""
        known, self._span = self._span is not None, span
        last_s = max(_on_grid(span.now_s - span.start_s), STEP_S)
        first_s = min(_on_grid(span.first_s - span.start_s), last_s - STEP_S)
        shown_s = last_s if span.shown_s is None else _on_grid(span.shown_s - span.start_s)
        values = {"min": first_s, "max": last_s, "value": shown_s, "disabled": span.now_s <= span.first_s}
        for name, value in values.items():
            if getattr(self.slider, name) != value:
                setattr(self.slider, name, value)
        if not known:
            self._show_list()

    def show_changes(self, changes: SceneChanges) -> None:
        """List what has appeared and left, the latest first."""
        self._latest = changes.changes
        self._show_list()

    def _show_list(self) -> None:
        """The list takes no room until there is something to tell."""
        start_s = 0.0 if self._span is None else self._span.start_s
        lines = [_in_words(change, start_s) for change in self._latest]
        self._list.visible = bool(lines)
        items = "".join(f"<div>{in_html(line)}</div>" for line in lines)
        self._list.content = f'<div style="padding:0 0.75em;font-size:0.8em">{items}</div>'


def _in_words(change: SceneChange, start_s: float) -> str:
    size = " x ".join(f"{side:.1f}" for side in change.size_m)
    centre = ", ".join(f"{value:.1f}" for value in change.centre_m)
    return f"{change.stamp_s - start_s:.1f} s: something of {size} m {change.verb} at ({centre})"


def _on_grid(seconds: float) -> float:
    return round(round(seconds / STEP_S) * STEP_S, 6)
