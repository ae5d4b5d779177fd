"""Poses of marker bodies as ground truth: the pose of the chessboard in the camera, at the time of any depth
image.

Markers sit neither in the camera's optical centre nor in the board's first corner. Where they sit, and the
time lag to a fraction of a millisecond, are the values that put the corners found in the images where they
were found: T_camera_board(t) = T_camera_body M(t + lag) T_body_board, with M the board's body in the
camera's. The search starts from a linear hand-eye solution, and Gauss-Newton minimises the reprojection
error.

The first guess of the lag comes from speeds. The angular speed of the board relative to the camera is the
same wherever the markers sit on either body; the linear speed nearly so. The lag is where the speeds of the
two streams agree best (MRFMap, section IV-C).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.calibration.chessboard import BoardView, corner_points
from taichi_mrf.calibration.options import BoardConfig, MotionCaptureConfig
from taichi_mrf.datasets.timed_poses import TimedPoses
from taichi_mrf.errors import ConfigError, DatasetError
from taichi_mrf.geometry.poses import Pose, inverse, inverses, rotation_vectors, rotations
from taichi_mrf.sensor.camera import PinholeCamera

LEAST_PAIRS = 10
"""Pairs of successive views of the board without which a lag is not sought."""

_LONGEST_PAUSE = 5.0
"""Views further apart than this many median intervals give no speed."""

_STEPS_PER_INTERVAL = 4
_COARSEST_STEP_S, _FINEST_STEP_S = 0.02, 0.002


@dataclass(frozen=True)
class BodyPair:
    """Camera and board as motion capture follows them: two bodies whose markers may sit anywhere on them."""

    camera: TimedPoses
    board: TimedPoses

    def relative(
        self, times: NDArray[np.float64], largest_gap: float
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """The board's body in the camera's body at ``times`` (M,) of motion capture, (M, 4, 4), and
        where it is known."""
        T_world_camera, has_camera = self.camera.between(times, largest_gap)
        T_world_board, has_board = self.board.between(times, largest_gap)
        return inverses(T_world_camera) @ T_world_board, has_camera & has_board


@dataclass(frozen=True)
class Lag:
    """Seconds to add to an image's stamp to get the time of motion capture, and how well the speeds then
    agree: the mean of the correlations of angular and linear speed."""

    seconds: float
    correlation: float


def estimate_lag(
    stamps: NDArray[np.float64],
    T_camera_board: NDArray[np.float64],
    bodies: BodyPair,
    options: MotionCaptureConfig,
) -> Lag:
    """The lag to about a quarter of the interval between images. ``stamps`` (N,) ascend, poses (N, 4, 4).

    Raises DatasetError if there are too few views of the board, or if the streams do not move together.
    """
    interval = np.diff(stamps)
    usual = float(np.median(interval)) if len(interval) else 0.0
    pairs = np.flatnonzero((interval > 0) & (interval <= _LONGEST_PAUSE * usual))
    if len(pairs) < LEAST_PAIRS:
        raise DatasetError(
            f"the time lag needs {LEAST_PAIRS} views of the board in quick succession; there are {len(pairs)}"
        )
    in_images = _speeds(T_camera_board[pairs], T_camera_board[pairs + 1], interval[pairs])
    step = float(np.clip(usual / _STEPS_PER_INTERVAL, _FINEST_STEP_S, _COARSEST_STEP_S))
    count = int(np.ceil(options.largest_lag / step))
    best = Lag(0.0, -np.inf)
    for lag in step * np.arange(-count, count + 1):
        T_bodies, known = bodies.relative(stamps + lag, options.largest_gap)
        usable = known[pairs] & known[pairs + 1]
        if usable.sum() < max(LEAST_PAIRS, len(pairs) // 2):
            continue
        in_capture = _speeds(T_bodies[pairs], T_bodies[pairs + 1], interval[pairs])
        correlation = float(
            np.mean([_correlation(a[usable], b[usable]) for a, b in zip(in_images, in_capture, strict=True)])
        )
        if correlation > best.correlation:
            best = Lag(float(lag), correlation)
    if not np.isfinite(best.correlation):
        raise DatasetError(
            f"images ({stamps[0]:.3f} to {stamps[-1]:.3f} s) and motion capture "
            f"({bodies.board.stamps[0]:.3f} to {bodies.board.stamps[-1]:.3f} s) overlap too little"
        )
    if best.correlation < options.least_correlation:
        raise DatasetError(
            "the board's motion in the images does not match motion capture: their speeds correlate by no "
            f"more than {best.correlation:.2f}, at a lag of {best.seconds:.3f} s"
        )
    return best


def _speeds(
    first: NDArray[np.float64], second: NDArray[np.float64], seconds: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Angular (rad/s) and linear speed (m/s) from one pose to the next, each (N,)."""
    turn = rotation_vectors(np.swapaxes(first[:, :3, :3], 1, 2) @ second[:, :3, :3])
    way = second[:, :3, 3] - first[:, :3, 3]
    return np.linalg.norm(turn, axis=1) / seconds, np.linalg.norm(way, axis=1) / seconds


