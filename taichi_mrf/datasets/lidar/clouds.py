"""Point clouds in files, by their endings: .npz, .ply, .pcd, .las, .laz, and .bin of plain numbers."""

import re
import warnings
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

_COLUMNS = (4, 3, 5, 6)
"""Numbers of a point in a .bin file: KITTI has x y z and reflectance, others leave that out, or have a ring
and a time too (nuScenes: 5). The first that fits counts, unless another one fits clearly better."""

_CLEARLY = 0.1
"""Mean logarithm of the variance within columns by which another number has to fit better: 6 columns fit
points of 3 as well."""

_LEAST_POINTS = 200
"""Of fewer the variances say nothing, and 4 numbers a point count."""


def read_cloud(path: Path) -> NDArray[np.float64]:
    """The points of a file, (N, 3) in metres, as they are in it, NaN included. Raises DatasetError, which
    names the file, if it is missing or damaged."""
    return READERS[path.suffix.lower()](path)


def is_cloud(path: Path) -> bool:
    """True if a file may hold a scan, by its ending and its first bytes; a damaged one may."""
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


def _float_points(path: Path) -> NDArray[np.float64]:
    """x y z, and as many more numbers as each point has (_COLUMNS), as little-endian float32."""
    data = read_bytes(path, DatasetError, "the scan is missing")
    fitting = [count for count in _COLUMNS if len(data) % (4 * count) == 0]
    if not fitting:
        raise DatasetError(
            f"{path}: has {len(data)} bytes, which is no whole number of points of "
            f"{', '.join(str(4 * count) for count in sorted(_COLUMNS))} bytes"
        )
    values = np.frombuffer(data, "<f4")
    spread = {count: _spread(values.reshape(-1, count)) for count in fitting}
    best = min(spread.values())
    count = next(count for count in fitting if spread[count] < best + _CLEARLY)
    if count != _COLUMNS[0]:
        warnings.warn(f".bin files with {count} numbers a point, of which the first are x y z", stacklevel=2)
    return values.reshape(-1, count)[:, :3].astype(np.float64)


def _spread(table: NDArray[np.float32]) -> float:
    """How much the numbers of a column differ: the mean logarithm of the variances. With a wrong number of
    columns each is a mixture of x, y, z and the others, whose variances are larger."""
    rows = table[np.isfinite(table).all(axis=1) & (np.abs(table) < 1e6).all(axis=1)].astype(np.float64)
    return float(np.log(rows.var(axis=0) + 1e-4).mean()) if len(rows) >= _LEAST_POINTS else 0.0


def _pcd_points(path: Path) -> NDArray[np.float64]:
    return read_pcd(path)[0]


READERS: dict[str, Callable[[Path], NDArray[np.float64]]] = {
    ".npz": _npz_points,
    ".ply": read_ply_points,
    ".pcd": _pcd_points,
    ".bin": _float_points,
    ".las": read_las,
    ".laz": read_las,
}
"""Reader of a file, by its ending."""


def natural(path: Path) -> tuple[list[tuple[int, str]], str]:
    """A key that orders names by the numbers in them: scan-9 before scan-10."""
    words = re.split(r"(\d+)", path.stem)
    return [(int(word), "") if word.isdecimal() else (-1, word) for word in words], path.name


def number_of(path: Path) -> int | None:
    """The last number in a file's name, None if there is none."""
    numbers = re.findall(r"\d+", path.stem)
    return int(numbers[-1]) if numbers else None
