"""Every parameter of the program, defined once.

The YAML files, the command line and the sliders are all made from these dataclasses: a field's
docstring is its help text, its default is the default, and its range is checked here. Nothing in
this file needs Taichi, so that ``taichi-mrf --help`` answers at once.
"""

import dataclasses
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args, get_type_hints

import yaml

from taichi_mrf.config.files import find_config, read_yaml
from taichi_mrf.config.poses import KeyframeConfig, PoseConfig
from taichi_mrf.config.values import check_field, from_dict

Arch = Literal["auto", "cuda", "vulkan", "cpu"]
Method = Literal["mrf", "log_odds", "visibility"]


@dataclass(frozen=True)
class SensorConfig:
    """What is known of the sensor. Depths are axial depth in metres."""

    sigma: tuple[float, ...] = (0.001504, -0.00152, 0.0019)
    """Standard deviation of the measured depth in metres: coefficients of a polynomial in depth, in
    ascending powers. The default is the Kinect 1 (Nguyen, Izadi and Lovell 2012)."""

    bias: tuple[float, ...] = (0.0,)
    """Mean of measured minus true depth in metres: coefficients in ascending powers of the true depth."""

    sigma_table: str | None = None
    """A .npy file of shape (patches, degree + 1) with one sigma polynomial for each pixel patch, row by
    row. It takes the place of ``sigma``; a relative path starts at the YAML file's folder."""

    bias_table: str | None = None
    """The same for the bias."""

    patch: int = 20
    """Side of a square pixel patch of the tables, in pixels."""

    min_depth: float = 0.1
    """Measurements nearer than this (metres) are ignored."""

    max_depth: float = 10.0
    """Rays end here (metres); a measurement beyond says only that the space up to here is free."""

    def __post_init__(self) -> None:
        check_field(len(self.sigma) >= 1, "sensor.sigma", "needs at least one coefficient")
        check_field(all(map(math.isfinite, self.sigma)), "sensor.sigma", "holds a value that is not finite")
        check_field(len(self.bias) >= 1, "sensor.bias", "needs at least one coefficient")
        check_field(all(map(math.isfinite, self.bias)), "sensor.bias", "holds a value that is not finite")
        check_field(self.patch >= 1, "sensor.patch", "must be at least 1 pixel")
        check_field(self.min_depth >= 0, "sensor.min_depth", "must not be negative")
        check_field(self.max_depth > self.min_depth, "sensor.max_depth", "must be more than sensor.min_depth")


