"""The probability of occupied at points, and whether they are known."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.arguments import array
from taichi_mrf.errors import ConfigError
from taichi_mrf.kernels.types import F32, I32, F32Array, I32Array
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.voxels.layout import BRICK, VOXELS
from taichi_mrf.voxels.pool import BrickPool
from taichi_mrf.voxels.topology import Topology

UNKNOWN = 0
"""The state of a place that no ray has crossed, or that has too little evidence either way."""

FREE = 1
"""The state of a place that was seen to be empty."""

OCCUPIED = 2
"""The state of a place that is more likely occupied than not."""


def point_log_odds(
    points: ArrayLike, voxel_size: float, topology: Topology, pool: BrickPool, seen_free: float
) -> NDArray[np.float32]:
    """(N, 3) points in metres -> (N,) log-odds of being occupied.

    Where no brick exists it is the prior where no ray has passed, else ``seen_free``. A point that is
    not finite raises ConfigError.
    """
    points_m = checked_points(points)
    if len(points_m) == 0:
        return np.zeros(0, np.float32)
    # A point beyond 32 bits is further away than any map reaches.
    voxels = np.clip(np.floor(points_m / voxel_size), -(2**30), 2**30).astype(np.int32)
    bricks = np.ascontiguousarray(voxels // BRICK, np.int32)
    slots = topology.slots(bricks)
    without_brick = np.where(topology.crossings(bricks) > 0, seen_free, pool.prior_log_odds).astype(
        np.float32
    )
    log_odds = np.zeros(len(points_m), np.float32)
    local = voxels - bricks * BRICK
    numbers = ((local[:, 0] * BRICK + local[:, 1]) * BRICK + local[:, 2]).astype(np.int32)
    _gather(pool.belief, slots, numbers, without_brick, log_odds)
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


def classify(log_odds: NDArray[np.float32], prior_log_odds: float, min_evidence: float) -> NDArray[np.int8]:
    """(N,) log-odds -> (N,) UNKNOWN, FREE or OCCUPIED.

    Occupied is more likely than not; of the rest, unknown is what lies within ``min_evidence`` of the
    prior or above it: evidence for a surface that does not suffice.
    """
    state = np.where(log_odds < prior_log_odds - min_evidence, FREE, UNKNOWN)
    known = np.abs(log_odds - prior_log_odds) > min_evidence
    return np.where((log_odds > 0) & known, OCCUPIED, state).astype(np.int8)


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


def probability(log_odds: NDArray[np.float32]) -> NDArray[np.float32]:
    """Log-odds to probability."""
    return (0.5 * (1.0 + np.tanh(0.5 * log_odds))).astype(np.float32)


@ti.kernel
def _gather(
    belief: F32Array, slots: I32Array, numbers: I32Array, without_brick: F32Array, log_odds: F32Array
):
    """Log-odds of points: those of voxel ``numbers`` (N) of the bricks in ``slots`` (N), or ``without_brick``
    (N) where the slot is -1, into ``log_odds`` (N). ``belief`` is (pool * 512)."""
    for i in range(slots.shape[0]):
        here = without_brick[i]
        if slots[i] >= 0:
            here = belief[slots[i] * VOXELS + numbers[i]]
        log_odds[i] = here
