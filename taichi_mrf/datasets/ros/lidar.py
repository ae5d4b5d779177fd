"""Point clouds of ROS as lidar scans: ``walk.mcap?points=/points&pose=/odom``.

The fields of a sensor_msgs/PointCloud2 are found by their names, whatever the driver. A cloud that is an
image of rows (beams) and columns, or whose rings can be put together to one, becomes an image, whose pixels
without a return are known; any other becomes free rays. A pixel that measured something has the direction of
its point, exactly. The direction of one that did not follows from the others: the elevation of its row, and
the azimuth of its column plus what the row is ahead. Where each point has a time, and the lidar moved
meanwhile, each ray starts where the lidar was at that time.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Table
from taichi_mrf.datasets.lidar.scans import (
    LidarRecording,
    Motion,
    Scan,
    measured_points,
    refuse_image_options,
    through_scans,
)
from taichi_mrf.datasets.options import TRACK, ReadOptions
from taichi_mrf.datasets.ros import messages
from taichi_mrf.datasets.ros.poses import BagPoses
from taichi_mrf.datasets.ros.reader import BagRow, RosReader
from taichi_mrf.datasets.ros.sensor import BagSensor, Posed, SensorChoice, find_sensor, poses_of
from taichi_mrf.datasets.ros.sources import Entry, TopicSource
from taichi_mrf.datasets.ros.topics import choose, cloud_topics, depth_topics
from taichi_mrf.datasets.timed_poses import largest_gap
from taichi_mrf.errors import DatasetError, naming
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.ray_table import RayTable

RINGS = ("ring", "channel", "laser_id", "line", "row")
TIMES = ("t", "time", "timestamp", "offset_time", "time_stamp", "point_time_offset")

_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_MOST_POINTS = 1 << 26
_LONGEST_SCAN_S = 2.0


@dataclass(frozen=True)
class Cloud:
    """The points of a message, (H, W, 3) metres in its frame, as it has them, NaN included; of each, (H, W):
    the ``ring``, and ``seconds`` from the header's stamp, if the message has them."""

    points_m: NDArray[np.float64]
    ring: NDArray[np.int64] | None
    seconds: NDArray[np.float64] | None


