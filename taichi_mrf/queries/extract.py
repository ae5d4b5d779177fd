"""All voxels of at least a given probability, as points."""

import math

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.queries.points import probability
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, F32Array, I32Array
from taichi_mrf.voxels.layout import BRICK, VOXELS, offsets_in_brick
from taichi_mrf.voxels.pool import BrickPool


def extract_voxels(
    pool: BrickPool, voxel_size: float, min_probability: float
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Centres (N, 3) in metres and marginals (N,), in the order of the bricks' coordinates.

    Raises ConfigError for a probability outside [0, 1].
    """
    if not 0 <= min_probability <= 1:
        raise ConfigError(f"min_probability must lie between 0 and 1, not {min_probability}")
    slots = pool.in_order
    if min_probability in (0.0, 1.0):
        threshold = math.copysign(1e30, min_probability - 0.5)
    else:
        threshold = math.log(min_probability / (1 - min_probability))
    counts = np.zeros(len(slots), np.int32)
    if len(slots):
        _count(pool.belief, slots, threshold, counts)
    ends = np.cumsum(counts, dtype=np.int64)
    total = int(ends[-1]) if len(ends) else 0
    rows, numbers = np.zeros(total, np.int32), np.zeros(total, np.int32)
    log_odds = np.zeros(total, np.float32)
    if total:
        _collect(pool.belief, slots, threshold, (ends - counts).astype(np.int32), rows, numbers, log_odds)
    runtime.settle()
    corners = pool.bricks[slots].astype(np.float64) * BRICK
    centres = (corners[rows] + offsets_in_brick()[numbers] + 0.5) * voxel_size
    return centres.reshape(-1, 3), probability(log_odds)


@ti.kernel
def _count(belief: F32Array, slots: I32Array, threshold: F32, counts: I32Array):
    """Count, for each brick in ``slots`` (n), the voxels of at least ``threshold`` log-odds, into ``counts``
    (n).

    ``belief`` is (pool * 512) log-odds.
    """
    for row in range(slots.shape[0]):
        n = 0
        for v in range(VOXELS):
            if belief[slots[row] * VOXELS + v] >= threshold:
                n += 1
        counts[row] = n


@ti.kernel
def _collect(
    belief: F32Array, slots: I32Array, threshold: F32,
    begins: I32Array, rows: I32Array, numbers: I32Array, log_odds: F32Array,
):  # fmt: skip
    """List the same voxels from place ``begins`` (n) on: their ``rows`` in ``slots``, their ``numbers`` in
    the brick and their ``log_odds``, (m) each."""
    for row in range(slots.shape[0]):
        i = begins[row]
        for v in range(VOXELS):
            here = belief[slots[row] * VOXELS + v]
            if here >= threshold:
                rows[i] = row
                numbers[i] = v
                log_odds[i] = here
                i += 1
