"""Recordings of Ouster's lidars: ``walk.osf?poses=FILE``, or a ``.pcap`` with its ``.json`` beside it.

The fields of :class:`OusterOptions` are the options. Poses are those in the recording (OSF files that a SLAM
has written have one for each column) or in a file of ``stamp tx ty tz qx qy qz qw`` lines, by the stamps of
the sensor; without either the sensor is assumed to stand still. A scan is an image of beams and columns; if
the sensor moved meanwhile, each column has a pose of its own (scans.py). Reading needs the extra ``ouster``.

ouster-sdk trusts what is in a file, and wrong sizes end the process, so the file is checked first. An OSF is
a row of blocks: a header, chunks of messages, and metadata. Each is its size in 4 bytes, a FlatBuffer of that
size whose name stands behind its first 4 bytes, and the CRC-32 of both. A PCAP is a row of packets, each
behind its time and two sizes: of what was captured, and of what was sent.

A beam leaves from a point that turns with the sensor, 15 to 36 mm off its axis, so the direction of a point
from the centre depends a little on its range (Ouster, "Sensor Data": coordinate frames). Directions are those
at NOMINAL_M, which moves points sideways by less than that up to twice NOMINAL_M, and ranges are those from
the centre.
"""

import struct
import zlib
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import NumberedRow, Table
from taichi_mrf.datasets.lidar.scans import (
    LidarRecording,
    Motion,
    PoseAt,
    Scan,
    reach_of,
    refuse_image_options,
    through_scans,
)
from taichi_mrf.datasets.options import TRACK, ReadOptions, parse_options
from taichi_mrf.datasets.timed_poses import (
    INTERPOLATION_GAP,
    TimedPoses,
    largest_gap,
    read_timed_poses,
    within_gap,
)
from taichi_mrf.errors import DatasetError, naming, said
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.spherical import SphericalCamera
from taichi_mrf.system.files import check_regular, open_regular
from taichi_mrf.system.libraries import library

OSF = ".osf"
HEADER, METADATA = b"OSF$", b"OSF#"
_PIECE = 1 << 20
_PCAP_ORDERS = {0xA1B2C3D4: "<", 0xD4C3B2A1: ">", 0xA1B23C4D: "<", 0x4D3CB2A1: ">"}
"""Byte orders by the first number of a PCAP, read as little-endian; the last two stamp nanoseconds."""

_PCAP_HEADER, _PACKET_HEADER = 24, 16


def check_recording(path: Path) -> None:
    """Read a file once, and raise DatasetError, which names it, if it is cut short, damaged, or an .osf that
    is none. Of a .pcap only the sizes of packets can be checked, and of one in another layout, nothing."""
    with open_regular(path, DatasetError) as file:
        try:
            length = file.seek(0, 2)
            file.seek(0)
            if length == 0:
                raise DatasetError(f"{path}: is empty")
            if path.suffix.lower() == OSF:
                _check_osf(path, file, length)
            else:
                _check_pcap(path, file, length)
        except OSError as error:
            raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from error


def _check_osf(path: Path, file: BinaryIO, length: int) -> None:
    place, name = 0, b""
    while place < length:
        place, name = _check_block(path, file, place, length)
    if name != METADATA:
        raise DatasetError(f"{path}: is cut short: its metadata are missing")


def _check_block(path: Path, file: BinaryIO, place: int, length: int) -> tuple[int, bytes]:
    """The end of a block, and its name."""
    head = file.read(12)
    if place == 0 and head[8:] != HEADER:
        raise DatasetError(f"{path}: not an OSF file")
    if len(head) < 12:
        raise DatasetError(f"{path}: is cut short at byte {length:,}")
    left = struct.unpack_from("<I", head)[0] - 8
    if left < 0 or file.tell() + left + 4 > length:
        raise DatasetError(
            f"{path}: is cut short or damaged: {left + 8:,} bytes at byte {place:,} do not fit"
        )
    checksum = zlib.crc32(head)
    while left > 0:
        piece = file.read(min(left, _PIECE))
        if not piece:
            raise DatasetError(f"{path}: is cut short while it is read")
        checksum, left = zlib.crc32(piece, checksum), left - len(piece)
    if file.read(4) != struct.pack("<I", checksum):
        raise DatasetError(f"{path}: is damaged: the checksum of the block at byte {place:,} is wrong")
    return file.tell(), head[8:]


