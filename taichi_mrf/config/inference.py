"""The parameters of inference on rays (method mrf). They are here and not in the method's folder because
inference/ and factor_graph/ read them too."""

from dataclasses import dataclass

from taichi_mrf.config.values import check_field

LEAST_FLOOR = 1e-6
"""The default of ``outlier_floor``, which holds for rays of any length."""


@dataclass(frozen=True)
class InferenceConfig:
    """How the marginals are computed (MRFMap, sections III and IV)."""

    sweeps: int = 3
    """Number of sweeps over all keyframes. Each keyframe uses the newest messages of the others (Gauss-
    Seidel)."""

    renew_tolerance: float = 0.35
    """Live mapping: sweep a keyframe again once other keyframes have changed more than this share of the
    marginals that it sees by more than 0.01 each. Full inference ignores this."""

    surface_density: float = 2.1
    """Prior: expected number of surfaces per metre of ray. It means the same at every voxel size; 2.1 is the
    paper's probability of 0.1 at 5 cm."""

    prior: float | None = None
    """Prior probability that a voxel is occupied. Overrides ``surface_density``."""

    outlier_floor: float | None = None
    """Density of outliers per metre of depth, added to both sides of every message. It keeps a single wrong
    pixel from overruling all others. By default 1e-6; 0.01 where a recording's rays are short."""

    ray_density: float = 2.5
    """Minimum rays cast at a voxel facing the camera, per centimetre of voxel size: 12.5 rays at 5 cm, 2.5 at
    1 cm. Pixels beyond that share rays. 0 casts a ray for every pixel."""

    pass_through: float | None = None
    """Chance that a ray passes through an occupied voxel, below 1, because what is in it fills only a part.
    With 0, the paper's model, a few rays that pass clear a voxel; with 0.1 thin things such as posts and legs
    stay in the map. By default 0.1 for a lidar's recording and 0 for all others. factor_graph() takes it as
    0."""

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
