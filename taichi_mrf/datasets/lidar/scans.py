"""Lidar scans as frames: the reader behind every format of point clouds.

A format only lists its scans; a scan's points are read and checked here. Points of an unknown pattern become
free rays, one for each point, so every frame has a camera of its own, and depth is range. What every lidar's
recording says of its sensor is here too.

A lidar moves while it measures: each column of its image, or each point, gets the pose at its time. Rows of
an image need not be measured together: drivers shift them so that a column is an azimuth, and the end of a
row then holds what was measured first. Such pixels are put beyond the image's other edge, a turn away, so
that time and the sensor's place run on along every row, and neighbours are neighbours.
"""

import contextlib
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset, Row, StatedSensor, Table
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.datasets.timed_poses import interpolate
from taichi_mrf.errors import DatasetError, FrameError
from taichi_mrf.geometry.poses import Pose, inverse, tangent_norms
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.ray_table import RayTable

PoseAt = Callable[[float], Pose | None]
"""T_world_lidar, (4, 4), at a time in seconds, None if it is not known."""

_FAR_M = 10.0
_LOOKED_UP, _POSES_A_SCAN = 16, 1024
"""Poses are looked up so many times during a scan, and interpolated for so many columns."""

_ROUNDED = 1e-5
"""Share by which a point's time may be later than the last pose, or earlier than the first, by rounding."""

_WIDEST = 1.5
"""An image that would become wider than this share has no columns that follow each other in time."""


@dataclass(frozen=True)
class Scan:
    """A lidar's image, all (H, W): the camera of a sensor that stands still, ranges in metres, 0 for none,
    and the pixels without a return."""

    camera: RayTable
    range_m: NDArray[np.float32]
    no_return: NDArray[np.bool_] | None


