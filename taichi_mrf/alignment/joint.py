"""All keyframes aligned with each other at once, and each with where it was recorded.

Aligning one keyframe after the other accumulates their errors, and further rounds correct a bend of the whole
trajectory only slowly. Here the residuals of every pair's points are functions of both its poses,
and one linear system moves all of them:

    sum over pairs (i, k) of |r_ik + J_ik (xi_i - Ad(T_i_k) xi_k)|^2  +  sum over i of |e_i + xi_i|^2

with T_i_k = inv(T_i) T_k, and e_i the twist from keyframe i's recorded pose. recorded.py has the weights of
the two terms.
"""

from collections.abc import Collection, Generator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.oriented_points import OrientedPoints
from taichi_mrf.alignment.point_to_plane import PointToPlane
from taichi_mrf.alignment.recorded import Recorded
from taichi_mrf.alignment.se3 import adjoint, moved
from taichi_mrf.alignment.surfel_grid import SurfelGrid
from taichi_mrf.alignment.surfels import surfels_of
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.geometry.poses import Pose, inverse

CELLS_M = (0.12, 0.06)
"""Widths of the surfels' cells in metres, from coarse to fine."""

THINNED = (6, 3)
"""Which of the points each level takes along rows and columns."""

STEPS = 6
"""Steps at each level, at most."""

SMALLEST_STEP = 2e-4
"""Metres or radians: smaller steps end a level."""

PARTNERS = 12
"""Others, those with which it shares most, that a keyframe is aligned with."""

SHARED = 0.05
"""Share of a keyframe's cells that a partner must have seen too."""


def align_jointly(
    points: Mapping[int, OrientedPoints],
    T_world_camera: Mapping[int, Pose],
    T_recorded: Mapping[int, Pose],
    config: PoseConfig,
    fixed: Collection[int] = (),
) -> Generator[None, None, dict[int, Pose]]:
    """The poses, by keyframe, under which all points fit each other and what was recorded; those that are
    ``fixed`` stay, and that with the lowest id. ``T_world_camera`` is where the search begins. A
    generator: it yields once for each pair of keyframes in each step."""
    ids = sorted(points)
    free = np.repeat([i > 0 and id not in fixed for i, id in enumerate(ids)], 6)
    poses = [T_world_camera[id] for id in ids]
    recorded = [Recorded(T_recorded[id], config) for id in ids]
    pairs = _partners([points[id] for id in ids], poses)
    for cell_size, every in zip(CELLS_M, THINNED, strict=True):
        # In the keyframes' own frames, so that surfels stay as they are when poses change.
        grids = [SurfelGrid(surfels_of(points[id], np.eye(4), cell_size)) for id in ids]
        thinned = [points[id].thinned(every) for id in ids]
        problems = {(i, k): PointToPlane(thinned[i], grids[k]) for i, k in pairs}
        for _ in range(STEPS):
            H, g = yield from _system(problems, poses, recorded)
            xi = np.zeros(6 * len(ids))
            xi[free] = np.linalg.solve(H[np.ix_(free, free)], -g[free])
            poses = [moved(T, xi[6 * i : 6 * i + 6]) for i, T in enumerate(poses)]
            if np.abs(xi).max() < SMALLEST_STEP:
                break
    return dict(zip(ids, poses, strict=True))


def _system(
    problems: Mapping[tuple[int, int], PointToPlane],
    poses: Sequence[Pose],
    recorded: Sequence[Recorded],
) -> Generator[None, None, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """The normal equations of all poses' steps, (6 n, 6 n) and (6 n,)."""
    n = len(poses)
    H, g = np.zeros((n, 6, n, 6)), np.zeros((n, 6))
    for (i, k), problem in problems.items():
        yield
        T_k_i = inverse(poses[k]) @ poses[i]
        pair = problem.linearised(T_k_i)
        worth = pair.worth
        to_k = -adjoint(inverse(T_k_i))
        H_i, g_i = worth * pair.H, worth * pair.g
        H[i, :, i] += H_i
        H[i, :, k] += H_i @ to_k
        H[k, :, i] += to_k.T @ H_i
        H[k, :, k] += to_k.T @ H_i @ to_k
        g[i] += g_i
        g[k] += to_k.T @ g_i
    for i, T in enumerate(poses):
        H[i, :, i] += recorded[i].H
        g[i] += recorded[i].gradient(T)
    return H.reshape(6 * n, 6 * n), g.reshape(-1)


def _partners(points: Sequence[OrientedPoints], poses: Sequence[Pose]) -> list[tuple[int, int]]:
    """Pairs (i, k): the points of i are aligned with the surfels of k."""
    keys = [surfels_of(p.thinned(4), T, 2 * CELLS_M[0]).keys for p, T in zip(points, poses, strict=True)]
    pairs = []
    for i, mine in enumerate(keys):
        shares = [
            0.0 if i == k else len(np.intersect1d(mine, theirs, assume_unique=True)) / max(1, len(mine))
            for k, theirs in enumerate(keys)
        ]
        best = np.argsort(shares, kind="stable")[::-1][:PARTNERS]
        pairs += [(i, int(k)) for k in best if shares[k] >= SHARED]
    return pairs
