"""Check that the steps per metre of a recording's depth images agree with its poses.

A 16-bit image does not contain its unit. Between two poses some centimetres apart a surface moves in the
image by focal length * baseline / depth: only with the right scale do the depths of neighbouring frames
agree. Where a scale is assumed and not recorded, this decides between the usual ones; otherwise it warns.
What one frame says of the surfaces that another one saw is here too.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.errors import BackendError, DatasetError, KeyframeError
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.sensor.camera import PinholeCamera


class Projection(Protocol):
    """The part of a camera (sensor/camera.py) that is needed here."""

    def project(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Column, row and depth at which points (N, 3) are seen, (N, 3), NaN for those that no pixel sees."""


@dataclass(frozen=True)
class SeenAgain:
    """Points of one frame in another: the depths that they should have there and those that it measured, 0
    where it sees or measures nothing, and the ``rows`` and ``columns`` of the latter, -1 if it does not see
    the point; (N,) each."""

    expected: NDArray[np.float64]
    measured: NDArray[np.float64]
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]


def seen_again(
    points: NDArray[np.float64], T_second_first: Pose, second: NDArray[np.floating], camera: Projection
) -> SeenAgain:
    """Points (N, 3) of the first frame, in the frame of its camera, in a second depth image (H, W)."""
    expected, rows, columns = pixels_of(points @ T_second_first[:3, :3].T + T_second_first[:3, 3], camera)
    return SeenAgain(expected, np.where(rows >= 0, second[rows, columns], 0.0), rows, columns)


