"""A database of RTAB-Map (SQLite; M. Labbe, F. Michaud, "RTAB-Map as an Open-Source Lidar and Visual SLAM
Library", JFR 2019) as a recording, and as a source of poses that change.

Each node with a depth image is a frame, named by its number. Its pose is the one after the last optimisation;
of a database without any, the odometry's. Depth is registered to the colour camera. The tables were read as
RTAB-Map 0.11 to 0.23 define them:

- ``Node``: id, session (map_id), stamp in seconds, and the robot's odometry pose, 12 float32 row by row
- ``Admin``: the robot's poses after the last optimisation, packed: opt_ids (int32) and opt_poses (12 float32)
- ``Data``: a node's colour image (JPEG or PNG), depth image and calibration
- ``Link``: what connects two nodes, and of which type it is

Packed data is a zlib stream and three int32: rows, columns and OpenCV's type. Databases are opened for
reading alone, while RTAB-Map may be writing.

Of a camera, from version 0.18 on: 11 int32 (three of the version, 0 for a single camera or 1 for a stereo
pair, width, height, and how many numbers of K, D, R, P and the local transform follow), then those as
float64, the local transform as float32. Before: float32 fx, fy, cx, cy, perhaps width and height, and the
local transform. That is the pose of the camera's optical frame on the robot. A node of several cameras has
one after the other.

Depth images are PNGs of 16-bit millimetres, PNGs whose four 8-bit channels are the bytes of float32 metres,
RVL (images.py) behind a name of 8 bytes, or inverse depth in 16 bits, as a PNG or as RVL.
"""

import contextlib
import sqlite3
import struct
import weakref
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Row, Table, start_pose
from taichi_mrf.datasets.color_camera import without_black
from taichi_mrf.datasets.images import (
    PNG_SIGNATURE,
    claimed_size,
    decode_16_bit,
    decode_color,
    decode_rvl,
    decode_unchanged,
    measured,
    note_of_largest,
    share_of_largest,
)
from taichi_mrf.datasets.options import DISTORTION_COUNTS, ReadOptions
from taichi_mrf.datasets.pose_sources.base import ChangedPoses, watched
from taichi_mrf.errors import ConfigError, DatasetError, KeyframeError, naming, said
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.system.bounded import computed_rows
from taichi_mrf.system.files import check_regular

LOOP_CLOSURES = (1, 2, 3, 4)
"""Types of links that close a loop: by appearance, near in space, near in time, by a user."""

_POSE_NUMBERS = 12
_TAIL_BYTES = 12
_MOST_PACKED = 1 << 28
"""Bytes that are unpacked, at most: the poses of five million nodes."""


@dataclass(frozen=True)
class Node:
    """A node: its session, its time in seconds, and the robot's pose by odometry (4, 4), if it has one."""

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
            computed = computed_rows(self._connection)
        weakref.finalize(self, self._connection.close)
        self._check(computed is None, f"not an RTAB-Map database: {computed}")
        missing = [name for name in ("Node", "Data", "Admin") if not self._columns(name)]
        if missing:
            raise DatasetError(f"{path}: not an RTAB-Map database: it lacks the table {', '.join(missing)}")

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    @property
    def version(self) -> tuple[int, ...]:
        """RTAB-Map's version that wrote the tables, such as (0, 21, 4)."""
        text = next((row[0] for row in self._rows("SELECT version FROM Admin")), None)
        return tuple(int(part[:9]) for part in str(text).split(".") if part.isdecimal())

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

    def link_types(self) -> list[Any]:
        """The types of all links between two nodes. Raises DatasetError."""
        if not self._columns("Link"):
            return []
        null = "transform IS NULL OR transform = zeroblob(48)"
        return [
            kind for (kind,) in self._rows(f"SELECT type FROM Link WHERE from_id != to_id AND NOT ({null})")
        ]

    def calibrations(self) -> Iterator[tuple[int, bytes]]:
        """The calibration of each node that has one and depth, as it is stored. Raises DatasetError."""
        query = "SELECT id, calibration FROM Data WHERE calibration IS NOT NULL AND length(depth) > 4"
        for id, blob in self._rows(f"{query} ORDER BY id"):
            self._check(isinstance(blob, bytes), f"Data {id}: calibration is not a blob")
            yield id, blob

    def images(self, id: int, color: bool) -> tuple[bytes, bytes | None]:
        """A node's encoded depth image, and with ``color`` its colour image, if any. Raises DatasetError."""
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


