"""The measured step from one keyframe to another: where the depth of one fits the surface that the other has
measured, and how well each direction is determined."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.levels import LEAST_POINTS, aligned, grids_of, levels_of
from taichi_mrf.alignment.levenberg import determined
from taichi_mrf.alignment.locate import agreement
from taichi_mrf.alignment.oriented_points import OrientedPoints
from taichi_mrf.alignment.recorded import SURFACE_SIGMA_M, Recorded
from taichi_mrf.alignment.surfels import Surfels
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.geometry.poses import Pose

PAIR_SIGMA_M = 0.002
"""Sigma of the alignment of two single images along the direction that it determines best, in metres."""

DETERMINED = 0.003
"""Least share of the largest eigenvalue that a direction needs to count as determined. Steps of a handheld
camera are wrong by about what this says along directions above it, and by 0.1 m along those below."""

FEWEST_SURFELS = 50
"""A surface of fewer cells aligns nothing."""


@dataclass(frozen=True)
class PairFit:
    """Fit of an image to a surface: ``T_world_camera`` (4, 4), with the ``information`` (6, 6) of its twist
    in the camera's frame, 0 along directions that are not determined: there the pose is the guess.
    ``overlap``, ``agreement`` and ``directions`` as in Located; ``cost`` is what ends of searches are
    compared by."""

    T_world_camera: Pose
    information: NDArray[np.float64]
    overlap: float
    agreement: float
    directions: int
    cost: float


def fit_to(
    points: OrientedPoints,
    surface: Surfels,
    guesses: Sequence[Pose],
    config: PoseConfig,
    first_cells_m: float,
) -> PairFit | None:
    """The best of the ends of searches from some guesses, or None if there is too little to align.

    ``config`` has the sigmas of the guesses. Surfaces further than about 1.5 times ``first_cells_m`` from
    where a guess puts them are not found.
    """
    if len(points.points) < LEAST_POINTS or len(surface.keys) < FEWEST_SURFELS:
        return None
    levels = levels_of(points, grids_of(surface, first_cells_m))
    lever_m = float(np.median(np.linalg.norm(points.points, axis=1)))
    found = []
    for T in guesses:
        guess = Recorded(T, config)
        end = aligned(levels, T, guess, lever_m, DETERMINED)
        worth = end.equations.worth * (SURFACE_SIGMA_M / PAIR_SIGMA_M) ** 2
        information = worth * determined(end.equations.H, lever_m, DETERMINED)
        overlap, agrees = end.equations.overlap, agreement(end.equations)
        cost = end.equations.cost
        found.append(PairFit(end.T_world_camera, information, overlap, agrees, end.directions, cost))
    return min(found, key=lambda fit: fit.cost)
