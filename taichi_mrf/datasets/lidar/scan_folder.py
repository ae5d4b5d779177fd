"""A folder of point clouds with their poses, or one PCD.

Each scan is a file (.npz, .ply, .pcd, .las, .laz or .bin). ``?poses=FILE`` after the folder's name takes the
poses from another file. Clouds without a pose are left out and counted. How poses and scans go together:
scan_poses.py. PCDs without a file of poses have theirs in VIEWPOINT. Whether points are in the sensor's frame
or in the world's is found by what fits (registered.py), else they are the sensor's, and the world's with
VIEWPOINT; ``?points=sensor`` and ``?points=world`` say so.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.values import check_field
from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.conventions import Conventions
from taichi_mrf.datasets.entries import CLOUD_PLACES
from taichi_mrf.datasets.hints import unread_poses
from taichi_mrf.datasets.lidar.clouds import READERS, is_cloud, natural, read_cloud
from taichi_mrf.datasets.lidar.pcd_file import read_pcd_header
from taichi_mrf.datasets.lidar.registered import MOST_HIDDEN, finite, hidden, in_world, of_sensor
from taichi_mrf.datasets.lidar.scan_poses import POSES_NPZ, ScanPose, find_poses, poses_of
from taichi_mrf.datasets.lidar.scans import SECONDS_PER_SCAN, RecordedScan, lidar_scans
from taichi_mrf.datasets.mended import pose_of
from taichi_mrf.datasets.options import ReadOptions, parse_options
from taichi_mrf.errors import DatasetError, naming
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.system.files import is_file, is_folder

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
    return clouds[0].suffix.lower() == PCD or (is_folder(path) and (len(clouds) > 1 or _poses_beside(path)))


def open_folder(path: Path, query: str, options: ReadOptions) -> Dataset:
    """List the clouds in the order of their stamps. Raises DatasetError, which names the folder
    or the file."""
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
            world, frame = _frame_of(posed, found, poses is None, options.conventions)
        notes += frame
    scans = [
        RecordedScan(
            cloud.stem,
            pose.stamp,
            pose.read,
            pose.source,
            partial(_points, cloud, world, options.conventions),
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
    return lidar_scans(path.name if is_folder(path) else path.stem, scans, notes, dropped, options)


def clouds_of(folder: Path) -> list[Path]:
    """The clouds in a folder, or in the one below it that has some, all of the kind of the first. A file
    is one itself."""
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


def _poses_beside(folder: Path) -> bool:
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
            "tell from where they were taken; ?points=sensor says that the origin is the sensor's place"
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
    clouds: list[Path], poses: dict[Path, ScanPose], viewpoints: bool, conventions: Conventions
) -> tuple[bool, list[str]]:
    """True if points are in the world's frame, as those of PCDs with ``viewpoints`` are unless others fit
    better, and a note where it is not as documented. Raises DatasetError for poses in other
    ``conventions``."""
    found = in_world(
        len(clouds), lambda i: pose_of(poses[clouds[i]].read(), conventions), lambda i: read_cloud(clouds[i])
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


def _points(cloud: Path, world: bool, conventions: Conventions, T_recorded: Pose) -> NDArray[np.float64]:
    """The points of a file in the sensor's frame, into which those of the ``world``'s are taken."""
    points_m = read_cloud(cloud)
    return of_sensor(points_m, pose_of(T_recorded, conventions)) if world else points_m