def pixels_of(
    points: NDArray[np.float64], camera: Projection
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """The depths (N,) at which points (N, 3) of the camera frame are seen, NaN for those that are not, and
    the rows and columns (N,), -1 for those."""
    u, v, expected = camera.project(points).T
    inside = ~np.isnan(expected)
    rows, columns = (np.where(inside, np.rint(each), -1).astype(np.int64) for each in (v, u))
    return expected, rows, columns


USUAL = (1000.0, 5000.0, 4000.0, 6553.5, 10000.0, 256.0)
"""Steps per metre of millimetres (Kinect, RealSense, Redwood), of TUM RGB-D and ICL-NUIM, of RealSense's
finer unit, of Replica, of tenths of millimetres, and of KITTI."""

PLAUSIBLE_MEDIAN_M = (0.1, 100.0)
"""A median depth outside this range is reported as implausible."""

_NO_METRES = 250.0
"""A median of floats above this is one of millimetres."""

_STEPS, _LONG_STEP_M = 8, 5.0
_PLACES = 4
_LEAST_BASELINE_M, _LARGEST_TURN = 0.1, 1.0
_FARTHEST_NEIGHBOUR = 60
_SAMPLES = 4000
_LEAST_SAMPLES = 200
_AGREES, _TIMES_BETTER, _TELLS = 0.03, 2.0, 0.001

Image = NDArray[np.floating]


@dataclass(frozen=True)
class Evidence:
    """``median`` is the median raw value of the images that were compared, None if all are empty.
    ``disagreement`` is, by steps per metre, the median relative difference of the depths of neighbouring
    frames; it is empty if no two frames can be compared."""

    median: float | None
    disagreement: dict[float, float]

    def better_than(self, steps_per_metre: float) -> float | None:
        """A scale with which neighbouring frames agree clearly better than with this one, or None."""
        if steps_per_metre not in self.disagreement:
            return None
        best = min(self.disagreement, key=self.disagreement.__getitem__)
        found, given = self.disagreement[best], self.disagreement[steps_per_metre]
        return best if found <= _AGREES and given >= max(_TIMES_BETTER * found, _TELLS) else None


def check_metres(depths: Sequence[Image], where: str) -> None:
    """Raise DatasetError, which begins with ``where``, if floats (H, W) are no plausible metres."""
    values = np.concatenate([depth[np.isfinite(depth) & (depth > 0)] for depth in depths] or [np.zeros(0)])
    median = float(np.median(values)) if len(values) else 0.0
    if median > _NO_METRES:
        raise DatasetError(
            f"{where}: the numbers have a median of {median:.4g}, too much for metres: pass "
            "--depth-scale 1000 if depth is in millimetres, --depth-scale 1 if it is in metres"
        )


def out_of_sight(dataset: Dataset) -> str:
    """Reason why neighbouring frames hardly overlap, if the sensor moves farther than it sees."""
    frames = range(0, len(dataset) - 1, max(1, len(dataset) // _STEPS))
    steps_m, far_m = [], []
    for i in frames:
        with suppress(DatasetError):
            steps_m.append(float(np.linalg.norm(dataset.pose(i + 1)[:3, 3] - dataset.pose(i)[:3, 3])))
    step_m = float(np.median(steps_m)) if steps_m else 0.0
    if step_m < _LONG_STEP_M:  # no frame need be read
        return ""
    for i in frames:
        with suppress(DatasetError, BackendError):  # a built-in scene may be opened before Taichi is started
            depth_m = dataset.read(i).depth_m
            far_m += [float(np.percentile(depth_m[depth_m > 0], 99))] if (depth_m > 0).any() else []
    if not far_m or step_m <= max(far_m):
        return ""
    return (
        f"the sensor moves {step_m:.3g} m from frame to frame, farther than it sees ({max(far_m):.3g} m), so "
        "that frames do not overlap: its poses may be in another unit than its depths, such as millimetres "
        "(--poses-are mm)"
    )


def gather(
    frames: int,
    read_pose: Callable[[int], Pose],
    read_steps: Callable[[int], Image],
    camera: PinholeCamera,
    candidates: Sequence[float],
) -> Evidence:
    """Compare neighbouring frames at a few places of a recording. ``read_steps`` gives the raw depth image
    (H, W) of a frame, 0 where there is no measurement. Frames that cannot be read (DatasetError,
    KeyframeError) are passed over."""
    medians, differences = [], []
    for first in np.unique(np.linspace(0, frames - 1, _PLACES + 1).astype(int)[:-1] if frames else []):
        try:
            T_first, steps = read_pose(int(first)), read_steps(int(first))
        except (DatasetError, KeyframeError):
            continue
        if steps.shape != camera.shape or not (steps > 0).any():
            continue
        medians.append(float(np.median(steps[steps > 0])))
        neighbour = _neighbour(int(first), frames, T_first, read_pose)
        if neighbour is None:
            continue
        second, T_second_first = neighbour
        try:
            other = read_steps(second)
        except DatasetError:
            continue
        if other.shape == camera.shape:
            found = [_difference(steps, other, T_second_first, camera, scale) for scale in candidates]
            if not all(np.isnan(found)):  # with a wrong scale the one may see nothing of the other
                differences.append(np.nan_to_num(found, nan=1.0))
    median = float(np.median(medians)) if medians else None
    if not differences:
        return Evidence(median, {})
    return Evidence(median, dict(zip(candidates, np.median(differences, axis=0).tolist(), strict=True)))


def _neighbour(
    first: int, frames: int, T_world_first: Pose, read_pose: Callable[[int], Pose]
) -> tuple[int, Pose] | None:
    """The next frame with a large enough baseline and a small enough turn, and T_second_first."""
    for second in range(first + 1, min(frames, first + _FARTHEST_NEIGHBOUR)):
        try:
            T = inverse(read_pose(second)) @ T_world_first
        except (DatasetError, KeyframeError):
            continue
        if np.linalg.norm(T[:3, 3]) >= _LEAST_BASELINE_M:
            turn = np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1))
            return (second, T) if turn <= _LARGEST_TURN else None
    return None


def _difference(
    first: Image, second: Image, T_second_first: Pose, camera: PinholeCamera, scale: float
) -> float:
    """The median of |expected - measured| / measured over the pixels of the first image that the second one
    sees too; NaN if they are few."""
    v, u = np.nonzero(first > 0)
    some = slice(None, None, max(1, len(v) // _SAMPLES))
    v, u = v[some], u[some]
    points = camera.directions(u, v) * (first[v, u] / scale)[:, None]
    seen = seen_again(points, T_second_first, second / scale, camera)
    both = seen.measured > 0
    if both.sum() < min(_LEAST_SAMPLES, len(v) // 4):
        return float("nan")
    return float(np.median(np.abs(seen.expected[both] - seen.measured[both]) / seen.measured[both]))
