"""The probability of occupied at points, and whether they are known."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.arguments import array
from taichi_mrf.errors import ConfigError
from taichi_mrf.system import runtime, tensors
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, F32Array, I32Array
from taichi_mrf.voxels.pool import BrickPool
from taichi_mrf.voxels.topology import CROSSED, Topology

UNKNOWN = 0
"""State of a place that no ray has crossed, or with too little evidence either way."""

FREE = 1
"""State of a place that was observed to be empty."""

OCCUPIED = 2
"""State of a place that is more likely occupied than not."""


def point_log_odds(
    points: ArrayLike, voxel_size: float, topology: Topology, pool: BrickPool, seen_free: float
) -> Any:
    """Step 7, eq. 8: the belief at (N, 3) points in metres, (N,) log-odds, float32, in the points' memory.

    Where no brick exists it is the prior where no ray has passed, else ``seen_free``. Points of float32 and
    float64 are read where they are. A point that is not finite raises ConfigError.
    """
    given = tensors.real_array(points, "points", ("N", 3))
    log_odds = tensors.empty(given, given.shape[:1])
    if len(given):
        voxels = tensors.empty(given, given.shape[:1], "int32")
        topology.locate(given, voxel_size, voxels)
        _gather(pool.belief, voxels, pool.prior_log_odds, seen_free, log_odds)
        runtime.settle()
    return log_odds


def checked_points(points: ArrayLike) -> NDArray[np.float64]:
    """Points as (N, 3) float64. Raises ConfigError for another shape or a value that is not finite."""
    points_m = array(points, "points")
    if points_m.ndim != 2 or points_m.shape[1] != 3:
        raise ConfigError(f"points must be of shape (N, 3), not {points_m.shape}")
    if not np.isfinite(points_m).all():
        raise ConfigError("points hold a value that is not finite")
    return points_m


def classify(log_odds: Any, prior_log_odds: float, min_evidence: float) -> Any:
    """(N,) log-odds -> (N,) UNKNOWN, FREE or OCCUPIED, int8; NumPy's arrays, or tensors of a device.

    Occupied is more likely than not; of the rest, unknown is what lies within ``min_evidence`` of the
    prior or above it: evidence for a surface that does not suffice.
    """
    occupied = (log_odds > 0) & (abs(log_odds - prior_log_odds) > min_evidence)
    free = (log_odds < prior_log_odds - min_evidence) & ~occupied
    return tensors.as_int8(free) * FREE + tensors.as_int8(occupied) * OCCUPIED


@ti.func
def state_of(log_odds: F32, prior_log_odds: F32, min_evidence: F32) -> I32:
    """:func:`classify` in kernels."""
    known = ti.abs(log_odds - prior_log_odds) > min_evidence
    state = UNKNOWN
    if log_odds > 0.0 and known:
        state = OCCUPIED
    elif log_odds < prior_log_odds - min_evidence:
        state = FREE
    return state


def probability(log_odds: Any) -> Any:
    """Log-odds to probability, float32."""
    if isinstance(log_odds, np.ndarray | np.generic):
        return (0.5 * (1.0 + np.tanh(0.5 * np.asarray(log_odds)))).astype(np.float32)
    return 0.5 * (1.0 + (0.5 * log_odds).tanh())


@ti.kernel
def _gather(belief: F32Array, voxels: I32Array, unseen: F32, crossed: F32, log_odds: F32Array):
    """Log-odds of ``voxels`` (N), as Topology.locate has them, into ``log_odds`` (N): those of ``belief``
    (pool * 512), or ``unseen`` or ``crossed`` where no brick is."""
    for i in range(voxels.shape[0]):
        here = unseen
        if voxels[i] >= 0:
            here = belief[voxels[i]]
        elif voxels[i] == CROSSED:
            here = crossed
        log_odds[i] = here
