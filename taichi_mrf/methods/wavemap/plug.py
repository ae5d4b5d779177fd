"""The entry of the method wavemap, with its parameters. No Taichi here: this is imported for a --help."""

import math
from dataclasses import dataclass
from typing import Literal

from taichi_mrf.config.method import Method
from taichi_mrf.config.sliders import Range, Slider
from taichi_mrf.config.values import check_field

LEAST_RANGE_SIGMA_M = 0.05
"""The noise of an Ouster OS0 (metres), below which the range's sigma is not set by the voxel size."""

REACH_SIGMAS = 6.0
"""Nothing is concluded further off a beam's axis, or further behind its measurement, in sigmas."""


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


METHOD = Method(
    name="wavemap",
    summary="wavemap's measurement model, by Reijgwart and others",
    title="wavemap's model",
    section="wavemap",
    section_class=WavemapConfig,
    section_help="Occupancy mapping by wavemap's measurement model (method wavemap).",
    map_class="taichi_mrf.methods.wavemap.map:WavemapMap",
    sliders=(
        Slider("angle_sigma_deg", Range(0.01, 0.5, 0.005)),
        Slider("range_sigma", Range(0.0, 0.5, 0.01)),
        Slider("scaling_free", Range(0.05, 0.95, 0.05)),
        Slider("scaling_occupied", Range(0.05, 0.95, 0.05)),
        Slider("beams"),
    ),
    prior_is_unknown=True,
    if_empty="raise wavemap.angle_sigma_deg if voxels are smaller than the beams are apart",
)