WITH_HEADER = (0, 18)
"""The version from which calibrations have a header."""

_HEADER = 11
_TRANSFORM = 12
_MOST = 1 << 20
"""Numbers of a matrix, at most."""


@dataclass(frozen=True)
class NodeCamera:
    """A node's camera: intrinsics (fx, fy, cx, cy) for images of ``size`` (width, height; 0, 0 if it is not
    stored), OpenCV's ``distortion``, and its pose on the robot."""

    intrinsics: tuple[float, float, float, float]
    size: tuple[int, int]
    distortion: tuple[float, ...]
    T_body_camera: Pose

    def of_images(self, width: int, height: int) -> PinholeCamera:
        """The camera of depth images of this size, which RTAB-Map makes by leaving out rows and columns of
        those that were calibrated. Raises ConfigError."""
        share = width / self.size[0] if self.size[0] else 1.0
        fx, fy, cx, cy = (value * share for value in self.intrinsics)
        return PinholeCamera(width, height, fx, fy, cx, cy)


def node_camera(blob: bytes, version: tuple[int, ...], where: str) -> NodeCamera:
    """A node's camera. Raises DatasetError, which begins with ``where``, for a damaged blob, a stereo pair
    and several cameras."""
    with naming(where, DatasetError, KeyframeError, ConfigError):
        return _with_header(blob) if version >= WITH_HEADER else _plain(blob)


def _with_header(blob: bytes) -> NodeCamera:
    header = np.frombuffer(blob[: 4 * _HEADER], "<i4").tolist() if len(blob) >= 4 * _HEADER else []
    if not header or not all(0 <= count <= _MOST for count in header[6:]):
        raise DatasetError("the calibration is damaged")
    _refuse(header[3] == 1, several=False)
    place, parts = 4 * _HEADER, []
    for count, kind in zip(header[6:], ("<f8",) * 4 + ("<f4",), strict=True):
        end = place + count * np.dtype(kind).itemsize
        if end > len(blob):
            raise DatasetError("the calibration is cut short")
        parts.append(np.frombuffer(blob[place:end], kind).astype(np.float64))
        place = end
    _refuse(stereo=False, several=place < len(blob))
    K, D, _, P, local = parts
    if len(P) == 12:  # images that are rectified already
        return _camera(P[[0, 5, 2, 6]], header[4], header[5], np.zeros(0), local)
    if len(K) != 9:
        raise DatasetError("the calibration has no matrix K")
    return _camera(K[[0, 4, 2, 5]], header[4], header[5], D, local)


def _plain(blob: bytes) -> NodeCamera:
    if len(blob) % 4:
        raise DatasetError("the calibration is damaged")
    numbers = np.frombuffer(blob, "<f4").astype(np.float64)
    count = len(numbers) - _TRANSFORM
    _refuse(stereo=count in (5, 7), several=count > 7)
    size = numbers[4:6] if count == 6 else np.zeros(2)
    if count not in (4, 6) or not (np.isfinite(size).all() and (size >= 0).all() and (size < _MOST).all()):
        raise DatasetError("the calibration is damaged")
    return _camera(numbers[:4], int(size[0]), int(size[1]), np.zeros(0), numbers[count:])


def _refuse(stereo: bool, several: bool) -> None:
    if stereo:
        raise DatasetError("holds a stereo pair; only depth images are read")
    if several:
        raise DatasetError("holds images of several cameras side by side; only one camera is read")