def decode(message: Any, stamp: float) -> Cloud:
    """Decode a message whose header has this stamp. Raises DatasetError, which does not name the topic, if it
    has no points or its data do not fit its fields."""
    points = _records(message)
    names = points.dtype.names or ()
    missing = [axis for axis in "xyz" if axis not in names]
    if missing:
        raise DatasetError(f"has no field {', '.join(missing)}, only {', '.join(names) or 'none'}")
    with np.errstate(invalid="ignore", over="ignore"):
        points_m = np.stack([points[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    ring = next((points[name] for name in RINGS if name in names and points[name].dtype.kind in "iu"), None)
    return Cloud(points_m, None if ring is None else ring.astype(np.int64), _times(points, stamp))


def _times(points: NDArray, stamp: float) -> NDArray[np.float64] | None:
    """Times of points (H, W), in seconds from the header's stamp, if the message has them."""
    names = points.dtype.names or ()
    time = next((points[name] for name in TIMES if name in names), None)
    return None if time is None else _seconds(time, stamp)


def _records(message: Any) -> NDArray:
    """The points as a structured array (H, W)."""
    height, width = int(message.height), int(message.width)
    step, row_step = int(message.point_step), int(message.row_step)
    if not 0 < height * width <= _MOST_POINTS or step <= 0:
        raise DatasetError(f"{width} x {height} points of {step} bytes; 1 to {_MOST_POINTS:,} are read")
    formats: dict[str, tuple[str, int]] = {}
    order = ">" if message.is_bigendian else "<"
    for each in message.fields:
        kind = _KINDS.get(int(each.datatype))
        if kind is None or not 0 <= int(each.offset) <= step - int(kind[1]):
            raise DatasetError(f"field {each.name[:40]!r} of type {each.datatype} lies outside a point")
        formats.setdefault(str(each.name), (order + kind, int(each.offset)))
    dtype = np.dtype(
        {
            "names": list(formats),
            "formats": [kind for kind, _ in formats.values()],
            "offsets": [offset for _, offset in formats.values()],
            "itemsize": step,
        }
    )
    data = np.asarray(message.data, np.uint8)
    if height == 1:  # some drivers leave row_step at 0
        row_step = max(row_step, width * step)
    if row_step < width * step or len(data) < height * row_step:
        raise DatasetError(f"{len(data)} bytes are too few for {width} x {height} points of {step} bytes")
    rows = data[: height * row_step].reshape(height, row_step)[:, : width * step]
    return np.ascontiguousarray(rows).view(dtype)


def _seconds(time: NDArray, stamp: float) -> NDArray[np.float64] | None:
    """Times of points as seconds from the header's stamp: drivers write seconds as floating-point numbers,
    and nanoseconds as integers or since 1970. None if they do not lie around the stamp."""
    seconds = time.astype(np.float64)
    finite = seconds[np.isfinite(seconds)]
    if finite.size == 0:
        return None
    largest = float(np.abs(finite).max())
    if time.dtype.kind in "iu" or largest > 1e12:
        seconds = seconds * 1e-9
        largest *= 1e-9
    if largest > 1e6:  # since 1970
        seconds = seconds - stamp
    inside = np.abs(seconds[np.isfinite(seconds)]) <= _LONGEST_SCAN_S
    return seconds if inside.all() else None


_LEAST_MEASURED = 0.2
"""Share of pixels below which nothing is said of the others."""

_NEIGHBOURS = 1.5
"""Largest distance, in columns, of nine tenths of the pixels from where row and column place them."""


def organised(points_m: NDArray[np.floating]) -> tuple[Scan, NDArray[np.intp]] | None:
    """The image of points (H, W, 3) in the sensor's frame, where pixels without a point got nothing back, and
    the number, row by row, of each pixel's point, (H, W). None if neighbours in the image are no neighbours
    in space. Rows that are ahead of others by whole columns, as some drivers write them, are shifted back."""
    height, width = points_m.shape[:2]
    measured = measured_points(points_m)
    if min(height, width) < 2 or measured.mean() < _LEAST_MEASURED:
        return None
    points = np.where(measured[..., None], points_m, 0.0).astype(np.float64)
    range_m = np.linalg.norm(points, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        directions = points / range_m[..., None]
    elevation = np.where(measured, np.arcsin(np.clip(directions[..., 2], -1, 1)), np.nan)
    azimuth = np.where(measured, np.arctan2(directions[..., 1], directions[..., 0]), np.nan)
    found = _azimuths(azimuth)
    if found is None:
        return None
    columns, ahead, step = found
    number = np.arange(height * width).reshape(height, width)
    shifts = np.rint(ahead / step).astype(int)
    if np.any(shifts != shifts[0]):
        if abs(abs(step) * width - 2 * np.pi) > 0.5 * abs(step) * np.abs(shifts).max() + 0.05:
            return None  # only a full turn can be shifted
        place = (np.arange(width)[None, :] - shifts[:, None]) % width
        picked = np.arange(height)[:, None], place
        measured, range_m, directions = measured[picked], range_m[picked], directions[picked]
        elevation, azimuth, number = elevation[picked], azimuth[picked], number[picked]
        found = _azimuths(azimuth)
        if found is None:
            return None
        columns, ahead, step = found
    rows = _filled(np.array([np.nanmedian(row) if np.isfinite(row).any() else np.nan for row in elevation]))
    guess = columns[None, :] + ahead[:, None]
    off = np.abs(_wrapped(azimuth - guess))[measured]
    if rows is None or np.quantile(off, 0.9) > _NEIGHBOURS * abs(step):
        return None
    level = np.cos(rows)[:, None]
    rays = np.stack(
        [level * np.cos(guess), level * np.sin(guess), np.broadcast_to(np.sin(rows)[:, None], guess.shape)],
        -1,
    )
    rays[measured] = directions[measured]
    return Scan(RayTable(rays), np.where(measured, range_m, 0.0).astype(np.float32), ~measured), number


def by_ring(points_m: NDArray[np.floating], ring: NDArray[np.integer]) -> NDArray[np.intp] | None:
    """The numbers of points (N, 3) as an image (H, W) with a row for each ring, the highest first; None if
    the rings have different numbers of points."""
    rings, counts = np.unique(ring, return_counts=True)
    if len(rings) < 2 or np.any(counts != counts[0]):
        return None
    numbers = np.argsort(ring, kind="stable").reshape(len(rings), counts[0])
    image = points_m[numbers]
    with np.errstate(invalid="ignore", divide="ignore"):
        height = np.nanmedian(image[..., 2] / np.linalg.norm(image, axis=-1), axis=1)
    return numbers[np.argsort(-height, kind="stable")]


def _azimuths(azimuth: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], float] | None:
    """From azimuths (H, W), NaN for none: the azimuth of each column (W,), by how much each row (H,) is ahead
    of it, and the step from column to column. None if columns do not follow each other."""
    width = azimuth.shape[1]
    steps = _wrapped(np.diff(azimuth, axis=1))
    steps = steps[np.isfinite(steps)]
    if steps.size == 0:
        return None
    step = float(np.median(steps))
    if step == 0.0:
        return None
    # Seen from the column, all azimuths of a row are nearly the same, and do not wrap.
    turned = np.arange(width) * step
    unrolled = azimuth - turned
    ahead = np.array([_circular_median(row) for row in unrolled])
    if not np.isfinite(ahead).any():
        return None
    ahead = np.where(np.isfinite(ahead), ahead, np.nanmedian(ahead))
    # One row's, not the middle between two, so that whole columns are whole.
    first = ahead[np.abs(_wrapped(ahead - _circular_median(ahead))).argmin()]
    rest = np.array([_circular_median(column) for column in (unrolled - ahead[:, None]).T])
    return first + turned + np.nan_to_num(rest), _wrapped(ahead - first), step


def _circular_median(angles: NDArray[np.float64]) -> float:
    """The median of angles around their mean direction, NaN if there is none."""
    angles = angles[np.isfinite(angles)]
    if angles.size == 0:
        return float("nan")
    mean = np.arctan2(np.sin(angles).mean(), np.cos(angles).mean())
    return float(mean + np.median(_wrapped(angles - mean)))


def _wrapped(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles taken to between -pi and pi."""
    return (angles + np.pi) % (2 * np.pi) - np.pi


def _filled(values: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Values (H,) with NaN replaced by what lies between their neighbours; None if all are NaN."""
    known = np.flatnonzero(np.isfinite(values))
    if known.size == 0:
        return None
    return np.interp(np.arange(len(values)), known, values[known])


@dataclass
class LidarBag(LidarRecording, Table[BagRow]):
    """The point clouds of one topic, each with its pose. ``rigid``: why motion during scans is not undone,
    though their points have times."""

    reader: RosReader = field(kw_only=True)
    clouds: "Clouds" = field(kw_only=True)
    rigid: str = field(default="", kw_only=True)

    def load(self, index: int, row: BagRow, T_world_camera: Pose) -> Frame:
        """Decode one cloud, which must have a measurement."""
        message = self.reader.read(self.clouds.topic, row.entry)
        return self.clouds.frame(row.entry, message, T_world_camera, row.stamp, row.name)

    def look_at_first(self, what: str = "cloud") -> None:
        """Set camera, reach and a note from the first cloud that can be read. Raises as for any lidar."""
        super().look_at_first(what)
        self.notes.append(self.clouds.in_words(self.camera))
        if self.clouds.registered:
            self.swept_m = 0.0
        elif self.rigid and self._has_times():
            self.note_motion(self.clouds.topic, self.rigid)
        elif self.swept_m and self._has_times():  # the first scan stood still
            self.swept_m = 0.0

    def _has_times(self) -> bool:
        """True if points of the first cloud have times that differ."""
        entry = self.rows[0].entry
        seconds = decode(self.reader.read(self.clouds.topic, entry), entry.stamp).seconds
        return seconds is not None and bool(np.ptp(seconds[np.isfinite(seconds)]) > 0)


@dataclass(frozen=True)
class Clouds:
    """Turns the point clouds of a ``topic`` of the source at ``path`` into frames. ``at`` gives the pose of a
    frame's lidar at a time in seconds, or None; if it is None itself, points are left where they are.
    ``registered`` points are in the world's frame, and are taken back into the lidar's."""

    path: Path | str
    topic: str
    at: Callable[[str, float], Pose | None] | None
    registered: bool

    def frame(self, entry: Entry, message: Any, pose: Pose, stamp: float, name: str) -> Frame:
        """The frame of a cloud, with a stamp and a name. Raises DatasetError, which names source and topic,
        if it cannot be decoded or nothing was measured."""
        with naming(f"{self.path}: topic {self.topic}"):
            cloud = decode(message, entry.stamp)
            measured = measured_points(cloud.points_m)
            if not measured.any():
                raise DatasetError(f"none of {measured.size} points is a measurement")
        if self.registered:
            own = (cloud.points_m.astype(np.float64) - pose[:3, 3]) @ pose[:3, :3]
            cloud = replace(cloud, points_m=own.astype(cloud.points_m.dtype))
        motion = None if self.at is None else Motion(entry.stamp, pose, partial(self.at, entry.frame))
        scan = _image(cloud, motion) or _free(cloud, motion)
        return Frame(scan.range_m, pose, scan.camera, stamp, name, no_return=scan.no_return)

    def until(self, entry: Entry, message: Any) -> float:
        """The time in seconds up to which the lidar's poses are asked for by a cloud."""
        if self.at is None:
            return entry.stamp
        try:
            seconds = _times(_records(message), entry.stamp)
        except DatasetError:  # reported when its frame is read
            return entry.stamp
        return entry.stamp + (0.0 if seconds is None else max(0.0, float(np.nanmax(seconds))))

    def is_posed(self, entry: Entry, message: Any, pose: Pose) -> bool | None:
        """True if poses are known from a cloud's first point to its last; None if they are not asked for, or
        its points have no times that differ."""
        if self.at is None:
            return None
        try:
            cloud = decode(message, entry.stamp)
        except DatasetError:  # as above
            return None
        if cloud.seconds is None:
            return None
        motion = Motion(entry.stamp, pose, partial(self.at, entry.frame))
        return motion.is_known(cloud.seconds[measured_points(cloud.points_m)])

    def in_words(self, camera: Camera) -> str:
        """A note of the rays of a camera."""
        pattern = isinstance(camera, RayTable) and camera.has_pattern
        rays = f"images of {camera.width} x {camera.height} rays" if pattern else "free rays"
        return f"{self.topic}: {rays}"


def maps_clouds(reader: TopicSource, choice: SensorChoice) -> bool:
    """True if point clouds are mapped, and no images of depth."""
    return bool(choice.points or (not choice.depth and cloud_topics(reader) and not depth_topics(reader)))


def find_clouds(
    reader: TopicSource, choice: SensorChoice, options: ReadOptions
) -> tuple[BagSensor, dict[str, BagPoses], Clouds]:
    """The point clouds that are mapped, as the user chose, else the only ones, their poses by frames, and how
    they become frames. Raises DatasetError, which names the source and lists the candidates."""
    refuse_image_options(f"{reader.path}", options)
    topic = choose(reader, "points", choice.points, cloud_topics(reader), "topics of point clouds")
    if reader.topics[topic].type != messages.POINT_CLOUD:
        raise DatasetError(
            f"{reader.path}: topic {topic} is of type {reader.topics[topic].type}, not {messages.POINT_CLOUD}"
        )
    sensor = find_sensor(reader, topic, "clouds", choice)
    found = poses_of(sensor, choice)
    tracked, registered = choice.poses == TRACK, any(each.registered for each in found.values())
    if tracked:
        found = {frame: replace(each, at=lambda stamp, gap: np.eye(4)) for frame, each in found.items()}
    gap, deskews = largest_gap(options), choice.deskew and not tracked and not registered
    at = (lambda frame, stamp: found[frame].at(stamp, gap)) if deskews else None
    return sensor, found, Clouds(reader.path, topic, at, registered)


def posed_through(
    sensor: BagSensor, found: dict[str, BagPoses], clouds: Clouds, posed: Posed, options: ReadOptions
) -> tuple[Posed, list[str], str]:
    """Of clouds with a pose those with poses from the first point to the last, as :func:`through_scans`. Only
    those near a time without poses are read."""
    gap = largest_gap(options)
    if clouds.at is None:
        return posed, [], ""
    stamps = np.array([entry.stamp for _, entry, _ in posed])
    doubtful = np.zeros(len(posed), bool)
    for frame, poses in found.items():
        of_frame = np.array([entry.frame == frame for _, entry, _ in posed])
        near = poses.lacking(stamps - _LONGEST_SCAN_S, stamps + _LONGEST_SCAN_S, 2 * gap)
        doubtful |= of_frame & near
    known = [
        not is_doubtful or clouds.is_posed(entry, sensor.reader.read(clouds.topic, entry), pose)
        for is_doubtful, (_, entry, pose) in zip(doubtful, posed, strict=True)
    ]
    return through_scans(posed, known, f"clouds of {clouds.topic}", len(sensor.entries), gap)


def _image(cloud: Cloud, motion: Motion | None) -> Scan | None:
    """The image of a cloud with rows or rings, None for any other."""
    points = cloud.points_m.reshape(-1, 3)
    numbers: NDArray[np.intp] = np.arange(len(points)).reshape(cloud.points_m.shape[:2])
    if len(cloud.points_m) == 1 and cloud.ring is not None:
        rings = by_ring(points, cloud.ring[0])
        numbers = numbers if rings is None else rings
    found = organised(points[numbers])
    if found is None:
        return None
    scan, order = found
    if motion is None or cloud.seconds is None:
        return scan
    seconds = cloud.seconds.reshape(-1)[numbers.reshape(-1)[order]]
    return motion.of_image(scan, seconds, (scan.range_m > 0) & np.isfinite(seconds)) or scan


def _free(cloud: Cloud, motion: Motion | None) -> Scan:
    """A cloud as free rays."""
    measured, poses = measured_points(cloud.points_m), None
    if motion is not None and cloud.seconds is not None:
        poses = motion.poses(cloud.seconds[measured])
    return Scan(*RayTable.of_points(cloud.points_m[measured], poses), None)
