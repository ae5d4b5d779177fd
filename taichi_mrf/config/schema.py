"""All parameters of mapping a sequence, and the sections that every mapping method shares.

YAML files, the command line and the sliders are made from these dataclasses: a field's docstring is its
help text, its default is the default, and its range is checked here. The section of a mapping method is
defined by its plug (registry.py). Nothing in this file needs Taichi, so that ``taichi-mrf --help`` answers at
once.
"""

import dataclasses
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import yaml

from taichi_mrf.config.arguments import real
from taichi_mrf.config.files import find_config, read_yaml
from taichi_mrf.config.registry import METHODS, MethodName
from taichi_mrf.config.values import check_field, from_dict

Arch = Literal["auto", "cuda", "vulkan", "cpu"]


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
class KeyframeConfig:
    """Which frames become keyframes (section V): those that have moved enough."""

    rotation: float = 0.0
    """A frame that is rotated by more than this (radians, tangent norm) becomes a keyframe; 0 means that
    rotation does not count."""

    translation: float = 0.0
    """A frame that is translated by more than this (metres) becomes a keyframe; 0 means that translation
    does not count. With both at 0 every frame is a keyframe."""

    against: Literal["last", "all"] = "last"
    """Compare with the last keyframe, as in the paper, or with all earlier ones, so that a place that is
    visited again adds nothing."""

    def __post_init__(self) -> None:
        check_field(self.rotation >= 0, "keyframes.rotation", "must not be negative")
        check_field(self.translation >= 0, "keyframes.translation", "must not be negative")


@dataclass(frozen=True)
class PoseConfig:
    """Poses that are slightly wrong, and how far depth may move them (method mrf)."""

    refine: bool = False
    """Align each new keyframe with those before it, and at the end all keyframes with each other. The first
    keyframe stays where it is."""

    rounds: int = 2
    """How often, at the end, every keyframe is aligned with all others."""

    translation_sigma: float = 0.03
    """How wrong recorded poses are along each axis (metres, standard deviation). What depth does not tell
    stays as it was recorded; what it tells badly is a compromise between the two."""

    rotation_sigma: float = 0.02
    """How wrong recorded poses are about each axis (radians, standard deviation)."""

    max_translation: float = 0.2
    """A keyframe that fits only further away than this (metres) is not moved."""

    max_rotation: float = 0.1
    """A keyframe that fits only when turned by more than this (radians) is not moved."""

    min_overlap: float = 0.3
    """A keyframe with less than this share of its points near what others have measured is not moved."""

    def __post_init__(self) -> None:
        check_field(self.rounds >= 0, "poses.rounds", "must not be negative")
        check_field(self.translation_sigma > 0, "poses.translation_sigma", "must be positive")
        check_field(self.rotation_sigma > 0, "poses.rotation_sigma", "must be positive")
        check_field(self.max_translation > 0, "poses.max_translation", "must be positive")
        check_field(0 < self.max_rotation <= math.pi, "poses.max_rotation", "must lie between 0 and pi")
        check_field(0 <= self.min_overlap <= 1, "poses.min_overlap", "must lie between 0 and 1")


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
class _Head:
    """What stands before the methods' sections in YAML and in help texts."""

    voxel_size: float = 0.05
    """Side of a voxel in metres."""

    method: MethodName = field(
        default=next(iter(METHODS)),
        metadata={
            "help": "Mapping method: " + "; ".join(f"{m.name} ({m.summary})" for m in METHODS.values())
        },
    )

    sensor: SensorConfig = field(default_factory=SensorConfig)
    """What is known of the sensor."""


@dataclass(frozen=True)
class _Tail:
    """What stands after them."""

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


if TYPE_CHECKING:
    _MethodSections: Any
else:
    _MethodSections = dataclasses.make_dataclass(
        "_MethodSections",
        [
            (
                m.section,
                m.section_class,
                field(default_factory=m.section_class, metadata={"help": m.section_help}),
            )
            for m in METHODS.values()
        ],
        frozen=True,
    )


@dataclass(frozen=True)
class Config(_Tail, _MethodSections, _Head):
    """All parameters of mapping a sequence: those that every method shares, and a section for each method.

    A dataclass takes its fields from its last base first, so YAML begins with the head. A type checker sees a
    method's section as Any, because methods are listed in plugs.py alone.
    """

    def __post_init__(self) -> None:
        ok = 0 < real(self.voxel_size, "voxel_size") < math.inf
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
