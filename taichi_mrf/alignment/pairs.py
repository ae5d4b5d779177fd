"""The measured step from one keyframe to another: where the depth of one fits the surface that the other has
measured, and how well each direction is determined. A loop is a step that holds without a guess."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.levels import LEAST_POINTS, aligned, grids_of, levels_of
from taichi_mrf.alignment.levenberg import determined
from taichi_mrf.alignment.locate import agreement
from taichi_mrf.alignment.oriented_points import OrientedPoints
from taichi_mrf.alignment.recorded import SURFACE_SIGMA_M, Recorded
from taichi_mrf.alignment.rules import RULES
from taichi_mrf.alignment.seen_through import looked_through
from taichi_mrf.alignment.surfels import Surfels
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.geometry.pose_edge import PoseEdge
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.inference.keyframe import Keyframe

PAIR_SIGMA_M = 0.002
"""Sigma of the alignment of two single images along the direction that it determines best, in metres."""

DETERMINED = 0.003
"""Least share of the largest eigenvalue that a direction needs to count as determined. Steps of a handheld
camera are wrong by about what this says along directions above it, and by 0.1 m along those below."""

FEWEST_SURFELS = 50
"""A surface of fewer cells aligns nothing."""

FREE = PoseConfig(translation_sigma=RULES.loop_sigma, rotation_sigma=RULES.loop_sigma)
"""The guesses of a loop."""


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


def loop(
    ends: tuple[int, int],
    older: Keyframe,
    surface: Surfels,
    newer: Keyframe,
    points: OrientedPoints,
    guesses: Sequence[Pose],
    first_cells_m: float,
) -> PoseEdge | None:
    """The step between the ``ends``, from an ``older`` keyframe to a ``newer`` one, if the ``points`` of that
    fit the ``surface`` around the older one and its image hardly looks through any of it: along a corridor
    walls fit everywhere, but not what stands along them."""
    fit = fit_to(points, surface, guesses, FREE, first_cells_m)
    if fit is None or fit.directions < 6:
        return None
    if fit.overlap < RULES.loop_overlap or fit.agreement < RULES.loop_agreement:
        return None
    if looked_through(surface.planes(), newer.image, fit.T_world_camera) > RULES.lost_through:
        return None
    step = inverse(older.T_world_camera) @ fit.T_world_camera
    return PoseEdge(*ends, step, fit.information, certain=False)
