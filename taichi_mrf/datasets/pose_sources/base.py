"""Sources of poses: their interface, the entry of a kind in the registry, and a file that is read anew.

A source gives the poses of some frames as they are known now. It is asked again and again, and answers only
if something has changed since: a file that was written again, a database that was optimised, a topic of a bag
whose next message is due.

A file that another program writes again and again is read when its time of change or its size differs from
the last look. It may be cut off anywhere: the last whole state counts, and a file that cannot be read is a
problem only after it has stayed so for a while.
"""

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from numpy.typing import ArrayLike

from taichi_mrf.errors import DatasetError

FrameKey = str | int | float
"""Which frame a pose is of: a frame's name (str), its number (int), or the time when it was taken, in seconds
(float). A number is the one in the frames' names, or the frame's index from 0, whichever fits more poses."""

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
        """Why the source cannot be read at present, if that has lasted for some time; None if it can be."""
        ...

    def poll(self, stamp_s: float) -> ChangedPoses | None:
        """All poses that are known now, None if they are those of the last call.

        ``stamp_s`` is the recording's time in seconds, infinite once the recording is over: a source that has
        times of its own gives what was known then. Does not wait.
        """
        ...


@dataclass(frozen=True)
class PoseKind:
    """A kind of source in a file: its entry in the registry (registry.py)."""

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
        """Poses that the function returns."""
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
        """The path."""
        return str(self._path)

    @property
    def problem(self) -> str | None:
        """Why the file cannot be read, once it has stayed so for STAYS_BROKEN_S seconds."""
        lasts = self._clock() - self._broken_since > STAYS_BROKEN_S
        return self._error if lasts else None

    def read_now(self) -> ChangedPoses:
        """The poses as they are now. Raises DatasetError, which names the file and the line, if they cannot
        be read."""
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
