"""What maps that integrate scans one by one share: the log-odds of a voxel, and how they change.

Such a map needs no prior: a voxel starts at log-odds of 0 and stays there until the first scan says
something of it. That very number therefore marks the unknown, and no update may end there. A sum can,
where a hit and a miss weigh the same; it is then moved aside by next to nothing, and up rather than
down, because a voxel whose log-odds reach the threshold counts as occupied (OctoMap).
"""

import taichi as ti

from taichi_mrf.kernels.types import F32

UNKNOWN_LOG_ODDS = 0.0
"""What a voxel holds of which no scan has said anything."""

LEAST_LOG_ODDS = 1e-6
"""The log-odds nearest to unknown that a known voxel can have. Small beside any update, and large enough
for the probability, a float32 near 0.5, to differ from 0.5."""


@ti.func
def updated(log_odds: F32, change: F32, lowest: F32, highest: F32) -> F32:
    """A voxel's log-odds after an update: clamped, and never those of an unknown voxel."""
    result = ti.max(lowest, ti.min(highest, log_odds + change))
    if ti.abs(result) < LEAST_LOG_ODDS:
        result = LEAST_LOG_ODDS if result >= 0.0 else -LEAST_LOG_ODDS
    return result
