"""The strip along the foot of the live page of a map whose world may change: the time that is shown, with a
tick for each keyframe, what its camera saw then, and what has come and gone."""

from collections.abc import Iterable

import viser

from taichi_mrf.viewer import messages as m
from taichi_mrf.viewer.scene.base_panel import BasePanel
from taichi_mrf.viewer.scene.widgets import change, image_html, in_html
from taichi_mrf.viewer.transport.viser_internals import set_ticks

TIME_STEP_S, PLAY_TIME = 0.1, "Play through time"

_MARGIN_PX, _WIDTH_PX = 15, 600
"""Of the strip: it stands beside the page's panel in a window of 1,000 pixels or more."""

_MOST_TICKS = 100


class TimeStrip:
    """Adds the strip, a panel of its own. Times on the page count from the first keyframe."""

    def __init__(self, gui: viser.GuiApi, panel: BasePanel) -> None:
        self._span: m.TimeSpan | None = None
        self._latest: tuple[m.SceneChange, ...] = ()
        self._nearest: m.KeyframeInfo | None = None
        self.strip = gui.add_panel(visible=False)
        self.strip.float(x=_MARGIN_PX, y=-_MARGIN_PX, width=_WIDTH_PX)
        with self.strip.add_tab("Time"):
            hint = (
                "Show the map as it was believed at this time, in all browsers. The right end is now "
                "and follows new keyframes. An edit returns to now."
            )
            step = TIME_STEP_S
            slider = gui.add_slider("Time (s)", 0.0, step, step, step, disabled=True, hint=hint)
            self.slider = panel.watch(slider)
            self._play = panel.add_button(
                PLAY_TIME,
                "Show the map from this time on, or from its first keyframe, until now.",
                disabled=True,
            )
            self._list = gui.add_html("", visible=False)

    def begin(self, has_dates: bool) -> None:
        """Start with an empty map; the strip is there if it ``has_dates``."""
        self._span, self._latest, self._nearest = None, (), None
        self.slider.disabled = self._play.disabled = True
        self.strip.visible = has_dates
        self._show_list()

    @property
    def past_s(self) -> float | None:
        """The earlier time that is shown, in seconds on the strip; None for now."""
        span = self._span
        return None if span is None or span.shown_s is None else span.shown_s - span.start_s

    def chosen_s(self) -> float | None:
        """The stamp of the time on the slider, None at its right end, which is now."""
        if self._span is None or self.slider.value >= self.slider.max - 0.5 * TIME_STEP_S:
            return None
        return max(self._span.first_s, self._span.start_s + float(self.slider.value))

    def played_s(self) -> float | None:
        """The stamp of the time from which the map is played."""
        chosen_s = self.chosen_s()
        return self._span.first_s if chosen_s is None and self._span is not None else chosen_s

    def show_span(self, span: m.TimeSpan, keyframes: Iterable[m.KeyframeInfo]) -> None:
        """Set the slider's ends, the time that is shown, and a tick for each keyframe, or each few."""
        known, self._span = self._span is not None, span
        last_s = max(_on_grid(span.now_s - span.start_s), TIME_STEP_S)
        first_s = min(_on_grid(span.first_s - span.start_s), last_s - TIME_STEP_S)
        shown_s = last_s if span.shown_s is None else _on_grid(span.shown_s - span.start_s)
        disabled = span.now_s <= span.first_s
        change(self.slider, min=first_s, max=last_s, value=shown_s, disabled=disabled)
        change(self._play, disabled=disabled)
        times_s = [each.stamp_s - span.start_s for each in keyframes]
        times_s = sorted(each for each in times_s if first_s <= each <= last_s)
        set_ticks(self.slider, times_s[:: -(-len(times_s) // _MOST_TICKS) or 1])
        if not known:
            self._show_list()

    def show_nearest(self, keyframes: Iterable[m.KeyframeInfo], stamp_s: float | None) -> None:
        """Show the picture of the keyframe that is nearest to a time; None: none."""
        before, self._nearest = self._nearest, None
        if stamp_s is not None:
            self._nearest = min(keyframes, key=lambda each: abs(each.stamp_s - stamp_s), default=None)
        if self._nearest is not before:
            self._show_list()

    def show_changes(self, changes: m.SceneChanges) -> None:
        """List what has appeared and left, the latest first."""
        self._latest = changes.changes
        self._show_list()

    def _show_list(self) -> None:
        """Picture and list take no room until there is something to tell."""
        start_s = 0.0 if self._span is None else self._span.start_s
        near, lines, picture = self._nearest, [_in_words(change, start_s) for change in self._latest], ""
        if near is not None:
            lines = [f"nearest keyframe: {near.name}, at {near.stamp_s - start_s:.1f} s", *lines]
            picture = image_html(near.picture, "width:160px;max-width:40%;align-self:start")
        self._list.visible = bool(lines)
        items = "".join(f"<div>{in_html(line)}</div>" for line in lines)
        style = "display:flex;gap:1em;padding:0 0.75em 0.75em;font-size:0.8em;max-height:11em;overflow:auto"
        self._list.content = f'<div style="{style}">{picture}<div>{items}</div></div>'


def _in_words(change: m.SceneChange, start_s: float) -> str:
    size = " x ".join(f"{side:.1f}" for side in change.size_m)
    centre = ", ".join(f"{value:.1f}" for value in change.centre_m)
    return f"{change.stamp_s - start_s:.1f} s: something of {size} m {change.verb} at ({centre})"


def _on_grid(seconds: float) -> float:
    return round(round(seconds / TIME_STEP_S) * TIME_STEP_S, 6)
