"""Text files of poses, in the layouts that depth-camera recordings use.

- ``stamped``: ``stamp tx ty tz qx qy qz qw`` a line (TUM RGB-D, the freiburg files of ICL-NUIM), or by the
  names of columns (EuRoC), or a stamp and the matrix (MulRan). Stamps are seconds; ms, us or ns since 1970
  are told by their size
- ``rows``: the 3 x 4 or 4 x 4 matrix, row by row, or tx ty tz qx qy qz qw, in one line for each frame
- ``log``: Choi's format (Redwood): a line of three integers, the first being the frame's number, then
  the four rows of the 4 x 4 matrix; or KITTI-360's lines of the number and the matrix

Separators, comments and names of columns: pose_text.py. A broken layout is an error at once; a pose
that is not a rigid transform is an error only when that pose is read, so that a recording with one bad pose
can still be used.
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
from taichi_mrf.datasets.pose_text import Line, lines_of_numbers, numbers_in, split, stamps_a_second
from taichi_mrf.datasets.runs import starts_of_runs
from taichi_mrf.errors import DatasetError, KeyframeError
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.files import decoded, is_file, open_regular, read_text

Layout = Literal["stamped", "rows", "log"]

OTHERWISE = "--poses FILE takes them from elsewhere, --track-poses finds them"
"""Remedy for a recording without poses."""

_UNIT_LENGTH = 0.01
"""Seven numbers are a pose if the last four are of length 1, up to so much."""


@dataclass(frozen=True)
class RecordedPose:
    """One pose as it was written.

    ``key`` is its stamp in seconds, or the frame's number where the layout counts frames. ``values``
    are tx ty tz qx qy qz qw, (7,), or a matrix, (3, 4) or (4, 4). ``source`` is the file and the line.
    ``camera`` took the frame, where the file holds its intrinsics.
    """

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
    a clock that starts again, of whose runs the longest is read.

    Raises DatasetError, whose text names the file and the line, if it cannot be read, contains no pose,
    or a line has too few or too many numbers or something that is not a number.
    """
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
        poses = _longest_run(path, tuple(_stamped(path, line, rate) for line in known))
        _warn_of_twice(path, poses)
        return Trajectory(path, "stamped", poses)
    if matrices:  # KITTI-360: the frame's number, and the matrix
        return Trajectory(path, "log", tuple(_numbered(path, line) for line in lines))
    if columns in (7, 12, 16):
        return Trajectory(path, "rows", tuple(_row(path, i, line) for i, line in enumerate(lines)))
    if columns == 3:
        blocks = (lines[i : i + 5] for i in range(0, len(lines), 5))
        return Trajectory(path, "log", tuple(_log_block(path, block) for block in blocks))
    raise DatasetError(
        f"{path} line {lines[0][0]}: {columns} numbers; expected 8 (stamp, position, quaternion), 7 (without "
        "stamp), 12 or 16 (a matrix), 13 or 17 (its number and a matrix), or 3 (the head of a .log block); "
        "a first line such as 'stamp,tx,ty,tz,qw,qx,qy,qz' may name other columns"
    )


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
        f"{path}: its clock starts again, with runs from {begins}: only the longest is read; a file of "
        "another run alone is read as that",
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
    """The pose in a file of its own, as a 3 x 4 or 4 x 4 matrix.

    Raises DatasetError if the file is missing or holds no such matrix, KeyframeError if that is no
    rigid transform.
    """
    if not is_file(path):
        raise DatasetError(f"{path}: the pose is missing")
    numbers = [number for _, row in lines_of_numbers(path) for number in row]
    if len(numbers) not in (12, 16):
        raise DatasetError(f"{path}: contains {len(numbers)} numbers; a pose is a 4 x 4 matrix")
    return as_pose(np.reshape(numbers, (-1, 4)))


def pose_from_quaternion(values: NDArray[np.float64]) -> Pose:
    """tx ty tz qx qy qz qw, (7,), to a (4, 4) matrix; the quaternion is normalised.

    Raises KeyframeError if a value is not finite or the quaternion is zero.
    """
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


def _stamped(path: Path, line: Line, rate: float) -> RecordedPose:
    number, values = line
    if len(values) in (13, 17):
        return replace(_numbered(path, line), key=values[0] / rate)
    _expect(path, line, 8)
    return RecordedPose(values[0] / rate, np.array(values[1:], float), f"{path} line {number}")


def _are_stamps(keys: Sequence[float]) -> bool:
    """True if the numbers before matrices are times since 1970, as MulRan has them, or have fractions."""
    return stamps_a_second(keys) != 1 or any(key % 1 for key in keys if np.isfinite(key))


def _row(path: Path, index: int, line: Line) -> RecordedPose:
    number, values = line
    if len(values) not in (7, 12, 16):
        _expect(path, line, 12)
    pose = np.array(values, float)
    return RecordedPose(index, pose if len(pose) == 7 else pose.reshape(-1, 4), f"{path} line {number}")


def _numbered(path: Path, line: Line) -> RecordedPose:
    number, values = line
    if len(values) not in (13, 17):
        _expect(path, line, 13)
    return RecordedPose(values[0], np.reshape(values[1:], (-1, 4)).astype(float), f"{path} line {number}")


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
