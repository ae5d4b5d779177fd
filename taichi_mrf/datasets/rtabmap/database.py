"""The nodes, poses and images in a database of RTAB-Map (SQLite; M. Labbe, F. Michaud, "RTAB-Map as an
Open-Source Lidar and Visual SLAM Library", JFR 2019).

- ``Node``: id, session (map_id), stamp in seconds, and the robot's odometry pose, 12 float32 row by row
- ``Admin``: the robot's poses after the last optimisation, packed: opt_ids (int32) and opt_poses (12 float32)
- ``Data``: a node's colour image (JPEG or PNG), depth image (PNG) and calibration (calibration.py)
- ``Link``: the pose of one node measured from another, and the inverse of its covariance (36 float64)

Packed data is a zlib stream and three int32: rows, columns and OpenCV's type. Databases are opened for
reading alone, while RTAB-Map may be writing.
"""

import contextlib
import sqlite3
import weakref
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import DatasetError, KeyframeError, naming, said
from taichi_mrf.geometry.pose_edge import PoseEdge
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.system.files import check_regular

LOOP_CLOSURES = (1, 2, 3, 4)
"""Types of links that close a loop: by appearance, near in space, near in time, by a user."""

_POSE_NUMBERS = 12
_TAIL_BYTES = 12
_MOST_PACKED = 1 << 28
"""Bytes that are unpacked, at most: the poses of five million nodes."""


@dataclass(frozen=True)
class Node:
    """A node: its session, when it was made, in seconds, and the robot's pose by odometry (4, 4), None if it
    has none."""

    id: int
    session: int
    stamp: float
    T_odom_body: Pose | None


