"""LAS and LAZ files, by the library laspy (extra ``las``): a scan, or with the path of the lidar a whole
survey, ``survey.laz?poses=FILE``.

What a header counts is compared with the size of the file first: laspy reads as many records as it says, and
the unpacker of LAZ takes memory for as many chunks, which ends the process where there is not so much.

Points of a survey are in the world's frame, and each has the time at which it was measured (``gps_time``).
They are grouped into scans of ``seconds`` (a tenth of one). The pose of a scan is that at its middle, and
each ray goes from where the lidar was at the time of its point, interpolated in a file of ``stamp tx ty tz qx
qy qz qw`` lines, by the clock of the points. A file beside the points with their name is found by itself.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.values import check_field
from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.lidar.registered import of_sensor
from taichi_mrf.datasets.lidar.scans import LIDAR_SIGMA_M, SECONDS_PER_SCAN, RecordedScan, lidar_scans
from taichi_mrf.datasets.options import ReadOptions, parse_options
from taichi_mrf.datasets.timed_poses import TimedPoses, largest_gap, read_timed_poses
from taichi_mrf.datasets.trajectories import TEXTS, is_trajectory
from taichi_mrf.errors import CapacityError, DatasetError, said
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.system.files import is_file, open_regular
from taichi_mrf.system.libraries import library
from taichi_mrf.system.memory import check_memory

_LAZ_RATIO = 100
"""LAZ packs points five to ten times."""

_READ_BYTES = 32
"""Of a point's coordinates and time, beside what is in the file."""

_LEAST_HEADER, _RECORD, _LONG_RECORD = 227, 54, 60
"""Bytes of the header of the oldest version, and of the heads of records before and behind the points."""

_PACKED = 0xC0
"""The bits of the point format that LAZ sets."""

_PACKING = (b"laszip encoded", 22204)
"""Name and number of the record that describes the packing."""

_LARGEST_CHUNK, _OF_ANY_SIZE = 1 << 24, 0xFFFFFFFF
"""Points of a chunk, of which writers put 50,000 into each; and what says that each has another size."""


def read_las(path: Path) -> NDArray[np.float64]:
    """The points of a file, (N, 3) in metres. Raises DatasetError, which names the file, if it is damaged,
    and if laspy is not installed."""
    return np.array(_las(path).xyz, np.float64)


