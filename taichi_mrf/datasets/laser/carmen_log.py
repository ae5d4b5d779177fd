"""CARMEN logs, plain or gzip: the lines FLASER, RLASER and ROBOTLASER1, each a scan and its pose.

    FLASER n r_1 .. r_n  x y theta  ...
    ROBOTLASER1 type start_angle field_of_view step max_range accuracy remission_mode
                n r_1 .. r_n  m remission_1 .. remission_m  x y theta  ...

x y theta is the pose of the scanner (of the rear one in RLASER); all other lines are skipped.
FLASER and RLASER do not give the directions of their beams: they cover 180 degrees.
"""

import gzip
import math
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.laser.scans import (
    DEFAULT_M,
    LaserScans,
    find_no_return_m,
    problem_of_scan,
    skipped_note,
)
from taichi_mrf.errors import DatasetError, said
from taichi_mrf.system.files import open_regular

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
    """Read all scans of a log. Raises DatasetError, which names the file and the line.

    A beam of at least ``no_return_m`` metres has no return. Without it the range is found in the log
    (find_no_return_m); a line of ROBOTLASER1 also gives the scanner's greatest range. Beams without a return
    carry no evidence (``no_return_is_free`` is False): in the logs that this was measured on, 59% (Intel) and
    95% (Freiburg 079) of them would go through a wall within 5 m.
    """
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
        why = "found in the log, where so many beams have this range that it can be no surface"
        if found_m is None:
            why = "assumed, since no range stands out in the log; --no-return-range sets another"
    return f"no return: ranges of {least_m:.2f} m and more, {(~hit).mean():.2%} of the beams ({why})"


def field_of_view_angles(beams: int) -> NDArray[np.float64]:
    """The angles of FLASER's beams, (beams,) radians: from -90 degrees on, in steps of 180 / n.

    An odd number (181, 361) includes both ends. An even one (180, 360) lacks the last: of the ways to lay
    180 degrees under so many beams, this one gives the sharpest map of the Intel and Freiburg 079 logs.
    """
    steps = beams - 1 if beams % 2 and beams > 1 else beams
    return -math.pi / 2 + math.pi * np.arange(beams) / steps


def _scan_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """The lines that are scans, in words, with their numbers from 1 on."""
    with open_regular(path, DatasetError) as raw:
        packed = raw.read(len(GZIP_MAGIC)) == GZIP_MAGIC
        raw.seek(0)
        file = gzip.GzipFile(fileobj=raw) if packed else raw
        for number, line in enumerate(_lines(path, file), start=1):
            # Cheaper than splitting the odometry, which is most of the lines.
            if line.lstrip().startswith(SCAN_LINES):
                words = line.decode("ascii", errors="replace").split()
                if words[0] in _OLD or words[0] == _NEW:
                    yield number, words


def _lines(path: Path, file: BinaryIO | gzip.GzipFile) -> Iterator[bytes]:
    """The lines of a log. A packed log of a few kilobytes may hold a line that fills the memory."""
    number = 0
    while line := file.readline(_LONGEST_LINE):
        number += 1
        if len(line) == _LONGEST_LINE:
            raise DatasetError(f"{path} line {number}: longer than {_LONGEST_LINE:,} bytes")
        yield line


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
    if not words[at].isdecimal() or (what == "ranges" and int(words[at]) == 0):
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
