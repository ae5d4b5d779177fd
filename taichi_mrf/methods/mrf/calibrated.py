"""How likely each voxel holds a surface, from where the rays of all keyframes together place it.

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

from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.inference.surface_votes import CALLED, called
from taichi_mrf.voxels.distance_field import MARGIN, DistanceSource, blended_sums
from taichi_mrf.voxels.layout import BRICK, CHUNK, CHUNK_VOXELS, VOXELS, grid_keys
from taichi_mrf.voxels.pool import BrickPool

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


def calibrated_log_odds(field: DistanceSource, pool: BrickPool) -> NDArray[np.float32]:
    """Log-odds of the voxels of a map, (capacity, 512), by the distances of its rays and the marginals."""
    log_odds: NDArray[np.float32] = pool.belief.to_numpy().reshape(-1, VOXELS)
    in_use = pool.in_use
    bricks = pool.bricks[in_use]
    chunk_of = grid_keys(bricks // CHUNK)
    for chunk in field.chunks.astype(np.int64):
        rows = np.flatnonzero(chunk_of == grid_keys(chunk[None].astype(np.int32)))
        if len(rows):
            evidence, behind = _around(field, chunk)
            x, y, z = (bricks[rows] - chunk * CHUNK).T
            found = _of_bricks(evidence)[x, y, z], _of_bricks(behind)[x, y, z]
            slots = in_use[rows]
            log_odds[slots] = _combined(*found, log_odds[slots], pool.prior_log_odds)
    return log_odds


def calibrated_block(
    field: DistanceSource, chunk: NDArray[np.int64], marginal: NDArray[np.float32], prior: float
) -> NDArray[np.float32]:
    """The same for the voxels of a chunk (3,), whose marginals' log-odds are (64, 64, 64)."""
    return _combined(*_around(field, chunk), marginal, prior)


def carried(
    likely: NDArray[np.float32], decided: NDArray[np.float32], prior: float, min_evidence: float
) -> NDArray[np.float32]:
    """Calibrated log-odds ``likely`` as far as the states by ``decided``, of the same shape, allow: occupied
    voxels stay just over even odds or above, free ones below what is known, those between stay there, and
    what is unknown keeps its own."""
    known, least = prior + min_evidence, called(prior, min_evidence)
    free = np.minimum(likely, np.float32(prior - min_evidence - CALLED))
    between = np.maximum(np.minimum(likely, np.float32(-CALLED)), np.float32(known))
    found = np.where(decided > 0, np.maximum(likely, np.float32(least)), between)
    found = np.where(decided < prior - min_evidence, free, found)
    known_one = np.abs(decided - prior) > min_evidence  # not NaN either
    return np.where(known_one, found, decided)


def _around(field: DistanceSource, chunk: NDArray[np.int64]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """What surface_evidence says of the voxels of a chunk, (64, 64, 64)."""
    first = chunk * CHUNK_VOXELS - 1 - MARGIN  # gradients and blending need the voxels around
    weight, distance, _ = field.box(first, CHUNK_VOXELS + 2 + 2 * MARGIN)
    weight, distance = blended_sums(weight, distance)
    return surface_evidence(weight, distance)


def _combined(
    evidence: NDArray[np.float32], behind: NDArray[np.bool_], marginal: NDArray[np.float32], prior: float
) -> NDArray[np.float32]:
    """Log-odds of voxels from what surface_evidence says of them and their marginals, of one shape."""
    likely = evidence - DOUBT + PRIOR * prior + MARGINAL * np.clip(marginal - prior, -SUREST, SUREST)
    likely = np.where(behind, np.maximum(likely, np.minimum(marginal, prior)), likely)
    return np.where(np.isnan(evidence), marginal, likely)


def surface_evidence(
    weight: NDArray[np.float32], distance: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """log(z / (1 - z)) of the voxels of a box without its outermost, from the sums of weights and of
    distances times weight, and whether each is behind the surface; NaN where there is no distance."""
    seen = weight > LEAST_WEIGHT
    mean = np.where(seen, distance / np.maximum(weight, LEAST_WEIGHT), np.float32(0))
    inner = (slice(1, -1),) * 3
    normal = np.stack([part[inner] for part in np.gradient(mean)])
    steep = np.sqrt((normal * normal).sum(axis=0))
    extent = 0.5 * np.abs(normal).sum(axis=0) / np.maximum(steep, 1e-6)
    steep = np.clip(steep, FLATTEST, STEEPEST)
    d, w = mean[inner] / steep, np.maximum(weight[inner], LEAST_WEIGHT)
    s = np.sqrt(NOISE / (16.0 * w * steep * steep) + BLUR**2)
    z = 0.5 * (np.tanh(0.5 * (d + REACH * extent) / s) - np.tanh(0.5 * (d - REACH * extent) / s))
    z = np.clip(z, UNLIKELIEST, 1.0 - UNLIKELIEST)
    evidence = np.where(seen[inner], np.log(z / (1.0 - z)), np.nan)
    return evidence.astype(np.float32), d < 0


def _of_bricks(voxels: NDArray[Any]) -> NDArray[Any]:
    """Values of a chunk's voxels, (64, 64, 64) -> (8, 8, 8, 512) of its bricks."""
    split = voxels.reshape(CHUNK, BRICK, CHUNK, BRICK, CHUNK, BRICK).transpose(0, 2, 4, 1, 3, 5)
    return split.reshape(CHUNK, CHUNK, CHUNK, VOXELS)