def _check_pcap(path: Path, file: BinaryIO, length: int) -> None:
    head = file.read(_PCAP_HEADER)
    order = _PCAP_ORDERS.get(int.from_bytes(head[:4], "little"))
    if order is None:
        return
    place, number = _PCAP_HEADER, 0
    while place < length:
        file.seek(place)
        header = file.read(_PACKET_HEADER)
        captured, sent = (
            struct.unpack_from(f"{order}II", header, 8) if len(header) == _PACKET_HEADER else (0, 0)
        )
        place += _PACKET_HEADER + captured
        if place > length:
            raise DatasetError(f"{path}: is cut short in packet {number}")
        if captured < sent:
            raise DatasetError(f"{path}: packet {number} holds {captured:,} of its {sent:,} bytes")
        number += 1


NOMINAL_M = 20.0


@dataclass(frozen=True)
class Beams:
    """``camera`` has a column for each azimuth, in the lidar's frame; row v of a measurement is shifted by
    ``shifts`` (H,) columns for that. ``T_sensor_lidar`` (4, 4)."""

    camera: SphericalCamera
    shifts: NDArray[np.int64]
    T_sensor_lidar: Pose
    _altitude: NDArray[np.float64]
    _azimuth: NDArray[np.float64]
    _origin_m: tuple[float, float]

    @staticmethod
    def of(info: Any) -> "Beams":
        """The geometry of a sensor's metadata (ouster.sdk's SensorInfo). Raises DatasetError for one that
        does not spin."""
        altitude, azimuth = np.radians(info.beam_altitude_angles), np.radians(info.beam_azimuth_angles)
        width = int(info.format.columns_per_frame)
        shifts = np.asarray(info.format.pixel_shift_by_row, np.int64)
        if not (altitude.ndim == 1 and len(altitude) == len(azimuth) == len(shifts)):
            raise DatasetError(f"has {altitude.size} beam angles for {len(shifts)} rows: it does not spin")
        T_lidar_beam = np.asarray(info.beam_to_lidar_transform, np.float64)
        origin_m = float(T_lidar_beam[0, 3]) / 1000, float(T_lidar_beam[2, 3]) / 1000
        T_sensor_lidar = np.array(info.lidar_to_sensor_transform, np.float64)
        T_sensor_lidar[:3, 3] /= 1000
        x, y, z = _from_column(np.full((len(shifts), 1), NOMINAL_M), altitude, azimuth, origin_m)
        turn = 2 * np.pi / width
        ahead = np.arctan2(y, x)[:, 0] + turn * shifts
        camera = SphericalCamera(
            np.arctan2(z, np.hypot(x, y))[:, 0],
            2 * np.pi - turn * np.arange(width),  # the encoder turns clockwise
            (ahead + np.pi) % (2 * np.pi) - np.pi,
        )
        return Beams(camera, shifts, T_sensor_lidar, altitude, azimuth, origin_m)

    def shifted(self, image: NDArray) -> NDArray:
        """An image (H, W) by measurement as one by azimuth."""
        columns = np.arange(image.shape[1])[None, :] - self.shifts[:, None]
        return image[np.arange(image.shape[0])[:, None], columns % image.shape[1]]

    def from_centre(self, range_m: NDArray[np.floating]) -> NDArray[np.float32]:
        """Distances (H, W) from the centre of points at ranges (H, W) along their beams; 0 stays 0."""
        x, y, z = _from_column(range_m, self._altitude, self._azimuth, self._origin_m)
        return np.where(range_m > 0, np.sqrt(x * x + y * y + z * z), 0.0).astype(np.float32)


