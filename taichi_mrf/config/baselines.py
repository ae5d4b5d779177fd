"""The parameters of the baselines: log-odds, visibility-aware mapping, wavemap's model. They are here and not
in the methods' folders because the whole configuration (schema.py) has a field for each."""

import math
from dataclasses import dataclass
from typing import Literal

from taichi_mrf.config.places import in_python
from taichi_mrf.config.values import check_field

LEAST_RANGE_SIGMA_M = 0.05
"""The noise of an Ouster OS0 (metres), below which the range's sigma is not set by the voxel size."""


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

    update: Literal["scan", "ray"] = in_python("scan")
    """Update a voxel once per scan, with a hit overriding misses (OctoMap), or once per ray."""

    max_range: float = in_python(0.0)
    """Cut rays off at this range (metres). A cut ray hits nothing: the voxel in which it ends is not updated.
    0 means no limit."""

    discretise: bool = in_python(False)
    """Cast one ray to the centre of each voxel that contains a measurement instead of one per pixel."""

    correct_bias: bool = in_python(False)
    """Subtract the sensor's bias from the measurements first."""

    def __post_init__(self) -> None:
        check_field(0.5 < self.hit < 1, "log_odds.hit", "must lie between 0.5 and 1")
        check_field(0 < self.miss < 0.5, "log_odds.miss", "must lie between 0 and 0.5")
        check_field(0 < self.lowest < 0.5, "log_odds.lowest", "must lie between 0 and 0.5")
        check_field(0.5 < self.highest < 1, "log_odds.highest", "must lie between 0.5 and 1")
        check_field(self.max_range >= 0, "log_odds.max_range", "must not be negative")


@dataclass(frozen=True)
class VisibilityConfig:
    """Visibility-aware occupancy mapping (Schauwecker & Zell, IROS 2014).

    The defaults are their Table I but for ``visible_if_occluded``: see TABLE_I.
    """

    hit_if_free: float = 0.43
    """P(H | V, not O): probability of a hit for a visible voxel that is free."""

    hit_if_occupied: float = 0.55
    """P(H | V, O): probability of a hit for a visible voxel that is occupied."""

    hit_if_hidden: float = 0.05
    """P(H | not V): probability of a hit for a voxel that is not visible."""

    visible_if_occluded: float = 0.45
    """P(V_i | C_i, V_i-1): probability that a locally occluded voxel behind a visible one is visible. From
    0.4 on (with q_max at 0.7) rays pass unknown voxels at once; with less, as with the paper's 0.2, the map
    grows by a few voxels a frame."""

    visible_if_clear: float = 1.0
    """P(V_i | not C_i, V_i-1): the same for a voxel that is not locally occluded."""

    q_min: float = 0.1
    """A ray ends where the probability of visibility falls below this."""

    q_max: float = 0.7
    """A probability of visibility of at least this counts as 1."""

    lowest: float = 0.1192
    """Lower bound on a voxel's probability (OctoMap's default)."""

    highest: float = 0.971
    """Upper bound on a voxel's probability (OctoMap's default)."""

    max_range: float = 0.0
    """Cut rays off at this range (metres). The end of a cut ray counts as free. 0 means no limit."""

    def __post_init__(self) -> None:
        for name in ("hit_if_free", "hit_if_occupied", "hit_if_hidden"):
            check_field(0 < getattr(self, name) < 1, f"visibility.{name}", "must lie between 0 and 1")
        for name in ("visible_if_occluded", "visible_if_clear", "q_min", "q_max"):
            check_field(0 <= getattr(self, name) <= 1, f"visibility.{name}", "must lie from 0 to 1")
        check_field(self.q_min < self.q_max, "visibility.q_max", "must be more than visibility.q_min")
        check_field(0 < self.lowest < 0.5, "visibility.lowest", "must lie between 0 and 0.5")
        check_field(0.5 < self.highest < 1, "visibility.highest", "must lie between 0.5 and 1")
        check_field(self.max_range >= 0, "visibility.max_range", "must not be negative")


@dataclass(frozen=True)
class WavemapConfig:
    """Occupancy mapping by wavemap's measurement model (Reijgwart et al., RSS 2023).

    The defaults are those that its authors publish for an Ouster OS0.
    """

    angle_sigma_deg: float = 0.035
    """Standard deviation of a beam's direction (degrees)."""

    range_sigma: float = 0.0
    """Standard deviation of a range (metres). 0 means half a voxel, and 5 cm at least."""

    scaling_free: float = 0.2
    """How much of the model's evidence for free counts."""

    scaling_occupied: float = 0.4
    """How much of the model's evidence for occupied counts."""

    beams: Literal["neighbours", "nearest", "ray"] = "neighbours"
    """The beams that update a voxel: the four nearest to its centre, the nearest, or the nearest in full
    wherever it lies within six angle_sigma (wavemap's ContinuousRay)."""

    lowest: float = 0.1192
    """Lower bound on a voxel's probability: log-odds of -2."""

    highest: float = 0.98201
    """Upper bound on a voxel's probability: log-odds of 4."""

    max_range: float = 0.0
    """Voxels beyond this range (metres) are not updated. 0 means no limit."""

    def __post_init__(self) -> None:
        check_field(0 < self.angle_sigma_deg <= 5, "wavemap.angle_sigma_deg", "must lie between 0 and 5")
        check_field(self.range_sigma >= 0, "wavemap.range_sigma", "must not be negative")
        for name in ("scaling_free", "scaling_occupied"):
            check_field(0 < getattr(self, name) < 1, f"wavemap.{name}", "must lie between 0 and 1")
        check_field(0 < self.lowest < 0.5, "wavemap.lowest", "must lie between 0 and 0.5")
        check_field(0.5 < self.highest < 1, "wavemap.highest", "must lie between 0.5 and 1")
        check_field(self.max_range >= 0, "wavemap.max_range", "must not be negative")

    @property
    def angle_sigma(self) -> float:
        """``angle_sigma_deg`` in radians."""
        return math.radians(self.angle_sigma_deg)

    def range_sigma_at(self, voxel_size: float) -> float:
        """The standard deviation of a range for voxels of a size, both in metres."""
        return self.range_sigma or max(0.5 * voxel_size, LEAST_RANGE_SIGMA_M)
