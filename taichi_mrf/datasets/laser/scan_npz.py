"""Scans in one npz file: range_m (N, B), angle_rad (B,), pose_x_y_theta (N, 3) and hit (N, B)."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.laser.scans import LaserScans, find_no_return_m, problem_of_scan, skipped_note
from taichi_mrf.errors import DatasetError
from taichi_mrf.system.files import open_regular
from taichi_mrf.system.npz_file import open_npz

FILE_NAME = "scans.npz"
"""The file's name in a folder."""

_ZIP_MAGIC = b"PK"


def recognises(path: Path) -> bool:
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
