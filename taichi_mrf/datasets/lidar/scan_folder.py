"""A folder of point clouds with their poses, or one PCD.

Each scan is a file (.npz, .ply, .pcd, .las, .laz or .bin). ``?poses=FILE`` after the folder's name takes the
poses from another file: poses.npz, or a text file in one of the layouts of trajectories.py. Poses with a
number go to the scan with that number in its name, poses with stamps to the scan whose name is a time, and
poses with neither to the scans in the order of their names. Clouds without a pose are left out and counted.
PCDs without a file of poses have theirs in VIEWPOINT. Whether points are in the sensor's frame or in the
world's is found by what fits (registered.py), else they are the sensor's, and the world's with VIEWPOINT;
``?points=sensor`` and ``?points=world`` say so.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.values import check_field
from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.derived import pose_of
from taichi_mrf.datasets.entries import CLOUD_PLACES
from taichi_mrf.datasets.hints import unread_poses
from taichi_mrf.datasets.lidar.clouds import READERS, is_cloud, layout_notes, read_cloud, read_pcd_header
from taichi_mrf.datasets.lidar.registered import MOST_HIDDEN, finite, hidden, in_world, read_of_sensor
from taichi_mrf.datasets.lidar.scans import SECONDS_PER_SCAN, RecordedScan, lidar_scans
from taichi_mrf.datasets.options import ReadOptions, parse_options
from taichi_mrf.datasets.recording import natural, number_in
from taichi_mrf.datasets.stereo.matching import read_times
from taichi_mrf.datasets.timed_poses import read_timed_poses
from taichi_mrf.datasets.trajectories import TEXTS, in_seconds, is_trajectory, read_trajectory
from taichi_mrf.errors import DatasetError, naming
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.system.files import is_file, is_folder
from taichi_mrf.system.npz_file import open_npz

POSES_NPZ = "poses.npz"
_MATRICES = ("T_world_lidar", "T_world_sensor", "T_world_camera")


@dataclass(frozen=True)
class ScanPose:
    """Time of a scan, in seconds, and its pose; ``read`` gives T_world_sensor (4, 4), or raises
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
                "names are not stamps; name them by their times in seconds or nanoseconds, or write one pose "
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
            f"{path}: contains {poses} poses for one cloud, {clouds[0].name}, so the sensor's pose for "
            "each of its points is unknown: give each scan a file of its own, with its pose, or a .las "
            "with gps_time"
        )


def _numbers_of(path: Path, clouds: Sequence[Path]) -> list[int]:
    """The numbers in the names of scans, by which they find their poses in a file."""
    numbers = [number for cloud in clouds if (number := number_in(cloud.stem)) is not None]
    if len(set(numbers)) < len(clouds):
        raise DatasetError(
            f"{path}: its poses go by the numbers of scans, but names such as {clouds[0].name} have no "
            "number, or one number twice"
        )
    return numbers


def _from_npz(path: Path, clouds: Sequence[Path]) -> tuple[dict[Path, ScanPose], list[str]]:
    with open_npz(path, DatasetError, "a readable npz file") as file:
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
    timed, where, clouds = read_timed_poses(path), str(path), list(stamps)
    posed, _ = timed.posed(list(stamps.values()), options, "scans", where, "by their names")
    return {clouds[i]: ScanPose(stamps[clouds[i]], partial(as_pose, pose), where) for i, pose in posed}


PCD = ".pcd"
SENSOR, WORLD = "sensor", "world"
_AT_ORIGIN = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
"""The VIEWPOINT that PCL writes where none is known."""


@dataclass(frozen=True)
class FolderOptions:
    """The options after the name of a folder of scans."""

    poses: str = ""
    """The file of the sensor's poses."""

    points: str = ""
    """The frame of the points, sensor or world; by default what fits."""

    def __post_init__(self) -> None:
        known = self.points in ("", SENSOR, WORLD)
        check_field(known, "points", f"must be {SENSOR} or {WORLD}, not {self.points!r}")


def recognises(path: Path) -> bool:
    """True if it is a PCD, or a folder that holds some, clouds with poses beside them, or several without."""
    clouds = clouds_of(path)
    if not clouds or not is_cloud(clouds[0]):
        return False
    return clouds[0].suffix.lower() == PCD or (is_folder(path) and (len(clouds) > 1 or _has_poses(path)))


