"""How far a slider goes. A page and whoever works behind it both read this, so it needs no page."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Range:
    """The smallest and largest value of a slider, and its step."""

    least: float
    most: float
    step: float
