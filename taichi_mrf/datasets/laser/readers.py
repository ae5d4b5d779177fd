"""Which reader opens a source of 2D laser scans: a file is recognised by its first bytes."""

import gzip
import re
import zlib
from pathlib import Path

from taichi_mrf.datasets.laser import carmen_log, floor_plan_scans, scan_npz
from taichi_mrf.datasets.laser.scans import LaserScans
from taichi_mrf.errors import DatasetError
from taichi_mrf.system.files import exists, is_file, is_folder, open_regular

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
        path = path / scan_npz.FILE_NAME
        if not exists(path):
            raise DatasetError(
                f"{source}: the folder contains no {scan_npz.FILE_NAME}; pass a log by its name"
            )
    if not exists(path):
        raise DatasetError(
            f"{source}: no such file, and no built-in scans of that name ({floor_plan_scans.NAME})"
        )
    try:
        if scan_npz.recognises(path):
            return scan_npz.read_scan_npz(path, skip_bad_scans=skip_bad_scans, no_return_m=no_return_m)
        return carmen_log.read_carmen_log(path, skip_bad_scans=skip_bad_scans, no_return_m=no_return_m)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from error


def holds_scans(path: Path) -> bool:
    """True if a file, or a folder with ``scans.npz``, contains 2D laser scans, damaged or not."""
    if is_folder(path):
        path = path / scan_npz.FILE_NAME
    if not is_file(path):
        return False
    if path.suffix == ".npz":
        return scan_npz.holds_ranges(path)
    try:
        with open_regular(path, DatasetError) as file:
            head = file.read(_LOOKED_AT_BYTES)
        if head[:2] == carmen_log.GZIP_MAGIC:
            head = zlib.decompressobj(16 + zlib.MAX_WBITS).decompress(head, _LOOKED_AT_BYTES)
    except (DatasetError, zlib.error, gzip.BadGzipFile):
        return False
    return any(line.lstrip().startswith(carmen_log.SCAN_LINES) for line in head.splitlines())