def _camera(
    intrinsics: NDArray[np.float64],
    width: int,
    height: int,
    distortion: NDArray[np.float64],
    local: NDArray[np.float64],
) -> NodeCamera:
    if len(local) not in (0, _TRANSFORM):
        raise DatasetError("the calibration's local transform is damaged")
    T_body_camera = as_pose(local.reshape(3, 4)) if len(local) else np.eye(4)
    fx, fy, cx, cy = map(float, intrinsics)
    PinholeCamera(max(width, 1), max(height, 1), fx, fy, cx, cy)
    if len(distortion) and (len(distortion) not in DISTORTION_COUNTS or not np.isfinite(distortion).all()):
        raise DatasetError(
            f"the lens has {len(distortion)} coefficients, which no pinhole model of OpenCV has"
        )
    lens = tuple(map(float, distortion)) if distortion.any() else ()
    return NodeCamera((fx, fy, cx, cy), (max(width, 0), max(height, 0)), lens, T_body_camera)


RVL, INVERSE = b"DEPTHRVL", b"DEPTHINV"
_RVL_HEADER = 16
_PNG_KIND = 25
"""The place of a PNG's type of colour: 6 is red, green, blue and opacity."""


def depth_size(data: bytes) -> tuple[int, int] | None:
    """(width, height) of a packed depth image, None for an unknown format or a damaged header."""
    if data.startswith(INVERSE):
        data = data[_RVL_HEADER:]
    if data.startswith(RVL) and len(data) >= _RVL_HEADER:
        width, height = struct.unpack_from("<2I", data, len(RVL))
        return width, height
    return claimed_size(data)


def decode_depth(data: bytes, where: str, steps_per_metre: float) -> NDArray[np.float32]:
    """Axial depth in metres, (H, W) float32, 0 for no measurement. ``steps_per_metre`` is for images of whole
    numbers. Raises DatasetError, which begins with ``where``, for a damaged image."""
    if data.startswith(INVERSE) and len(data) >= _RVL_HEADER:
        a, b = struct.unpack_from("<2f", data, len(INVERSE))
        steps = _whole(data[_RVL_HEADER:], where).astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            metres = np.where(steps > 0, np.float32(a) / (steps - np.float32(b)), np.float32(0))
    elif data.startswith(PNG_SIGNATURE) and data[_PNG_KIND : _PNG_KIND + 1] == b"\6":
        metres = np.ascontiguousarray(decode_unchanged(data, where)).view("<f4")[..., 0]
    else:
        metres = _whole(data, where).astype(np.float32) / np.float32(steps_per_metre)
    return np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(0)).astype(np.float32)


def _whole(data: bytes, where: str) -> NDArray[np.uint16]:
    """The whole numbers of an image, (H, W)."""
    if not data.startswith(RVL):
        return decode_16_bit(data, where)
    with naming(where):
        return measured(decode_rvl(data[len(RVL) :]))


STEPS_PER_METRE = 1000.0
_LOOKED_AT = 4
"""Images whose numbers are looked at when a database is opened."""


@dataclass(frozen=True)
class PosedNode(Row):
    """A node with its camera."""

    pose: Pose
    node: Node
    camera: NodeCamera


