"""How much a voxel dims a ray that passes through it.

Occupancy is read as a medium: a voxel of probability p has the occlusion density
alpha = -ln(1 - p) / voxel size (MRFMap, section III-D).
"""

from dataclasses import dataclass

from taichi_mrf.kernels.log_odds import softplus
from taichi_mrf.kernels.types import F32
from taichi_mrf.system.compiler import ti
from taichi_mrf.voxels.traversal import FAR


@dataclass(frozen=True)
class Occlusion:
    """Which voxels let every ray through, by their log-odds of being occupied."""

    unknown: float = FAR
    """Log-odds that stand for "never seen" in maps that mark it so."""

    empty_below: float = -FAR
    """Voxels with less than this are taken for empty, as in a map that keeps occupied voxels only."""


@ti.func
def occlusion(log_odds: F32, unknown: F32, empty_below: F32) -> F32:
    """alpha times the voxel size: -ln(1 - p), or 0 for a voxel that lets every ray through."""
    alpha = softplus(log_odds)
    if log_odds == unknown or log_odds < empty_below:
        alpha = 0.0
    return alpha


@ti.func
def stopped_share(thickness: F32) -> F32:
    """1 - e^-thickness: the share of a ray that is stopped where alpha times the length is ``thickness``.

    By its series near 0, where the difference has no digits left and most voxels are.
    """
    share = ti.cast(thickness * (1.0 - thickness * (0.5 - thickness * (1.0 / 6.0))), ti.f32)
    if thickness >= 0.05:
        share = 1.0 - ti.exp(-thickness)
    return share