def read_timed_las(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The points of a file, (N, 3) in metres, and the seconds (N,) at which they were measured, by its own
    clock. Raises DatasetError as :func:`read_las` does, and if it has no times."""
    points = _las(path)
    if "gps_time" not in points.point_format.dimension_names:
        raise DatasetError(
            f"{path}: its points have no gps_time (point format {points.point_format.id}), so that it is not "
            "known from where they were measured"
        )
    return np.array(points.xyz, np.float64), np.array(points.gps_time, np.float64)


def _las(path: Path) -> Any:
    """A file as laspy has it."""
    laspy = library("laspy", "LAS and LAZ files need", "las", DatasetError)
    with open_regular(path, DatasetError) as stream:
        try:
            count, point_bytes = _checked_header(stream)
            check_memory(count * (point_bytes + _READ_BYTES), f"{path}")
            stream.seek(0)
            with laspy.open(stream, closefd=False) as file:
                return file.read()
        except CapacityError:
            raise
        except Exception as error:  # the library raises many kinds of errors
            raise DatasetError(f"{path}: cannot be read: {said(error)}") from error
        except BaseException as error:
            if type(error).__name__ != "PanicException":  # of the unpacker of LAZ
                raise
            raise DatasetError(f"{path}: cannot be read, it is damaged: {said(error)}") from error


def _checked_header(stream: BinaryIO) -> tuple[int, int]:
    """The number of points and the bytes of each. Raises ValueError if the file cannot hold what its header
    counts, and struct.error if it ends within the header."""
    size = stream.seek(0, 2)
    stream.seek(0)
    head = stream.read(375)
    if head[:4] != b"LASF" or size < _LEAST_HEADER:
        raise ValueError("not a LAS file, or its header is cut short")
    header_bytes, begin, records, kind, point_bytes, count = struct.unpack_from("<HIIBHI", head, 94)
    if head[25] >= 4:
        long_records, count = struct.unpack_from("<IQ", head, 243)
        if long_records * _LONG_RECORD > size:
            raise ValueError(f"it claims {long_records:,} long records, more than it can hold")
    if not _LEAST_HEADER <= header_bytes <= begin <= size or header_bytes + records * _RECORD > begin:
        raise ValueError(f"it claims {records:,} records before its points, more than there is room for")
    packed = kind & _PACKED != 0
    if count * point_bytes > (size - begin) * (_LAZ_RATIO if packed else 1):
        raise ValueError(f"it claims {count:,} points of {point_bytes} bytes, more than it can hold")
    if packed and count:
        _check_chunk_size(stream, header_bytes, records, count)
        _check_chunks(stream, begin, size, point_bytes)
    return count, point_bytes


def _check_chunk_size(stream: BinaryIO, place: int, records: int, count: int) -> None:
    """Raise ValueError if the record that describes the packing claims chunks of far more points than there
    are: the unpacker takes memory for one."""
    for _ in range(records):
        stream.seek(place)
        user, number, length = struct.unpack("<2x16sHH", stream.read(22))
        if (user.rstrip(b"\0"), number) == _PACKING:
            (points,) = struct.unpack("<12xI", stream.read(_RECORD - 22 + 16)[_RECORD - 22 :])
            if points != _OF_ANY_SIZE and points > max(count, _LARGEST_CHUNK):
                raise ValueError(f"it claims chunks of {points:,} points")
        place += _RECORD + length


def _check_chunks(stream: BinaryIO, begin: int, size: int, point_bytes: int) -> None:
    """Raise ValueError if there are more packed chunks than fit: the first point of each is not packed."""
    stream.seek(begin)
    (table,) = struct.unpack("<q", stream.read(8))
    if table == -1:  # written as a stream: the last bytes tell it
        stream.seek(size - 8)
        (table,) = struct.unpack("<q", stream.read(8))
    if not begin + 8 <= table <= size - 8:
        raise ValueError("the table of its chunks is not in the file")
    stream.seek(table)
    _, chunks = struct.unpack("<II", stream.read(8))
    if chunks * max(1, point_bytes) > size:
        raise ValueError(f"it claims {chunks:,} chunks of points, more than it can hold")


_MOST_SCANS = 1 << 40


@dataclass(frozen=True)
class SurveyOptions:
    """The options after the name of a file."""

    poses: str = ""
    """The file of the lidar's poses in TUM's layout."""

    seconds: float = SECONDS_PER_SCAN
    """The length of a scan."""

    def __post_init__(self) -> None:
        check_field(self.seconds > 0, "seconds", f"must be positive, not {self.seconds:g}")


def open_survey(path: Path, query: str, options: ReadOptions) -> Dataset:
    """Read the points and put them into scans, in the order of time. Raises DatasetError, which names the
    file, if it cannot be read, its points have no times, or none of them has a pose."""
    chosen = parse_options(SurveyOptions, query, str(path))
    poses_path = Path(chosen.poses) if chosen.poses else _poses_beside(path)
    if poses_path is None:
        raise DatasetError(
            f"{path}: contains lidar point clouds without poses; ?poses=FILE names the path of the lidar, "
            "lines of stamp tx ty tz qx qy qz qw by the clock of its gps_time"
        )
    trajectory = read_timed_poses(poses_path)
    points_m, times = read_timed_las(path)
    gap, groups = largest_gap(options), _groups(path, times, chosen.seconds)
    stamps = [0.5 * float(times[members[0]] + times[members[-1]]) for _, members in groups]
    posed, notes = trajectory.posed(stamps, options, "scans", str(path), str(poses_path))
    scans = []
    for i, T_world_lidar in posed:
        number, members = groups[i]
        read = partial(of_sensor, points_m[members])
        starts = partial(_starts, trajectory, times, members, T_world_lidar, gap)
        pose = T_world_lidar, str(poses_path)
        scans.append(RecordedScan(f"{number:06d}", stamps[i], *pose, read, str(path), starts))
    notes.insert(0, f"{len(times)} points in {len(scans)} scans of {chosen.seconds:g} s")
    return lidar_scans(path.stem, scans, notes, len(groups) - len(scans), options)


def _poses_beside(path: Path) -> Path | None:
    """The file of poses that is called as the points are."""
    beside = (path.with_suffix(suffix) for suffix in TEXTS)
    return next((file for file in beside if is_file(file) and is_trajectory(file)), None)


def _groups(
    path: Path, times: NDArray[np.float64], seconds: float
) -> Sequence[tuple[int, NDArray[np.int64]]]:
    """The points of each scan that has some, in the order of time, and its number. Raises DatasetError for
    times that are none."""
    if len(times) == 0:
        raise DatasetError(f"{path}: contains no point")
    if not np.isfinite(times).all() or (times.max() - times.min()) / seconds > _MOST_SCANS:
        raise DatasetError(
            f"{path}: its gps_time goes from {times.min():g} to {times.max():g} s, which are not times"
        )
    order = np.argsort(times, kind="stable")
    numbers = ((times[order] - times[order[0]]) / seconds).astype(np.int64)
    ends = np.flatnonzero(np.diff(numbers)) + 1
    groups = np.split(order, ends)
    return [(int(numbers[i]), members) for i, members in zip([0, *ends], groups, strict=True)]


def _starts(
    trajectory: TimedPoses,
    times: NDArray[np.float64],
    members: NDArray[np.int64],
    T_world_lidar: Pose,
    gap: float,
) -> NDArray[np.float64]:
    """Place of the lidar when it measured each point of a scan, (n, 3) in its frame at the scan's pose; that
    pose itself where it was not known, and for all if it moved less than its noise."""
    poses, known = trajectory.between(times[members], 2 * gap)  # a pose within the gap on both sides
    if not known.any():
        return np.zeros((len(members), 3))
    T_lidar_world = inverse(T_world_lidar)
    starts = poses[:, :3, 3] @ T_lidar_world[:3, :3].T + T_lidar_world[:3, 3]
    moved = known & (np.ptp(starts[known], axis=0).max() > LIDAR_SIGMA_M)
    return np.where(moved[:, None], starts, 0.0)
