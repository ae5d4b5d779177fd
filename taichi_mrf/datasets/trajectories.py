"""Text files of poses, in the layouts that depth-camera recordings use.

- ``stamped``: ``stamp tx ty tz qx qy qz qw`` a line (TUM RGB-D, the freiburg files of ICL-NUIM), or by the
  names of columns (EuRoC), or a stamp and the matrix (MulRan). Stamps are seconds; ms, us or ns since 1970
  are told by their size
- ``rows``: the 3 x 4 or 4 x 4 matrix, row by row, or tx ty tz qx qy qz qw, in one line for each frame
- ``log``: Choi's format (Redwood): a line of three integers, the first being the frame's number, then
  the four rows of the 4 x 4 matrix; or KITTI-360's lines of the number and the matrix

A blank, a comma, a semicolon or a tab separates numbers, which may be quoted. Lines that are empty or start
with ``#``, ``%`` or ``//`` are left out, and so are first lines of words. The last of these that names the
columns of a position and a quaternion, in any order and among others (EuRoC's
``#timestamp [ns], p_RS_R_x [m], ..., q_RS_w [], ...``), says which numbers are which.

A broken layout is an error at once; a pose that is not a rigid transform is an error only when that pose is
read, so that a recording with one bad pose can still be used.
"""

import re
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import start_pose
from taichi_mrf.errors import DatasetError, KeyframeError
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.files import decoded, is_file, open_regular, read_text

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
    """Units per second of a file's stamps: 1, or a thousand and more where they are too large for seconds
    since 1970. The earliest tell, as nanoseconds of a clock that starts at 0 become as large."""
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


def floats(words: Iterable[str | bytes | float], where: str) -> list[float]:
    """The numbers that are words. Raises DatasetError, which begins with ``where``."""
    try:
        return [float(word) for word in words]
    except ValueError:
        raise DatasetError(f"{where} contains something that is not a number") from None


def _number(word: str) -> float:
    """A number; nanoseconds keep all their digits."""
    return int(word) if word.isascii() and word.isdecimal() else float(word)


Layout = Literal["stamped", "rows", "log"]

TEXTS = (".txt", ".log", ".tum", ".csv", ".freiburg")
"""Endings of such files."""

OTHERWISE = "--poses FILE takes them from elsewhere, --track-poses finds them"
"""Remedy for a recording without poses."""

_UNIT_LENGTH = 0.01
"""Seven numbers are a pose if the last four are of length 1, up to so much."""


@dataclass(frozen=True)
class RecordedPose:
    """One pose as it was written. ``key`` is its stamp in seconds, or the frame's number where the layout
    counts frames. ``values`` are tx ty tz qx qy qz qw, (7,), or a matrix, (3, 4) or (4, 4). ``source`` is the
    file and the line. ``camera`` took the frame, where the file holds its intrinsics."""

    key: float
    values: NDArray[np.float64]
    source: str
    camera: PinholeCamera | None = None

    @property
    def is_lost(self) -> bool:
        """True if its numbers say that tracking was lost: NaN, infinity, or a quaternion of zeros."""
        return not (np.isfinite(self.values).all() and self.values.reshape(-1)[3:].any())

    def T_world_camera(self) -> Pose:
        """The pose, (4, 4), its rotation projected. Raises KeyframeError if it is no rigid transform."""
        return as_pose(pose_from_quaternion(self.values) if self.values.shape == (7,) else self.values)


@dataclass(frozen=True)
class Trajectory:
    """The poses of a file in its order."""

    path: Path
    layout: Layout
    poses: tuple[RecordedPose, ...]


