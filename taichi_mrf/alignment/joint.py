"""All keyframes aligned with each other at once, and each with what is known of its pose.

Aligning one keyframe after the other accumulates their errors, and further rounds correct a bend of the whole
trajectory only slowly. Here the residuals of every pair's points are functions of both its poses,
and one sparse linear system moves all of them:

    sum over pairs (i, k) of |r_ik + J_ik (xi_i - Ad(T_i_k) xi_k)|^2  +  sum over i of |e_i + xi_i|^2

with T_i_k = inv(T_i) T_k, and e_i the twist from keyframe i's recorded pose. If poses were tracked, e_i is
that of the step from the keyframe before. recorded.py has the weights of the two terms.
"""

from collections import defaultdict
from collections.abc import Collection, Generator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.oriented_points import OrientedPoints
from taichi_mrf.alignment.point_to_plane import PointToPlane
from taichi_mrf.alignment.pose_equations import PoseEquations
from taichi_mrf.alignment.recorded import KnownPoses
from taichi_mrf.alignment.se3 import adjoint, moved
from taichi_mrf.alignment.surfel_grid import SurfelGrid
from taichi_mrf.alignment.surfels import surfels_of
from taichi_mrf.geometry.poses import Pose, inverse

Levels = tuple[tuple[float, int], ...]
"""From coarse to fine: the width of the surfels' cells in metres, and which of the points a level takes along
rows and columns."""

LEVELS: Levels = ((0.12, 6), (0.06, 3))
"""For poses that were recorded. With the third level eight views with little in common are left with twice
the error."""

TRACKED_LEVELS: Levels = (*LEVELS, (0.03, 2))
"""For tracked poses, whose views have much in common: it takes the built-in room from 0.9 to 0.6 cm RMS."""

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
    known: KnownPoses,
    fixed: Collection[int] = (),
    levels: Levels = LEVELS,
) -> Generator[None, None, dict[int, Pose]]:
    """The poses, by keyframe, under which all points fit each other and what is ``known`` of the poses, in
    the order of the ids; those that are ``fixed`` stay, and that with the lowest id. ``T_world_camera`` is
    where the search begins. A generator: it yields once for each pair of keyframes in each step."""
    ids = sorted(points)
    free = np.array([i > 0 and id not in fixed for i, id in enumerate(ids)])
    poses = [T_world_camera[id] for id in ids]
    pairs = _partners([points[id] for id in ids], poses)
    for cell_size, every in levels:
        # In the keyframes' own frames, so that surfels stay as they are when poses change.
        grids = [SurfelGrid(surfels_of(points[id], np.eye(4), cell_size)) for id in ids]
        thinned = [points[id].thinned(every) for id in ids]
        problems = {(i, k): PointToPlane(thinned[i], grids[k]) for i, k in pairs}
        for _ in range(STEPS):
            equations = yield from _equations(problems, poses)
            known.add_to(equations, poses)
            xi = equations.step(free)
            poses = [moved(T, xi[i]) for i, T in enumerate(poses)]
            if np.abs(xi).max() < SMALLEST_STEP:
                break
    return dict(zip(ids, poses, strict=True))


def _equations(
    problems: Mapping[tuple[int, int], PointToPlane], poses: Sequence[Pose]
) -> Generator[None, None, PoseEquations]:
    """The normal equations of all poses' steps, by the points alone."""
    equations = PoseEquations(len(poses))
    if problems:
        terms = []
        for (i, k), problem in problems.items():
            yield
            T_k_i = inverse(poses[k]) @ poses[i]
            pair = problem.linearised(T_k_i)
            terms.append((-adjoint(inverse(T_k_i)), pair.worth * pair.H, pair.worth * pair.g))
        moving, other = np.array(list(problems), np.intp).T
        equations.add_pairs(moving, other, *(np.stack(part) for part in zip(*terms, strict=True)))
    return equations


def _partners(points: Sequence[OrientedPoints], poses: Sequence[Pose]) -> list[tuple[int, int]]:
    """Pairs (i, k): the points of i are aligned with the surfels of k."""
    cells = [surfels_of(p.thinned(4), T, 2 * LEVELS[0][0]).keys for p, T in zip(points, poses, strict=True)]
    views = SharedViews(dict(enumerate(cells)))
    return [(i, k) for i, mine in enumerate(cells) for k in views.partners(mine, PARTNERS, SHARED, i)]


class SharedViews:
    """The cells (n,) that each keyframe has measured something in, by id."""

    def __init__(self, cells: Mapping[int, NDArray[np.int64]] = {}) -> None:
        self._seen_by: defaultdict[int, list[int]] = defaultdict(list)
        for id, keys in cells.items():
            self.add(id, keys)

    def add(self, id: int, cells: NDArray[np.int64]) -> None:
        """Add a keyframe that is not in the index."""
        for key in cells.tolist():
            self._seen_by[key].append(id)

    def shares(self, cells: NDArray[np.int64]) -> dict[int, float]:
        """The share of some cells that each keyframe has seen, if it has seen any."""
        counts: defaultdict[int, int] = defaultdict(int)
        for key in cells.tolist():
            for id in self._seen_by.get(key, ()):
                counts[id] += 1
        return {id: count / len(cells) for id, count in counts.items()}

    def partners(self, cells: NDArray[np.int64], most: int, least: float, without: int) -> list[int]:
        """Those keyframes that have seen most of some cells, ``most`` of them at most, each at least the
        share ``least``; not keyframe ``without``."""
        shares = self.shares(cells)
        known = [id for id, share in shares.items() if id != without and share >= least]
        return sorted(known, key=lambda id: (-shares[id], -id))[:most]
