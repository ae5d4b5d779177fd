"""How far a trajectory is from the true one: after rigid alignment, anchored at the first frame, by steps.

J. Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems" (IROS 2012): the absolute error is
what is left when one trajectory is laid on the other by the best rigid motion. Anchored, the two agree at
the first frame, so that the error of the last one is the drift of the whole path. The error of a step
compares motions from frame to frame, which shows where drift arises.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ArgumentError
from taichi_mrf.geometry.poses import Pose, inverse, tangent_norms

Trajectory = Mapping[float, Pose]
"""T_world_camera, (4, 4), by stamp in seconds, or by the index of the frame."""


@dataclass(frozen=True)
class TrajectoryError:
    """Errors of the positions of ``frames`` poses, in metres: ``rms_m`` and ``largest_m`` after rigid
    alignment, ``anchored_rms_m`` and ``anchored_largest_m`` with the first poses laid on each other.
    ``end_m`` and ``end_rad`` are the last pose's, anchored."""

    frames: int
    rms_m: float
    largest_m: float
    anchored_rms_m: float
    anchored_largest_m: float
    end_m: float
    end_rad: float


def trajectory_error(estimated: Trajectory, true: Trajectory, largest_gap: float = 0.0) -> TrajectoryError:
    """The error of the estimated poses that have a true one at most ``largest_gap`` away in time.

    Raises ArgumentError if there are none.
    """
    pairs = list(associated(estimated, true, largest_gap).values())
    if not pairs:
        raise ArgumentError("estimated: none of its poses has a true pose at the same time")
    ours, theirs = np.array(pairs).swapaxes(0, 1)
    aligned = _distances(rigid_alignment(ours[:, :3, 3], theirs[:, :3, 3]), ours, theirs)
    T_anchored = theirs[0] @ inverse(ours[0])
    anchored = _distances(T_anchored, ours, theirs)
    end_rad, end_m = tangent_norms(theirs[-1], T_anchored @ ours[-1])
    return TrajectoryError(
        frames=len(pairs),
        rms_m=_rms(aligned),
        largest_m=float(aligned.max()),
        anchored_rms_m=_rms(anchored),
        anchored_largest_m=float(anchored.max()),
        end_m=end_m,
        end_rad=end_rad,
    )


def associated(
    estimated: Trajectory, true: Trajectory, largest_gap: float = 0.0
) -> dict[float, tuple[Pose, Pose]]:
    """Each estimated pose with the true one that is nearest in time, in the order of time; poses without a
    true one within ``largest_gap`` are left out."""
    times = np.array(sorted(true))
    if not len(times):
        return {}
    pairs = {}
    for time in sorted(estimated):
        after = min(int(np.searchsorted(times, time)), len(times) - 1)
        nearest = min(times[max(0, after - 1)], times[after], key=lambda other: abs(other - time))
        if abs(nearest - time) <= largest_gap:
            pairs[time] = (estimated[time], true[nearest])
    return pairs


def step_errors(estimated: Trajectory, true: Trajectory) -> dict[float, float]:
    """By how many metres the camera's motion since the estimated pose before differs from the true motion,
    for each estimated pose with a true one at the same time, but for the first."""
    pairs = associated(estimated, true)
    errors = {}
    for before, time in zip(list(pairs)[:-1], list(pairs)[1:], strict=True):
        (a, true_a), (b, true_b) = pairs[before], pairs[time]
        errors[time] = tangent_norms(inverse(true_a) @ true_b, inverse(a) @ b)[1]
    return errors


def rigid_alignment(points: NDArray[np.float64], onto: NDArray[np.float64]) -> Pose:
    """The rigid motion, (4, 4), that takes points (N, 3) to others (N, 3), least squares of distances.

    S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns" (1991),
    without scale. Points on a line leave the rotation about it open; one is chosen.
    """
    middle, middle_onto = points.mean(axis=0), onto.mean(axis=0)
    # Eq. (38) to (40): the rotation from the covariance's singular vectors, never a reflection.
    U, _, Vt = np.linalg.svd((onto - middle_onto).T @ (points - middle))
    handed = np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    T = np.eye(4)
    T[:3, :3] = U @ handed @ Vt
    T[:3, 3] = middle_onto - T[:3, :3] @ middle
    return T


def _distances(T: Pose, estimated: NDArray[np.float64], true: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) metres between the positions of moved poses (N, 4, 4) and the true ones."""
    positions = estimated[:, :3, 3] @ T[:3, :3].T + T[:3, 3]
    return np.asarray(np.linalg.norm(positions - true[:, :3, 3], axis=1))


def _rms(errors: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(errors**2)))
