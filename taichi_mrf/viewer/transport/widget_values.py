"""The value that a widget takes when a client writes one: of its own type, in its range, on its grid."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import viser

from taichi_mrf.viewer.transport.client_messages import WidgetValue
from taichi_mrf.viewer.transport.viser_internals import Widget

LONGEST_TEXT = 200
"""Characters of a text field; no widget of the pages needs more."""

LARGEST_NUMBER = 2**53
"""Beyond this a browser's numbers cannot hold every integer, and msgpack ends at 2^64."""

Bounds = tuple[float | None, float | None]


def value_to_set(widget: Widget, sent: WidgetValue) -> Any | None:
    """The value that ``widget`` takes when ``sent`` arrives; None if it must not change.

    Numbers are clamped and rounded, text is cut; a value of the wrong type, a choice that is not offered
    or the wrong count of numbers is refused.
    """
    match widget:
        case viser.GuiCheckboxHandle():
            return sent if isinstance(sent, bool) else None
        case viser.GuiButtonHandle():
            return True if sent is True else None
        case viser.GuiButtonGroupHandle() | viser.GuiDropdownHandle():
            return sent if isinstance(sent, str) and sent in widget.options else None
        case viser.GuiTextHandle():
            return sent[:LONGEST_TEXT] if isinstance(sent, str) else None
        case viser.GuiSliderHandle():
            return _slider_value(widget, sent) if _is_number(sent) else None
        case viser.GuiNumberHandle():
            return _field_value(widget, sent, (widget.min, widget.max), widget.value)
        case viser.GuiMultiSliderHandle():
            return _multi_slider_value(widget, sent)
        case viser.GuiRgbHandle() | viser.GuiRgbaHandle():
            channels = _numbers(sent, len(widget.value))
            return channels and tuple(int(_clamp(round(channel), (0, 255))) for channel in channels)
        case viser.GuiVector2Handle() | viser.GuiVector3Handle():
            return _vector_value(widget, sent)
    return None


def is_out_of_range(widget: Widget, sent: WidgetValue) -> bool:
    """True if ``sent`` is a number that the slider or field cannot show."""
    if not isinstance(widget, viser.GuiSliderHandle | viser.GuiNumberHandle) or not _is_number(sent):
        return False
    assert isinstance(sent, int | float)
    return _clamp(sent, (widget.min, widget.max)) != sent


def is_same(sent: Any, taken: Any) -> bool:
    """True if a client that shows ``sent`` shows what is in force, but for the last bits of a float."""
    if isinstance(sent, list) and isinstance(taken, tuple):
        return len(sent) == len(taken) and all(map(is_same, sent, taken))
    if _is_number(sent) and _is_number(taken):
        return math.isclose(sent, taken, rel_tol=1e-9, abs_tol=1e-9)
    return bool(sent == taken)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _numbers(sent: WidgetValue, count: int) -> Sequence[float] | None:
    """``sent`` if it is a list of ``count`` finite numbers."""
    if isinstance(sent, list) and len(sent) == count and all(map(_is_number, sent)):
        return sent
    return None


def _clamp(value: float, bounds: Bounds) -> float:
    lower, upper = bounds
    lower = -LARGEST_NUMBER if lower is None else lower
    upper = LARGEST_NUMBER if upper is None else upper
    return min(max(value, lower), upper)


def _on_grid(value: float, origin: float, widget: Any, current: float) -> float:
    """``value`` clamped to the slider's range and rounded to ``origin`` + k step, or one of its ends.

    The ends count although they may lie off the grid, as they do for the client.
    """
    value = _clamp(value, (widget.min, widget.max))
    if value not in (widget.min, widget.max):
        stepped = origin + round((value - origin) / widget.step) * widget.step
        value = _clamp(round(stepped, widget.precision), (widget.min, widget.max))
    return type(current)(value)


def _slider_value(widget: viser.GuiSliderHandle, sent: Any) -> float:
    return _on_grid(sent, widget.min, widget, widget.value)


def _multi_slider_value(widget: viser.GuiMultiSliderHandle, sent: WidgetValue) -> tuple[float, ...] | None:
    """Handles in ascending order; the client counts the steps of this widget from zero."""
    numbers = _numbers(sent, len(widget.value))
    if numbers is None:
        return None
    handles = [
        current if is_same(number, current) else _on_grid(number, 0.0, widget, current)
        for number, current in zip(numbers, widget.value, strict=True)
    ]
    if widget.fixed_endpoints and handles:
        handles[0], handles[-1] = widget.value[0], widget.value[-1]
    smallest_gap = (widget.min_range or 0.0) - 1e-9
    if any(upper - lower < smallest_gap for lower, upper in pairwise(handles)):
        return None
    return tuple(handles)


def _field_value(widget: Any, sent: Any, bounds: Bounds, current: float) -> float | None:
    """A typed number; a field's step is what its arrows add, its grid are the decimals it shows."""
    if not _is_number(sent):
        return None
    return type(current)(_clamp(round(sent, widget.precision), bounds))


def _vector_value(
    widget: viser.GuiVector2Handle | viser.GuiVector3Handle, sent: WidgetValue
) -> tuple[float, ...] | None:
    numbers = _numbers(sent, len(widget.value))
    if numbers is None:
        return None
    unbounded = (None,) * len(numbers)
    values = (
        _field_value(widget, *each)
        for each in zip(
            numbers,
            zip(widget.min or unbounded, widget.max or unbounded, strict=True),
            widget.value,
            strict=True,
        )
    )
    return tuple(value for value in values if value is not None)
