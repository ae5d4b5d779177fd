"""A folder of point clouds in the sensor's frame with their poses.

Each scan is a file (.npz, .ply, .pcd, .las, .laz or .bin). ``?poses=FILE`` after the folder's name takes the
poses from another file. Clouds without a pose are left out and counted. How poses and scans go together:
scan_poses.py.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset, Format
from taichi_mrf.datasets.lidar.clouds import READERS, is_cloud, natural, read_cloud
from taichi_mrf.datasets.lidar.scan_poses import POSES_NPZ, ScanPose, find_poses, poses_of
from taichi_mrf.datasets.lidar.scans import RecordedScan, lidar_scans
from taichi_mrf.datasets.options import ReadOptions, parse_options
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.system.files import is_file, is_folder

PLACES = ("", "scans", "clouds", "lidar", "velodyne", "pcd", "ply", "las")
"""Where clouds are in a folder."""


@dataclass(frozen=True)
class FolderOptions:
    """The options after the name of a folder of scans."""

    poses: str = ""
    """The file of the sensor's poses."""


def recognises(path: Path) -> bool:
    """Whether a folder holds clouds with poses beside them, or several clouds without. PCDs without know
    where they were taken (pcd_viewpoints.py)."""
    if not is_folder(path):
        return False
    clouds = clouds_of(path)
    if not clouds or not is_cloud(clouds[0]):
        return False
    return _poses_beside(path) or (len(clouds) > 1 and clouds[0].suffix.lower() != ".pcd")


def open_folder(path: Path, query: str, options: ReadOptions) -> Dataset:
    """List the clouds in the order of their stamps. Raises DatasetError, which names the folder
    or the file."""
    chosen = parse_options(FolderOptions, query, str(path))
    clouds = clouds_of(path)
    poses = Path(chosen.poses) if chosen.poses else find_poses(path)
    if poses is None:
        raise DatasetError(
            f"{path}: no poses for its {len(clouds)} scans; add {POSES_NPZ} or a file of poses, or name one: "
            "?poses=FILE"
        )
    found, notes = poses_of(poses, clouds, options)
    scans = [_scan(cloud, found[cloud]) for cloud in clouds if cloud in found]
    scans.sort(key=lambda scan: scan.stamp)
    if not scans:
        raise DatasetError(f"{poses}: has a pose for none of the {len(clouds)} scans in {path}")
    dropped = len(clouds) - len(scans)
    if dropped:
        notes.append(f"{dropped} of {len(clouds)} scans dropped: {poses.name} has no pose for them")
    return lidar_scans(path.name, scans, notes, dropped, options)


def clouds_of(folder: Path) -> list[Path]:
    """The clouds in a folder, or in the one below it that has some, all of the kind of the first."""
    for place in PLACES:
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


def _scan(cloud: Path, pose: ScanPose) -> RecordedScan:
    def read() -> tuple[NDArray[np.float64], Pose]:
        return read_cloud(cloud), pose.read()

    return RecordedScan(cloud.stem, pose.stamp, read, str(cloud), pose.source)


FORMAT = Format(
    name="lidar scans",
    looks_for=f"scan-NNN.npz (xyz), *.ply, *.pcd, *.las or *.bin with {POSES_NPZ} or a file of poses",
    recognises=recognises,
    open=lambda path, options: open_folder(path, "", options),
    open_with_query=open_folder,
)