class RtabmapDatabase:
    """An open database."""

    def __init__(self, path: Path) -> None:
        """Raises DatasetError, which names the file, if it is none of RTAB-Map's."""
        self.path = path
        check_regular(path, DatasetError)
        with self._errors():
            self._connection = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True, timeout=1.0)
        weakref.finalize(self, self._connection.close)
        missing = [name for name in ("Node", "Data", "Admin") if not self._columns(name)]
        if missing:
            raise DatasetError(f"{path}: is no database of RTAB-Map: it has no table {', '.join(missing)}")

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    @property
    def version(self) -> tuple[int, ...]:
        """RTAB-Map's version that wrote the tables, such as (0, 21, 4)."""
        text = next((row[0] for row in self._rows("SELECT version FROM Admin")), None)
        return tuple(int(part) for part in str(text).split(".") if part.isdecimal())

    def nodes(self) -> list[Node]:
        """All nodes by id. Raises DatasetError."""
        columns = self._columns("Node")
        wanted = ["id", "map_id", "stamp" if "stamp" in columns else "NULL", "pose"]
        found = []
        for id, session, stamp, blob in self._rows(f"SELECT {', '.join(wanted)} FROM Node ORDER BY id"):
            self._check(isinstance(id, int) and id > 0, f"Node {id!r} has no number")
            seconds = float(stamp) if isinstance(stamp, int | float) else 0.0
            self._check(bool(np.isfinite(seconds)), f"Node {id}: the stamp is not finite")
            pose = self._pose(blob, f"Node {id}: pose") if blob else None
            found.append(Node(id, session if isinstance(session, int) else 0, seconds, pose))
        return found

    def optimised_poses(self) -> dict[int, Pose]:
        """The robot's poses T_map_body (4, 4) after the last optimisation, by node; none if there was none.
        Raises DatasetError."""
        if not {"opt_ids", "opt_poses"} <= self._columns("Admin"):
            return {}
        blobs = next(iter(self._rows("SELECT opt_ids, opt_poses FROM Admin")), (None, None))
        if not (blobs[0] and blobs[1]):
            return {}
        ids = self._unpacked(blobs[0], "<i4", "opt_ids")
        poses = self._unpacked(blobs[1], "<f4", "opt_poses")
        self._check(
            len(poses) == _POSE_NUMBERS * len(ids),
            f"{len(poses)} numbers of opt_poses for {len(ids)} opt_ids",
        )
        rows = poses.reshape(-1, 3, 4)
        return {int(id): self._rigid(T, f"opt_poses of {id}") for id, T in zip(ids, rows, strict=True)}

    def links(self) -> list[tuple[int, PoseEdge]]:
        """The types of all links between two nodes, and their measurements. Raises DatasetError."""
        if not self._columns("Link"):
            return []
        found = []
        for first, second, kind, blob, information in self._rows(
            "SELECT from_id, to_id, type, transform, information_matrix FROM Link"
        ):
            where = f"Link {first} to {second}"
            whole = all(isinstance(value, int) for value in (first, second, kind))
            self._check(whole, f"{where}: numbers are missing")
            matrix = np.frombuffer(information, "<f8") if isinstance(information, bytes) else np.zeros(0)
            known = len(matrix) == 36 and bool(np.isfinite(matrix).all())
            T = self._pose(blob, where) if blob else None
            if T is not None and first != second:
                edge = PoseEdge(first, second, T, matrix.reshape(6, 6) if known else None)
                found.append((kind, edge))
        return found

    def calibrations(self) -> Iterator[tuple[int, bytes]]:
        """The calibration of each node that has one and depth, as it is stored. Raises DatasetError."""
        query = "SELECT id, calibration FROM Data WHERE calibration IS NOT NULL AND length(depth) > 4"
        for id, blob in self._rows(f"{query} ORDER BY id"):
            self._check(isinstance(blob, bytes), f"Data {id}: calibration is no blob")
            yield id, blob

    def images(self, id: int, color: bool) -> tuple[bytes, bytes | None]:
        """A node's encoded depth image, and its colour image if it has one and ``color``. Raises
        DatasetError."""
        rows = self._rows(f"SELECT depth, {'image' if color else 'NULL'} FROM Data WHERE id = ?", (id,))
        depth, image = next(iter(rows), (None, None))
        self._check(isinstance(depth, bytes), f"node {id} has no depth image")
        return depth, image if isinstance(image, bytes) and len(image) > 4 else None

    def _rows(self, query: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        with self._errors():
            return self._connection.execute(query, values).fetchall()

    def _columns(self, table: str) -> set[str]:
        return {row[1] for row in self._rows(f"PRAGMA table_info({table})")}

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, OverflowError) as error:
            raise DatasetError(
                f"{self.path}: cannot be read as an RTAB-Map database: {said(error)}"
            ) from error

    def _check(self, holds: bool, problem: str) -> None:
        if not holds:
            raise DatasetError(f"{self.path}: {problem}")

    def _unpacked(self, blob: Any, kind: str, what: str) -> NDArray:
        """The numbers of packed data, in one row."""
        self._check(isinstance(blob, bytes) and len(blob) > _TAIL_BYTES, f"{what} is cut short")
        rows, columns, _ = np.frombuffer(blob[-_TAIL_BYTES:], "<i4").tolist()
        size = rows * columns * np.dtype(kind).itemsize
        self._check(rows >= 0 and columns >= 0 and size <= _MOST_PACKED, f"{what} is damaged")
        unpacker = zlib.decompressobj()
        try:
            data = unpacker.decompress(blob[:-_TAIL_BYTES], size + 1)
        except zlib.error as error:
            raise DatasetError(f"{self.path}: {what} is damaged: {said(error)}") from error
        self._check(len(data) == size, f"{what} is damaged: it holds {len(data)} bytes of {size}")
        return np.frombuffer(data, kind)

    def _pose(self, blob: Any, what: str) -> Pose | None:
        """The pose in a blob; None for RTAB-Map's null transform, all zeros."""
        if isinstance(blob, bytes) and len(blob) == 4 * _POSE_NUMBERS:
            matrix = np.frombuffer(blob, "<f4").reshape(3, 4)
            return self._rigid(matrix, what) if matrix.any() else None
        raise DatasetError(f"{self.path}: {what} does not hold {_POSE_NUMBERS} numbers")

    def _rigid(self, matrix: NDArray[np.float32], what: str) -> Pose:
        with naming(f"{self.path}: {what}", KeyframeError):
            return as_pose(matrix)
