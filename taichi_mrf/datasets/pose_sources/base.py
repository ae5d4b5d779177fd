"""Sources of poses: their interface, every kind of file that poses can come from, and a file that is read
anew.

A source gives the poses of some frames as they are known now. It is asked again and again, and answers only
if something has changed since: a file that was written again, a database that was optimised, a topic of a bag
whose next message is due.

A file that another program writes again and again is read when its time of change or its size differs from
the last look. It may be cut off anywhere: the last whole state counts, and a file that cannot be read is a
problem only after it has stayed so for a while.

The first of KINDS that recognises a file opens it.
"""

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from numpy.typing import ArrayLike

from taichi_mrf.datasets.entries import reader
from taichi_mrf.datasets.intrinsics import is_trajectory_json, read_trajectory_json
from taichi_mrf.datasets.pose_sources.graph_file import SUFFIXES, is_pose_graph, read_pose_graph
from taichi_mrf.datasets.ros.names import METADATA, is_bag
from taichi_mrf.datasets.ros.names import SUFFIXES as BAGS
from taichi_mrf.datasets.trajectories import Trajectory, read_trajectory, valid_poses
from taichi_mrf.errors import DatasetError
from taichi_mrf.system.files import exists, is_folder

FrameKey = str | int | float
"""Frame of a pose: the frame's name (str), its number (int), or its time in seconds (float). A number is the
one in the frames' names, or the frame's index from 0, whichever fits more poses."""

ChangedPoses = Mapping[FrameKey, ArrayLike]
"""Poses T_world_camera, (4, 4), by frame."""


class PoseSource(Protocol):
    """Poses that may change while a map is made."""

    @property
    def name(self) -> str:
        """Name of the source in messages: a path, or what a caller named it."""
        ...

    @property
    def problem(self) -> str | None:
        """Reason why the source has been unreadable for some time; None if it can be read."""
        ...

    def poll(self, stamp_s: float) -> ChangedPoses | None:
        """All poses that are known now, None if they are those of the last call. ``stamp_s`` is the
        recording's time in seconds, infinite once the recording is over: a source that has times of its own
        gives what was known then. Does not wait."""
        ...


@dataclass(frozen=True)
class PoseKind:
    """A kind of source in a file: an entry of KINDS."""

    name: str

    looks_for: str
    """Marks of a file of this kind, as error messages list it."""

    recognises: Callable[[Path], bool]
    """True if a file is of this kind, even if it is damaged."""

    open: Callable[[Path, str], PoseSource]
    """Open a file with the text after the question mark in its name. Raises DatasetError."""


@dataclass(frozen=True)
class CallbackPoses:
    """Poses that a function gives: ``function(stamp_s)`` returns all poses that are known, or None if they
    have not changed. What it raises ends a run of ``map_sequence``."""

    function: Callable[[float], ChangedPoses | None]
    name: str = "the callback"
    problem: str | None = None

    def poll(self, stamp_s: float) -> ChangedPoses | None:
        return self.function(stamp_s)


STAYS_BROKEN_S = 3.0
"""A file that cannot be read for longer than this many seconds is a problem."""

SETTLES_S = 1.0
"""A text file whose last line has no end may be cut off inside a number. It is read once it has not changed
for this many seconds."""

Signature = tuple[tuple[int, int, int], ...]
"""Time of change in nanoseconds, size and number of each file, those that do not exist left out."""


