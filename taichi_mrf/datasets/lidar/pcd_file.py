"""PCD, the point clouds of PCL: a header in text, then points as ASCII, binary, or binary packed by LZF.

The packed values are ordered field by field, the others point by point. ``VIEWPOINT tx ty tz qw qx qy qz`` is
the pose of the sensor. LZF (M. Lehmann's libLZF), with which PCL packs points, is literal bytes, and repeats
of earlier bytes.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.trajectories import pose_from_quaternion
from taichi_mrf.errors import DatasetError, KeyframeError, naming
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.system.files import open_regular, read_bytes
from taichi_mrf.system.memory import check_memory

LARGEST_RATIO = 88
"""Three bytes repeat up to 264."""


def unpack_lzf(packed: bytes, size: int) -> bytes:
    """The ``size`` bytes that are packed. Raises ValueError if they are others, or refer to what is not
    there."""
    out, at, end = bytearray(), 0, len(packed)
    while at < end:
        control = packed[at]
        at += 1
        if control < 32:  # control + 1 literal bytes follow
            out += packed[at : at + control + 1]
            at += control + 1
            if at > end:
                raise ValueError("it ends within a run of literal bytes")
        else:  # a repeat of length + 2 bytes that begin distance + 1 bytes back
            length = control >> 5
            if length == 7 and at < end:
                length += packed[at]
                at += 1
            if at >= end:
                raise ValueError("it ends within a repeat")
            first = len(out) - ((control & 31) << 8 | packed[at]) - 1
            at += 1
            if first < 0:
                raise ValueError("a repeat begins before the first byte")
            piece = out[first : first + length + 2]
            while len(piece) < length + 2:  # a repeat may run into itself
                piece += piece[: length + 2 - len(piece)]
            out += piece
        if len(out) > size:
            break
    if len(out) != size:
        raise ValueError(f"it unpacks to {'more' if len(out) > size else 'fewer'} than {size} bytes")
    return bytes(out)


def text_columns(
    path: Path, text: bytes, rows: int, wanted: Sequence[int], columns: int
) -> NDArray[np.float64]:
    """The ``wanted`` columns, (rows, len(wanted)), of the first ``rows`` lines that are not empty, each of
    which has ``columns`` numbers. Raises DatasetError, which names the file and the row."""
    lines = [line for line in text.splitlines() if line.strip()]
    if len(lines) < rows:
        raise DatasetError(f"{path}: is cut short: {rows} points are expected, it has {len(lines)}")
    found = np.empty((rows, len(wanted)))
    for row, line in enumerate(lines[:rows]):
        words = line.split()
        if len(words) != columns:
            raise DatasetError(f"{path}: point {row} has {len(words)} values, expected {columns}")
        try:
            found[row] = [float(words[column]) for column in wanted]
        except ValueError:
            raise DatasetError(f"{path}: point {row} contains something that is not a number") from None
    return found


_LONGEST_HEADER = 1 << 16
_KINDS = {
    "F": {4: "<f4", 8: "<f8"},
    "I": {n: f"<i{n}" for n in (1, 2, 4, 8)},
    "U": {n: f"<u{n}" for n in (1, 2, 4, 8)},
}


@dataclass(frozen=True)
class PcdHeader:
    """Content of a header. ``dtype`` is one point's, with a field for each name; ``start`` the byte at which
    the points begin; ``encoding`` ascii, binary or binary_compressed."""

    dtype: np.dtype
    points: int
    viewpoint: tuple[float, ...]
    encoding: str
    start: int

    def T_world_sensor(self) -> Pose:
        """The pose of the sensor, (4, 4). Raises KeyframeError for an invalid one."""
        x, y, z, qw, qx, qy, qz = self.viewpoint
        return pose_from_quaternion(np.array([x, y, z, qx, qy, qz, qw]))


def read_pcd_header(path: Path) -> PcdHeader:
    """The header of a file. Raises DatasetError, which names the file and the entry."""
    with open_regular(path, DatasetError) as file:
        return _header(path, file.read(_LONGEST_HEADER))


def read_pcd(path: Path) -> tuple[NDArray[np.float64], Pose]:
    """Points (N, 3) in metres as they are in the file, NaN included, and the pose in VIEWPOINT.

    Raises DatasetError, which names the file and the entry, for a file that is cut short or damaged, and
    CapacityError for one that does not fit into memory.
    """
    data = read_bytes(path, DatasetError)
    header = _header(path, data[:_LONGEST_HEADER])
    with naming(f"{path}: VIEWPOINT", KeyframeError):
        T_world_sensor = header.T_world_sensor()
    missing = [axis for axis in "xyz" if axis not in (header.dtype.names or ())]
    if missing:
        raise DatasetError(f"{path}: FIELDS has no {', '.join(missing)}")
    body = memoryview(data)[header.start :]
    read = {"ascii": _ascii, "binary": _binary, "binary_compressed": _compressed}[header.encoding]
    return read(path, header, body), T_world_sensor


def _header(path: Path, data: bytes) -> PcdHeader:
    entries: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in entries:
        end = data.find(b"\n", start)
        if end < 0:
            raise DatasetError(f"{path}: not a PCD file: its header has no DATA entry")
        words = data[start:end].decode("ascii", "replace").split()
        start = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    dtype = _dtype(path, entries)
    points = _points(path, entries)
    encoding = " ".join(entries["DATA"]).lower()
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise DatasetError(f"{path}: DATA {encoding[:40]!r} is not ascii, binary or binary_compressed")
    viewpoint = _numbers(path, "VIEWPOINT", entries.get("VIEWPOINT") or ["0", "0", "0", "1", "0", "0", "0"])
    if len(viewpoint) != 7:
        raise DatasetError(f"{path}: VIEWPOINT has {len(viewpoint)} numbers, not tx ty tz qw qx qy qz")
    return PcdHeader(dtype, points, tuple(viewpoint), encoding, start)


def _dtype(path: Path, entries: dict[str, list[str]]) -> np.dtype:
    """One point, from FIELDS, SIZE, TYPE and COUNT."""
    names = entries.get("FIELDS") or []
    sizes, kinds = entries.get("SIZE") or [], entries.get("TYPE") or []
    counts = entries.get("COUNT") or ["1"] * len(names)
    if not names or not len(names) == len(sizes) == len(kinds) == len(counts):
        raise DatasetError(
            f"{path}: FIELDS, SIZE, TYPE and COUNT have {len(names)}, {len(sizes)}, {len(kinds)} and "
            f"{len(counts)} entries; expected one for each field"
        )
    fields: list[tuple[str, str, int]] = []
    for place, (name, size, kind, count) in enumerate(zip(names, sizes, kinds, counts, strict=True)):
        wanted = _KINDS.get(kind.upper(), {}).get(_whole(path, "SIZE", size))
        if wanted is None:
            raise DatasetError(f"{path}: field {name[:40]!r} of TYPE {kind[:8]} and SIZE {size} is not known")
        times = _whole(path, "COUNT", count)
        if not 1 <= times <= _LONGEST_HEADER:
            raise DatasetError(f"{path}: field {name[:40]!r} has COUNT {times}")
        # Padding is called "_", any number of times; of two fields with one name the first counts.
        known = {each[0] for each in fields}
        fields.append((name if name not in known and name != "_" else f"_{place}", wanted, times))
    return np.dtype([(name, kind) if n == 1 else (name, kind, (n,)) for name, kind, n in fields])


def _points(path: Path, entries: dict[str, list[str]]) -> int:
    """How many points there are: POINTS, or WIDTH times HEIGHT, which must be the same."""
    sizes = {
        name: _whole(path, name, entries[name][0])
        for name in ("WIDTH", "HEIGHT", "POINTS")
        if entries.get(name)
    }
    if any(size < 0 for size in sizes.values()):
        raise DatasetError(f"{path}: WIDTH, HEIGHT and POINTS must not be negative")
    area = sizes["WIDTH"] * sizes.get("HEIGHT", 1) if "WIDTH" in sizes else None
    points = sizes.get("POINTS", area)
    if points is None:
        raise DatasetError(f"{path}: neither POINTS nor WIDTH is given")
    if area not in (None, points):
        raise DatasetError(f"{path}: POINTS is {points}, WIDTH x HEIGHT {area}")
    return points


def _ascii(path: Path, header: PcdHeader, body: memoryview) -> NDArray[np.float64]:
    places, place = {}, 0
    for name in header.dtype.names or ():
        places[name] = place
        place += int(np.prod(header.dtype[name].shape, dtype=int))
    return text_columns(path, bytes(body), header.points, [places[axis] for axis in "xyz"], place)


def _binary(path: Path, header: PcdHeader, body: memoryview) -> NDArray[np.float64]:
    needed = header.points * header.dtype.itemsize
    if len(body) < needed:
        raise DatasetError(
            f"{path}: is cut short: {header.points} points take {needed} bytes, it has {len(body)}"
        )
    return _stacked(np.frombuffer(body[:needed], header.dtype))


def _compressed(path: Path, header: PcdHeader, body: memoryview) -> NDArray[np.float64]:
    if len(body) < 8:
        raise DatasetError(f"{path}: is cut short before its packed points")
    packed, unpacked = struct.unpack_from("<II", body)
    needed = header.points * header.dtype.itemsize
    if len(body) < 8 + packed:
        raise DatasetError(
            f"{path}: is cut short: {packed} packed bytes are expected, it has {len(body) - 8}"
        )
    if unpacked != needed or needed > LARGEST_RATIO * (packed + 1):
        raise DatasetError(
            f"{path}: claims to unpack {packed} bytes to {unpacked}; {header.points} points take {needed}"
        )
    check_memory(needed, f"{path}")
    with naming(f"{path}: its packed points are damaged", ValueError):
        data = unpack_lzf(bytes(body[8 : 8 + packed]), needed)
    columns, start = {}, 0
    for name in header.dtype.names or ():
        kind = header.dtype[name]
        if name in "xyz":
            columns[name] = np.frombuffer(data, kind, header.points, start)
        start += header.points * kind.itemsize
    return _stacked(columns)


def _stacked(columns: "dict[str, NDArray] | NDArray") -> NDArray[np.float64]:
    """x, y and z, (N, 3); of a field with several values the first."""
    with np.errstate(invalid="ignore"):
        parts = [np.asarray(columns[axis]).reshape(len(columns[axis]), -1)[:, 0] for axis in "xyz"]
    return np.stack([part.astype(np.float64) for part in parts], axis=-1)


def _numbers(path: Path, entry: str, words: list[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError:
        raise DatasetError(f"{path}: {entry} contains something that is not a number") from None


def _whole(path: Path, entry: str, word: str) -> int:
    try:
        return int(word)
    except ValueError:
        raise DatasetError(f"{path}: {entry} {word[:40]!r} is not a whole number") from None
