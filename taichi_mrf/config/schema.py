"""All parameters of mapping a sequence, and the sections that every mapping method shares.

YAML files, the command line and the sliders are made from these dataclasses: a field's docstring is its help
text, its default is the default, and its range is checked here. values.py says which fields files and flags
can set. Nothing in this file needs Taichi, so that ``taichi-mrf --help`` answers at once.
"""

import dataclasses
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml

from taichi_mrf.config.arguments import real
from taichi_mrf.config.files import find_config, read_yaml
from taichi_mrf.config.registry import METHODS, MethodName, methods_with
from taichi_mrf.config.sections import (
    InferenceConfig,
    LogOddsConfig,
    TimeConfig,
    VisibilityConfig,
    WavemapConfig,
)
from taichi_mrf.config.values import (
    IN_FILES,
    IN_PYTHON,
    check_field,
    check_files_set_it,
    from_dict,
    in_files,
    in_python,
)

Arch = Literal["auto", "cuda", "vulkan", "cpu"]

_LARGEST_VOXEL_M = 1000.0


@dataclass(frozen=True)
class SensorConfig:
    """The sensor's noise and range. Depths are axial depth in metres."""

    sigma: tuple[float, ...] = (0.001504, -0.00152, 0.0019)
    """Standard deviation of the measured depth in metres: coefficients of a polynomial in depth, in
    ascending powers. The default is the Kinect 1 (Nguyen, Izadi and Lovell 2012)."""

    bias: tuple[float, ...] = (0.0,)
    """Mean of measured minus true depth in metres: coefficients in ascending powers of the true depth."""

    sigma_table: str | None = in_files(None)
    """A .npy file (patches, degree + 1) with a sigma polynomial for each pixel patch, row by row, or the .npz
    of a noise model. Overrides ``sigma``. A relative path starts at the YAML file's folder."""

    bias_table: str | None = in_files(None)
    """A .npy file of the same shape with a bias polynomial for each pixel patch. Overrides ``bias``."""

    patch: int = in_files(20)
    """Side of the tables' square pixel patches, in pixels."""

    pixel_sigma: bool = True
    """Use each pixel's own standard deviation if frames have one, as those of stereo cameras do. If off,
    ``sigma`` or its table applies to all pixels."""

    sigma_scale: float = in_files(1.0)
    """Factor on every standard deviation of ``sigma``, its table or frames. ``map --noise auto`` learns it
    and ``sigma_added`` from a recording."""

    sigma_added: float = in_files(0.0)
    """Metres added to every scaled standard deviation: the error of poses and voxels, at all depths."""

    min_depth: float = 0.1
    """Ignore measurements nearer than this (metres)."""

    max_depth: float = 10.0
    """Rays end at this depth (metres). A measurement beyond it only marks the space up to it as free."""

    no_return: Literal["ignore", "free", "model"] = "ignore"
    """Use of the pixels that frames mark as having no return. ``free``: space is free up to
    ``no_return_depth``. ``model`` (mrf only): each surface on the ray may have failed to return the signal,
    with a probability set by ``no_return_share``, ``no_return_depth`` and ``no_return_width``."""

    no_return_share: float = in_files(0.3)
    """Probability that a near surface gives no return, as dark, wet and shiny ones do; below 0.5."""

    no_return_depth: float = 10.0
    """Depth in metres. With ``free``, a pixel without a return marks the space up to this depth as free; with
    ``model``, half of the surfaces that give a return when near give none at this depth."""

    no_return_width: float = in_files(2.0)
    """Metres over which the half that still gives a return falls: to 27% one width further, to 12% two."""

    def __post_init__(self) -> None:
        check_field(0 <= self.no_return_share < 0.5, "sensor.no_return_share", "must lie in [0, 0.5)")
        check_field(self.no_return_depth > 0, "sensor.no_return_depth", "must be positive")
        check_field(self.no_return_width > 0, "sensor.no_return_width", "must be positive")
        check_field(len(self.sigma) >= 1, "sensor.sigma", "needs at least one coefficient")
        check_field(all(map(math.isfinite, self.sigma)), "sensor.sigma", "holds a value that is not finite")
        check_field(len(self.bias) >= 1, "sensor.bias", "needs at least one coefficient")
        check_field(all(map(math.isfinite, self.bias)), "sensor.bias", "holds a value that is not finite")
        scale_ok = 0 < self.sigma_scale < math.inf
        check_field(scale_ok, "sensor.sigma_scale", "must be positive and finite")
        check_field(0 <= self.sigma_added < math.inf, "sensor.sigma_added", "must be 0 or a number of metres")
        check_field(self.patch >= 1, "sensor.patch", "must be at least 1 pixel")
        check_field(self.min_depth >= 0, "sensor.min_depth", "must not be negative")
        check_field(self.max_depth > self.min_depth, "sensor.max_depth", "must be more than sensor.min_depth")