def open_folder(path: Path, query: str, options: ReadOptions) -> Dataset:
    """List the clouds in the order of their stamps. Raises DatasetError, which names folder or file."""
    chosen = parse_options(FolderOptions, query, str(path))
    clouds = clouds_of(path)
    poses = Path(chosen.poses) if chosen.poses else find_poses(path) if is_folder(path) else None
    if poses is not None:
        found, notes = poses_of(poses, clouds, options)
    elif clouds[0].suffix.lower() == PCD:
        found = _viewpoints(path, clouds, chosen.points == SENSOR)
        notes = [f"no stamps: assumed {SECONDS_PER_SCAN:g} s from one scan to the next"]
    else:
        raise DatasetError(
            f"{path}: no poses for its {len(clouds)} scans; add {POSES_NPZ} or a file of poses, or name one: "
            "?poses=FILE. Points in the world's frame need the sensor's poses too: rays begin there"
            f"{unread_poses(path) if is_folder(path) else ''}"
        )
    posed = [cloud for cloud in clouds if cloud in found]
    world = chosen.points == WORLD
    if not chosen.points:
        with naming(str(path)):
            world, frame = _frame_of(posed, found, poses is None, options)
        notes += frame
    scans = [
        RecordedScan(
            cloud.stem,
            pose.stamp,
            pose.read,
            pose.source,
            partial(read_of_sensor, partial(_read_metres, cloud, options), world, options.conventions),
            str(cloud),
        )
        for cloud in posed
        for pose in (found[cloud],)
    ]
    scans.sort(key=lambda scan: scan.stamp)
    if not scans:
        raise DatasetError(f"{poses}: has a pose for none of the {len(clouds)} scans in {path}")
    dropped = len(clouds) - len(scans)
    if dropped and poses is not None:
        notes.append(f"{dropped} of {len(clouds)} scans dropped: {poses.name} has no pose for them")
    name = path.name if is_folder(path) else path.stem
    notes += layout_notes(posed)
    return lidar_scans(name, scans, notes, dropped, options, takes_scale=True)


def _read_metres(cloud: Path, options: ReadOptions) -> NDArray[np.float64]:
    """The points of a cloud, in the unit of ``options.depth_scale``. Raises DatasetError."""
    points = read_cloud(cloud)
    return points if options.depth_scale is None else points / options.depth_scale


def clouds_of(folder: Path) -> list[Path]:
    """The clouds in a folder or one below it, all of the kind of the first. A file is one itself."""
    if is_file(folder):
        return [folder] if folder.suffix.lower() in READERS else []
    for place in CLOUD_PLACES:
        if not is_folder(folder / place):
            continue
        files = [
            path
            for path in (folder / place).iterdir()
            if path.suffix.lower() in READERS and path.name != POSES_NPZ and is_file(path)
        ]
        if files:
            files.sort(key=natural)
            return [path for path in files if path.suffix.lower() == files[0].suffix.lower()]
    return []


def _has_poses(folder: Path) -> bool:
    try:
        return find_poses(folder) is not None
    except DatasetError:  # several, which opening reports
        return True


def _viewpoints(path: Path, clouds: list[Path], at_origin: bool) -> dict[Path, ScanPose]:
    """The sensor's poses in the headers of PCDs. Raises DatasetError if they are not known: all of several
    are the origin, or the points of one cannot have been measured there; not if the caller says that they
    were (``at_origin``)."""
    unknown = not at_origin and all(map(_is_at_origin, clouds))
    if unknown and len(clouds) == 1:
        try:
            unknown = hidden(finite(read_cloud(clouds[0])), np.zeros(3)) > MOST_HIDDEN
        except DatasetError:  # reading the scan reports it
            unknown = False
    if unknown:
        what = f"the VIEWPOINT of all {len(clouds)} clouds is" if len(clouds) > 1 else "its VIEWPOINT is"
        why = "" if len(clouds) > 1 else ", from where its points cannot be seen, as they hide each other"
        raise DatasetError(
            f"{path}: {what} the origin{why}, so their poses are not known; name a file of poses "
            "(T_world_sensor), one for each scan: ?poses=FILE. A map of many scans in one cloud does not "
            "hold their poses. If the origin is the sensor's position, pass ?points=sensor"
        )
    return {
        cloud: ScanPose(SECONDS_PER_SCAN * i, partial(_viewpoint, cloud), f"{cloud}: VIEWPOINT")
        for i, cloud in enumerate(clouds)
    }


def _is_at_origin(cloud: Path) -> bool:
    try:
        return read_pcd_header(cloud).viewpoint == _AT_ORIGIN
    except DatasetError:  # reading the scan reports it
        return False


def _viewpoint(cloud: Path) -> Pose:
    return read_pcd_header(cloud).T_world_sensor()


def _frame_of(
    clouds: list[Path], poses: dict[Path, ScanPose], viewpoints: bool, options: ReadOptions
) -> tuple[bool, list[str]]:
    """True if points are in the world's frame, as those of PCDs with ``viewpoints`` are unless others fit
    better, and a note where it is not as documented. Raises DatasetError for poses in other conventions."""
    found = in_world(
        len(clouds),
        lambda i: pose_of(poses[clouds[i]].read(), options.conventions),
        lambda i: _read_metres(clouds[i], options),
    )
    if found is None or found == viewpoints:
        told = ["VIEWPOINT is taken for the sensor's pose, and points for those of the world's frame"]
        return viewpoints, told if viewpoints else []
    frames = (WORLD, SENSOR) if found else (SENSOR, WORLD)
    why = "as they are" if found else "at their poses"
    return found, [
        f"points are in the {frames[0]}'s frame: clouds fit together {why}; rays begin at the sensor's "
        f"poses. ?points={frames[1]} takes them for the {frames[1]}'s"
    ]
