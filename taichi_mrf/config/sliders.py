"""Sliders as data: ranges and units, which the tuning page and the automatic search both read."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Range:
    """The smallest and largest value of a slider, and its step."""

    least: float
    most: float
    step: float


def always(section: Any) -> bool:
    """The condition of a parameter that always has an effect."""
    return True


@dataclass(frozen=True)
class Slider:
    """One parameter of a section that the tuning page offers.

    ``name`` is the field's name. ``range`` is None for a choice or a switch. With ``decades`` the slider
    and its range are powers of ten. ``counts`` takes the section and says whether the parameter
    changes anything under the section's other values. The automatic search varies a parameter by steps, or by
    factors if ``by_factors``, and those that are ``searched`` unless others are named.
    """

    name: str
    range: Range | None = None
    unit: str = ""
    decades: bool = False
    counts: Callable[[Any], bool] = always
    by_factors: bool = False
    searched: bool = False