def _correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Pearson's correlation; 0 where one of the two does not change."""
    a, b = a - a.mean(), b - b.mean()
    scale = np.linalg.norm(a) * np.linalg.norm(b)
    return float(a @ b / scale) if scale > 1e-12 else 0.0


_PARAMETERS = 13
"""Six for where each body's markers sit, one for the lag."""

_ITERATIONS = 30
_DIFFERENCE = 1e-5
_CONVERGED = 1e-8
_LARGEST_RESIDUAL = 5.0
"""In largest_reprojection of the board: what the alignment may leave, RMS."""

_LARGEST_RATIO = 0.999
"""Of the second to the first singular value: above it rotations hardly differ (by some 3 degrees)."""


@dataclass(frozen=True)
class Alignment:
    """The link from motion capture to the images; ``lag`` and ``lag_error`` (one sigma) in seconds, to be
    added to an image's stamp; ``reprojection`` in pixels, RMS."""

    T_camera_body: Pose
    T_body_board: Pose
    lag: float
    lag_error: float
    reprojection: float
    correlation: float

    def T_camera_board(
        self, stamps: NDArray[np.float64], bodies: BodyPair, largest_gap: float
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """The board's pose at image stamps (N,), (N, 4, 4), and whether motion capture has it."""
        M, known = bodies.relative(np.asarray(stamps) + self.lag, largest_gap)
        return self.T_camera_body @ M @ self.T_body_board, known


def align(
    stamps: NDArray[np.float64],
    views: list[BoardView],
    bodies: BodyPair,
    board: BoardConfig,
    camera: PinholeCamera,
    options: MotionCaptureConfig,
) -> Alignment:
    """Find the lag and where the markers sit, from views of the board at ascending ``stamps``.

    Raises ConfigError for a board that looks the same upside down, DatasetError if the streams do not
    belong together or the views are too few or too alike.
    """
    if (board.columns + board.rows) % 2 == 0:
        raise ConfigError(
            f"board.columns: with motion capture the board must not look the same upside down: one of "
            f"{board.columns} and {board.rows} must be even and the other odd"
        )
    T_camera_board = np.stack([view.T_camera_board for view in views])
    lag = estimate_lag(stamps, T_camera_board, bodies, options)
    M, known = bodies.relative(stamps + lag.seconds, options.largest_gap)
    start = hand_eye(T_camera_board[known], M[known])
    problem = _Reprojection(
        stamps[known],
        np.stack([view.corners for view, has in zip(views, known, strict=True) if has]),
        bodies,
        corner_points(board),
        camera,
        options.largest_gap,
    )
    (T_camera_body, T_body_board, seconds), covariance, error = _gauss_newton(problem, (*start, lag.seconds))
    if not error <= _LARGEST_RESIDUAL * board.largest_reprojection:
        raise DatasetError(
            f"motion capture puts the board's corners {error:.1f} pixels (RMS) from where the images show "
            "them: check that both are of the same recording and that the markers did not slip"
        )
    return Alignment(
        T_camera_body, T_body_board, seconds, float(np.sqrt(covariance[-1, -1])), error, lag.correlation
    )


def hand_eye(T_camera_board: NDArray[np.float64], M: NDArray[np.float64]) -> tuple[Pose, Pose]:
    """T_camera_body and T_body_board so that T_camera_board = T_camera_body M T_body_board.

    The robot-world and hand-eye problem A X = Z B in closed form (Shah, "Solving the robot-world/hand-eye
    calibration problem using the Kronecker product", 2013). OpenCV 4 had it, OpenCV 5 has not.

    ``T_camera_board`` and ``M``, the board's body in the camera's body, are (N, 4, 4). Raises DatasetError
    if the board was not turned enough.
    """
    R_A, R_M = T_camera_board[:, :3, :3], M[:, :3, :3]
    # R_A R_X = R_Z R_M; with columns stacked, (R_M kron R_A) vec R_X = vec R_Z for every pose.
    kron = np.einsum("nij,nkl->ikjl", R_M, R_A).reshape(9, 9)
    U, s, Vt = np.linalg.svd(kron)
    if len(M) < 3 or s[1] > _LARGEST_RATIO * s[0]:
        raise DatasetError(
            "the views of the board do not determine where the markers sit; tilt the board about two axes"
        )
    R_X, R_Z = _rotation(Vt[0]), _rotation(U[:, 0])
    # R_A t_X - t_Z = R_Z t_M - t_A
    left = np.concatenate([R_A, np.repeat(-np.eye(3)[None], len(M), axis=0)], axis=2).reshape(-1, 6)
    right = (M[:, :3, 3] @ R_Z.T - T_camera_board[:, :3, 3]).ravel()
    t, *_ = np.linalg.lstsq(left, right, rcond=None)
    T_camera_body, T_board_body = np.eye(4), np.eye(4)
    T_camera_body[:3, :3], T_camera_body[:3, 3] = R_Z, t[3:]
    T_board_body[:3, :3], T_board_body[:3, 3] = R_X, t[:3]
    return T_camera_body, inverse(T_board_body)


def _rotation(stacked_columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation nearest to a matrix known up to a factor, its sign included."""
    matrix = stacked_columns.reshape(3, 3).T
    U, _, Vt = np.linalg.svd(matrix * np.sign(np.linalg.det(matrix)))
    return U @ Vt


_State = tuple[Pose, Pose, float]


@dataclass(frozen=True)
class _Reprojection:
    """Corners (N, corners, 2) seen at ``stamps`` (N,), and their prediction from a state."""

    stamps: NDArray[np.float64]
    corners: NDArray[np.float64]
    bodies: BodyPair
    points: NDArray[np.float64]
    camera: PinholeCamera
    largest_gap: float

    def residuals(self, state: _State) -> NDArray[np.float64]:
        """Projected minus seen, (N, corners * 2), in pixels."""
        T_camera_body, T_body_board, lag = state
        M, _ = self.bodies.relative(self.stamps + lag, self.largest_gap)
        T = T_camera_body @ M @ T_body_board
        seen = np.einsum("nij,cj->nci", T[:, :3, :3], self.points) + T[:, None, :3, 3]
        x, y, z = np.moveaxis(seen, -1, 0)
        z = np.maximum(z, 1e-3)
        u = self.camera.fx * x / z + self.camera.cx
        v = self.camera.fy * y / z + self.camera.cy
        return (np.stack([u, v], axis=-1) - self.corners).reshape(len(self.stamps), -1)


def _gauss_newton(problem: _Reprojection, state: _State) -> tuple[_State, NDArray[np.float64], float]:
    """Levenberg-damped Gauss-Newton; returns state, covariance of its parameters, and RMS error in pixels.

    Views whose corners lie far off (more than three times the median) count less, as in Huber's norm.
    """
    residuals = problem.residuals(state)
    damping = 1e-3
    for _ in range(_ITERATIONS):
        weight = _view_weights(residuals)
        J = _jacobian(problem, state, residuals)
        H = np.einsum("nki,n,nkj->ij", J, weight, J)
        g = np.einsum("nki,n,nk->i", J, weight, residuals)
        step = -np.linalg.solve(H + damping * np.diag(np.diag(H) + 1e-12), g)
        moved = _moved(state, step)
        new = problem.residuals(moved)
        if _cost(new, weight) < _cost(residuals, weight):
            state, residuals, damping = moved, new, max(damping / 10, 1e-9)
            if np.abs(step).max() < _CONVERGED:
                break
        elif damping > 1e6:
            break
        else:
            damping *= 10
    weight = _view_weights(residuals)
    per_corner = 2 * _cost(residuals, weight) / (float(weight.sum()) * residuals.shape[1])
    return state, _covariance(problem, state, residuals, weight), float(np.sqrt(per_corner))


def _covariance(
    problem: _Reprojection, state: _State, residuals: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Of the parameters, if views are independent and the corners of one view need not be: an error of
    motion capture moves them all together (the sandwich estimator, clustered by view)."""
    J = _jacobian(problem, state, residuals)
    bread = np.linalg.pinv(np.einsum("nki,n,nkj->ij", J, weight, J))
    scores = np.einsum("nki,n,nk->ni", J, weight, residuals)
    views = len(residuals)
    return bread @ (scores.T @ scores) @ bread * views / max(1, views - _PARAMETERS)


def _cost(residuals: NDArray[np.float64], weight: NDArray[np.float64]) -> float:
    return float(np.einsum("nk,n->", residuals**2, weight))


def _view_weights(residuals: NDArray[np.float64]) -> NDArray[np.float64]:
    size = np.sqrt(np.mean(residuals**2, axis=1))
    return np.minimum(1.0, 3 * np.median(size) / np.maximum(size, 1e-12))


def _jacobian(problem: _Reprojection, state: _State, residuals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivatives of the residuals by the parameters, (N, corners * 2, _PARAMETERS), by differences."""
    columns = [
        (problem.residuals(_moved(state, _DIFFERENCE * direction)) - residuals) / _DIFFERENCE
        for direction in np.eye(_PARAMETERS)
    ]
    return np.stack(columns, axis=-1)


def _moved(state: _State, step: NDArray[np.float64]) -> _State:
    T_camera_body, T_body_board, lag = state
    return _transform(step[:6]) @ T_camera_body, T_body_board @ _transform(step[6:12]), lag + float(step[12])


def _transform(step: NDArray[np.float64]) -> Pose:
    T = np.eye(4)
    T[:3, :3] = rotations(step[None, :3])[0]
    T[:3, 3] = step[3:]
    return T
