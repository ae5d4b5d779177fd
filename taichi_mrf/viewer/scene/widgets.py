"""Widgets made from a typed dataclass, so that a name, a range or a help text is written once, and text from
data, such as the name of a frame, of which every character is itself and none is markup.

viser renders HTML inside markdown, so an unescaped file name could run a script in the page. All text that is
not written in this package passes through one of these two functions before it reaches a markdown or an HTML
widget. Other widgets (dropdowns, labels, notifications) show plain text.
"""

import base64
import dataclasses
import html
import string
import typing
import unicodedata
from collections.abc import Callable, Container, Sequence
from typing import Annotated, Any, Generic, Literal, TypeVar

import cv2
import numpy as np
import viser
from numpy.typing import NDArray

from taichi_mrf.config.method import Range
from taichi_mrf.config.text import field_help

LONGEST = 1000
"""Characters of one text in markdown; the rest is cut off."""

INDENT = "\N{EM SPACE}"

_PUNCTUATION = {ord(c): f"&#{ord(c)};" for c in string.punctuation}
_INVISIBLE = {"Cc", "Cf", "Cs", "Co", "Cn"}


def in_markdown(text: str) -> str:
    """One paragraph of markdown that reads as ``text``: line breaks become spaces."""
    one_line = _visible(" ".join(text.split()))
    if len(one_line) > LONGEST:
        one_line = one_line[: LONGEST - 1] + "…"
    return one_line.translate(_PUNCTUATION)


def in_html(text: str) -> str:
    """HTML that reads as ``text``, inside an element or an attribute in quotes; line breaks stay."""
    return "\n".join(html.escape(_visible(line)) for line in text.split("\n"))


def image_html(picture: NDArray[np.uint8], style: str, alt: str = "") -> str:
    """An RGB picture (h, w, 3) as an element of HTML."""
    png = base64.b64encode(cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))[1].tobytes())
    return f'<img alt="{in_html(alt)}" style="{style}" src="data:image/png;base64,{png.decode("ascii")}">'


def _visible(text: str) -> str:
    """Without control characters, some of which turn the direction of the text around."""
    return "".join("\N{REPLACEMENT CHARACTER}" if unicodedata.category(c) in _INVISIBLE else c for c in text)


T = TypeVar("T")


class OptionWidgets(Generic[T]):
    """One widget for each field of a dataclass: a slider for a number with a Range, a dropdown for a Literal
    or for names that are offered later, a checkbox for a bool."""

    def __init__(self, gui: viser.GuiApi, options: T, changed: Callable[[], None]) -> None:
        """``changed`` is called, on some thread, after any of the widgets was moved."""
        self._gui, self._options, self._changed = gui, options, changed
        self.handles: dict[str, Any] = {}

    def add(self, *names: str, indented: Container[str] = ()) -> None:
        """Add the widgets of these fields, of all without a name, at the place where the GUI stands."""
        cls: type[Any] = type(self._options)
        hints, texts = typing.get_type_hints(cls, include_extras=True), field_help(cls)
        for name in names or tuple(hints):
            value = getattr(self._options, name)
            label = f"{INDENT if name in indented else ''}{label_of(name)}"
            handle = add_widget(self._gui, label, hints[name], value, texts[name])
            handle.on_update(lambda event: self._changed())
            self.handles[name] = handle

    def offer(self, name: str, choices: Sequence[str]) -> None:
        """Let a dropdown offer these choices only."""
        change(self.handles[name], options=tuple(choices))

    def value(self) -> T:
        """The options with the values of the widgets."""
        values = {name: handle.value for name, handle in self.handles.items()}
        options: Any = self._options
        result: T = dataclasses.replace(options, **values)
        return result


def change(handle: Any, **values: Any) -> None:
    """Set those properties of a widget or a scene node that differ: browsers are told of each that is set."""
    for name, value in values.items():
        if getattr(handle, name) != value:
            setattr(handle, name, value)


def label_of(name: str) -> str:
    """The label of a field; one in metres says so at its end."""
    words = name.removesuffix("_m").replace("_", " ").capitalize()
    return f"{words} (m)" if name.endswith("_m") else words


def add_widget(gui: viser.GuiApi, label: str, hint: Any, value: Any, text: str) -> Any:
    """The widget for a value of the type ``hint``, with ``text`` as its help: a slider for a number with a
    Range, a dropdown for a Literal or a name, a checkbox for a bool. Raises TypeError for any other type."""
    if typing.get_origin(hint) is Annotated:
        limits = next(each for each in typing.get_args(hint) if isinstance(each, Range))
        return gui.add_slider(label, limits.least, limits.most, limits.step, value, hint=text)
    if typing.get_origin(hint) is Literal:
        return gui.add_dropdown(label, list(typing.get_args(hint)), initial_value=value, hint=text)
    if hint is str:
        return gui.add_dropdown(label, [value], initial_value=value, hint=text)
    if hint is bool:
        return gui.add_checkbox(label, value, hint=text)
    raise TypeError(f"no widget for {label}: {hint}")
