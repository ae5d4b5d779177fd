"""The sections of parameters that belong to some mapping methods: time, inference on rays, and the baselines.

They are here and not in the methods' folders because the whole configuration (schema.py) holds them, and
inference/ and factor_graph/ read those on rays too.
"""

import math
from dataclasses import dataclass
from typing import Literal

from taichi_mrf.config.values import check_field, in_files, in_python

LIVE_HALF_LIFE_S = 14400.0
"""Default half-life of a live run, in which people and chairs move. Other commands map a static world."""


@dataclass(frozen=True)
class TimeConfig:
    """Rate at which the world may change. Each voxel is a two-state Markov chain in time: the older an
    observation, the less it counts."""

    half_life_s: float = 0.0
    """Seconds after which half of the knowledge of a voxel is stale. With 14400 (four hours), a few views are
    enough to show a change, whatever the map held before. 0 means a static world, as in surveys."""

    moving_share: float = in_files(1e-6)
    """Share of space that moving objects fill. The smaller it is, the more views it takes until a surface
    that was seen often counts as gone. Only mrf uses it."""

    glimpse_half_life_s: float = in_files(2.0)
    """Half-life in seconds of a single view that contradicts known free space, such as a view of a person
    walking past. Later views confirm or refute it. Only mrf uses it."""

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
        """State changes of a voxel per second, if both states are equally likely; 0 if static."""
        return 0.0 if self.is_static else math.log(2.0) / (2.0 * self.half_life_s)

    def forgotten(self, seconds: float) -> float:
        """The share of a voxel's state that is drawn anew within some seconds: 1 - exp(-2 flip_rate t)."""
        return -math.expm1(-2.0 * self.flip_rate * max(seconds, 0.0))


LEAST_FLOOR = 1e-6
"""The default of ``outlier_floor``, which holds for rays of any length."""


@dataclass(frozen=True)
class InferenceConfig:
    """Computation of the marginals (MRFMap, sections III and IV)."""

    sweeps: int = 3
    """Number of sweeps over all keyframes. Each keyframe uses the newest messages of the others (Gauss-
    Seidel)."""

    renew_tolerance: float = 0.35
    """Live mapping: sweep a keyframe again once others have changed more than this share of its marginals by
    over 0.01 each. Full inference ignores this."""

    surface_density: float = 2.1
    """Prior: expected number of surfaces per metre of ray. It means the same at every voxel size; 2.1 is the
    paper's probability of 0.1 at 5 cm."""

    prior: float | None = None
    """Prior probability that a voxel is occupied. Overrides ``surface_density``."""

    outlier_floor: float | None = None
    """Density of outliers per metre of depth, added to both likelihoods in every message. It keeps a single
    wrong pixel from overruling all others. By default 1e-6; 0.01 for recordings with short rays."""

    ray_density: float = 2.5
    """Minimum rays cast at a voxel facing the camera, per centimetre of voxel size: 12.5 rays at 5 cm, 2.5 at
    1 cm. Pixels beyond that share rays. 0 casts a ray for every pixel."""

    pass_through: float | None = None
    """Probability (below 1) that a ray passes through an occupied voxel, because objects fill only part of
    it. With 0, the paper's model, a few passing rays clear a voxel; with 0.1, thin objects such as posts and
    legs stay in the map. By default 0.1 for lidar recordings and 0 for others. factor_graph() uses 0."""

    free_share: float = 0.25
    """Lower bound on a voxel's cavity probability, as a share of its prior: a voxel that other keyframes see
    as free may still stop a ray."""

    @property
    def floor(self) -> float:
        """The density of outliers that is in force."""
        return LEAST_FLOOR if self.outlier_floor is None else self.outlier_floor

    def __post_init__(self) -> None:
        check_field(self.sweeps >= 0, "inference.sweeps", "must not be negative")
        check_field(self.renew_tolerance >= 0, "inference.renew_tolerance", "must not be negative")
        check_field(self.surface_density > 0, "inference.surface_density", "must be positive")
        check_field(self.prior is None or 0 < self.prior < 1, "inference.prior", "must lie between 0 and 1")
        check_field(self.floor >= 0, "inference.outlier_floor", "must not be negative")
        check_field(self.ray_density >= 0, "inference.ray_density", "must not be negative")
        share = self.pass_through or 0.0
        check_field(0 <= share < 1, "inference.pass_through", "must be at least 0 and less than 1")
        check_field(0 <= self.free_share <= 1, "inference.free_share", "must lie between 0 and 1")


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

    The defaults are their Table I but for ``visible_if_occluded``, which is 0.2 there.
    """

    hit_if_free: float = in_python(0.43)
    """P(H | V, not O): probability of a hit for a visible voxel that is free."""

    hit_if_occupied: float = in_python(0.55)
    """P(H | V, O): probability of a hit for a visible voxel that is occupied."""

    hit_if_hidden: float = in_python(0.05)
    """P(H | not V): probability of a hit for a voxel that is not visible."""

    visible_if_occluded: float = in_files(0.45)
    """P(V_i | C_i, V_i-1): probability that a locally occluded voxel behind a visible one is visible. From
    0.4 on (with q_max at 0.7) rays pass unknown voxels at once; with less, as with the paper's 0.2, the map
    grows by a few voxels a frame."""

    visible_if_clear: float = in_python(1.0)
    """P(V_i | not C_i, V_i-1): probability that an unoccluded voxel behind a visible one is visible."""

    q_min: float = in_python(0.1)
    """A ray ends where the probability of visibility falls below this."""

    q_max: float = in_python(0.7)
    """A probability of visibility of at least this counts as 1."""

    lowest: float = in_python(0.1192)
    """Lower bound on a voxel's probability (OctoMap's default)."""

    highest: float = in_python(0.971)
    """Upper bound on a voxel's probability (OctoMap's default)."""

    max_range: float = in_python(0.0)
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

    The defaults are its authors' for an Ouster OS0.
    """

    angle_sigma_deg: float = 0.035
    """Standard deviation of a beam's direction (degrees)."""

    range_sigma: float = 0.0
    """Standard deviation of a range (metres). 0 means half a voxel, but at least 5 cm."""

    scaling_free: float = 0.2
    """Factor on the model's evidence for free."""

    scaling_occupied: float = 0.4
    """Factor on the model's evidence for occupied."""

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