@dataclass
class RtabmapRecording(Table[PosedNode]):
    """The nodes of a database that have depth and a pose."""

    camera: PinholeCamera
    database: RtabmapDatabase = field(kw_only=True)
    own_cameras: bool = True
    """Each node has the camera that is stored with it, not one that the caller named."""

    steps_per_metre: float = STEPS_PER_METRE
    color: bool = True

    def check_scale(self, pose: Callable[[int], Pose] | None) -> list[str]:
        """A note of whole numbers that are no measurements; the unit is known."""
        shares = []
        for row in self.rows[:: -(-len(self.rows) // _LOOKED_AT)]:
            with contextlib.suppress(DatasetError):  # no PNG, or reported when its frame is read
                depth, _ = self.database.images(row.node.id, color=False)
                shares.append(share_of_largest(decode_unchanged(depth, row.pose_source)))
        return note_of_largest(shares)

    def load(self, index: int, row: PosedNode, T_world_camera: Pose) -> Frame:
        where = f"{self.database.path}: node {row.node.id}"
        depth, image = self.database.images(row.node.id, self.color)
        depth_m = decode_depth(depth, f"{where}: depth", self.steps_per_metre)
        height, width = depth_m.shape
        with naming("", ConfigError):
            camera = row.camera.of_images(width, height) if self.own_cameras else self.camera
        if depth_m.shape != camera.shape:
            raise DatasetError(
                f"{where}: depth is {width} x {height}, the camera {camera.width} x {camera.height}"
            )
        color = None if image is None else _thinned(decode_color(image, f"{where}: image"), camera)
        return Frame(depth_m, T_world_camera, camera, row.stamp, row.name, color)


def _thinned(color: NDArray[np.uint8], camera: PinholeCamera) -> NDArray[np.uint8]:
    """The pixels of a colour image that a depth image of fewer rows and columns has kept."""
    rows, columns = (np.arange(n) * of // n for n, of in zip(camera.shape, color.shape, strict=False))
    return without_black(np.ascontiguousarray(color[rows][:, columns]))


def open_database(path: Path, options: ReadOptions) -> RtabmapRecording:
    """List the nodes that can be frames. Raises DatasetError, which names the file, if there are none."""
    database = RtabmapDatabase(path)
    nodes, dropped, notes = _posed_nodes(database, options.track)
    if not nodes:
        why = f"none of {dropped} nodes with depth has a pose" if dropped else "no node has a depth image"
        raise DatasetError(f"{path}: {why}")
    size = depth_size(database.images(nodes[0].node.id, color=False)[0])
    if size is None:
        raise DatasetError(
            f"{path}: node {nodes[0].node.id}: the depth image is of an unknown format, or damaged"
        )
    links = database.link_types()
    loops = sum(kind in LOOP_CLOSURES for kind in links)
    notes.append(f"{len(links)} links between nodes, {loops} of them close a loop")
    return RtabmapRecording(
        name=path.stem,
        camera=options.camera or nodes[0].camera.of_images(*size),
        notes=notes,
        dropped=dropped,
        distortion=nodes[0].camera.distortion,
        database=database,
        rows=nodes,
        own_cameras=options.camera is None and options.intrinsics is None,
        steps_per_metre=options.depth_scale or STEPS_PER_METRE,
        color=options.color,
    )


def _posed_nodes(database: RtabmapDatabase, track: bool = False) -> tuple[list[PosedNode], int, list[str]]:
    """The nodes with depth and a pose, how many with depth have none, and notes."""
    version, optimised = database.version, database.optimised_poses()
    nodes = {node.id: node for node in database.nodes()}
    found, without = [], 0
    for id, blob in database.calibrations():
        node = nodes.get(id)
        if node is None:
            continue
        T_world_body = start_pose() if track else optimised.get(id) if optimised else node.T_odom_body
        if T_world_body is None:
            without += 1
            continue
        camera = node_camera(blob, version, f"{database.path}: node {id}")
        T_world_camera = T_world_body if track else T_world_body @ camera.T_body_camera
        found.append(
            PosedNode(f"{id:06d}", node.stamp, T_world_camera, f"{database.path}: node {id}", node, camera)
        )
    if optimised and not track:
        return found, without, ["poses as RTAB-Map last optimised them"]
    notes = [] if track else ["poses of the odometry: the database holds no optimised ones"]
    sessions = Counter(each.node.session for each in found).most_common()
    if len(sessions) > 1:
        (longest, count), *others = sessions
        left_out = ", ".join(f"{session} ({nodes} nodes)" for session, nodes in others)
        notes.append(
            f"session {longest} ({count} nodes) is read, not {left_out}: each has an odometry of its own; "
            "optimise them in RTAB-Map to use all"
        )
        without += len(found) - count
        found = [each for each in found if each.node.session == longest]
    return found, without, notes


def changing_poses(path: Path) -> ChangedPoses:
    """The poses T_world_camera of all nodes with depth by their stamps. Raises DatasetError."""
    database = RtabmapDatabase(path)
    try:
        nodes, _, _ = _posed_nodes(database)
    finally:
        database.close()
    return {each.stamp: each.pose for each in nodes}


open_poses = watched(changing_poses, beside=("-wal", "-journal"), is_text=False)
