"""The parameters of time: how soon the world may change. All mapping methods read them."""

import math
from dataclasses import dataclass

from taichi_mrf.config.places import in_files
from taichi_mrf.config.values import check_field

LIVE_HALF_LIFE_S = 14400.0
"""The half-life that a live run has by default: people and chairs move. All else maps a static world."""


@dataclass(frozen=True)
class TimeConfig:
    """How soon the world may change. Each voxel is a two-state Markov chain in time: what keyframes said of
    the past counts for less, the longer ago it was, and never for more than the chance of a change since."""

    half_life_s: float = 0.0
    """Seconds after which half of what is known of a voxel is out of date: how soon may a chair move? With
    14400 (four hours) a few views are enough to see what is new, whatever was there before. 0 is a world
    that never changes, for surveys."""

    moving_share: float = in_files(1e-6)
    """Share of space that things which come and go fill. The smaller it is, the more views it takes until a
    surface that was seen often counts as gone. Only mrf uses it."""

    glimpse_half_life_s: float = in_files(2.0)
    """Seconds after which half of a single view's claim is forgotten, if it contradicts what was known to be
    free: a person who walks past. Later views confirm or deny it. Only mrf uses it."""

    def __post_init__(self) -> None:
        check_field(0 <= self.half_life_s < math.inf, "time.half_life_s", "must not be negative")
        check_field(0 < self.moving_share <= 0.5, "time.moving_share", "must be above 0 and at most 0.5")
        check_field(
            0 < self.glimpse_half_life_s < math.inf, "time.glimpse_half_life_s", "must be a positive number"
        )

    @property
    def is_static(self) -> bool:
        """True if the world never changes."""
        return self.half_life_s == 0

    @property
    def flip_rate(self) -> float:
        """How often a voxel changes its state, per second, if both states are equally likely; 0 if static."""
        return 0.0 if self.is_static else math.log(2.0) / (2.0 * self.half_life_s)

    def forgotten(self, seconds: float) -> float:
        """The share of a voxel's state that is drawn anew within some seconds: 1 - exp(-2 flip_rate t)."""
        return -math.expm1(-2.0 * self.flip_rate * max(seconds, 0.0))
