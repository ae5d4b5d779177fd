"""LAS and LAZ files, by the library laspy (extra ``las``).

What a header counts is compared with the size of the file first: laspy reads as many records as it says, and
the unpacker of LAZ takes memory for as many chunks, which ends the process where there is not so much.
"""

import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import CapacityError, DatasetError, said
from taichi_mrf.system.files import open_regular
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
    return np.array(_points(path).xyz, np.float64)


def read_timed_las(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The points of a file, (N, 3) in metres, and the seconds (N,) at which they were measured, by its own
    clock. Raises DatasetError as :func:`read_las` does, and if it has no times."""
    points = _points(path)
    if "gps_time" not in points.point_format.dimension_names:
        raise DatasetError(
            f"{path}: its points have no gps_time (point format {points.point_format.id}), so that it is not "
            "known from where they were measured"
        )
    return np.array(points.xyz, np.float64), np.array(points.gps_time, np.float64)


def _points(path: Path) -> Any:
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
        raise ValueError("it is no LAS file, or its header is cut short")
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
    """Raise ValueError if there are more chunks of packed points than the file can hold: the first point of
    each is not packed."""
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
