"""Point clouds in files, by their endings: .npz, .ply, .pcd, .las, .laz, and .bin of plain numbers.

PCD, PCL's format, is a header in text, then points as ASCII, binary, or binary packed by LZF. The packed
values are ordered field by field, the others point by point. ``VIEWPOINT tx ty tz qw qx qy qz`` is the pose
of the sensor. LZF (M. Lehmann's libLZF) is literal bytes, and repeats of earlier bytes. PLY (G. Turk, 1994)
is ASCII, or binary of either byte order.
"""

import contextlib
import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.lidar.las_file import read_las
from taichi_mrf.datasets.trajectories import floats, pose_from_quaternion
from taichi_mrf.errors import DatasetError, KeyframeError, naming
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.system.bounded import MOST_DIGITS
from taichi_mrf.system.files import open_regular, read_bytes
from taichi_mrf.system.memory import check_memory
from taichi_mrf.system.npz_file import NpzFile, open_npz

LARGEST_RATIO = 88
"""Three bytes repeat up to 264."""


def unpack_lzf(packed: bytes, size: int) -> bytes:
    """The ``size`` bytes that are packed. Raises ValueError if they are others, or refer to others."""
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
        found[row] = floats((words[column] for column in wanted), f"{path}: point {row}")
    return found


_LONGEST_HEADER = 1 << 16
_PCD_KINDS = {
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
        return _pcd_header(path, file.read(_LONGEST_HEADER))


def read_pcd(path: Path) -> tuple[NDArray[np.float64], Pose]:
    """Points (N, 3) in metres as they are in the file, NaN included, and the pose in VIEWPOINT. Raises
    DatasetError, which names the file and the entry, for a file that is cut short or damaged, and
    CapacityError for one that does not fit into memory."""
    data = read_bytes(path, DatasetError)
    header = _pcd_header(path, data[:_LONGEST_HEADER])
    with naming(f"{path}: VIEWPOINT", KeyframeError):
        T_world_sensor = header.T_world_sensor()
    missing = [axis for axis in "xyz" if axis not in (header.dtype.names or ())]
    if missing:
        raise DatasetError(f"{path}: FIELDS has no {', '.join(missing)}")
    body = memoryview(data)[header.start :]
    read = {"ascii": _ascii, "binary": _binary, "binary_compressed": _compressed}[header.encoding]
    return read(path, header, body), T_world_sensor


def _pcd_header(path: Path, data: bytes) -> PcdHeader:
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
    viewpoint = floats(entries.get("VIEWPOINT") or [0, 0, 0, 1, 0, 0, 0], f"{path}: VIEWPOINT")
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
        wanted = _PCD_KINDS.get(kind.upper(), {}).get(_whole(path, "SIZE", size))
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
    """Number of points: POINTS, or WIDTH times HEIGHT, which must be the same."""
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


def _whole(path: Path, entry: str, word: str) -> int:
    try:
        return int(word)
    except ValueError:
        raise DatasetError(f"{path}: {entry} {word[:40]!r} is not a whole number") from None


_SCALARS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class PlyHeader:
    """Content of a header. ``dtype`` is one vertex; ``faces`` how many faces follow, if any; ``start`` the
    byte at which the vertices begin; ``encoding`` ascii, binary_little_endian or binary_big_endian."""

    dtype: np.dtype
    vertices: int
    faces: int
    encoding: str
    start: int


def read_ply_header(path: Path) -> PlyHeader:
    """The header of a file. Raises DatasetError, which names the file and the entry."""
    with open_regular(path, DatasetError) as file:
        return _ply_header(path, file.read(_LONGEST_HEADER))


def read_ply_points(path: Path) -> NDArray[np.float64]:
    """x, y and z of the vertices, (N, 3), NaN included. Raises DatasetError, which names the file and the
    entry, for a damaged file, and CapacityError for one that does not fit into memory."""
    data = read_bytes(path, DatasetError)
    header = _ply_header(path, data[:_LONGEST_HEADER])
    names = header.dtype.names or ()
    missing = [axis for axis in "xyz" if axis not in names]
    if missing:
        raise DatasetError(f"{path}: the vertices have no property {', '.join(missing)}")
    if header.encoding == "ascii":
        places = [names.index(axis) for axis in "xyz"]
        return text_columns(path, data[header.start :], header.vertices, places, len(names))
    needed, held = header.vertices * header.dtype.itemsize, len(data) - header.start
    if held < needed:
        raise DatasetError(
            f"{path}: is cut short: {header.vertices} vertices take {needed} bytes, it has {held}"
        )
    return _stacked(np.frombuffer(data, header.dtype, header.vertices, header.start))


def _ply_header(path: Path, data: bytes) -> PlyHeader:
    lines: list[list[str]] = []
    start = 0
    while not lines or lines[-1] != ["end_header"]:
        end = data.find(b"\n", start)
        if end < 0 or (not lines and data[start:end].strip() != b"ply"):
            raise DatasetError(f"{path}: not a PLY file, or its header has no end")
        lines.append(data[start:end].decode("ascii", "replace").split())
        start = end + 1
    encoding = next((words[1] for words in lines if words[:1] == ["format"] and len(words) > 1), "")
    if encoding not in _ORDERS:
        raise DatasetError(f"{path}: format {encoding[:40]!r} is not one of {', '.join(_ORDERS)}")
    counts: dict[str, int] = {}
    properties: list[tuple[str, str]] = []
    for words in lines:
        if words[:1] == ["element"]:
            counts[_word(path, words, 1)] = _count(path, words)
        elif words[:1] == ["property"] and list(counts)[-1:] == ["vertex"]:
            name, kind = words[-1], _SCALARS.get(_word(path, words, 1))
            if kind is None or len(words) != 3 or name in dict(properties):
                raise DatasetError(f"{path}: vertex property {' '.join(words[1:])[:60]!r} is not one number")
            properties.append((name, _ORDERS[encoding] + kind))
    if next(iter(counts), None) != "vertex":
        raise DatasetError(f"{path}: its first element is not the vertex")
    return PlyHeader(np.dtype(properties), counts["vertex"], counts.get("face", 0), encoding, start)


def _word(path: Path, words: list[str], place: int) -> str:
    if len(words) <= place:
        raise DatasetError(f"{path}: the header's line {' '.join(words)!r} is cut short")
    return words[place]


def _count(path: Path, words: list[str]) -> int:
    word = _word(path, words, 2)
    if not (word.isascii() and word.isdecimal() and len(word) <= MOST_DIGITS):
        raise DatasetError(f"{path}: {word[:40]!r} is not a number of elements")
    return int(word)


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
    with open_npz(path, DatasetError, "a readable npz file") as file:
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


def layout_notes(clouds: Sequence[Path]) -> list[str]:
    """Interpretation of the first readable cloud, where it is a guess that may be wrong."""
    for path in clouds:
        if path.suffix.lower() != ".bin":
            continue
        with contextlib.suppress(DatasetError):  # told when it is read
            count = _float_table(path).shape[1]
            said = f".bin files with {count} numbers a point, of which the first are x y z"
            return [said] if count != _COLUMNS[0] else []
    return []


def _float_table(path: Path) -> NDArray[np.float32]:
    """x y z, and as many more numbers as each point has (_COLUMNS), as little-endian float32."""
    data = read_bytes(path, DatasetError, "the scan is missing")
    fitting = [count for count in _COLUMNS if len(data) % (4 * count) == 0]
    if not fitting:
        raise DatasetError(
            f"{path}: has {len(data)} bytes, not a whole number of points of "
            f"{', '.join(str(4 * count) for count in sorted(_COLUMNS))} bytes"
        )
    values = np.frombuffer(data, "<f4")
    spread = {count: _spread(values.reshape(-1, count)) for count in fitting}
    best = min(spread.values())
    count = next(count for count in fitting if spread[count] < best + _CLEARLY)
    return values.reshape(-1, count)


def _spread(table: NDArray[np.float32]) -> float:
    """Spread of the numbers in a column: the mean logarithm of the variances. With a wrong number of columns
    each is a mixture of x, y, z and the others, whose variances are larger."""
    rows = table[np.isfinite(table).all(axis=1) & (np.abs(table) < 1e6).all(axis=1)].astype(np.float64)
    return float(np.log(rows.var(axis=0) + 1e-4).mean()) if len(rows) >= _LEAST_POINTS else 0.0


READERS: dict[str, Callable[[Path], NDArray[np.float64]]] = {
    ".npz": _npz_points,
    ".ply": read_ply_points,
    ".pcd": lambda path: read_pcd(path)[0],
    ".bin": lambda path: _float_table(path)[:, :3].astype(np.float64),
    ".las": read_las,
    ".laz": read_las,
}
"""Reader of a file, by its ending."""
