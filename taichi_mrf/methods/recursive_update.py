"""The update of a voxel's log-odds in recursive maps.

A voxel starts at log-odds 0 and keeps them until the first scan observes it, so the value 0 marks unknown
voxels and no update may end there. A sum of updates can be exactly 0 where a hit and a miss weigh the same.
It is then moved to LEAST_LOG_ODDS, up rather than down, because a voxel whose log-odds reach the threshold
counts as occupied (OctoMap).
"""

import math

from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, F32Array, I32Array, Template
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.log_odds import faded
from taichi_mrf.voxels.numbering import strip_begin

UNKNOWN_LOG_ODDS = 0.0
"""The log-odds of a voxel that no scan has observed."""

LEAST_LOG_ODDS = 1e-6
"""The smallest magnitude of a known voxel's log-odds: small compared to any update, and large enough for the
probability, a float32 near 0.5, to differ from 0.5."""


def log_odds(probability: float) -> float:
    """ln(p / (1 - p))."""
    return math.log(probability / (1 - probability))


@ti.func
def updated(log_odds: F32, change: F32, lowest: F32, highest: F32) -> F32:
    """A voxel's log-odds after an update: clamped, and never those of an unknown voxel."""
    result = ti.max(lowest, ti.min(highest, log_odds + change))
    if ti.abs(result) < LEAST_LOG_ODDS:
        result = LEAST_LOG_ODDS if result >= 0.0 else -LEAST_LOG_ODDS
    return result


@ti.kernel
def fade_bricks(slots: I32Array, belief: F32Array, forgotten: F32, strip: Template):
    """Let time pass in bricks, (n) ``slots`` of ``belief`` (pool * 512): the share ``forgotten`` of each
    voxel's state is drawn anew, and either is as likely. Unknown voxels stay unknown."""
    for part in range(slots.shape[0] * (VOXELS // strip)):
        _, j = strip_begin(part, slots, strip)
        for k in range(strip):
            belief[j + k] = faded(belief[j + k], 1.0 - forgotten, 0.5 * forgotten, 0.5 * forgotten)