@dataclass(frozen=True)
class InferenceConfig:
    """How the marginals are computed (MRFMap, sections III and IV)."""

    method: Literal["sum-product", "max-product"] = "sum-product"
    """sum-product gives each voxel's marginal probability; max-product asks, for either state of a voxel, how
    well the best explanation of all measurements does, and its odds are those of the two."""

    sweeps: int = 3
    """Gauss-Seidel sweeps over all keyframes."""

    tolerance: float = 0.0
    """Stop before the last sweep when no more than this share of the voxels moved by over 0.01."""

    renew_tolerance: float = 0.35
    """While frames come, a keyframe is swept again once others have moved more than this share of the
    marginals that it sees by over 0.01 each. It does not touch full inference."""

    damping: float = 0.0
    """Share of a keyframe's old message that is kept when it is renewed, 0 to below 1."""

    surface_density: float = 2.1
    """Prior: surfaces met per metre of ray, so that it means the same at every voxel size
    (2.1 is the paper's probability of 0.1 at 5 cm)."""

    prior: float | None = None
    """Prior probability of occupied for each voxel; takes the place of ``surface_density``."""

    likelihood: Literal["auto", "segment", "centre"] = "auto"
    """Likelihood of the measurement given a surface in a voxel: averaged over the segment of the ray in
    it, taken at the segment's centre, or (auto) averaged where sigma is less than the voxel size."""

    outlier_floor: float = 1e-6
    """Added to both sides of every message (per metre of depth): the share of measurements that no
    surface explains, so that one wild pixel cannot veto all the others."""

    end_sigmas: float = 3.0
    """A ray ends this many sigma beyond its measurement, and bricks exist this many around it."""

    segment_lengths: bool = True
    """Weigh a voxel by the length that the ray spends in it (section IV-A). Without it every voxel
    counts once, as eqs. 11 to 14 are printed."""

    ray_density: float = 2.5
    """Rays that a keyframe casts at least at a voxel that faces it, for each centimetre of the voxel's side:
    12.5 at 5 cm, 2.5 at 1 cm. Where a voxel covers more pixels, not each has a ray of its own. 0 casts
    every pixel."""

    ray_choice: Literal["bundle", "thin"] = "bundle"
    """How pixels go without a ray: bundled with neighbours whose measurements agree, as one ray with their
    mean that counts as many as they are, or (thin) left out but for every second, third, ... of them."""

    average: Literal["probability", "log_odds"] = "log_odds"
    """What is averaged, weighted by length, over a keyframe's rays through a voxel."""

    min_length: float = 0.02
    """A voxel that a keyframe's rays cross for less than this many voxel sizes in sum keeps its old
    message."""

    message_clamp: float = 6.9
    """Largest log-odds of a keyframe's message to a voxel (6.9 is a probability of 0.999)."""

    cavity_clamp: float = 9.2
    """Largest log-odds of a voxel as a keyframe's rays see it, without that keyframe's own message."""

    free_share: float = 0.25
    """A voxel is never more surely free, as a keyframe's rays see it, than this share of its prior: what
    others hold to be free may still stop a ray now and then. 0 leaves only the clamp."""

    message_precision: Literal["float16", "float32"] = "float16"
    """How messages are stored. float16 halves the memory and moves beliefs by at most 0.006."""

    def __post_init__(self) -> None:
        for name in ("method", "likelihood", "ray_choice", "average", "message_precision"):
            choices = get_args(get_type_hints(type(self))[name])
            check_field(
                getattr(self, name) in choices, f"inference.{name}", f"must be one of {', '.join(choices)}"
            )
        check_field(self.sweeps >= 0, "inference.sweeps", "must not be negative")
        check_field(0 <= self.tolerance <= 1, "inference.tolerance", "must lie between 0 and 1")
        check_field(self.renew_tolerance >= 0, "inference.renew_tolerance", "must not be negative")
        check_field(0 <= self.damping < 1, "inference.damping", "must be at least 0 and less than 1")
        check_field(self.surface_density > 0, "inference.surface_density", "must be positive")
        check_field(self.prior is None or 0 < self.prior < 1, "inference.prior", "must lie between 0 and 1")
        check_field(self.outlier_floor >= 0, "inference.outlier_floor", "must not be negative")
        check_field(self.end_sigmas > 0, "inference.end_sigmas", "must be positive")
        check_field(self.ray_density >= 0, "inference.ray_density", "must not be negative")
        check_field(self.min_length >= 0, "inference.min_length", "must not be negative")
        check_field(0 < self.message_clamp <= 30, "inference.message_clamp", "must lie between 0 and 30")
        check_field(0 < self.cavity_clamp <= 60, "inference.cavity_clamp", "must lie between 0 and 60")
        check_field(0 <= self.free_share <= 1, "inference.free_share", "must lie between 0 and 1")


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


@dataclass(frozen=True)
class VisibilityConfig:
    """Visibility-aware occupancy mapping (Schauwecker & Zell, IROS 2014); defaults are their Table I."""

    hit_if_free: float = 0.43
    """P(H | V, not O): probability of a hit for a visible voxel that is free."""

    hit_if_occupied: float = 0.55
    """P(H | V, O): probability of a hit for a visible voxel that is occupied."""

    hit_if_hidden: float = 0.05
    """P(H | not V): probability of a hit for a voxel that cannot be seen."""

    visible_if_occluded: float = 0.2
    """P(V_i | C_i, V_i-1): probability that a locally occluded voxel behind a visible one is visible."""

    visible_if_clear: float = 1.0
    """P(V_i | not C_i, V_i-1): the same for one that is not locally occluded."""

    q_min: float = 0.1
    """A ray ends where the probability of being visible falls below this."""

    q_max: float = 0.7
    """A probability of being visible from here on counts as 1."""

    lowest: float = 0.1192
    """A voxel's probability never falls below this (OctoMap's default)."""

    highest: float = 0.971
    """A voxel's probability never rises above this (OctoMap's default)."""

    max_range: float = 0.0
    """A ray is cut off at this range (metres) and its end then counts as free; 0 means no limit."""

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
class VolumeConfig:
    """Where the map may be, and when it counts as known."""

    lower: tuple[float, float, float] | None = None
    """Lowest corner of the mapped box in metres (world frame); no box means an unbounded map."""

    upper: tuple[float, float, float] | None = None
    """Highest corner of the mapped box in metres."""

    dense_bricks: int = 256
    """Vulkan only, which has no sparse fields: bricks along each side of the volume, around the first
    keyframe. 256 at 2 cm are 41 m and take 128 MB."""

    memory_limit_gb: float = 0.0
    """Most memory for the map in GB: its voxels, images and messages; 0 means what the machine has free."""

    min_evidence: float = 0.1
    """A voxel whose log-odds lie nearer than this to the prior counts as unknown."""

    def __post_init__(self) -> None:
        check_field((self.lower is None) == (self.upper is None), "volume.lower", "goes with volume.upper")
        if self.lower is not None and self.upper is not None:
            ok = all(a < b for a, b in zip(self.lower, self.upper, strict=True))
            check_field(ok, "volume.upper", "must lie above volume.lower on every axis")
        check_field(8 <= self.dense_bricks <= 1024, "volume.dense_bricks", "must lie between 8 and 1024")
        check_field(self.memory_limit_gb >= 0, "volume.memory_limit_gb", "must not be negative")
        check_field(self.min_evidence >= 0, "volume.min_evidence", "must not be negative")


