"""Files from outside that could go on without end while they are read: packed streams, and databases whose
rows are computed."""

import functools
import sqlite3
from collections.abc import Callable
from contextlib import closing
from typing import Any

from taichi_mrf.system.packed import UnpackedBytes

MOST_DIGITS = 18
"""Of a count in a text; Python reads no more than 4,300, and raises ValueError."""


class BoundedFile:
    """A file that is unpacked while it is read, up to the bound for a file of ``packed_bytes``; a byte counts
    ``weight`` times. Reading raises ValueError beyond it."""

    def __init__(self, stream: Any, packed_bytes: int, weight: int = 1) -> None:
        self._stream, self._sum, self._weight, self._held = stream, UnpackedBytes(packed_bytes), weight, 0

    def __enter__(self) -> "BoundedFile":
        return self

    def __exit__(self, *error: object) -> None:
        self._stream.close()

    def read(self, size: int) -> bytes:
        """The next ``size`` bytes, or fewer."""
        return self._counted(self._stream.read(size))

    def readline(self, most: int) -> bytes:
        """The next line, or its first ``most`` bytes."""
        return self._counted(self._stream.readline(most))

    def _counted(self, found: bytes) -> bytes:
        self._held += len(found)
        self._sum.count("", self._held, self._weight)
        return found


def computed_rows(connection: sqlite3.Connection) -> str | None:
    """The first table of a database whose rows are computed and not stored, in words; None if all are stored.
    A view of a kilobyte has as many rows and bytes as it likes."""
    rows = connection.execute("SELECT type, name, sql LIKE 'CREATE VIRTUAL%' FROM sqlite_master").fetchall()
    for kind, name, is_virtual in rows:
        if kind == "view" or is_virtual:
            return f"{name} is not a table with rows of its own"
        columns = connection.execute("SELECT name, hidden FROM pragma_table_xinfo(?)", (name,)).fetchall()
        if kind == "table" and any(hidden for _, hidden in columns):
            return f"{name} has columns that are computed"
    return None


def stored_only(opens: Callable[[Any], None]) -> Callable[[Any], None]:
    """A function that opens a reader's database if its rows are stored, else it raises ValueError."""

    @functools.wraps(opens)
    def open_stored(reader: Any) -> None:
        with closing(sqlite3.connect(f"{reader.path.resolve().as_uri()}?mode=ro", uri=True)) as file:
            if computed := computed_rows(file):
                raise ValueError(computed)
        opens(reader)

    return open_stored
