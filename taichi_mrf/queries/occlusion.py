"""Dimming of a ray by the voxels that it passes through.

Occupancy is read as a medium: a voxel of probability p has the occlusion density
alpha = -ln(1 - p) / voxel size (MRFMap, section III-D).
"""

import math
from dataclasses import dataclass

from taichi_mrf.kernels.bundles import Bundle
from taichi_mrf.kernels.log_odds import softplus
from taichi_mrf.kernels.types import F32, Template
from taichi_mrf.system.compiler import ti
from taichi_mrf.voxels.traversal import FAR


@dataclass(frozen=True)
class Occlusion(Bundle):
    """The voxels that let every ray through, and how sure a view is of the others, by their log-odds of
    being occupied."""

    unknown: F32 = FAR
    """Log-odds that stand for "never seen" in maps that mark it so."""

    empty_below: F32 = -FAR
    """Voxels with less than this are taken for empty, as in a map that keeps occupied voxels only."""

    least: F32 = -FAR
    """A voxel with less counts as one with these log-odds: none is surer to be free."""

    most: F32 = FAR
    """A voxel with more counts as one with these log-odds: none is surer to be occupied."""


def doubting(share: float, passing: float, prior: float) -> Occlusion:
    """The rule of a view in which a voxel is occupied with at least the ``share`` of its ``prior``
    probability, however often it was seen to be free, and lets a ray pass with at least the chance
    ``passing``, however often it was seen to be occupied; 0 trusts what was seen.

    Poses and noise are never as exact as they are said to be, so that evidence that agrees with itself a
    hundred times is wrong more often than its log-odds say.
    """
    least = -math.log(1.0 / (share * prior) - 1.0) if share * prior > 0 else -FAR
    most = math.log(1.0 / passing - 1.0) if passing > 0 else FAR
    return Occlusion(least=least, most=most)


@ti.func
def occlusion(log_odds: F32, rule: Template) -> F32:
    """alpha times the voxel size by a ``rule`` (Occlusion): -ln(1 - p), or 0 for a voxel that lets every ray
    through."""
    alpha = softplus(ti.max(rule.least, ti.min(rule.most, log_odds)))
    if log_odds == rule.unknown or log_odds < rule.empty_below:
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
