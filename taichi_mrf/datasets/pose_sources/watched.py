"""A file of poses that another program writes again and again.

The file is read when its time of change or its size differs from the last look. A file that is being written
may be cut off anywhere: the last whole state counts, and a file that cannot be read is a problem only after
it has stayed so for a while.
"""

import os
import time
from collections.abc import Callable
from pathlib import Path

from taichi_mrf.datasets.pose_sources.base import ChangedPoses
from taichi_mrf.errors import DatasetError

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
