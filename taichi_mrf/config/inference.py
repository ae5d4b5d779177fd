"""The parameters of inference on rays (method mrf). They are here and not in the method's folder because
inference/ and factor_graph/ read them too."""

from dataclasses import dataclass
from typing import Literal, get_args, get_type_hints

from taichi_mrf.config.values import check_field

LEAST_FLOOR = 1e-6
"""The default of ``outlier_floor``, which holds for rays of any length."""


@dataclass(frozen=True)
class InferenceConfig:
    """How the marginals are computed (MRFMap, sections III and IV)."""

    method: Literal["sum-product", "max-product"] = "sum-product"
    """sum-product computes each voxel's marginal probability. max-product compares the best explanation of
    all measurements with the voxel occupied to the best one with it free."""

    sweeps: int = 3
    """Number of sweeps over all keyframes. Each keyframe uses the newest messages of the others (Gauss-
    Seidel)."""

    tolerance: float = 0.0
    """Stop early once at most this share of the voxels changed its probability by more than 0.01 in a
    sweep."""

    renew_tolerance: float = 0.35
    """Live mapping: sweep a keyframe again once other keyframes have changed more than this share of the
    marginals that it sees by more than 0.01 each. Full inference ignores this."""

    damping: float = 0.0
    """Share of the old message in a keyframe's new message, at least 0 and less than 1."""

    surface_density: float = 2.1
    """Prior: expected number of surfaces per metre of ray. It means the same at every voxel size; 2.1 is the
    paper's probability of 0.1 at 5 cm."""

    prior: float | None = None
    """Prior probability that a voxel is occupied. Overrides ``surface_density``."""

    likelihood: Literal["auto", "segment", "centre"] = "auto"
    """Likelihood of a measurement given a surface in a voxel: the average over the ray's segment in the
    voxel, the value at the segment's centre, or (auto) the average where sigma is less than the voxel
    size."""

    outlier_floor: float | None = None
    """Density of outliers per metre of depth, added to both sides of every message. It keeps a single wrong
    pixel from overruling all others. By default 1e-6; 0.01 where a recording's rays are short."""

    tail_share: float = 0.0
    """Share of the measurements whose error is ``tail_sigmas`` times as wide: poses that are off, mixed
    pixels and errors that neighbours share, which no sigma of the sensor holds. 0 takes errors as normal."""

    tail_sigmas: float = 10.0
    """How many times as wide the errors of ``tail_share`` are."""

    end_sigmas: float = 3.0
    """A ray ends this many sigma behind its measurement. Bricks are allocated this many sigma around it."""

    segment_lengths: bool = True
    """Weight a voxel by the length of the ray's segment in it (section IV-A). If off, every voxel on a ray
    has the weight 1, as eqs. 11 to 14 are printed."""

    ray_density: float = 2.5
    """Minimum rays cast at a voxel facing the camera, per centimetre of voxel size: 12.5 rays at 5 cm, 2.5 at
    1 cm. Pixels beyond that share rays. 0 casts a ray for every pixel."""

    plane_window: float = 0.0
    """Half the side, in voxel sizes, of the window of pixels around each measurement that are averaged along
    the plane through them, 8 pixels at most; sigma falls with what averages out, to half at most. Only where
    sigma is above the voxel size. 2 is a good value for voxels much smaller than sigma. 0 leaves measurements
    as they are."""

    pass_through: float | None = None
    """Chance that a ray passes through an occupied voxel, below 1, because what is in it fills only a part.
    With 0, the paper's model, a few rays that pass clear a voxel; with 0.1 thin things such as posts and legs
    stay in the map. By default 0.1 for a lidar's recording and 0 for all others. max-product and
    factor_graph() take it as 0."""

    ray_choice: Literal["bundle", "thin"] = "bundle"
    """How pixels share rays: bundle casts one ray with the mean depth of neighbouring pixels that agree, with
    their number as its weight; thin casts only every second, third, ... pixel."""

    first_sweep_stride: int = 1
    """Follow one in so many neighbouring rays in a keyframe's first sweep, and all in later ones. 4 is a good
    value where keyframes are swept again, as ``renew_tolerance`` and ``sweeps`` have it. 1 follows all."""

    free_space_stride: int = 1
    """Follow one in so many neighbouring rays through the free space far before its measurement, where it
    counts for the others too. 1 follows all."""

    average: Literal["probability", "log_odds"] = "log_odds"
    """What a keyframe's message averages over its rays through a voxel, weighted by length."""

    ray_correlation: float = 1.0
    """Correlation of the errors of two rays of one image, 0 to 1. A keyframe's message to a voxel counts as
    that of n / (1 + ray_correlation (n - 1)) average rays, n being its rays through the voxel: once at 1, as
    in the paper; up to twice at 0.5."""

    min_length: float = 0.02
    """A voxel keeps its old message if a keyframe's rays cross it for less than this length in total, in
    voxel sizes."""

    message_clamp: float = 6.9
    """Bound on the log-odds of a keyframe's message to a voxel (6.9 is a probability of 0.999)."""

    cavity_clamp: float = 9.2
    """Bound on the log-odds of the cavity belief: a voxel's belief minus the keyframe's own message."""

    free_share: float = 0.25
    """Lower bound on a voxel's cavity probability, as a share of its prior: a voxel that other keyframes see
    as free may still stop a ray. 0 leaves only ``cavity_clamp``."""

    doubt_free: float = 0.01
    """Lower bound on a voxel's probability where measurements are predicted, as a share of its prior: poses
    and noise are never quite right. By default 0.02 surfaces per metre; 0 trusts the marginals."""

    doubt_occupied: float = 0.01
    """Chance, below 0.5, that a predicted ray passes a voxel that was seen to be occupied, however often. 0
    trusts the marginals."""

    return_pass: Literal["replay", "retrace"] = "replay"
    """How a ray's messages are found on the way back to the camera: from a trace of its way out (replay), or
    by following it a second time (retrace), which takes less memory and is slower on a CPU. max-product
    always replays."""

    message_precision: Literal["float16", "float32"] = "float16"
    """Storage of messages. float16 halves their memory and changes beliefs by at most 0.006."""

    @property
    def floor(self) -> float:
        """The density of outliers that is in force."""
        return LEAST_FLOOR if self.outlier_floor is None else self.outlier_floor

    def __post_init__(self) -> None:
        for name in ("method", "likelihood", "ray_choice", "average", "return_pass", "message_precision"):
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
        check_field(self.floor >= 0, "inference.outlier_floor", "must not be negative")
        check_field(0 <= self.tail_share < 1, "inference.tail_share", "must be at least 0 and less than 1")
        check_field(self.tail_sigmas >= 2, "inference.tail_sigmas", "must be at least 2")
        check_field(self.end_sigmas > 0, "inference.end_sigmas", "must be positive")
        check_field(self.ray_density >= 0, "inference.ray_density", "must not be negative")
        check_field(self.plane_window >= 0, "inference.plane_window", "must not be negative")
        for name in ("first_sweep_stride", "free_space_stride"):
            check_field(1 <= getattr(self, name) <= 1024, f"inference.{name}", "must lie between 1 and 1024")
        share = self.pass_through or 0.0
        check_field(0 <= share < 1, "inference.pass_through", "must be at least 0 and less than 1")
        check_field(0 <= self.ray_correlation <= 1, "inference.ray_correlation", "must lie between 0 and 1")
        check_field(self.min_length >= 0, "inference.min_length", "must not be negative")
        check_field(0 < self.message_clamp <= 30, "inference.message_clamp", "must lie between 0 and 30")
        check_field(0 < self.cavity_clamp <= 60, "inference.cavity_clamp", "must lie between 0 and 60")
        check_field(0 <= self.free_share <= 1, "inference.free_share", "must lie between 0 and 1")
        check_field(0 <= self.doubt_free <= 1, "inference.doubt_free", "must lie between 0 and 1")
        check_field(
            0 <= self.doubt_occupied < 0.5, "inference.doubt_occupied", "must be at least 0 and below 0.5"
        )
