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
    """Probability of occupied for a voxel in which a ray ends."""

    miss: float = 0.4
    """Probability of occupied for a voxel that a ray passes through."""

    lowest: float = 0.1192
    """Lower bound on a voxel's probability, so that it can still change."""

    highest: float = 0.971
    """Upper bound on a voxel's probability."""

    update: Literal["scan", "ray"] = "scan"
    """Update a voxel once per scan, with a hit overriding misses (OctoMap), or once per ray."""

    max_range: float = 0.0
    """Cut rays off at this range (metres). A cut ray hits nothing: the voxel in which it ends is not updated.
    0 means no limit."""

    discretise: bool = False
    """Cast one ray to the centre of each voxel that contains a measurement instead of one per pixel."""

    correct_bias: bool = False
    """Subtract the sensor's bias from the measurements first."""

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
    is_octomap=True,
)
