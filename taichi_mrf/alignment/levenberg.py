"""Gauss-Newton with Levenberg's damping on SE(3), which leaves directions alone that the points do not
determine.

A camera that sees one flat wall can slide along it and turn about its normal without any residual changing.
Such directions are found among the eigenvectors of the normal equations, with rotations measured by how far
they move a typical point, and get no step.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.photometric import NO_COLOR, ColorEquations, Photometric
from taichi_mrf.alignment.point_to_plane import NormalEquations, PointToPlane
from taichi_mrf.alignment.recorded import Recorded
from taichi_mrf.alignment.se3 import moved
from taichi_mrf.geometry.poses import Pose

MOST_STEPS = 12
"""Steps at one level, tried ones included."""

SMALLEST_STEP_M = 2e-4
"""A step that moves points by less than this ends a level."""

OBSERVABLE = 0.005
"""Least share of the largest eigenvalue that a direction needs to be moved in, by default."""


@dataclass(frozen=True)
class Aligned:
    """End of a level: its pose, the equations there and how many of the six directions were determined."""

    T_world_camera: Pose
    equations: NormalEquations
    directions: int


def align(
    problem: PointToPlane,
    T_world_camera: Pose,
    recorded: Recorded,
    lever_m: float,
    observable: float = OBSERVABLE,
    color: Photometric | None = None,
) -> Aligned:
    """Steps from a pose while they lower the cost: of the residuals, of leaving where it was recorded, and of
    ``color``.

    ``lever_m`` is the distance of a typical point, ``observable`` the least share of the largest eigenvalue
    that a direction needs to be moved in.
    """
    T, here = T_world_camera, problem.linearised(T_world_camera)
    shown = NO_COLOR if color is None else color.linearised(T)
    worth = here.worth
    damping, directions = 1e-3, 0
    for _ in range(MOST_STEPS):
        step, directions = solve(here, worth, recorded, T, lever_m, damping, observable, shown)
        if np.linalg.norm(step * _scale(lever_m)) < SMALLEST_STEP_M:
            break
        tried_T = moved(T, step)
        tried = problem.linearised(tried_T)
        tried_shown = NO_COLOR if color is None else color.linearised(tried_T)
        before = worth * here.cost + recorded.cost(T) + shown.cost
        if worth * tried.cost + recorded.cost(tried_T) + tried_shown.cost < before:
            T, here, shown, damping = tried_T, tried, tried_shown, max(1e-4, damping / 10)
        elif damping > 1:
            break
        else:
            damping *= 10
    return Aligned(T, here, directions)


def solve(
    equations: NormalEquations,
    worth: float,
    recorded: Recorded,
    T: Pose,
    lever_m: float,
    damping: float,
    observable: float = OBSERVABLE,
    color: ColorEquations = NO_COLOR,
) -> tuple[NDArray[np.float64], int]:
    """The damped step (6,) from the pose T, 0 along directions that neither the points nor colour determine,
    and the number of those that they do."""
    scale = _scale(lever_m)
    known = equations.H + color.H / worth if worth > 0 else equations.H
    told = _told(known, lever_m, observable)
    H = told.T @ ((worth * equations.H + recorded.H + color.H) / np.outer(scale, scale)) @ told
    g = told.T @ ((worth * equations.g + recorded.gradient(T) + color.g) / scale)
    H[np.diag_indices_from(H)] *= 1 + damping
    return (told @ np.linalg.solve(H, -g)) / scale, told.shape[1]


def determined(H: NDArray[np.float64], lever_m: float, observable: float) -> NDArray[np.float64]:
    """The part of normal equations H (6, 6) along the directions that they determine, as for align; along the
    others it is 0."""
    told, scale = _told(H, lever_m, observable), _scale(lever_m)
    units = np.outer(scale, scale)
    return np.asarray(units * (told @ told.T @ (H / units) @ told @ told.T))


def _told(H: NDArray[np.float64], lever_m: float, observable: float) -> NDArray[np.float64]:
    """(6, n): orthogonal unit vectors along the directions that normal equations determine, in metres that a
    typical point is moved."""
    scale = _scale(lever_m)
    values, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    return np.asarray(vectors[:, values > observable * max(values[-1], 1e-12)])


def _scale(lever_m: float) -> NDArray[np.float64]:
    """Metres that a unit of each component of a step moves a typical point."""
    return np.array([1.0, 1.0, 1.0, lever_m, lever_m, lever_m])
