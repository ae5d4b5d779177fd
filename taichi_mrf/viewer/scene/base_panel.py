"""The widgets that both pages have: what is being done, counts, legend, notices; how widgets of an action are
added; and the events that their use puts into the page's inbox.

Updates come into the inbox from the mapping process, events from the browsers; None ends the page, whose own
thread takes them out. viser runs callbacks on a pool of threads: a callback only puts an event into it.
"""

import queue
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from taichi_mrf.viewer.messages import Hello, Notice, Update
from taichi_mrf.viewer.scene.coloring import COLORINGS
from taichi_mrf.viewer.scene.view_options import OF_LAYER, ViewOptions, colorings_of, drawings_of
from taichi_mrf.viewer.scene.widgets import OptionWidgets, change, in_html
from taichi_mrf.viewer.transport.pulse import ACTIVITY


class Event:
    """Base of what a user or a browser does; the pages add their own."""


@dataclass(frozen=True)
class Joined(Event):
    """A browser has connected."""

    client: int


@dataclass(frozen=True)
class OptionsMoved(Event):
    """A widget of the view options was used; the latest values count."""


@dataclass(frozen=True)
class Used(Event):
    """A client used the widget of an action: it pressed the button, or changed the value. The action has the
    name of the widget."""

    action: str
    client: int


Item = Update | Event | None


class Inbox(queue.SimpleQueue[Item]):
    """A queue that any thread may fill."""

    def wait(self, patience_s: float | None) -> list[Item]:
        """All items in the queue. Waits for the first one for at most ``patience_s`` seconds (None: without
        limit), and returns an empty list if none has come by then."""
        try:
            batch = [self.get(timeout=patience_s)]
        except queue.Empty:
            return []
        while not self.empty():
            batch.append(self.get())
        return batch


Tell = Callable[[Event], None]

AGREE, DECLINE = "agree", "decline"
"""Actions of the answers to a question."""

_MOST_NOTICES = 8

_COUNTED = {
    "dynamic": "that move",
    "points": "measured points",
    "baseline": "of the baseline",
}
"""Layers that are counted beside voxels or the surface, and their words."""

_SEVERITY_COLORS = {"info": "inherit", "warning": "#c77700", "error": "#c62828"}