def read_trajectory(path: Path) -> Trajectory:
    """Read a file of poses, recognising its layout by the first line. Warns of stamps that come twice, and of
    a clock that starts again, of whose runs the longest is read. Raises DatasetError, which names the file
    and the line, if it cannot be read, contains no pose, or a line has too few or too many numbers or
    something that is not a number."""
    lines = lines_of_numbers(path)
    if not lines:
        raise DatasetError(f"{path}: contains no pose")
    columns = len(lines[0][1])
    matrices = columns in (13, 17)
    if columns == 8 or (matrices and _are_stamps([values[0] for _, values in lines])):
        known = [line for line in lines if np.isfinite(line[1][0])]
        if not known:
            raise DatasetError(f"{path} line {lines[0][0]}: the stamp is not finite")
        if len(known) < len(lines):
            left_out = len(lines) - len(known)
            warnings.warn(
                f"{left_out} of {len(lines)} poses of {path} are left out: their stamps are not finite",
                stacklevel=2,
            )
        rate = stamps_a_second([values[0] for _, values in known])
        stamped = (_pose(path, line, (8, 13, 17)) for line in known)
        poses = _longest_run(path, tuple(replace(pose, key=pose.key / rate) for pose in stamped))
        _warn_of_twice(path, poses)
        return Trajectory(path, "stamped", poses)
    if matrices:  # KITTI-360: the frame's number, and the matrix
        return Trajectory(path, "log", tuple(_pose(path, line, (13, 17)) for line in lines))
    if columns in (7, 12, 16):
        return Trajectory(
            path, "rows", tuple(_pose(path, line, (12, 7, 16), i) for i, line in enumerate(lines))
        )
    if columns == 3:
        blocks = (lines[i : i + 5] for i in range(0, len(lines), 5))
        return Trajectory(path, "log", tuple(_log_block(path, block) for block in blocks))
    raise DatasetError(
        f"{path} line {lines[0][0]}: {columns} numbers; expected 8 (stamp, position, quaternion), 7 (without "
        "stamp), 12 or 16 (a matrix), 13 or 17 (its number and a matrix), or 3 (the head of a .log block); "
        "a first line such as 'stamp,tx,ty,tz,qw,qx,qy,qz' may name other columns"
    )


RESTART_S = 1.0
"""A clock that goes back by more than this starts again; by less, messages came out of order."""


def starts_of_runs(stamps: Sequence[float] | NDArray[np.float64]) -> list[int]:
    """The indices at which runs begin, the first 0, of stamps (seconds) in the order of recording. A single
    stamp that is off, between two that follow each other, begins none."""
    s = np.asarray(stamps, np.float64)
    back: list[int] = (np.flatnonzero(s[1:] < s[:-1] - RESTART_S) + 1).tolist()
    return [0] * bool(len(s)) + [i for i in back if not (_is_off(s, i - 1) or _is_off(s, i))]


def _is_off(stamps: NDArray[np.float64], i: int) -> bool:
    """True if the stamp after this one follows the one before it."""
    return bool(0 < i < len(stamps) - 1 and stamps[i + 1] > stamps[i - 1])


_SHORTEST_RUN = 5
"""Stamps that go back after fewer lines are in no order; with more lines a clock has started again."""


def _longest_run(path: Path, poses: tuple[RecordedPose, ...]) -> tuple[RecordedPose, ...]:
    bounds = [*starts_of_runs([pose.key for pose in poses]), len(poses)]
    if len(bounds) < 3 or min(np.diff(bounds)) < _SHORTEST_RUN:
        return poses
    runs = [poses[first:stop] for first, stop in pairwise(bounds)]
    longest = max(runs, key=len)
    begins = ", ".join(f"{run[0].source.removeprefix(f'{path} ')} ({len(run)} poses)" for run in runs)
    warnings.warn(
        f"{path}: its clock restarts, with runs from {begins}: only the longest is read; to read "
        "another, put it in a file of its own",
        stacklevel=2,
    )
    return longest


def poses_at_start(folder: Path, layout: Layout, keys: Iterable[float]) -> Trajectory:
    """Poses for frames that have none: they are found while mapping, or taken from elsewhere."""
    start = start_pose()[:3]
    return Trajectory(folder, layout, tuple(RecordedPose(key, start, str(folder)) for key in keys))


def valid_poses(trajectory: Trajectory) -> tuple[list[float], list[Pose]]:
    """The keys of the poses that are rigid transforms, and these, (4, 4). Where tracking was lost, programs
    write NaN or zeros: warns of how many are left out. Raises DatasetError if all are."""
    keys, poses, problems = [], [], []
    for pose in trajectory.poses:
        try:
            poses.append(pose.T_world_camera())
            keys.append(pose.key)
        except KeyframeError as error:
            problems.append(f"{pose.source}: {error}")
    if not poses:
        raise DatasetError(problems[0])
    if problems:
        left_out = f"{len(problems)} of {len(trajectory.poses)} poses of {trajectory.path} are left out"
        warnings.warn(f"{left_out}, first {problems[0]}", stacklevel=2)
    return keys, poses


