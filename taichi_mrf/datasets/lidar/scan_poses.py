"""The poses of scans in files: poses.npz, or a text file in one of the layouts of trajectories.py.

Poses with a number go to the scan with that number in its name, poses with stamps to the scan whose name is a
time, and poses with neither to the scans in the order of their names.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from taichi_mrf.datasets.lidar.clouds import number_of
from taichi_mrf.datasets.lidar.scans import SECONDS_PER_SCAN
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.datasets.pose_text import in_seconds
from taichi_mrf.datasets.stereo.pairs import read_times
from taichi_mrf.datasets.timed_poses import largest_gap, read_timed_poses, within_gap
from taichi_mrf.datasets.trajectories import is_trajectory, read_trajectory
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.system.files import is_file
from taichi_mrf.system.npz_file import open_npz

POSES_NPZ = "poses.npz"
TEXTS = (".txt", ".log", ".tum", ".csv", ".freiburg")
_MATRICES = ("T_world_lidar", "T_world_sensor", "T_world_camera")


@dataclass(frozen=True)
class ScanPose:
    """When a scan was taken, in seconds, and from where; ``read`` gives T_world_sensor (4, 4), or raises
    KeyframeError."""

    stamp: float
    read: Callable[[], Pose]
    source: str


def find_poses(folder: Path) -> Path | None:
    """The file with the poses of a folder's scans. Raises DatasetError if there are several."""
    if is_file(folder / POSES_NPZ):
        return folder / POSES_NPZ
    found = [path for path in sorted(folder.iterdir()) if path.suffix in TEXTS and is_trajectory(path)]
    if len(found) > 1:
        names = ", ".join(path.name for path in found[:8])
        raise DatasetError(f"{folder}: contains several files of poses, {names}; choose one by ?poses=FILE")
    return found[0] if found else None


def poses_of(
    path: Path, clouds: Sequence[Path], options: ReadOptions
) -> tuple[dict[Path, ScanPose], list[str]]:
    """The pose of each cloud that has one, and notes. Raises DatasetError, which names the file and the line
    or the array, if it cannot be read or it is not clear which pose is whose."""
    if path.suffix == ".npz":
        return _from_npz(path, clouds)
    trajectory = read_trajectory(path)
    if trajectory.layout == "stamped":
        stamps = {cloud: stamp for cloud in clouds if (stamp := _stamp_of(cloud)) is not None}
        if len(stamps) == len(clouds):
            return _at_stamps(path, stamps, options), []
        _check_one_map(path, clouds, len(trajectory.poses))
        if len(trajectory.poses) != len(clouds):
            raise DatasetError(
                f"{path}: contains {len(trajectory.poses)} poses with stamps for {len(clouds)} scans, whose "
                "names are no stamps; name them by their times in seconds or nanoseconds, or write one pose "
                "for each"
            )
        return {
            cloud: ScanPose(pose.key, pose.T_world_camera, pose.source)
            for cloud, pose in zip(clouds, trajectory.poses, strict=True)
        }, []
    _check_one_map(path, clouds, len(trajectory.poses))
    if trajectory.layout == "rows" and len(trajectory.poses) == len(clouds):
        numbers = list(range(len(clouds)))
    else:
        numbers = _numbers_of(path, clouds)
    by_number = {int(pose.key): pose for pose in trajectory.poses}
    times = path.with_name("times.txt")
    seconds = read_times(times) if is_file(times) else []
    known = len(seconds) == len(trajectory.poses) > max(by_number)
    found = {
        cloud: ScanPose(
            seconds[number] if known else SECONDS_PER_SCAN * number, pose.T_world_camera, pose.source
        )
        for cloud, number in zip(clouds, numbers, strict=True)
        if (pose := by_number.get(number)) is not None
    }
    note = f"no stamps in {path.name}: assumed {SECONDS_PER_SCAN:g} s from one scan to the next"
    return found, [] if known else [note]


def _check_one_map(path: Path, clouds: Sequence[Path], poses: int) -> None:
    """Raise DatasetError for one cloud with many poses: from which were its points measured?"""
    if len(clouds) == 1 < poses:
        raise DatasetError(
            f"{path}: contains {poses} poses for one cloud, {clouds[0].name}, which does not tell from where "
            "each of its points was measured: give each scan a file of its own, with its pose, or a .las "
            "with gps_time"
        )


def _numbers_of(path: Path, clouds: Sequence[Path]) -> list[int]:
    """The numbers in the names of scans, by which they find their poses in a file."""
    numbers = [number for cloud in clouds if (number := number_of(cloud)) is not None]
    if len(set(numbers)) < len(clouds):
        raise DatasetError(
            f"{path}: its poses go by the numbers of scans, but names such as {clouds[0].name} have no "
            "number, or one number twice"
        )
    return numbers


def _from_npz(path: Path, clouds: Sequence[Path]) -> tuple[dict[Path, ScanPose], list[str]]:
    with open_npz(path, DatasetError, "an npz file that can be read") as file:
        name = next((name for name in _MATRICES if name in file), None)
        if name is None:
            raise DatasetError(
                f"{path}: contains no {', '.join(_MATRICES[:2])}, only {', '.join(file.names)}"
            )
        poses = file[name]
        if poses.dtype.kind not in "fiu" or poses.ndim != 3 or poses.shape[1:] not in ((4, 4), (3, 4)):
            raise DatasetError(f"{path}: {name} is {poses.dtype} {poses.shape}; expected (N, 4, 4)")
        count = len(poses)
        numbers = file.array("scan", "iu", (count,)) if "scan" in file else None
        stamps = file.array("stamp_s", "fiu", (count,)) if "stamp_s" in file else None
    if numbers is None and count != len(clouds):
        raise DatasetError(f"{path}: contains {count} poses and no array scan, for {len(clouds)} scans")
    notes = []
    if stamps is None:
        notes = [f"no stamp_s in {path.name}: assumed {SECONDS_PER_SCAN:g} s from one scan to the next"]
        stamps = SECONDS_PER_SCAN * (np.arange(count) if numbers is None else numbers)
    rows = range(count) if numbers is None else numbers.tolist()
    row_of = {int(number): row for row, number in enumerate(rows)}
    wanted = list(range(count)) if numbers is None else _numbers_of(path, clouds)
    found = {}
    for cloud, number in zip(clouds, wanted, strict=True):
        row = row_of.get(number)
        if row is not None:
            read = partial(as_pose, poses[row])
            found[cloud] = ScanPose(float(stamps[row]), read, f"{path}: {name} {row}")
    return found, notes


def _stamp_of(cloud: Path) -> float | None:
    """The time in seconds that is a file's name: seconds with a point, or ms, us or ns since 1970."""
    try:
        stamp = float(cloud.stem)
    except ValueError:
        return None
    if not np.isfinite(stamp):
        return None
    if cloud.stem.isdecimal():
        seconds = in_seconds(int(cloud.stem))
        return seconds if seconds < int(cloud.stem) else None
    return stamp


def _at_stamps(path: Path, stamps: dict[Path, float], options: ReadOptions) -> dict[Path, ScanPose]:
    """Each scan's pose, interpolated at its time, for those that have neighbours near enough."""
    timed, gap, clouds = read_timed_poses(path), largest_gap(options), list(stamps)
    at = [timed.at(stamp, gap) for stamp in stamps.values()]
    where = str(path)
    posed, _ = within_gap(list(stamps.values()), at, gap, "scans", where, "by their names", timed.stamps)
    return {clouds[i]: ScanPose(stamps[clouds[i]], partial(as_pose, pose), where) for i, pose in posed}
