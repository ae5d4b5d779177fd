"""Sliders and boxes for parameters of the configuration, as the page shows them.

A slider has steps and the configuration has not: only the widget that a user has moved changes its parameter.
"""

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import viser

from taichi_mrf.config.schema import Config
from taichi_mrf.viewer.scene.widgets import add_widget
from taichi_mrf.viewer.tune.knobs import Knob

LEAST_DECADE = 1e-300
"""Shown in place of 0 by a slider of powers of ten."""


class KnobWidgets:
    """One widget for each of some knobs, added where the GUI stands. ``moved`` is called, on any thread, with
    the name of a knob that a user has moved."""

    def __init__(
        self, gui: viser.GuiApi, knobs: Sequence[Knob], config: Config, moved: Callable[[str], None]
    ) -> None:
        self._knobs = {knob.name: knob for knob in knobs}
        self._handles: dict[str, Any] = {}
        for knob in knobs:
            value = shown_value(knob, config)
            hint = knob.parameter.hint
            if knob.range is not None:
                hint = Annotated[hint, knob.range]
            handle = add_widget(gui, knob.label, hint, value, f"{knob.parameter.help} ({knob.name})")
            handle.on_update(
                lambda event, name=knob.name: moved(name) if event.client_id is not None else None
            )
            self._handles[knob.name] = handle
        self.follow(config)

    def __contains__(self, name: str) -> bool:
        return name in self._knobs

    def applied(self, name: str, config: Config) -> Config:
        """The configuration with one parameter as its widget shows it. Raises ConfigError if the result is
        not valid."""
        knob = self._knobs[name]
        return knob.parameter.replaced(config, config_value(knob, self._handles[name].value))

    def show(self, config: Config) -> None:
        """Set all widgets to a configuration's values."""
        for name, knob in self._knobs.items():
            value = shown_value(knob, config)
            if self._handles[name].value != value:
                self._handles[name].value = value
        self.follow(config)

    def follow(self, config: Config) -> None:
        """Show the widgets of parameters that have an effect under this configuration, hide the others."""
        for name, knob in self._knobs.items():
            visible = knob.applies(config)
            if self._handles[name].visible != visible:
                self._handles[name].visible = visible


def shown_value(knob: Knob, config: Config) -> Any:
    """Value that a knob's widget shows: the parameter's or its power of ten, clamped to the range."""
    value = knob.value_of(config)
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
