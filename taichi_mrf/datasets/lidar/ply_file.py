"""The vertices of a PLY file (G. Turk, 1994): ASCII, or binary of either byte order."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.lidar.pcd_file import text_columns
from taichi_mrf.errors import DatasetError
from taichi_mrf.system.files import open_regular, read_bytes

_LONGEST_HEADER = 1 << 16
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
        return _header(path, file.read(_LONGEST_HEADER))


def read_ply_points(path: Path) -> NDArray[np.float64]:
    """x, y and z of the vertices, (N, 3), NaN included.

    Raises DatasetError, which names the file and the entry, for a file that is cut short or damaged, and
    CapacityError for one that does not fit into memory.
    """
    data = read_bytes(path, DatasetError)
    header = _header(path, data[:_LONGEST_HEADER])
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
    vertices = np.frombuffer(data, header.dtype, header.vertices, header.start)
    with np.errstate(invalid="ignore"):
        return np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=-1)


def _header(path: Path, data: bytes) -> PlyHeader:
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
    if not (word.isascii() and word.isdecimal()):
        raise DatasetError(f"{path}: {word[:40]!r} is no number of elements")
    return int(word)