@dataclass(frozen=True)
class KeyframeConfig:
    """Choice of keyframes (section V): frames taken far enough from the last one."""

    rotation: float = 0.0
    """A frame rotated by more than this (radians, tangent norm) becomes a keyframe. 0 ignores rotation."""

    translation: float = 0.0
    """A frame translated by more than this (metres) becomes a keyframe. 0 ignores translation. If rotation
    and translation are both 0, every frame becomes a keyframe."""

    def __post_init__(self) -> None:
        check_field(self.rotation >= 0, "keyframes.rotation", "must not be negative")
        check_field(self.translation >= 0, "keyframes.translation", "must not be negative")


@dataclass(frozen=True)
class PoseConfig:
    """Refinement of recorded poses by aligning depth images (methods that can align keyframes: mrf)."""

    refine: bool = in_files(False)
    """Align each new keyframe with the earlier ones, and at the end all keyframes with each other. The first
    keyframe keeps its pose."""

    close_loops: bool = in_files(True)
    """For tracked poses: correct the whole trajectory when the camera returns to a place that it has seen
    (loop closure), and align all keyframes with each other at the end."""

    translation_sigma: float = in_files(0.03)
    """Standard deviation of recorded positions along each axis (metres). It weights recorded poses against
    depth; directions that depth does not determine keep the recorded value."""

    rotation_sigma: float = in_files(0.02)
    """Standard deviation of recorded orientations about each axis (radians)."""

    max_translation: float = in_python(0.2)
    """Do not move a keyframe further than this (metres)."""

    max_rotation: float = in_python(0.1)
    """Do not rotate a keyframe by more than this (radians)."""

    min_overlap: float = in_python(0.3)
    """Do not move a keyframe if less than this share of its points lies near surfaces that other keyframes
    measured."""

    doubt_translation: float = 0.0
    """Standard deviation of each keyframe's position along each axis, relative to keyframes that see the same
    surfaces (metres). Rays count less where such an error would change which surface they hit. 0 treats
    positions as exact."""

    doubt_rotation: float = 0.0
    """Standard deviation of each keyframe's orientation about each axis (radians). 0 treats orientations as
    exact."""

    def __post_init__(self) -> None:
        check_field(self.translation_sigma > 0, "poses.translation_sigma", "must be positive")
        check_field(self.rotation_sigma > 0, "poses.rotation_sigma", "must be positive")
        check_field(self.max_translation > 0, "poses.max_translation", "must be positive")
        check_field(0 < self.max_rotation <= math.pi, "poses.max_rotation", "must lie between 0 and pi")
        check_field(0 <= self.min_overlap <= 1, "poses.min_overlap", "must lie between 0 and 1")
        for name in ("doubt_translation", "doubt_rotation"):
            sigma = getattr(self, name)
            check_field(0 <= sigma < math.inf, f"poses.{name}", "must be finite and not negative")


@dataclass(frozen=True)
class VolumeConfig:
    """The space that the map may cover, its memory, and when a voxel counts as known."""

    lower: tuple[float, float, float] | None = None
    """Lowest corner of the mapped box in metres (world frame). Without a box the map is unbounded."""

    upper: tuple[float, float, float] | None = None
    """Highest corner of the mapped box in metres."""

    dense_bricks: int = in_python(256)
    """Vulkan only, because it has no sparse fields: bricks along each side of the volume around the first
    keyframe. 256 bricks at 2 cm cover 41 m and need 128 MB."""

    memory_limit_gb: float = 0.0
    """Memory limit of the map in GB (voxels, images and messages). 0 means the free memory of the machine."""

    window_m: float = 0.0
    """Keep in memory only the map within this distance of the newest keyframe's camera (metres). The rest is
    frozen, written to disk, and read again when the camera returns, so that an endless run needs bounded
    memory (methods that can freeze keyframes: mrf). 0 keeps the whole map in memory."""

    min_evidence: float = in_python(0.1)
    """A voxel counts as unknown if its log-odds differ from the prior by less than this."""

    origin: tuple[float, float, float] = in_files((0.0, 0.0, 0.0))
    """The map's origin in the recorded world (metres); far from 0 in a national grid. The recording sets it.
    Exported files have the recorded world's coordinates, if their format can store them."""

    def __post_init__(self) -> None:
        check_field((self.lower is None) == (self.upper is None), "volume.lower", "goes with volume.upper")
        if self.lower is not None and self.upper is not None:
            ok = all(a < b for a, b in zip(self.lower, self.upper, strict=True))
            check_field(ok, "volume.upper", "must lie above volume.lower on every axis")
        check_field(8 <= self.dense_bricks <= 1024, "volume.dense_bricks", "must lie between 8 and 1024")
        check_field(0 <= self.memory_limit_gb < math.inf, "volume.memory_limit_gb", "must be 0 or more GB")
        check_field(0 <= self.window_m < math.inf, "volume.window_m", "must be 0 or a number of metres")
        check_field(self.min_evidence >= 0, "volume.min_evidence", "must not be negative")