def _from_column(
    range_m: NDArray[np.floating],
    altitude: NDArray[np.float64],
    azimuth: NDArray[np.float64],
    origin_m: tuple[float, float],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """x, y, z (H, W) of points in a frame whose x axis has the azimuth of their column's encoder."""
    along = np.asarray(range_m, np.float64) - np.hypot(*origin_m)
    altitude, azimuth = altitude[:, None], azimuth[:, None]
    level = along * np.cos(altitude)
    return (
        level * np.cos(azimuth) + origin_m[0],
        -level * np.sin(azimuth),
        along * np.sin(altitude) + origin_m[1],
    )


STANDS_STILL = "contains no poses: the lidar is assumed to stand still; for one that moves add ?poses=FILE"
_LONGEST_GAP_S = 1.0


@dataclass(frozen=True)
class OusterOptions:
    """The options after the name of a recording."""

    poses: str = ""
    """A file of the sensor's poses in TUM's layout, in place of those in the recording; or track, to find
    them while mapping."""

    meta: str = ""
    """The metadata of a .pcap, if it is not beside it."""

    sensor: int = 0
    """Index, from 0, of the sensor in a recording with several."""

    deskew: bool = True
    """Give each column of a scan the sensor's pose at its time."""


@dataclass
class OusterScans(LidarRecording, Table[NumberedRow]):
    """The scans of one sensor. ``source`` is ouster.sdk's; ``trajectory`` are poses of the sensor,
    T_world_sensor, from a file, None for those in the recording."""

    path: Path = field(kw_only=True)
    source: Any = field(kw_only=True)
    sensor: int = field(kw_only=True)
    beams: Beams = field(kw_only=True)
    trajectory: TimedPoses | None = None
    gap: float = INTERPOLATION_GAP
    deskew: bool = True

    def load(self, index: int, row: NumberedRow, T_world_camera: Pose) -> Frame:
        """Decode one scan, which must have a column."""
        with naming(self.path):
            columns = columns_of(self.source, row.number, self.sensor)
        if columns is None:
            raise DatasetError(f"{self.path}: it has no column")
        at = _poses(columns, self.trajectory, self.gap)
        range_m = self.beams.from_centre(self.beams.shifted(columns.range_m))
        measured = range_m > 0
        looked = self.beams.shifted(np.broadcast_to(columns.valid, range_m.shape))
        image = Scan(self.beams.camera, range_m, looked & ~measured)
        if self.deskew and not self.tracked:

            def lidar_at(stamp: float) -> Pose | None:
                T = at(stamp)
                return None if T is None else T @ self.beams.T_sensor_lidar

            seconds = self.beams.shifted(np.broadcast_to(columns.stamps - row.stamp, range_m.shape))
            image = Motion(row.stamp, T_world_camera, lidar_at).of_image(image, seconds, looked) or image
        return Frame(
            image.range_m, T_world_camera, image.camera, row.stamp, row.name, no_return=image.no_return
        )


@dataclass(frozen=True)
class Columns:
    """A scan by measurement: ranges (H, W) in metres, 0 for none; of its columns (W,) the stamps in seconds,
    which are ``valid``, and the poses T_world_sensor of those."""

    range_m: NDArray[np.float64]
    stamps: NDArray[np.float64]
    valid: NDArray[np.bool_]
    poses: TimedPoses


def columns_of(source: Any, number: int, sensor: int) -> Columns | None:
    """A scan of one sensor, None if it has no column. Raises DatasetError if it cannot be decoded."""
    try:
        frame = next(islice(source[number], sensor, None), None)
        if frame is None:
            return None
        valid = (np.asarray(frame.status) & 1) > 0
        stamps = np.asarray(frame.timestamp, np.float64) * 1e-9
        range_m = np.asarray(frame.field("RANGE"), np.float64) / 1000
        poses = np.asarray(frame.body_to_world, np.float64)
        extrinsic = np.asarray(frame.sensor_info.sensor_to_body, np.float64)
    except Exception as error:  # the library raises many kinds of errors
        raise DatasetError(f"cannot be decoded: {said(error)}") from error
    if not valid.any():
        return None
    range_m = np.where(valid[None, :], range_m, 0.0)
    return Columns(range_m, stamps, valid, TimedPoses(stamps[valid], poses[valid] @ extrinsic))


def _poses(columns: Columns, trajectory: TimedPoses | None, gap: float) -> PoseAt:
    """The sensor's pose at any time of a scan."""
    timed, largest_s = (columns.poses, _LONGEST_GAP_S) if trajectory is None else (trajectory, gap)
    return lambda stamp: timed.at(stamp, largest_s)


def _is_posed(
    columns: Columns, stamp: float, pose: Pose | None, trajectory: TimedPoses, gap: float
) -> bool | None:
    """True if a ``trajectory`` goes from the first column of the scan at a ``stamp`` to the last."""
    at = _poses(columns, trajectory, gap)
    return pose is not None and Motion(stamp, pose, at).is_known(columns.stamps[columns.valid] - stamp)


def _pose(path: Path, T_world_sensor: Pose | None, T_sensor_lidar: Pose) -> Pose:
    if T_world_sensor is None:
        raise DatasetError(f"{path}: its pose is not known")
    return as_pose(T_world_sensor @ T_sensor_lidar)


def open_recording(path: Path, query: str, options: ReadOptions) -> OusterScans:
    """Open a recording with the options after the question mark of its name, and read the stamps of its
    scans. Raises DatasetError, which names the file, if ouster-sdk is not installed, metadata are missing,
    and if no scan can be read or has a pose."""
    chosen = parse_options(OusterOptions, query, str(path))
    refuse_image_options(f"{path}", options)
    check_regular(path, DatasetError)
    tracked = options.track or chosen.poses == TRACK
    trajectory = None if tracked or not chosen.poses else read_timed_poses(Path(chosen.poses))
    gap = largest_gap(options)
    source, count = _open(path, chosen)
    beams = _beams(path, source, chosen.sensor)
    scans: list[NumberedRow] = []
    at: list[Pose | None] = []
    through: list[bool | None] = []
    ends: list[Pose] = []
    reach_m = None
    for number in range(count):
        try:
            columns = columns_of(source, number, chosen.sensor)
        except DatasetError:
            columns = None
        if columns is None:
            continue
        first, last = columns.stamps[columns.valid][[0, -1]]
        stamp = 0.5 * (first + last)
        at.append(np.eye(4) if tracked else _poses(columns, trajectory, gap)(stamp))
        pose = partial(_pose, path, at[-1], beams.T_sensor_lidar)
        scans.append(NumberedRow(f"{number:06d}", stamp, pose, str(path), number))
        if trajectory is not None:
            through.append(_is_posed(columns, stamp, at[-1], trajectory, gap))
        ends += [columns.poses.poses[0], columns.poses.poses[-1]]
        if reach_m is None and at[-1] is not None and columns.range_m.any():
            reach_m = reach_of(columns.range_m)
    if not scans:
        raise DatasetError(f"{path}: none of its {count} scans can be read")
    damaged = count - len(scans)
    notes = [f"{damaged} of {count} scans dropped: damaged, or without a column"] if damaged else []
    rigid = ""
    if trajectory is not None:
        stamps = [scan.stamp for scan in scans]
        posed, said_of = within_gap(stamps, at, gap, "scans", str(path), chosen.poses, trajectory.stamps)
        scans, notes = [scans[i] for i, _ in posed], notes + said_of
        if chosen.deskew:
            known = [through[i] for i, _ in posed]
            scans, dropped, rigid = through_scans(scans, known, "scans", len(stamps), gap)
            notes += dropped
    elif not tracked and all(np.array_equal(pose, ends[0]) for pose in ends):
        notes.append(STANDS_STILL)
    found = OusterScans(
        path.stem,
        beams.camera,
        notes,
        count - len(scans),
        path=path,
        source=source,
        sensor=chosen.sensor,
        beams=beams,
        rows=scans,
        trajectory=trajectory,
        gap=gap,
        deskew=chosen.deskew and not rigid,
        tracked=tracked,
        reach_m=reach_m,
    )
    if rigid:
        found.note_motion(str(path), rigid)
    return found


def _open(path: Path, chosen: OusterOptions) -> tuple[Any, int]:
    sdk = library("ouster.sdk", "recordings of Ouster's lidars need", "ouster", DatasetError)
    more: dict[str, Any] = {"meta": [chosen.meta]} if chosen.meta else {}
    check_recording(path)
    try:
        source = sdk.open_source(str(path), index=True, **more)
        return source, len(source)
    except Exception as error:  # as above
        hint = "; a .pcap needs its metadata: a .json of the same name beside it, or ?meta=FILE"
        pcap = path.suffix.lower() == ".pcap"
        raise DatasetError(f"{path}: cannot be read: {said(error)}{hint if pcap else ''}") from error


def _beams(path: Path, source: Any, sensor: int) -> Beams:
    infos = list(source.sensor_info)
    if not 0 <= sensor < len(infos):
        raise DatasetError(f"{path}: has {len(infos)} sensors, so there is no sensor {sensor}")
    with naming(f"{path}: sensor {sensor}"):
        return Beams.of(infos[sensor])
