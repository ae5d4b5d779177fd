"""Which reader opens a source of 2D laser scans: a file is recognised by its first bytes.

Scans in one npz file are range_m (N, B), angle_rad (B,), pose_x_y_theta (N, 3) and hit (N, B).
"""

import gzip
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.laser import carmen_log, floor_plan_scans
from taichi_mrf.datasets.laser.scans import LaserScans, find_no_return_m, problem_of_scan, skipped_note
from taichi_mrf.errors import DatasetError
from taichi_mrf.system.files import exists, is_file, is_folder, open_regular
from taichi_mrf.system.npz_file import open_npz

FILE_NAME = "scans.npz"
"""The file's name in a folder."""

_ZIP_MAGIC = b"PK"


def _is_npz(path: Path) -> bool:
    """True if a file is of this format, damaged or not."""
    with open_regular(path, DatasetError) as file:
        return file.read(len(_ZIP_MAGIC)) == _ZIP_MAGIC or path.suffix == ".npz"


def holds_ranges(path: Path) -> bool:
    """True if an npz file has an array of ranges."""
    try:
        with open_npz(path, DatasetError, "an npz file that can be read") as file:
            return "range_m" in file
    except DatasetError:
        return False


def read_scan_npz(
    path: Path, *, skip_bad_scans: bool = False, no_return_m: float | None = None
) -> LaserScans:
    """Read a file of scans; ``hit`` is 0 where nothing came back, and so are ranges of at least
    ``no_return_m`` metres. Raises DatasetError."""
    arrays = _arrays(path)
    range_m = arrays["range_m"].astype(np.float32)
    pose = arrays["pose_x_y_theta"].astype(np.float64)
    keep = np.ones(len(range_m), dtype=bool)
    problems = []
    suspects = ~(
        np.isfinite(range_m).all(axis=1) & (range_m >= 0).all(axis=1) & np.isfinite(pose).all(axis=1)
    )
    for scan in np.flatnonzero(suspects):
        problem = f"{path}: scan {scan + 1} of {len(range_m)}: {problem_of_scan(range_m[scan], pose[scan])}"
        if not skip_bad_scans:
            raise DatasetError(problem)
        keep[scan] = False
        problems.append(problem)
    if not keep.any():
        raise DatasetError(problems[0] if problems else f"{path}: contains no scans")
    range_m, pose, hit = range_m[keep], pose[keep], (arrays["hit"] != 0)[keep]
    notes = skipped_note(problems)
    if no_return_m is not None:
        hit &= range_m < no_return_m
    elif hit.all() and (found_m := find_no_return_m(range_m, pose)) is not None:
        share = (range_m >= found_m).mean()
        notes += (
            f"hit is 1 everywhere, but {share:.2%} of the beams have ranges of {found_m:.2f} m and more, "
            f"which looks like no return: --no-return-range {found_m:.2f} marks them",
        )
    return LaserScans(
        name=path.parent.name if path.name == FILE_NAME else path.stem,
        range_m=range_m,
        angle_rad=arrays["angle_rad"].astype(np.float64),
        pose_x_y_theta=pose,
        hit=hit,
        notes=notes,
    )


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    """The file's arrays, of the right shapes."""
    arrays: dict[str, NDArray[Any]] = {}
    with open_npz(path, DatasetError, "an npz file that is whole") as file:
        for name in ("range_m", "angle_rad", "pose_x_y_theta", "hit"):
            if name not in file:
                held = ", ".join(file.names) or "nothing"
                raise DatasetError(f"{path}: contains no array '{name}', only {held}")
            arrays[name] = file[name]
    for name, array in arrays.items():
        if not (np.issubdtype(array.dtype, np.number) or array.dtype == np.bool_) or np.iscomplexobj(array):
            raise DatasetError(f"{path}: {name} contains {array.dtype}, not numbers")
    if arrays["range_m"].ndim != 2 or arrays["range_m"].shape[1] == 0:
        raise DatasetError(
            f"{path}: range_m must have the shape (scans, beams), not {arrays['range_m'].shape}"
        )
    scans, beams = arrays["range_m"].shape
    for name, shape in {"angle_rad": (beams,), "pose_x_y_theta": (scans, 3), "hit": (scans, beams)}.items():
        if arrays[name].shape != shape:
            raise DatasetError(
                f"{path}: {name} has the shape {arrays[name].shape}; with range_m's it must be {shape}"
            )
    if not np.isfinite(arrays["angle_rad"]).all():
        raise DatasetError(f"{path}: angle_rad contains a value that is not finite")
    return arrays


__all__ = ["LaserScans", "holds_scans", "open_scans"]

_LOOKED_AT_BYTES = 1 << 16


def open_scans(
    source: str | Path, *, skip_bad_scans: bool = False, no_return_m: float | None = None
) -> LaserScans:
    """Read a CARMEN log (plain or gzip), an npz file or a folder with ``scans.npz``, or make the
    scans of a built-in source such as ``synthetic:floor-plan?scans=200``.

    Beams of at least ``no_return_m`` metres have no return; None leaves it to the reader. Raises
    DatasetError, which names the file and the line or the scan, if something cannot be read, and for beams
    with a NaN, negative or infinite range. With ``skip_bad_scans`` broken scans are left out and
    counted in the notes, as long as one is left.
    """
    path = Path(source)
    if re.match(r"[a-z][a-z0-9_]+:", str(source)) and not exists(path):
        return floor_plan_scans.open_floor_plan(str(source))
    if is_folder(path):
        path = path / FILE_NAME
        if not exists(path):
            raise DatasetError(f"{source}: the folder contains no {FILE_NAME}; pass a log by its name")
    if not exists(path):
        raise DatasetError(
            f"{source}: no such file, and no built-in scans of that name ({floor_plan_scans.NAME})"
        )
    try:
        if _is_npz(path):
            return read_scan_npz(path, skip_bad_scans=skip_bad_scans, no_return_m=no_return_m)
        return carmen_log.read_carmen_log(path, skip_bad_scans=skip_bad_scans, no_return_m=no_return_m)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from error


def holds_scans(path: Path) -> bool:
    """True if a file, or a folder with ``scans.npz``, contains 2D laser scans, damaged or not."""
    if is_folder(path):
        path = path / FILE_NAME
    if not is_file(path):
        return False
    if path.suffix == ".npz":
        return holds_ranges(path)
    try:
        with open_regular(path, DatasetError) as file:
            head = file.read(_LOOKED_AT_BYTES)
        if head[:2] == carmen_log.GZIP_MAGIC:
            head = zlib.decompressobj(16 + zlib.MAX_WBITS).decompress(head, _LOOKED_AT_BYTES)
    except (DatasetError, zlib.error, gzip.BadGzipFile):
        return False
    return any(line.lstrip().startswith(carmen_log.SCAN_LINES) for line in head.splitlines())