@dataclass(frozen=True)
class EvaluationConfig:
    """Check of a finished map against frames that it was not built from."""

    hold_out: int = 10
    """Keep every N-th frame out of the map and compare its depth with the map's prediction. 0 maps all frames
    and checks nothing."""

    def __post_init__(self) -> None:
        ok = self.hold_out == 0 or self.hold_out >= 2
        check_field(ok, "evaluation.hold_out", "must be 0, or at least 2 so that frames are left to map")


@dataclass(frozen=True)
class RuntimeConfig:
    """The device that runs the kernels."""

    arch: Arch = "auto"
    """Backend: cuda, vulkan, cpu, or auto for the first of these that is available."""

    threads: int = 0
    """CPU threads, at most one for each core. 0 means all cores."""

    def __post_init__(self) -> None:
        check_field(self.threads >= 0, "runtime.threads", "must not be negative")


@dataclass(frozen=True)
class Config:
    """All parameters of mapping a sequence: those that every method shares, and a section for each method."""

    voxel_size: float = 0.05
    """Side of a voxel, in metres or as 5cm. By default 5 cm, or what the depths require."""

    method: MethodName = field(
        default=next(iter(METHODS)),
        metadata={
            "help": "Mapping method: " + "; ".join(f"{m.name} ({m.summary})" for m in METHODS.values())
        },
    )

    sensor: SensorConfig = field(default_factory=SensorConfig)
    """The sensor's noise and range."""

    inference: InferenceConfig = field(default_factory=InferenceConfig)
    """Computation of the marginals."""

    log_odds: LogOddsConfig = field(default_factory=LogOddsConfig, metadata=IN_FILES)
    """Occupancy mapping by independent log-odds (method log_odds)."""

    visibility: VisibilityConfig = field(default_factory=VisibilityConfig, metadata=IN_FILES)
    """Visibility-aware occupancy mapping (method visibility)."""

    wavemap: WavemapConfig = field(default_factory=WavemapConfig, metadata=IN_PYTHON)
    """Occupancy mapping by wavemap's measurement model (method wavemap)."""

    color: bool = False
    """Read the recording's colour images too, and colour voxels and surfaces by the pixels that see them
    (methods whose maps have colours: mrf)."""

    keep_surface: bool = False
    """Keep the measured surface in each voxel when the images of keyframes are dropped by freezing or in
    submaps (methods that freeze keyframes: mrf)."""

    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    """Choice of keyframes."""

    poses: PoseConfig = field(default_factory=PoseConfig)
    """Refinement of recorded poses."""

    time: TimeConfig = field(default_factory=TimeConfig)
    """Rate at which the world may change."""

    volume: VolumeConfig = field(default_factory=VolumeConfig)
    """The space and memory of the map."""

    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    """Check of a finished map."""

    runtime: RuntimeConfig = field(default_factory=RuntimeConfig)
    """The device that runs the kernels."""

    fit_voxel_size: bool = in_python(False)
    """Choose another voxel size if 5 cm fits neither the recording's depths nor its noise. Commands set it
    if no size is given."""

    def __post_init__(self) -> None:
        ok = 0 < real(self.voxel_size, "voxel_size") < math.inf
        check_field(ok, "voxel_size", f"must be a positive number of metres, not {self.voxel_size}")
        small = self.voxel_size <= _LARGEST_VOXEL_M  # coordinates of voxels are float32 in many formats
        most = f"must be at most {_LARGEST_VOXEL_M:g} metres, not {self.voxel_size:g}"
        check_field(small, "voxel_size", most)
        freezes = self.volume.window_m == 0 or METHODS[self.method].can_freeze
        needed = f"needs the method {methods_with('can_freeze')}, not {self.method}"
        check_field(freezes, "volume.window_m", needed)
        colored = not self.color or METHODS[self.method].has_colors
        check_field(colored, "color", f"needs the method {methods_with('has_colors')}, not {self.method}")
        kept = not self.keep_surface or METHODS[self.method].can_freeze
        check_field(kept, "keep_surface", needed)


def without_window(config: Config) -> Config:
    """Copy of the parameters without a window: the whole map is in memory."""
    return dataclasses.replace(config, volume=dataclasses.replace(config.volume, window_m=0.0))


def load(path: str | Path) -> Config:
    """Read a YAML file, or the shipped one of that name, such as ``kinect1``. Table paths in it are relative
    to its folder. Raises ConfigError, which names the file and the parameter."""
    path = find_config(path)
    config = from_dict(Config, read_yaml(path), str(path))
    check_files_set_it(config, str(path))
    return with_absolute_tables(config, path.parent)


def with_absolute_tables(config: Config, folder: Path) -> Config:
    """Copy of the configuration whose relative paths of noise tables are taken from ``folder``."""
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
