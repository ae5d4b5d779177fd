"""Point clouds in files, by their endings: .npz, .ply, .pcd, .las, .laz, and KITTI's .bin."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.lidar.las_file import read_las
from taichi_mrf.datasets.lidar.pcd_file import read_pcd
from taichi_mrf.datasets.lidar.ply_file import read_ply_header, read_ply_points
from taichi_mrf.errors import DatasetError
from taichi_mrf.system.files import read_bytes
from taichi_mrf.system.npz_file import NpzFile, open_npz

ARRAYS = ("points_m", "points", "xyz")
"""Arrays of points (N, 3) in metres in an npz; xyz_2mm are steps of 2 mm."""

_STEPS = re.compile(r"(?:xyz|points)_(\d+)mm")
_VELODYNE_BYTES = 16


def read_cloud(path: Path) -> NDArray[np.float64]:
    """The points of a file, (N, 3) in metres, as they are in it, NaN included. Raises DatasetError, which
    names the file, if it is missing or damaged."""
    return READERS[path.suffix.lower()](path)


def is_cloud(path: Path) -> bool:
    """Whether a file may hold a scan, by its ending and its first bytes; a damaged one may."""
    suffix = path.suffix.lower()
    if suffix not in READERS:
        return False
    try:
        if suffix == ".npz":
            with open_npz(path, DatasetError, "points") as file:
                return _array_name(file) is not None
        return suffix != ".ply" or read_ply_header(path).faces == 0
    except DatasetError:
        return True


def _npz_points(path: Path) -> NDArray[np.float64]:
    with open_npz(path, DatasetError, "an npz file that can be read") as file:
        name = _array_name(file)
        if name is None:
            held = ", ".join(file.names) or "nothing"
            raise DatasetError(f"{path}: contains no points ({', '.join(ARRAYS)} or xyz_2mm), only {held}")
        points = file[name]
        if points.ndim != 2 or points.shape[1] < 3 or points.dtype.kind not in "fiu":
            raise DatasetError(f"{path}: {name} is {points.dtype} {points.shape}; expected numbers (N, 3)")
        step = _STEPS.fullmatch(name)
        return points[:, :3].astype(np.float64) * (1.0 if step is None else int(step[1]) / 1000)


def _array_name(file: NpzFile) -> str | None:
    return next((name for name in file.names if name in ARRAYS or _STEPS.fullmatch(name)), None)


def _velodyne_points(path: Path) -> NDArray[np.float64]:
    """KITTI's: x y z and reflectance of each point, as little-endian float32."""
    data = read_bytes(path, DatasetError, "the scan is missing")
    if len(data) % _VELODYNE_BYTES:
        raise DatasetError(
            f"{path}: has {len(data)} bytes, which is no whole number of points of {_VELODYNE_BYTES} bytes"
        )
    return np.frombuffer(data, "<f4").reshape(-1, 4)[:, :3].astype(np.float64)


def _pcd_points(path: Path) -> NDArray[np.float64]:
    return read_pcd(path)[0]


READERS: dict[str, Callable[[Path], NDArray[np.float64]]] = {
    ".npz": _npz_points,
    ".ply": read_ply_points,
    ".pcd": _pcd_points,
    ".bin": _velodyne_points,
    ".las": read_las,
    ".laz": read_las,
}
"""What reads a file, by its ending."""


def natural(path: Path) -> tuple[list[tuple[int, str]], str]:
    """A key that orders names by the numbers in them: scan-9 before scan-10."""
    words = re.split(r"(\d+)", path.stem)
    return [(int(word), "") if word.isdecimal() else (-1, word) for word in words], path.name


def number_of(path: Path) -> int | None:
    """The last number in a file's name, None if there is none."""
    numbers = re.findall(r"\d+", path.stem)
    return int(numbers[-1]) if numbers else None