@dataclass(frozen=True)
class Motion:
    """Time and place of a lidar: the ``stamp`` of a scan in seconds, its pose then and at any time."""

    stamp: float
    T_world_lidar: Pose
    at: PoseAt

    def poses(self, seconds: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """The poses (..., 4, 4) in the lidar's frame at the stamp, at times (...) after it in seconds. None
        if it moved less than its noise, if all times are one, or not all poses are known."""
        if not np.isfinite(seconds).all() or seconds.max() == seconds.min():
            return None
        first, last, known = float(seconds.min()), float(seconds.max()), self._looked_up(seconds)
        if known is None:
            return None
        rotation, translation = tangent_norms(known[0], known[-1])
        if _FAR_M * rotation + translation < LIDAR_SIGMA_M:
            return None
        T_lidar_world = inverse(self.T_world_lidar)
        T_lidar_then = np.array([T_lidar_world @ pose for pose in known])
        place = np.linspace(0, _LOOKED_UP - 1, _POSES_A_SCAN)
        before = np.minimum(place.astype(int), _LOOKED_UP - 2)
        T = interpolate(T_lidar_then[before], T_lidar_then[before + 1], place - before)
        column = np.rint((seconds - first) / (last - first) * (_POSES_A_SCAN - 1)).astype(int)
        return T[column]

    def is_known(self, seconds: NDArray[np.float64]) -> bool | None:
        """True if poses are known from the first of the times (...) after the stamp in seconds to the last;
        None if all times are one. Times that are not finite do not count."""
        times = seconds[np.isfinite(seconds)]
        if times.size == 0 or times.max() == times.min():
            return None
        return self._looked_up(times) is not None

    def _looked_up(self, seconds: NDArray[np.float64]) -> list[Pose] | None:
        """T_world_lidar at times that are spread from the first of ``seconds`` to the last, None if one of
        them is not known."""
        known = []
        for time in np.linspace(float(seconds.min()), float(seconds.max()), _LOOKED_UP):
            pose = self.at(self.stamp + time)
            pose = self.at(self.stamp + time * (1 - _ROUNDED)) if pose is None else pose
            if pose is None:
                return None
            known.append(pose)
        return known

    def of_image(self, scan: Scan, seconds: NDArray[np.float64], known: NDArray[np.bool_]) -> Scan | None:
        """A scan that was measured at times (H, W) after the stamp, of which some are ``known`` (H, W), with
        the sensor's pose at each pixel. None as for :meth:`poses`. Rays without a pattern take its place if
        columns do not follow each other in time."""
        if not known.any():
            return None
        order = _in_time(seconds, known)
        if order is None:
            measured = (scan.range_m > 0) & known
            poses = self.poses(seconds[measured]) if measured.any() else None
            if poses is None:
                return None
            points = scan.camera.rays()[measured] * scan.range_m[measured, None]
            return Scan(*RayTable.of_points(points, poses), None)
        poses = self.poses(order.seconds)
        if poses is None:
            return None
        rows = np.arange(len(seconds))[:, None]
        camera = RayTable.moving(RayTable(scan.camera.rays()[rows, order.columns]), poses)
        taken = rows, np.where(order.filled, order.columns, 0)
        range_m = np.where(order.filled, scan.range_m[taken], np.float32(0.0))
        no_return = None if scan.no_return is None else order.filled & scan.no_return[taken]
        return Scan(camera, range_m, no_return)


@dataclass(frozen=True)
class _Order:
    """The pixels of an image (H, W) in the order of time: the ``columns`` (W',) from which they come, which
    pixels are ``filled`` (H, W'), and the ``seconds`` (H, W') of all."""

    columns: NDArray[np.intp]
    filled: NDArray[np.bool_]
    seconds: NDArray[np.float64]


def _in_time(seconds: NDArray[np.float64], known: NDArray[np.bool_]) -> _Order | None:
    """Order of pixels measured at times (H, W); None if they do not follow each other column by column."""
    height, width = seconds.shape
    apart = max(1, width // 8)  # times may be those of packets of columns
    steps = (seconds[:, apart:] - seconds[:, :-apart])[known[:, apart:] & known[:, :-apart]] / apart
    step = float(np.median(steps)) if len(steps) else 0.0
    if step == 0.0:
        return None
    column = np.arange(width)
    times = np.where(known, seconds, np.nan)
    begin = float(np.nanmedian(times - step * column))
    for row, is_known in zip(times, known, strict=True):
        there = np.flatnonzero(is_known)
        if len(there):  # other pixels have the time of the nearest one, and the steps to it
            after = np.clip(np.searchsorted(there, column), 1, max(1, len(there) - 1))
            left, right = there[after - 1], there[np.minimum(after, len(there) - 1)]
            nearest = np.where(column - left <= right - column, left, right)
            row[:] = row[nearest] + step * (column - nearest)
        else:
            row[:] = begin + step * column
    turns = np.rint((times - begin - step * column) / (step * width))
    if np.abs(turns).max() > 1:
        return None
    place = column + turns.astype(np.intp) * width
    first, last = int(place.min()), int(place.max())
    if last - first + 1 > _WIDEST * width:
        return None
    places, rows = np.arange(first, last + 1), np.arange(height)[:, None]
    filled = np.zeros((height, len(places)), np.bool_)
    filled[rows, place - first] = True
    begins = np.median(times - step * place, axis=1)
    in_time = begins[:, None] + step * places
    in_time[rows, place - first] = times
    ends = seconds[known].min(), seconds[known].max()
    return _Order(places % width, filled, np.clip(in_time, *ends))


LIDAR_SIGMA_M = 0.03
"""Standard deviation of range that is assumed: spinning lidars are specified with 2 to 3 cm at all ranges."""

LIDAR_PASS_THROUGH = 0.1
"""Chance that a beam passes an occupied voxel. A lidar's voxels are wide, so posts and legs fill only a part
of one (docs/decisions.md)."""

_REACH_STEP_M, MOST_REACH_M = 10.0, 500.0


@dataclass
class LidarRecording(Dataset):
    """The scans of a lidar. ``reach_m`` is the largest range of the first one, None until that is read, and
    ``swept_m`` how far the lidar moves during a scan whose points have one pose, turns counted at 10 m.
    ``unit_is_known``: the points are metres, because their format or the user says so."""

    reach_m: float | None = field(default=None, kw_only=True)
    swept_m: float = field(default=0.0, kw_only=True)
    unit_is_known: bool = field(default=True, kw_only=True)

    def look_at_first(self, what: str) -> None:
        """Set camera and reach from the first scan (``what``) that can be read. Raises DatasetError, which
        says why the first cannot, if none can, and if its points are hardly metres."""
        problem: FrameError | None = None
        for index in range(len(self)):
            try:
                frame = self.read(index)
            except FrameError as error:
                problem = problem or error
                continue
            far_m = median_range(frame.depth_m)
            if far_m > MOST_REACH_M and not self.unit_is_known:
                raise DatasetError(
                    f"{self.name}: half of the points of {frame.name} are further away than {far_m:.0f} m: "
                    "pass --depth-scale 1000 if depth is in millimetres, --depth-scale 1 if it is in metres"
                )
            self.camera, self.reach_m = frame.camera, reach_of(frame.depth_m)
            if isinstance(frame.camera, RayTable) and frame.camera.origins_m is None:
                self.swept_m = self._swept_m()
            return
        raise DatasetError(f"{self.name}: no {what} can be read: {problem}") from problem

    def _swept_m(self) -> float:
        """The median motion in the usual time of a scan, by scans' poses; 0 if it is less than noise."""
        moved_m, stamps = [], self.stamps()
        for index in [] if self.tracked else range(0, len(self) - 1, max(1, len(self) // _LOOKED_UP)):
            seconds = stamps[index + 1] - stamps[index]
            with contextlib.suppress(FrameError):  # told when it is read
                rotation, translation = tangent_norms(self.pose(index), self.pose(index + 1))
                share = min(1.0, SECONDS_PER_SCAN / seconds) if seconds > 0 else 0.0
                moved_m.append(share * (_FAR_M * rotation + translation))
        swept_m = float(np.median(moved_m)) if moved_m else 0.0
        return swept_m if swept_m > LIDAR_SIGMA_M else 0.0

    def note_motion(self, what: str, why: str) -> None:
        """Set how far the lidar moves during scans (``what``), and say that it is not undone, and why."""
        self.swept_m = self._swept_m()
        if len(self) > 1 and not self.swept_m:
            return
        moves = f"the lidar moves by {self.swept_m:.2f} m in a scan, turns counted at 10 m, which is"
        moves = moves if self.swept_m else "the lidar's motion in a scan is"
        self.notes.append(f"{what}: {moves} not undone, though its points have times: {why}")

    @property
    def stated(self) -> StatedSensor:
        """Facts that are assumed for every lidar, and the largest range of the first scan."""
        return StatedSensor(
            (LIDAR_SIGMA_M,),
            origin="assumed for a lidar",
            reach_m=self.reach_m,
            pass_through=LIDAR_PASS_THROUGH,
            swept_m=self.swept_m,
        )


def median_range(range_m: NDArray[np.floating]) -> float:
    """The median of ranges, 0 for none."""
    return float(np.median(range_m[range_m > 0]))


def reach_of(range_m: NDArray[np.floating]) -> float:
    """Reach of ranges, 0 for none: all but the thousandth of them that may be damaged, rounded up to tens of
    metres, and at most MOST_REACH_M. Warns if most go further."""
    far_m = median_range(range_m)
    if far_m > MOST_REACH_M:
        warnings.warn(
            f"half of the points of the first scan are further than {far_m:.0f} m: set sensor.max_depth",
            stacklevel=3,
        )
    reach_m = np.quantile(range_m[range_m > 0], 0.999)
    return float(min(max(1.0, np.ceil(reach_m / _REACH_STEP_M)) * _REACH_STEP_M, MOST_REACH_M))


SECONDS_PER_SCAN = 0.1
"""Assumed where nothing tells: most lidars turn ten times a second."""


@dataclass(frozen=True)
class RecordedScan(Row):
    """One scan of a recording, whose pose is T_world_sensor. ``read_points`` gives its points (N, 3) in
    metres in the sensor's frame, of which it gets the pose, NaN and 0 where nothing came back; ``source`` is
    their file. ``starts`` gives the places (N, 3) in that frame from which they were measured, None if that
    is its pose. Both raise DatasetError, which names the file."""

    read_points: Callable[[Pose], NDArray[np.float64]]
    source: str
    starts: Callable[[], NDArray[np.float64]] | None = None


AnyScan = TypeVar("AnyScan")

DENSER_POSES = "denser poses are needed, or a larger --max-time-gap"


@dataclass
class LidarScans(LidarRecording, Table[RecordedScan]):
    """Scans of free rays. ``camera`` and ``reach_m`` are those of the first scan that can be read."""

    def load(self, index: int, row: RecordedScan, T_world_camera: Pose) -> Frame:
        """The rays of a scan's measured points, of which there must be one, and their ranges (1, N)."""
        points_m = row.read_points(T_world_camera)
        starts_m = np.zeros((1, 3)) if row.starts is None else row.starts()
        measured = measured_points(points_m - starts_m)
        if not measured.any():
            raise DatasetError(f"{row.source}: none of {len(points_m)} points is a measurement")
        if row.starts is None:
            table, range_m = RayTable.of_points(points_m[measured])
        else:
            T_sensor_then = np.tile(np.eye(4), (int(measured.sum()), 1, 1))
            T_sensor_then[:, :3, 3] = starts_m[measured]
            table, range_m = RayTable.of_points((points_m - starts_m)[measured], T_sensor_then)
        return Frame(range_m, T_world_camera, table, row.stamp, row.name)


def measured_points(points_m: NDArray[np.floating]) -> NDArray[np.bool_]:
    """True for points (..., 3) in the sensor's frame that are measurements: not NaN, infinite or 0."""
    with np.errstate(over="ignore", invalid="ignore"):
        range_m = np.linalg.norm(points_m.astype(np.float64), axis=-1).astype(np.float32)
    return np.isfinite(range_m) & (range_m > 0)


def lidar_scans(
    name: str,
    scans: Sequence[RecordedScan],
    notes: Sequence[str],
    dropped: int,
    options: ReadOptions,
    takes_scale: bool = False,
) -> LidarScans:
    """The recording of these scans. ``takes_scale``: their files do not tell the unit of points, and their
    readers take that of ``options.depth_scale``. Raises DatasetError if none can be read, which is the first
    one's error, and for options that only depth images have."""
    refuse_image_options(name, options, takes_scale)
    found = LidarScans(
        name, RayTable([[1.0, 0.0, 0.0]]), list(notes), dropped, rows=scans,
        unit_is_known=not takes_scale or options.depth_scale is not None,
    )  # fmt: skip
    found.look_at_first("scan")
    return found


def through_scans(
    scans: Sequence[AnyScan], known: Sequence[bool | None], what: str, count: int, gap: float
) -> tuple[list[AnyScan], list[str], str]:
    """The scans of which poses are ``known`` from the first point to the last, or that have no points with
    times (None), with a note that counts the others among ``count``. If no poses are known the motion during
    scans cannot be undone: all scans, and why. ``gap`` is the largest time to a neighbouring pose in seconds,
    of which two lie between two poses."""
    found = [scan for scan, is_known in zip(scans, known, strict=True) if is_known is None or is_known]
    poses = f"poses, at most {2 * gap:g} s apart, from its first point to its last"
    if not any(known) and len(found) < len(scans):
        return list(scans), [], f"no scan has {poses}; {DENSER_POSES}"
    dropped = len(scans) - len(found)
    return found, [f"{dropped} of {count} {what} dropped: none has {poses}"] if dropped else [], ""


def refuse_image_options(name: str, options: ReadOptions, takes_scale: bool = False) -> None:
    """Raise DatasetError, in one sentence, for options that only depth images have."""
    asked = {
        "--camera": options.camera is not None or options.intrinsics is not None,
        "--depth-scale": options.depth_scale is not None and not takes_scale,
        "--undistort": options.undistort is not None,
        "--image-scale": options.image_scale != 1.0,
    }
    wrong = [flag for flag, is_asked in asked.items() if is_asked]
    if wrong:
        raise DatasetError(f"{name}: contains lidar scans; {', '.join(wrong)} is for depth images")
