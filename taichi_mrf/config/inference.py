"""The parameters of inference on rays (method mrf). They stand here, not in the method's folder, because
inference/ and factor_graph/ read them too."""

from dataclasses import dataclass
from typing import Literal, get_args, get_type_hints

from taichi_mrf.config.values import check_field


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