class WatchedFile:
    """The poses in a file, read anew when it changes."""

    def __init__(
        self,
        path: Path,
        read: Callable[[Path], ChangedPoses],
        beside: tuple[str, ...] = (),
        is_text: bool = True,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``read`` gives the poses or raises DatasetError. ``beside`` are endings of further files that
        belong to it, such as a database's log. ``is_text``: the file is whole where a line ends."""
        self._path, self._read, self._clock, self._is_text = path, read, clock, is_text
        self._parts = (path, *(path.with_name(path.name + ending) for ending in beside))
        self._seen: Signature | None = None
        self._seen_at = self._broken_since = 0.0
        self._is_read = False
        self._error: str | None = None

    @property
    def name(self) -> str:
        return str(self._path)

    @property
    def problem(self) -> str | None:
        """Reason why the file cannot be read, once it has been unreadable for STAYS_BROKEN_S seconds."""
        lasts = self._clock() - self._broken_since > STAYS_BROKEN_S
        return self._error if lasts else None

    def read_now(self) -> ChangedPoses:
        """The poses as they are now. Raises DatasetError, which names the file and the line."""
        self._seen, self._seen_at, self._is_read = self._signature(), self._clock(), True
        return self._read(self._path)

    def poll(self, stamp_s: float) -> ChangedPoses | None:
        """The poses if the file has changed and is whole."""
        now, signature = self._clock(), self._signature()
        if signature != self._seen:
            self._seen, self._seen_at, self._is_read = signature, now, False
        if self._is_read or (now - self._seen_at < SETTLES_S and not self._ends_with_a_line()):
            return None
        self._is_read = True
        try:
            poses = self._read(self._path)
        except DatasetError as error:
            self._broken_since = now if self._error is None else self._broken_since
            self._error = str(error)
            return None
        self._error = None
        return poses

    def _signature(self) -> Signature:
        found = []
        for part in self._parts:
            try:
                status = os.stat(part)
            except OSError:
                continue
            found.append((status.st_mtime_ns, status.st_size, status.st_ino))
        return tuple(found)

    def _ends_with_a_line(self) -> bool:
        if not self._is_text:
            return True
        try:
            with self._path.open("rb") as file:
                file.seek(-1, os.SEEK_END)
                return file.read(1) in b"\r\n"
        except OSError:  # missing, or empty
            return False


def _poses_in(trajectory: Trajectory) -> ChangedPoses:
    """The valid poses of a trajectory by stamp, or by number. Raises DatasetError if there is none."""
    keys, poses = valid_poses(trajectory)
    kind: type[FrameKey] = float if trajectory.layout == "stamped" else int
    return dict(zip(map(kind, keys), poses, strict=True))


def watched(
    read: Callable[[Path], ChangedPoses], beside: tuple[str, ...] = (), is_text: bool = True
) -> Callable[[Path, str], PoseSource]:
    """Opener of a file that ``read`` reads, as a WatchedFile."""

    def open_file(path: Path, query: str) -> WatchedFile:
        if query:
            raise DatasetError(f"{path}: takes no options after a question mark; bags do")
        return WatchedFile(path, read, beside, is_text)

    return open_file


BAG = PoseKind(
    "ROS bag",
    f"a bag ({', '.join(BAGS)}, or a folder with {METADATA}) with a Path, tf or poses",
    is_bag,
    reader("ros.pose_history:open_history"),
)
RTABMAP = PoseKind(
    "RTAB-Map", "a database (.db)", lambda path: path.suffix == ".db", reader("formats.rtabmap:open_poses")
)
GRAPH = PoseKind(
    "pose graph",
    f"VERTEX_SE3:QUAT or VERTEX3 lines ({', '.join(SUFFIXES)})",
    is_pose_graph,
    watched(lambda path: dict(read_pose_graph(path, with_edges=False).poses.items())),
)
OPEN3D = PoseKind(
    "Open3D trajectory",
    "a PinholeCameraTrajectory or a PoseGraph (.json)",
    lambda path: path.suffix == ".json",
    watched(lambda path: _poses_in(_open3d(path))),
)
TRAJECTORY = PoseKind(
    "trajectory",
    "lines of stamp tx ty tz qx qy qz qw (TUM), of 12 or 16 numbers (KITTI), or a .log",
    lambda path: not is_folder(path),
    watched(lambda path: _poses_in(read_trajectory(path))),
)

KINDS: tuple[PoseKind, ...] = (BAG, RTABMAP, GRAPH, OPEN3D, TRAJECTORY)


def open_pose_source(name: str | Path) -> PoseSource:
    """Open a file of poses, which may follow later if its name says of which kind it is; options of a bag
    follow a question mark. Raises DatasetError, which names the file."""
    text, query = str(name), ""
    if not exists(text) and "?" in text:
        text, _, query = text.rpartition("?")
    path = Path(text)
    kind = next((kind for kind in KINDS if kind.recognises(path)), None)
    if kind is None:
        looked_for = "; ".join(f"{each.name}: {each.looks_for}" for each in KINDS)
        raise DatasetError(f"{path}: holds no poses that can be read; looked for {looked_for}")
    return kind.open(path, query)


def _open3d(path: Path) -> Trajectory:
    if not is_trajectory_json(path):
        raise DatasetError(f"{path}: is not {OPEN3D.looks_for}")
    return read_trajectory_json(path)
