"""The time lag between images and motion capture, from how fast the board moves in either.

The angular speed of the board relative to the camera is the same wherever the markers sit on either body;
the linear speed nearly so. The lag is where the speeds of the two streams agree best (MRFMap, section IV-C).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.calibration.options import MotionCaptureConfig
from taichi_mrf.datasets.timed_poses import TimedPoses
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import inverses, rotation_vectors

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
            "the board does not move in the images as in motion capture: their speeds correlate by no more "
            f"than {best.correlation:.2f}, at a lag of {best.seconds:.3f} s"
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
