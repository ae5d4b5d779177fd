"""The prior probability of a voxel."""

import math

from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.errors import ConfigError


def prior_probability(inference: InferenceConfig, voxel_size: float) -> float:
    """The prior of a voxel: as given, or 1 - exp(-density * voxel size), which is the chance of meeting
    a surface on the way through a voxel."""
    if inference.prior is not None:
        return inference.prior
    prior = -math.expm1(-inference.surface_density * voxel_size)
    if not 0 < prior < 1:
        raise ConfigError(
            f"inference.surface_density {inference.surface_density} and voxel_size {voxel_size} give a prior "
            f"of {prior}"
        )
    return prior


def log_odds_without_bricks(
    inference: InferenceConfig, voxel_size: float, clamp: float
) -> tuple[float, float]:
    """Log-odds of places where no brick is allocated: the prior's, where no ray came, and those of a place
    that rays crossed without a surface near; ``clamp`` bounds messages."""
    prior = prior_probability(inference, voxel_size)
    prior_log_odds = math.log(prior / (1 - prior))
    return prior_log_odds, prior_log_odds - clamp