class BasePanel:
    """Adds widgets to the current container of the GUI; each use of them calls ``tell`` with an event."""

    DARK_OR_LIGHT = "Dark or light", "The panel's colours in this browser; at first as its system has them."

    def __init__(self, gui: viser.GuiApi, tell: Tell) -> None:
        """The first widgets of the panel; a subclass adds its own, ``add_legend`` and ``add_notices``."""
        self.gui, self._tell = gui, tell
        self.view_options = OptionWidgets(gui, ViewOptions(), lambda: tell(OptionsMoved()))
        self._notices: list[Notice] = []
        self._questions: dict[int, tuple[Any, Callable[[], None]]] = {}
        self._activity = gui.add_html(_activity_html("Starting …"))
        self._progress: Any = gui.add_progress_bar(0.0, animated=True)

    def add_layers(self, *without: str) -> None:
        """Add the list of layers, each with what belongs to it, in the order of the options' fields."""
        names = (each.name for each in fields(ViewOptions))
        self.view_options.add(*(name for name in names if name not in without), indented=OF_LAYER)

    def add_counts(self) -> None:
        """Add the line that says how many voxels the page shows."""
        self._shown = self.gui.add_markdown("0 voxels shown")

    def add_legend(self) -> None:
        """Add the scale of the colours."""
        self._legend = self.gui.add_html("")

    def add_notices(self) -> None:
        """Add the list of the latest notices."""
        self._notice_list = self.gui.add_html("")

    def add_button(self, label: str, hint: str | None = None, action: str = "", **options: Any) -> Any:
        """Add a button, whose action has the name that is written on it unless ``action`` is given."""
        button = self.gui.add_button(label, hint=hint, **options)
        button.on_click(lambda event: self.used(event, action or label))
        return button

    def add_buttons(self, label: str, actions: Sequence[str], hint: str | None = None) -> Any:
        """Add a row of buttons: the action of each has the name that is written on it."""
        group = self.gui.add_button_group(label, tuple(actions), hint=hint)
        group.on_click(lambda event: self.used(event, event.target.value))
        return group

    def add_command(self, label: str, action: str, key: Any, modifier: Any = None) -> None:
        """Add an entry of the command palette (Ctrl-K) with a key; keys do nothing while text is typed."""
        command = self.gui.add_command(label, hotkey=key, modifier=modifier)
        command.on_trigger(lambda event: self.used(event, action))

    def watch(self, widget: Any) -> Any:
        """Take each change of a widget's value by a user as the action of the widget's label; the page's own
        changes are none. Returns the widget."""
        widget.on_update(lambda event: self.used(event, widget.label))
        return widget

    def show_activity(self, text: str, share: float, moving: bool) -> None:
        """Show what is being done and how much of it is, 0 to 1; ``moving`` animates the bar."""
        self._activity.content = _activity_html(text)
        self._progress.value = 100.0 * min(max(share, 0.0), 1.0)
        self._progress.animated = moving

    def show_counts(self, counts: Mapping[str, int], square_m: float | None, recording: bool) -> None:
        """Show how much the page shows, by the names that MapScene.counts has, how wide the squares on the
        ground are if there are any, and whether the scene is being recorded."""
        triangles = counts.get("triangles")
        text = f"{counts['map']:,} voxels" if triangles is None else f"{triangles:,} triangles"
        others = (f", {counts[name]:,} {words}" for name, words in _COUNTED.items() if counts.get(name))
        text += "".join([" shown", *others, "" if square_m is None else f" · ground: {square_m:g} m squares"])
        self._shown.content = text + (" · recording" if recording else "")

    def show_cut(self, ends_m: NDArray[np.float64] | None, in_middle: bool = False) -> None:
        """Offer cuts between these coordinates (2,), and cut in the middle of them if asked; None: no cut."""
        slider, flip = (self.view_options.handles[name] for name in ("cut_at_m", "flip_cut"))
        for handle in (slider, flip):
            change(handle, visible=ends_m is not None)
        if ends_m is not None:
            low, high = np.round(ends_m, 2).tolist()
            middle = round((low + high) / 2, 2) if in_middle else min(max(slider.value, low), high)
            change(slider, min=low, max=high, value=middle)

    def offer(self, hello: Hello) -> None:
        """Offer the drawings that a map has the data for, and the colours; the chosen ones may come yet."""
        chosen = COLORINGS[self.view_options.handles["color_by"].value].layer
        self.offer_colorings(hello, (chosen,))
        self.view_options.offer("draw_as", drawings_of(hello))

    def offer_colorings(self, hello: Hello, layers: Container[str]) -> None:
        """Offer the colourings that a map has the data for, of which pixels have fed ``layers``."""
        self.view_options.offer("color_by", colorings_of(hello, layers))

    def show_used(self, **used: bool) -> None:
        """Show the widgets of these view options while they have an effect; explain the chosen colours."""
        colors = self.view_options.handles["color_by"]
        change(colors, hint=f"The map's colours say {COLORINGS[colors.value].help}")
        for name in used.keys() & self.view_options.handles.keys():
            change(self.view_options.handles[name], visible=used[name])

    def show_legend(self, legend_html: str) -> None:
        """Show the scale of the colours."""
        self._legend.content = legend_html

    def show_notice(self, notice: Notice) -> None:
        """Put a notice at the head of the list."""
        self._notices = [notice, *self._notices][:_MOST_NOTICES]
        self._notice_list.content = notices_html(self._notices)

    def clear_notices(self) -> None:
        """Empty the list."""
        self._notices.clear()
        self._notice_list.content = notices_html([])

    def ask(
        self, client: viser.ClientHandle, then: Callable[[], None], title: str, text: str, yes: str, no: str
    ) -> None:
        """Ask one user to confirm what cannot be undone, which ``then`` does. The answers are actions, for
        :meth:`agree` and :meth:`close_question`."""
        self.close_question(client.client_id)
        modal = client.gui.add_modal(title)
        self._questions[client.client_id] = modal, then
        with modal:
            client.gui.add_markdown(text)
            client.gui.add_button(yes, color="red").on_click(lambda event: self.used(event, AGREE))
            client.gui.add_button(no).on_click(lambda event: self.used(event, DECLINE))

    def close_question(self, client: int) -> None:
        """Close the question."""
        modal, _ = self._questions.pop(client, (None, None))
        if modal is not None and not modal.closed:
            modal.close()

    def agree(self, client: int) -> None:
        """Close the question, and do what was asked."""
        _, then = self._questions.get(client, (None, lambda: None))
        self.close_question(client)
        then()

    def used(self, event: Any, action: str) -> None:
        """Callback of what a user does with viser's widgets."""
        if event.client_id is not None:
            self._tell(Used(action, event.client_id))


def _activity_html(text: str) -> str:
    """Activity in an element that the page hides while nothing answers it."""
    return f'<p class="{ACTIVITY}" style="margin:0.1em 0.75em">{in_html(text)}</p>'


def rows_html(rows: Mapping[str, str]) -> str:
    """A table of two columns; both hold plain text."""
    cells = "".join(
        f'<tr><td style="vertical-align:top">{in_html(name)}</td>'
        f'<td style="overflow-wrap:anywhere">{in_html(value)}</td></tr>'
        for name, value in rows.items()
    )
    return f'<table style="margin:0 0.75em;font-size:0.85em;border-spacing:0.5em 0">{cells}</table>'


def notices_html(notices: Iterable[Notice]) -> str:
    """A paragraph for each notice, in the order given and the colour of its severity."""
    lines = "".join(
        f'<p style="margin:0.2em 0;color:{_SEVERITY_COLORS[each.severity]}">{in_html(each.text)}</p>'
        for each in notices
    )
    return f'<div style="margin:0.5em 0.75em;font-size:0.85em">{lines}</div>'