@dataclass(frozen=True)
class EvaluationConfig:
    """How a finished map is checked against frames that were kept out of it."""

    hold_out: int = 10
    """One frame in so many is kept out of the map; its depth is compared afterwards with the depth that
    the map predicts. 0 maps all frames and checks nothing."""

    def __post_init__(self) -> None:
        ok = self.hold_out == 0 or self.hold_out >= 2
        check_field(ok, "evaluation.hold_out", "must be 0, or at least 2 so that frames are left to map")


@dataclass(frozen=True)
class RuntimeConfig:
    """Where the kernels run."""

    arch: Arch = "auto"
    """Backend: cuda, vulkan, cpu, or auto for the first of these that there is."""

    threads: int = 0
    """CPU threads; 0 means all cores."""

    debug: bool = False
    """Let Taichi check array bounds (slow)."""

    def __post_init__(self) -> None:
        check_field(self.threads >= 0, "runtime.threads", "must not be negative")


@dataclass(frozen=True)
class Config:
    """All parameters of mapping a sequence."""

    voxel_size: float = 0.05
    """Side of a voxel in metres."""

    method: Method = "mrf"
    """How a map is made: mrf is MRFMap, log_odds OctoMap's way, visibility Schauwecker & Zell's."""

    sensor: SensorConfig = field(default_factory=SensorConfig)
    """What is known of the sensor."""

    inference: InferenceConfig = field(default_factory=InferenceConfig)
    """How the marginals are computed."""

    log_odds: LogOddsConfig = field(default_factory=LogOddsConfig)
    """Occupancy mapping by independent log-odds (method log_odds)."""

    visibility: VisibilityConfig = field(default_factory=VisibilityConfig)
    """Visibility-aware occupancy mapping (method visibility)."""

    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    """Which frames become keyframes."""

    poses: PoseConfig = field(default_factory=PoseConfig)
    """Whether depth may move keyframes whose poses are slightly wrong."""

    volume: VolumeConfig = field(default_factory=VolumeConfig)
    """Where the map may be."""

    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    """How a finished map is checked."""

    runtime: RuntimeConfig = field(default_factory=RuntimeConfig)
    """Where the kernels run."""

    def __post_init__(self) -> None:
        ok = math.isfinite(self.voxel_size) and self.voxel_size > 0
        check_field(ok, "voxel_size", f"must be a positive number of metres, not {self.voxel_size}")


def load(path: str | Path) -> Config:
    """Read a YAML file, or the shipped one of that name, such as ``kinect1``. Table paths in it are relative
    to its folder. Raises ConfigError, which names the file and the parameter."""
    path = find_config(path)
    return with_absolute_tables(from_dict(Config, read_yaml(path), str(path)), path.parent)


def with_absolute_tables(config: Config, folder: Path) -> Config:
    """The same configuration with the paths of noise tables, if relative, taken from ``folder``."""
    tables: dict[str, Any] = {
        name: str((folder / table).resolve())
        for name in ("sigma_table", "bias_table")
        if (table := getattr(config.sensor, name)) is not None
    }
    return dataclasses.replace(config, sensor=dataclasses.replace(config.sensor, **tables))


def to_yaml(config: Config) -> str:
    """The effective configuration as YAML text that :func:`load` accepts unchanged."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: plain(v) for k, v in value.items()}
        return [plain(v) for v in value] if isinstance(value, tuple) else value

    return yaml.safe_dump(plain(dataclasses.asdict(config)), sort_keys=False)
