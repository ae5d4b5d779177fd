"""The entry of the method log_odds, with its parameters. No Taichi here: this is imported for a --help."""

from dataclasses import dataclass
from typing import Literal

from taichi_mrf.config.method import Method
from taichi_mrf.config.sliders import Range, Slider
from taichi_mrf.config.values import check_field


@dataclass(frozen=True)
class LogOddsConfig:
    """Occupancy mapping by independent log-odds, as OctoMap does it (Hornung et al. 2013)."""

    hit: float = 0.7
    """Probability of occupied that a ray's end gives a voxel."""

    miss: float = 0.4
    """Probability of occupied that a ray gives a voxel by passing through it."""

    lowest: float = 0.1192
    """A voxel's probability never falls below this, so that it can change again."""

    highest: float = 0.971
    """A voxel's probability never rises above this."""

    update: Literal["scan", "ray"] = "scan"
    """One update for each voxel and scan, in which a hit wins over misses (OctoMap), or one for each ray."""

    max_range: float = 0.0
    """A ray is cut off at this range (metres) and then hits nothing: the voxel in which it ends is not
    updated. 0 means no limit."""

    discretise: bool = False
    """Cast one ray to the centre of each voxel that holds a measurement, instead of one for each pixel."""

    correct_bias: bool = False
    """Take the sensor's known bias out of the measurements first."""

    def __post_init__(self) -> None:
        check_field(0.5 < self.hit < 1, "log_odds.hit", "must lie between 0.5 and 1")
        check_field(0 < self.miss < 0.5, "log_odds.miss", "must lie between 0 and 0.5")
        check_field(0 < self.lowest < 0.5, "log_odds.lowest", "must lie between 0 and 0.5")
        check_field(0.5 < self.highest < 1, "log_odds.highest", "must lie between 0.5 and 1")
        check_field(self.max_range >= 0, "log_odds.max_range", "must not be negative")


METHOD = Method(
    name="log_odds",
    summary="independent log-odds as in OctoMap",
    title="Log-odds (OctoMap)",
    section="log_odds",
    section_class=LogOddsConfig,
    section_help="Occupancy mapping by independent log-odds (method log_odds).",
    map_class="taichi_mrf.methods.log_odds.map:LogOddsMap",
    sliders=(
        Slider("hit", Range(0.51, 0.98, 0.01)),
        Slider("miss", Range(0.02, 0.49, 0.01)),
        Slider("lowest", Range(0.01, 0.49, 0.01)),
        Slider("highest", Range(0.51, 0.99, 0.01)),
        Slider("update"),
        Slider("correct_bias"),
    ),
    prior_is_unknown=True,
)
