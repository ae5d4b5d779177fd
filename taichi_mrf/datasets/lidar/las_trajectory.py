"""A LAS or LAZ file of a whole survey with the path of the lidar: ``survey.laz?poses=FILE``.

Points are in the world's frame, and each has the time at which it was measured (``gps_time``). They are
grouped into scans of ``seconds`` (a tenth of one). The pose of a scan is that at its middle, and each ray
goes from where the lidar was at the time of its point, interpolated in a file of
``stamp tx ty tz qx qy qz qw`` lines, by the clock of the points. A file beside the points with their name is
found by itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.values import check_field
from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.lidar.las_file import read_timed_las
from taichi_mrf.datasets.lidar.scan_folder import TEXTS
from taichi_mrf.datasets.lidar.scans import LIDAR_SIGMA_M, SECONDS_PER_SCAN, RecordedScan, lidar_scans
from taichi_mrf.datasets.options import ReadOptions, parse_options
from taichi_mrf.datasets.timed_poses import TimedPoses, largest_gap, read_timed_poses, within_gap
from taichi_mrf.datasets.trajectories import is_trajectory
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.system.files import is_file

_MOST_SCANS = 1 << 40


@dataclass(frozen=True)
class SurveyOptions:
    """The options after the name of a file."""

    poses: str = ""
    """The file of the lidar's poses in TUM's layout."""

    seconds: float = SECONDS_PER_SCAN
    """The length of a scan."""

    def __post_init__(self) -> None:
        check_field(self.seconds > 0, "seconds", f"must be positive, not {self.seconds:g}")


def open_survey(path: Path, query: str, options: ReadOptions) -> Dataset:
    """Read the points and put them into scans, in the order of time. Raises DatasetError, which names the
    file, if it cannot be read, its points have no times, or none of them has a pose."""
    chosen = parse_options(SurveyOptions, query, str(path))
    poses_path = Path(chosen.poses) if chosen.poses else _poses_beside(path)
    if poses_path is None:
        raise DatasetError(
            f"{path}: contains lidar point clouds without poses; ?poses=FILE names the path of the lidar, "
            "lines of stamp tx ty tz qx qy qz qw by the clock of its gps_time"
        )
    trajectory = read_timed_poses(poses_path)
    points_m, times = read_timed_las(path)
    gap, groups = largest_gap(options), _groups(path, times, chosen.seconds)
    stamps = [0.5 * float(times[members[0]] + times[members[-1]]) for _, members in groups]
    at = [trajectory.at(stamp, gap) for stamp in stamps]
    posed, notes = within_gap(stamps, at, gap, "scans", str(path), str(poses_path), trajectory.stamps)
    scans = []
    for i, T_world_lidar in posed:
        number, members = groups[i]
        read = partial(_in_lidar_frame, points_m, members)
        starts = partial(_starts, trajectory, times, members, T_world_lidar, gap)
        pose = T_world_lidar, str(poses_path)
        scans.append(RecordedScan(f"{number:06d}", stamps[i], *pose, read, str(path), starts))
    notes.insert(0, f"{len(times)} points in {len(scans)} scans of {chosen.seconds:g} s")
    return lidar_scans(path.stem, scans, notes, len(groups) - len(scans), options)


def _poses_beside(path: Path) -> Path | None:
    """The file of poses that is called as the points are."""
    beside = (path.with_suffix(suffix) for suffix in TEXTS)
    return next((file for file in beside if is_file(file) and is_trajectory(file)), None)


def _groups(
    path: Path, times: NDArray[np.float64], seconds: float
) -> Sequence[tuple[int, NDArray[np.int64]]]:
    """The points of each scan that has some, in the order of time, and its number. Raises DatasetError for
    times that are none."""
    if len(times) == 0:
        raise DatasetError(f"{path}: contains no point")
    if not np.isfinite(times).all() or (times.max() - times.min()) / seconds > _MOST_SCANS:
        raise DatasetError(
            f"{path}: its gps_time goes from {times.min():g} to {times.max():g} s, which is no time"
        )
    order = np.argsort(times, kind="stable")
    numbers = ((times[order] - times[order[0]]) / seconds).astype(np.int64)
    ends = np.flatnonzero(np.diff(numbers)) + 1
    groups = np.split(order, ends)
    return [(int(numbers[i]), members) for i, members in zip([0, *ends], groups, strict=True)]


def _in_lidar_frame(
    points_m: NDArray[np.float64], members: NDArray[np.int64], T_world_lidar: Pose
) -> NDArray[np.float64]:
    """The points of a scan in the lidar's frame."""
    T_lidar_world = inverse(T_world_lidar)
    return points_m[members] @ T_lidar_world[:3, :3].T + T_lidar_world[:3, 3]


def _starts(
    trajectory: TimedPoses,
    times: NDArray[np.float64],
    members: NDArray[np.int64],
    T_world_lidar: Pose,
    gap: float,
) -> NDArray[np.float64]:
    """Place of the lidar when it measured each point of a scan, (n, 3) in its frame at the scan's pose; that
    pose itself where it was not known, and for all if it moved less than its noise."""
    poses, known = trajectory.between(times[members], 2 * gap)  # a pose within the gap on both sides
    if not known.any():
        return np.zeros((len(members), 3))
    T_lidar_world = inverse(T_world_lidar)
    starts = poses[:, :3, 3] @ T_lidar_world[:3, :3].T + T_lidar_world[:3, 3]
    moved = known & (np.ptp(starts[known], axis=0).max() > LIDAR_SIGMA_M)
    return np.where(moved[:, None], starts, 0.0)
