"""Lines of numbers in text files of poses, by the names of their columns where there are some.

A blank, a comma, a semicolon or a tab separates numbers, which may be quoted. Lines that are empty or start
with ``#``, ``%`` or ``//`` are left out, and so are first lines of words. The last of these that names the
columns of a position and a quaternion, in any order and among others (EuRoC's
``#timestamp [ns], p_RS_R_x [m], ..., q_RS_w [], ...``), says which numbers are which.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from taichi_mrf.errors import DatasetError
from taichi_mrf.system.files import read_text

Line = tuple[int, list[float]]
"""A line's number in its file (from 1) and its numbers."""

_COUNTS, _DECIMAL = (7, 8, 12, 13, 16, 17), re.compile(r"[-+]?\d+(,\d+)?([eE][-+]?\d+)?")
"""Numbers a line, of which each may have a decimal comma, where blanks separate them."""

_COLMAP = re.compile(r"\s*(#.*\s+)*#\s*IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME")
_AROUND = " \t\"'"
_COMMENT = re.compile(r"(?:#|%|//)+")
_UNIT = re.compile(r"[\[(].*?[\])]")
_POSITION, _ROTATION = (
    re.compile(r"|t|p|p[._].*|.*(?:pos|tran|loc).*"),
    re.compile(r"q.*|.*[._]q|.*(?:quat|orient|rot).*"),
)
_STAMP = re.compile(r".*(?:time|stamp|secs?$).*|t|ts")
_HEADER_STAMP = re.compile(r".*header[._]+stamp")
"""Of a message: rostopic names the time of its arrival too, before it."""
_NANOSECONDS = re.compile(r"(?:.*[._])?n(?:ano)?secs?")
_UNITS = {"ns": 1e9, "nsec": 1e9, "nanoseconds": 1e9, "us": 1e6, "usec": 1e6, "ms": 1e3, "msec": 1e3}
_MAGNITUDES = ((1e17, 1e9), (1e14, 1e6), (1e11, 1e3))
"""Numbers from the first are stamps since 1970 of so many a second."""

_EARLIEST = 0.05
"""Share of a file's stamps that may be outliers."""


@dataclass(frozen=True)
class Columns:
    """Places of stamp, position x y z and quaternion x y z w in a line of ``count`` cells; without a stamp
    seven places. ``stamps_a_second`` is what the header says, 1 for seconds; ``nanoseconds`` the place of
    what comes to whole seconds."""

    places: tuple[int, ...]
    count: int
    stamps_a_second: float = 1.0
    nanoseconds: int | None = None


def lines_of_numbers(path: Path) -> list[Line]:
    """All lines of a file with their numbers: 8 or 7, in the order of :class:`Columns`, where a header names
    the columns. Raises DatasetError, which names the file and the line."""
    text = read_text(path, DatasetError)
    if _COLMAP.match(text):
        raise DatasetError(
            f"{path}: is COLMAP's list of images: its poses are T_camera_world, and in no known unit; write "
            "T_world_camera in metres, for each image the 12 numbers of the first three rows in a line"
        )
    columns, found = split(text.splitlines())
    lines = []
    for number, text in found:
        try:
            lines.append((number, numbers_in(text, columns)))
        except ValueError:
            raise DatasetError(f"{path} line {number}: contains something that is not a number") from None
        except IndexError:
            wanted = columns.count if columns is not None else 0
            raise DatasetError(
                f"{path} line {number}: {len(_cells(text))} numbers, expected {wanted} as the header names"
            ) from None
    return lines


def split(lines: list[str]) -> tuple[Columns | None, list[tuple[int, str]]]:
    """The columns that a header names, None without one, and the lines of numbers, counted from 1."""
    columns: Columns | None = None
    found: list[tuple[int, str]] = []
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        mark = _COMMENT.match(text)
        if not text:
            continue
        is_head = mark is not None or (not found and not any(map(_is_number, _cells(text))))
        if not is_head:
            found.append((number, text))
        elif not found:
            columns = _named(text[mark.end() :] if mark else text) or columns
    return columns, found


def numbers_in(text: str, columns: Columns | None) -> list[float]:
    """The numbers of a line. Raises ValueError, and IndexError if the header names another number."""
    if columns is None:
        return [_number(word) for word in _cells(text)]
    cells = re.split("[,;]", text) if re.search("[,;]", text) else text.split()  # text may be among them
    cells = [cell.strip(_AROUND) for cell in cells]
    if sum(map(bool, cells)) > columns.count:
        raise IndexError
    numbers = [_number(cells[place]) for place in columns.places]
    if len(numbers) == 8:
        numbers[0] /= columns.stamps_a_second
    if columns.nanoseconds is not None:
        numbers[0] += _number(cells[columns.nanoseconds]) / 1e9
    return numbers


def stamps_a_second(stamps: Sequence[float]) -> float:
    """How many a second the stamps of one file count: 1, or a thousand and more where they are too large for
    seconds since 1970. The earliest tell, as nanoseconds of a clock that starts at 0 become as large."""
    sizes = np.abs(np.asarray(stamps, np.float64))
    least = np.quantile(sizes[sizes > 0], _EARLIEST) if sizes.any() else 0.0
    return next((rate for first, rate in _MAGNITUDES if least >= first), 1.0)


def in_seconds(stamp: float) -> float:
    """A stamp that stands alone, in seconds."""
    return stamp / stamps_a_second([stamp])


def _named(head: str) -> Columns | None:
    """The columns that a line names; None if it does not name a position and a quaternion."""
    by_commas = re.search("[,;]", head) is not None
    text = head if by_commas else _UNIT.sub("", head)
    names = [word.strip(_AROUND).lower() for word in re.split("[,;]" if by_commas else r"\s+", text.strip())]
    places: dict[str, int] = {}
    for place, name in enumerate(names):
        bare = _UNIT.sub("", name).strip()
        field = _field(bare)
        if field is not None and (field not in places or _HEADER_STAMP.fullmatch(bare)):
            places[field] = place
    wanted = ["x", "y", "z", "qx", "qy", "qz", "qw"]
    if any(name not in places for name in wanted):
        return None
    if "stamp" not in places:
        return Columns(tuple(places[name] for name in wanted), len(names))
    unit = re.search(r"[\[(_](\w+)[\])]?$", names[places["stamp"]])
    rate = _UNITS.get(unit[1], 1.0) if unit else 1.0
    rest = next((place for place, name in enumerate(names) if _NANOSECONDS.fullmatch(name)), None)
    rest = None if rest == places["stamp"] else rest
    return Columns(tuple(places[name] for name in ("stamp", *wanted)), len(names), rate, rest)


def _field(name: str) -> str | None:
    """Meaning of a column's name: stamp, x, y, z, qx, qy, qz or qw."""
    if _STAMP.fullmatch(name):
        return "stamp"
    axis, head = name[-1:], name[:-1].rstrip("._")
    if axis in "wxyz" and _ROTATION.fullmatch(head):
        return f"q{axis}"
    return axis if axis and axis in "xyz" and _POSITION.fullmatch(head) else None


def _cells(text: str) -> list[str]:
    words = text.split()
    if len(words) in _COUNTS and all(map(_DECIMAL.fullmatch, words)) and "," in text:
        return [word.replace(",", ".") for word in words]
    return [cell for word in re.split(r"[,;\s]+", text) if (cell := word.strip(_AROUND))]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _number(word: str) -> float:
    """A number; nanoseconds keep all their digits."""
    return int(word) if word.isascii() and word.isdecimal() else float(word)
