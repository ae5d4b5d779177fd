"""The verdict of the rays on a voxel beyond its marginal, one byte: the layer FIRST of a store.

0 is nothing. WON is a voxel that is occupied by the vote of the rays, DOUBTED one that is not called free. A
larger byte is a voxel that is occupied by its score, in tenths of a nat the byte plus SCORED
(inference/thin_matter.py).
"""

import numpy as np
from numpy.typing import NDArray

MATTER = 21
"""Score, in tenths of a nat, from which on a voxel may be occupied by it: that of one keyframe with a sharp
end in it, while in others no more than 36 rays pass."""

SUREST = 5.0
"""Log-odds of a voxel that is occupied by its score, at most."""

WON, DOUBTED = 1, 2
SCORED = MATTER - DOUBTED


def calls_of(
    decided: NDArray[np.float32], marginal: NDArray[np.float32], prior: float, min_evidence: float
) -> NDArray[np.uint8]:
    """The bytes of voxels, from the log-odds by which they have their states and those of the marginals."""
    calls = ((decided > 0) & (marginal <= 0)).astype(np.uint8)
    calls[(np.abs(decided - prior) <= min_evidence) & (marginal < prior - min_evidence)] = DOUBTED
    scored = (calls == WON) & (marginal <= prior + min_evidence)
    scores = np.ceil(10.0 * (decided[scored].astype(np.float64) - prior) - 0.01)
    calls[scored] = np.clip(scores - SCORED, DOUBTED + 1, 255)
    return calls


def follow_calls(calls: NDArray[np.uint8], log_odds: NDArray[np.float32], prior: float, least: float) -> None:
    """Change the ``log_odds`` of voxels in doubt, and of those that are occupied by their score, which have
    ``least`` at least."""
    log_odds[calls == DOUBTED] = prior
    scored = calls > DOUBTED
    evidence = np.float32(prior) + np.float32(0.1) * (calls[scored].astype(np.float32) + SCORED)
    log_odds[scored] = np.maximum(np.minimum(evidence, SUREST), least)
