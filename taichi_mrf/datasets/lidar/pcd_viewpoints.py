"""PCD files with points in the world's frame, whose VIEWPOINT is the sensor's pose: one, or a folder of them.

A folder with a file of poses beside the clouds, or after a question mark, has points in the sensor's frame
instead (scan_folder.py).
"""

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset, Format
from taichi_mrf.datasets.lidar.clouds import natural
from taichi_mrf.datasets.lidar.pcd_file import read_pcd, read_pcd_header
from taichi_mrf.datasets.lidar.scan_folder import open_folder
from taichi_mrf.datasets.lidar.scans import SECONDS_PER_SCAN, RecordedScan, lidar_scans
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.system.files import is_file, is_folder

SUFFIX = ".pcd"
_AT_ORIGIN = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def recognises(path: Path) -> bool:
    """Whether a file is a PCD, or a folder has some."""
    return bool(_files(path))


def open_pcd(path: Path, options: ReadOptions) -> Dataset:
    """List the files in the order of the numbers in their names. Raises DatasetError, which names the file;
    also if all of several have the viewpoint that PCL writes where none is known."""
    files = _files(path)
    if len(files) > 1 and all(_is_at_origin(file) for file in files):
        raise DatasetError(
            f"{path}: the VIEWPOINT of all {len(files)} clouds is the origin, so their poses are not known; "
            "add a file of poses (T_world_sensor) beside them, for points in the sensor's frame"
        )
    scans = [
        RecordedScan(file.stem, SECONDS_PER_SCAN * i, partial(_read, file), str(file), f"{file}: VIEWPOINT")
        for i, file in enumerate(files)
    ]
    notes = [
        "VIEWPOINT is taken for the sensor's pose, and points for those of the world's frame",
        f"no stamps: assumed {SECONDS_PER_SCAN:g} s from one scan to the next",
    ]
    name = path.name if is_folder(path) else path.stem
    return lidar_scans(name, scans, notes, 0, options)


def _files(path: Path) -> list[Path]:
    if is_folder(path):
        return sorted((each for each in path.iterdir() if _is_pcd(each)), key=natural)
    return [path] if _is_pcd(path) else []


def _is_pcd(path: Path) -> bool:
    return path.suffix.lower() == SUFFIX and is_file(path)


def _is_at_origin(file: Path) -> bool:
    try:
        return read_pcd_header(file).viewpoint == _AT_ORIGIN
    except DatasetError:  # reading the scan reports it
        return False


def _read(file: Path) -> tuple[NDArray[np.float64], Pose]:
    points_world_m, T_world_sensor = read_pcd(file)
    T_sensor_world = inverse(T_world_sensor)
    with np.errstate(invalid="ignore", over="ignore"):
        return points_world_m @ T_sensor_world[:3, :3].T + T_sensor_world[:3, 3], T_world_sensor


FORMAT = Format(
    name="PCD",
    looks_for="*.pcd with VIEWPOINT",
    recognises=recognises,
    open=open_pcd,
    open_with_query=open_folder,
)