def is_trajectory(path: Path) -> bool:
    """True if the first lines of a text file look like one of the layouts."""
    try:
        with open_regular(path, DatasetError) as file:
            # Of a file without line ends, no more than this is read either.
            lines = decoded(file.read(1 << 16), "ignore").splitlines()
        columns, found = split(lines)
        head = [numbers_in(text, columns) for _, text in found[:5]]
    except (DatasetError, ValueError, IndexError):
        return False
    counts = [len(numbers) for numbers in head]
    if counts[:1] == [7]:
        return bool(abs(np.linalg.norm(head[0][3:]) - 1) < _UNIT_LENGTH)
    return counts == [3, 4, 4, 4, 4] or (bool(counts) and counts[0] in (8, 12, 13, 16, 17))


def is_lost(pose_file: Path) -> bool:
    """True if the numbers of a pose's own file say that tracking was lost (-inf, nan, -1.#IND)."""
    try:
        return re.search(r"inf|nan|#ind", read_text(pose_file, DatasetError), re.IGNORECASE) is not None
    except DatasetError:
        return False


def read_matrix_file(path: Path) -> Pose:
    """The pose in a file of its own, as a 3 x 4 or 4 x 4 matrix. Raises DatasetError if the file is missing
    or holds no such matrix, KeyframeError if that is no rigid transform."""
    if not is_file(path):
        raise DatasetError(f"{path}: the pose is missing")
    numbers = [number for _, row in lines_of_numbers(path) for number in row]
    if len(numbers) not in (12, 16):
        raise DatasetError(f"{path}: contains {len(numbers)} numbers; a pose is a 4 x 4 matrix")
    return as_pose(np.reshape(numbers, (-1, 4)))


def pose_from_quaternion(values: NDArray[np.float64]) -> Pose:
    """tx ty tz qx qy qz qw, (7,), to a (4, 4) matrix; the quaternion is normalised. Raises KeyframeError if a
    value is not finite or the quaternion is zero."""
    if not np.isfinite(values).all():
        raise KeyframeError("a pose contains a value that is not finite (NaN or infinity)")
    norm = np.linalg.norm(values[3:])
    if norm < 1e-6:
        raise KeyframeError("the quaternion of a pose is zero")
    T = np.eye(4)
    T[:3, :3] = rotation_of(values[3:] / norm)
    T[:3, 3] = values[:3]
    return T


def rotation_of(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotations (..., 3, 3) of quaternions x y z w of length one, (..., 4)."""
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def _pose(path: Path, line: Line, counts: tuple[int, ...], key: float | None = None) -> RecordedPose:
    """The pose in a line of one of these numbers of numbers, behind its key unless that is given."""
    number, values = line
    if len(values) not in counts:
        _expect(path, line, counts[0])
    pose = np.array(values[1:] if key is None else values, float)
    where = f"{path} line {number}"
    return RecordedPose(
        values[0] if key is None else key, pose if len(pose) == 7 else pose.reshape(-1, 4), where
    )


def _are_stamps(keys: Sequence[float]) -> bool:
    """True if the numbers before matrices are times since 1970, as MulRan has them, or have fractions."""
    return stamps_a_second(keys) != 1 or any(key % 1 for key in keys if np.isfinite(key))


def _warn_of_twice(path: Path, poses: tuple[RecordedPose, ...]) -> None:
    """Name a stamp that several poses have, of which the last counts."""
    seen: dict[float, RecordedPose] = {}
    twice = [pose for pose in poses if seen.setdefault(pose.key, pose) is not pose]
    if twice:
        warnings.warn(
            f"{len(twice)} of {len(poses)} poses of {path} have the stamp of one before, first "
            f"{twice[0].source}: {twice[0].key:.6f}",
            stacklevel=3,
        )


def _log_block(path: Path, block: list[Line]) -> RecordedPose:
    number, head = block[0]
    _expect(path, block[0], 3)
    if not float(head[0]).is_integer():
        raise DatasetError(f"{path} line {number}: a .log block starts with integers, not {head[0]}")
    for line in block[1:]:
        _expect(path, line, 4)
    if len(block) < 5:
        raise DatasetError(f"{path} line {number}: the file ends inside this pose")
    return RecordedPose(head[0], np.array([values for _, values in block[1:]]), f"{path} line {number}")


def _expect(path: Path, line: Line, count: int) -> None:
    number, values = line
    if len(values) != count:
        raise DatasetError(f"{path} line {number}: {len(values)} numbers, expected {count}")
