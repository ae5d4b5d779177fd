"""Probability that each voxel holds a surface, from where the rays of all keyframes together place it.

A marginal is cautious: a keyframe's message is the average of its rays, and counts once, however many they
are. Here each voxel gets its distance from the surface that all rays measured. With their mean signed
distance there (inference/surface_rays.py, blended as for meshes), its weight w and its gradient of length g
along the normal n, the voxel's centre lies d = mean / g voxels in front of the surface, and the voxel
extends e = (|n_x| + |n_y| + |n_z|) / 2 to either side. With S(x) = 1 / (1 + exp(-x)),

    s^2 = NOISE / (16 w g^2) + BLUR^2
    z = S((d + REACH e) / s) - S((d - REACH e) / s)               that the surface passes near the voxel
    log-odds = log(z / (1 - z)) - DOUBT + PRIOR prior + MARGINAL (marginal - prior)

where prior and marginal are log-odds, too.

A voxel behind the surface has at least the prior, since it has not been seen, unless its marginal is lower.
Where no ray measured a distance, the marginal stays. docs/evaluation.md says how far these probabilities can
be trusted.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.inference.surface_votes import CALLED
from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, AnyArray, F32Array, I32Array, IVec3, Template, Vec3
from taichi_mrf.voxels.blended_field import blended, cell_of, voxel_around
from taichi_mrf.voxels.distance_field import DistanceField
from taichi_mrf.voxels.layout import VOXELS, grid_keys, rows_around

NOISE, BLUR, REACH = 0.41, 0.17, 1.67
DOUBT, PRIOR, MARGINAL = 0.56, 0.55, 0.29
"""Found by the likelihood of the voxels of three scenes at 5 and 2 cm: docs/decisions.md."""

LEAST_WEIGHT = 0.001
"""A voxel with less has no distance."""

STEEPEST, FLATTEST = 3.0, 0.7
"""Bounds on a gradient, which at the border of what was seen means nothing."""

UNLIKELIEST = 1e-4
"""Bound on z and on 1 - z."""

SUREST = 10.0
"""Bound on how far a marginal's log-odds may be from the prior's."""

BRICKS_AT_ONCE = 1 << 14
"""Bricks whose blended distances are in memory together: at most 130 MB."""

_FACES = np.array([[0, 0, 0], *np.eye(3, dtype=np.int32), *-np.eye(3, dtype=np.int32)], np.int32)


def calibrate(
    field: DistanceField,
    bricks: NDArray[np.int32],
    slots: NDArray[np.int32],
    log_odds: "AnyArray",
    prior: float,
) -> None:
    """Make marginals' ``log_odds`` (slots * 512) the calibrated ones in some ``bricks`` (n, 3), which are
    distinct, in ``slots`` (n)."""
    sums = field.weight.reshape(-1), field.distance.reshape(-1)
    keys = grid_keys(field.bricks)
    for rows in _near(bricks, keys):
        blended_bricks = _distinct((bricks[rows, None] + _FACES).reshape(-1, 3))
        around = rows_around(blended_bricks, keys)
        near = (around >= 0).any(axis=1)
        blended_bricks, around = blended_bricks[near], around[near]
        total, mean = (ti.ndarray(ti.f32, len(around) * VOXELS) for _ in range(2))
        _blend(*sums, around.reshape(-1), total, mean)
        around = rows_around(bricks[rows], grid_keys(blended_bricks))
        _combine(total, mean, around.reshape(-1), slots[rows], log_odds, prior)
        runtime.settle()


@kernel
def carry(likely: F32Array, log_odds: F32Array, prior: F32, min_evidence: F32, least: F32) -> None:
    """Bring ``log_odds`` (n), by which voxels have their states, to the calibrated ``likely`` (n) as far as
    the states allow: occupied voxels stay at ``least`` (surface_votes.called) or above, free ones below what
    is known, those between stay there, and what is unknown keeps its own."""
    for i in log_odds:
        decided = log_odds[i]
        if ti.abs(decided - prior) > min_evidence:
            if decided > 0.0:
                log_odds[i] = ti.max(likely[i], least)
            elif decided < prior:
                log_odds[i] = ti.min(likely[i], prior - min_evidence - CALLED)
            else:
                log_odds[i] = ti.max(ti.min(likely[i], -CALLED), prior + min_evidence)


def _near(bricks: NDArray[np.int32], keys: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """The rows of the bricks (n, 3) whose voxels may have distances, by those of a field's bricks: some at
    once, which lie together."""
    near = np.flatnonzero((rows_around(bricks, keys) >= 0).any(axis=1))
    near = near[np.argsort(grid_keys(bricks[near]))]
    for begin in range(0, len(near), BRICKS_AT_ONCE):
        yield near[begin : begin + BRICKS_AT_ONCE]


def _distinct(bricks: NDArray[np.int32]) -> NDArray[np.int32]:
    """Each of some bricks (n, 3) once, ascending."""
    return bricks[np.unique(grid_keys(bricks), return_index=True)[1]]


@kernel
def _blend(weight: F32Array, distance: F32Array, around: I32Array, total: F32Array, mean: F32Array) -> None:
    """The blended weight and mean distance of the voxels of some bricks, (n * 512) each, 0 where there is no
    distance, from a field's sums. ``around`` (n * 27) are the field's rows around each brick."""
    for i in mean:
        total[i] = mean[i] = 0.0
        sums = blended(weight, distance, around, i // VOXELS, cell_of(i % VOXELS))
        if sums[0] > LEAST_WEIGHT:
            total[i], mean[i] = sums[0], sums[1] / sums[0]


@kernel
def _combine(
    total: F32Array, mean: F32Array, around: I32Array, slots: I32Array, log_odds: F32Array, prior: F32
) -> None:
    """Calibrated ``log_odds`` (slots * 512) of the bricks in ``slots`` (n) instead of the marginals', by the
    blended weights and distances; ``around`` (n * 27) are the rows of these around each brick."""
    for i in range(slots.shape[0] * VOXELS):
        place, cell = i // VOXELS, cell_of(i % VOXELS)
        own = voxel_around(around, place, cell)
        if own >= 0 and total[own] > 0.0:
            slope = Vec3(0.0)
            for axis in ti.static(range(3)):
                step = ti.Vector.unit(3, axis, ti.i32)
                before = _mean_at(mean, around, place, cell - step)
                slope[axis] = 0.5 * (_mean_at(mean, around, place, cell + step) - before)
            voxel = slots[place] * VOXELS + i % VOXELS
            marginal = log_odds[voxel]
            told = ti.max(ti.min(marginal - prior, SUREST), -SUREST)
            likely = _evidence(total[own], mean[own], slope) - DOUBT + PRIOR * prior + MARGINAL * told
            if mean[own] < 0.0:  # behind the surface
                likely = ti.max(likely, ti.min(marginal, prior))
            log_odds[voxel] = likely


@ti.func
def _mean_at(mean: Template, around: Template, place: I32, cell: IVec3) -> F32:
    voxel = voxel_around(around, place, cell)
    found = 0.0
    if voxel >= 0:
        found = mean[voxel]
    return found


@ti.func
def _evidence(weight: F32, mean: F32, slope: Vec3) -> F32:
    """log(z / (1 - z)) of a voxel from its weight, mean distance and gradient."""
    steep = slope.norm()
    extent = 0.5 * ti.abs(slope).sum() / ti.max(steep, 1e-6)
    steep = ti.max(ti.min(steep, STEEPEST), FLATTEST)
    d = mean / steep
    s = ti.sqrt(NOISE / (16.0 * weight * steep * steep) + BLUR * BLUR)
    z = 0.5 * (ti.tanh(0.5 * (d + REACH * extent) / s) - ti.tanh(0.5 * (d - REACH * extent) / s))
    z = ti.max(ti.min(z, 1.0 - UNLIKELIEST), UNLIKELIEST)
    return ti.log(z / (1.0 - z))
