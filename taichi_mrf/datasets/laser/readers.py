"""Readers of 2D laser scans; a file is recognised by its first bytes.

Scans in one npz file are range_m (N, B), angle_rad (B,), pose_x_y_theta (N, 3) and hit (N, B). CARMEN logs,
plain or gzip, have the lines FLASER, RLASER and ROBOTLASER1, each a scan and its pose.

    FLASER n r_1 .. r_n  x y theta  ...
    ROBOTLASER1 type start_angle field_of_view step max_range accuracy remission_mode
                n r_1 .. r_n  m remission_1 .. remission_m  x y theta  ...

x y theta is the pose of the scanner (of the rear one in RLASER); all other lines are skipped.
FLASER and RLASER do not give the directions of their beams: they cover 180 degrees.
"""

import gzip
import math
import re
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.laser import floor_plan_scans
from taichi_mrf.datasets.laser.scans import (
    DEFAULT_M,
    LaserScans,
    find_no_return_m,
    problem_of_scan,
    skipped_note,
)
from taichi_mrf.errors import DatasetError, said
from taichi_mrf.system.bounded import MOST_DIGITS, BoundedFile
from taichi_mrf.system.files import exists, is_file, is_folder, open_regular
from taichi_mrf.system.npz_file import open_npz
from taichi_mrf.system.packed import TEXT

GZIP_MAGIC = b"\x1f\x8b"
SCAN_LINES = (b"FLASER", b"RLASER", b"ROBOTLASER1")
_LONGEST_LINE = 10_000_000
_OLD, _NEW = ("FLASER", "RLASER"), "ROBOTLASER1"


@dataclass(frozen=True)
class _Scan:
    range_m: NDArray[np.float64]
    pose_x_y_theta: NDArray[np.float64]
    angle_rad: NDArray[np.float64]
    greatest_range_m: float
    """The scanner's own, infinity where the log does not give it."""


class _BadLineError(Exception):
    """The problem with a line, without its place."""


def read_carmen_log(
    path: Path, *, skip_bad_scans: bool = False, no_return_m: float | None = None
) -> LaserScans:
    """Read all scans of a log. Raises DatasetError, which names the file and the line. A beam of at least
    ``no_return_m`` metres has no return. Without it the range is found in the log (find_no_return_m); a line
    of ROBOTLASER1 also gives the scanner's greatest range. Beams without a return carry no evidence
    (``no_return_is_free`` is False): in the logs that this was measured on, 59% (Intel) and 95% (Freiburg
    079) of them would go through a wall within 5 m."""
    scans: list[_Scan] = []
    problems: list[str] = []
    try:
        for number, words in _scan_lines(path):
            try:
                scans.append(_checked(_robotlaser(words) if words[0] == _NEW else _laser(words), scans))
            except _BadLineError as error:
                problem = f"{path}: line {number}: {error}"
                if not skip_bad_scans:
                    raise DatasetError(problem) from None
                problems.append(problem)
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        problem = (
            f"{path}: the compressed log is truncated or damaged after {len(scans)} scans: {said(error)}"
        )
        if not skip_bad_scans:
            raise DatasetError(problem) from error
        problems.append(problem)
    if not scans:
        wanted = f"{', '.join(_OLD)} or {_NEW}"
        raise DatasetError(
            problems[0] if problems else f"{path}: contains no scans, which are lines of {wanted}"
        )
    range_m = np.stack([scan.range_m for scan in scans]).astype(np.float32)
    pose = np.stack([scan.pose_x_y_theta for scan in scans])
    found_m = find_no_return_m(range_m, pose) if no_return_m is None else None
    least_m = next(each for each in (no_return_m, found_m, DEFAULT_M) if each is not None)
    greatest_m = np.array([math.inf if no_return_m else scan.greatest_range_m for scan in scans])
    hit = range_m < np.minimum(greatest_m, least_m).astype(np.float32)[:, None]
    return LaserScans(
        name=path.name.split(".")[0],
        range_m=range_m,
        angle_rad=scans[0].angle_rad,
        pose_x_y_theta=pose,
        hit=hit,
        no_return_is_free=False,
        notes=(*skipped_note(problems), _no_return_note(hit, least_m, found_m, no_return_m)),
    )


def _no_return_note(
    hit: NDArray[np.bool_], least_m: float, found_m: float | None, given_m: float | None
) -> str:
    why = "set by --no-return-range"
    if given_m is None:
        why = "found in the log, where so many beams have this range that it cannot be a surface"
        if found_m is None:
            why = "assumed, since no range stands out in the log; --no-return-range sets another"
    return f"no return: ranges of {least_m:.2f} m and more, {(~hit).mean():.2%} of the beams ({why})"


def field_of_view_angles(beams: int) -> NDArray[np.float64]:
    """The angles of FLASER's beams, (beams,) radians: from -90 degrees on, in steps of 180 / n. An odd number
    (181, 361) includes both ends. An even one (180, 360) lacks the last: of the ways to lay 180 degrees under
    so many beams, this one gives the sharpest map of the Intel and Freiburg 079 logs."""
    steps = beams - 1 if beams % 2 and beams > 1 else beams
    return -math.pi / 2 + math.pi * np.arange(beams) / steps


