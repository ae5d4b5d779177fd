"""Which reader opens a source of 2D laser scans: a file is recognised by its first bytes."""

import re
from pathlib import Path

from taichi_mrf.datasets.laser import carmen_log, floor_plan_scans, scan_npz
from taichi_mrf.datasets.laser.scans import LaserScans
from taichi_mrf.errors import DatasetError

__all__ = ["LaserScans", "open_scans"]


def open_scans(source: str | Path, *, skip_bad_scans: bool = False) -> LaserScans:
    """Read a CARMEN log (plain or gzip), an npz file or a folder that holds ``scans.npz``, or make the
    scans of a built-in source such as ``synthetic:floor-plan?scans=200``.

    Raises DatasetError, whose text names the file and the line or the scan, for whatever cannot be read and
    for beams with a NaN, negative or infinite range. With ``skip_bad_scans`` broken scans are left out and
    counted in the notes, as long as one is left.
    """
    path = Path(source)
    if re.match(r"[a-z][a-z0-9_]+:", str(source)) and not path.exists():
        return floor_plan_scans.open_floor_plan(str(source))
    if path.is_dir():
        path = path / scan_npz.FILE_NAME
        if not path.exists():
            raise DatasetError(f"{source}: the folder holds no {scan_npz.FILE_NAME}; a log is named itself")
    if not path.exists():
        raise DatasetError(
            f"{source}: there is no such file, nor built-in scans of that name ({floor_plan_scans.NAME})"
        )
    try:
        if scan_npz.recognises(path):
            return scan_npz.read_scan_npz(path, skip_bad_scans=skip_bad_scans)
        return carmen_log.read_carmen_log(path, skip_bad_scans=skip_bad_scans)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from error