def _scan_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """The lines that are scans, in words, with their numbers from 1 on."""
    with open_regular(path, DatasetError) as raw:
        file: Any = raw
        if raw.read(len(GZIP_MAGIC)) == GZIP_MAGIC:  # a few kilobytes may hold lines that fill the memory
            file = BoundedFile(gzip.GzipFile(fileobj=raw), raw.seek(0, 2), TEXT)
        raw.seek(0)
        number = 0
        while line := _line(path, number, file):
            number += 1
            # Cheaper than splitting the odometry, which is most of the lines.
            if line.lstrip().startswith(SCAN_LINES):
                words = line.decode("ascii", errors="replace").split()
                if words[0] in _OLD or words[0] == _NEW:
                    yield number, words


def _line(path: Path, number: int, file: Any) -> bytes:
    """The next line, after so many others."""
    try:
        line: bytes = file.readline(_LONGEST_LINE)
    except ValueError as problem:
        raise DatasetError(f"{path} line {number + 1}: the log {problem}") from None
    if len(line) == _LONGEST_LINE:
        raise DatasetError(f"{path} line {number + 1}: longer than {_LONGEST_LINE:,} bytes")
    return line


def _laser(words: list[str]) -> _Scan:
    count = _count(words, 1, "ranges")
    range_m, pose = _numbers(words, 2, count, "ranges"), _pose(words, 2 + count)
    return _Scan(range_m, pose, field_of_view_angles(count), math.inf)


def _robotlaser(words: list[str]) -> _Scan:
    start, _, step, max_range, _, _ = _numbers(words, 2, 6, "values that describe the scanner")
    count = _count(words, 8, "ranges")
    range_m = _numbers(words, 9, count, "ranges")
    remissions = _count(words, 9 + count, "remissions")
    pose = _pose(words, 10 + count + remissions)
    if not (math.isfinite(start) and math.isfinite(step) and max_range > 0):
        raise _BadLineError("the scanner's start angle, step or greatest range is not a usable number")
    return _Scan(range_m, pose, start + step * np.arange(count), max_range)


def _count(words: list[str], at: int, what: str) -> int:
    if at >= len(words):
        raise _BadLineError(f"{words[0]} ends before the number of its {what}; the log may be truncated")
    is_count = words[at].isdecimal() and len(words[at]) <= MOST_DIGITS
    if not is_count or (what == "ranges" and int(words[at]) == 0):
        raise _BadLineError(f"{words[0]} has '{words[at][:40]}' as the number of its {what}")
    return int(words[at])


def _pose(words: list[str], at: int) -> NDArray[np.float64]:
    if len(words) < at + 3:
        raise _BadLineError(f"{words[0]} has no pose (x y theta) after its ranges; the log may be truncated")
    return _numbers(words, at, 3, "numbers of the pose")


def _numbers(words: list[str], at: int, count: int, what: str) -> NDArray[np.float64]:
    if len(words) < at + count:
        raise _BadLineError(
            f"{words[0]} should have {count} {what}, but ends after {max(0, len(words) - at)}; "
            "the log may be truncated"
        )
    try:
        return np.array(words[at : at + count], dtype=np.float64)
    except ValueError as error:
        raise _BadLineError(f"not a number among the {what}: {said(error)}") from None


def _checked(scan: _Scan, before: list[_Scan]) -> _Scan:
    """The scan, if its values are sound and its beams are those of the scans before."""
    problem = problem_of_scan(scan.range_m, scan.pose_x_y_theta)
    if problem:
        raise _BadLineError(problem)
    if before and len(scan.range_m) != len(before[0].range_m):
        raise _BadLineError(f"{len(scan.range_m)} beams, where the first scan has {len(before[0].range_m)}")
    if before and not np.allclose(scan.angle_rad, before[0].angle_rad, atol=1e-6):
        raise _BadLineError("the beams' angles differ from those of the first scan")
    return scan


FILE_NAME = "scans.npz"
"""The file's name in a folder."""

_ZIP_MAGIC = b"PK"


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
    with open_npz(path, DatasetError, "a whole npz file") as file:
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
    """Read a CARMEN log (plain or gzip), an npz file or a folder with ``scans.npz``, or make the scans of a
    built-in source such as ``synthetic:floor-plan?scans=200``. Beams of at least ``no_return_m`` metres have
    no return; None leaves it to the reader. Raises DatasetError, which names the file and the line or the
    scan, if something cannot be read, and for beams with a NaN, negative or infinite range. With
    ``skip_bad_scans`` broken scans are left out and counted in the notes, as long as one is left."""
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
        with open_regular(path, DatasetError) as file:
            is_npz = file.read(len(_ZIP_MAGIC)) == _ZIP_MAGIC or path.suffix == ".npz"
        read = read_scan_npz if is_npz else read_carmen_log
        return read(path, skip_bad_scans=skip_bad_scans, no_return_m=no_return_m)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from error


def holds_scans(path: Path) -> bool:
    """True if a file, or a folder with ``scans.npz``, contains 2D laser scans, damaged or not."""
    if is_folder(path):
        path = path / FILE_NAME
    if not is_file(path):
        return False
    try:
        if path.suffix == ".npz":
            with open_npz(path, DatasetError, "a readable npz file") as arrays:
                return "range_m" in arrays
        with open_regular(path, DatasetError) as file:
            head = file.read(_LOOKED_AT_BYTES) or b""  # None: a device without news
        if head[:2] == GZIP_MAGIC:
            head = zlib.decompressobj(16 + zlib.MAX_WBITS).decompress(head, _LOOKED_AT_BYTES)
    except (DatasetError, zlib.error, gzip.BadGzipFile):
        return False
    return any(line.lstrip().startswith(SCAN_LINES) for line in head.splitlines())
