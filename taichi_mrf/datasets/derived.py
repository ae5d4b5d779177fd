"""Datasets that show the frames of another one in another way.

Pixels are resampled: put back where images are turned, undistorted, thinned out. Each output pixel is one
recorded measurement: the one nearest to where its ray crosses the recorded image. Nothing is averaged. An
average would mix the depths on both sides of an edge into surfaces that do not exist, and the mean or the
minimum of several pixels has another noise than the sensor model assumes (the minimum of four is one sigma
too near).

A recording is mended: its conventions are undone (conventions.py), and its origin is put near its first pose.
This is done on frames, so that it is the same for all formats.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Arrivals, Dataset, StampedPoses, StatedSensor
from taichi_mrf.datasets.conventions import AS_USUAL, POSE_UNITS, Conventions
from taichi_mrf.datasets.timed_poses import INTERPOLATION_GAP, TimedPoses, quaternion
from taichi_mrf.datasets.trajectories import pose_from_quaternion
from taichi_mrf.datasets.turned import put_back, sensor_camera
from taichi_mrf.errors import ConfigError, DatasetError, FrameError, LostFrameError, naming
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.sensor.camera import Camera, PinholeCamera, pinhole
from taichi_mrf.sensor.frame import Frame


@dataclass
class Derived(Dataset):
    """As many frames as ``source`` has, with the same names, and all else as the source has it; subclasses
    define how a frame is read."""

    source: Dataset = field(kw_only=True)

    @property
    def endless(self) -> bool:
        return self.source.endless

    def awaiting(self) -> str:
        return self.source.awaiting()

    def arrivals(self) -> Arrivals | None:
        return self.source.arrivals()

    @property
    def stated(self) -> StatedSensor:
        return self.source.stated

    @property
    def origin_m(self) -> NDArray[np.float64]:
        return self.source.origin_m

    def stamps(self) -> Sequence[float] | NDArray[np.float64]:
        return self.source.stamps()

    def pose(self, index: int) -> Pose:
        return self.source.pose(index)

    def own_poses(self) -> StampedPoses | None:
        return self.source.own_poses()

    def misfit(self) -> str | None:
        return self.source.misfit()

    def sensor_of(self, index: int) -> str:
        return self.source.sensor_of(index)

    @property
    def frame_names(self) -> Sequence[str]:
        return self.source.frame_names


def later(frame: Frame, by_s: float) -> Frame:
    """A frame as if it had been taken so many seconds later, with the samples of its IMU."""
    if by_s == 0:
        return frame
    gyro, acceleration = frame.gyro, frame.acceleration
    return replace(
        frame,
        stamp=frame.stamp + by_s,
        gyro=gyro and replace(gyro, stamps_s=gyro.stamps_s + by_s),
        acceleration=acceleration and replace(acceleration, stamps_s=acceleration.stamps_s + by_s),
    )


@dataclass
class Reposed(Derived):
    """The frames of ``source``, each (by index) at its pose of ``poses``, (4, 4) T_world_camera."""

    poses: Mapping[int, Pose] = field(kw_only=True)

    def own_poses(self) -> None:
        """None: they are not those of the source."""

    def pose(self, index: int) -> Pose:
        """The frame's pose. Raises LostFrameError if it has none."""
        if index not in self.poses:
            raise LostFrameError(f"{self.frame_names[index]}: pose unknown (tracking was lost)")
        return self.poses[index]

    def read(self, index: int) -> Frame:
        """The source's frame. Raises LostFrameError if it has no pose, and what the source raises."""
        T_world_camera = self.pose(index)
        return replace(self.source.read(index), T_world_camera=T_world_camera)


def reposed(dataset: Dataset, poses: Mapping[int, Pose]) -> Reposed:
    """The frames of a dataset at other poses."""
    return Reposed(dataset.name, dataset.camera, dataset.notes, dataset.dropped, source=dataset, poses=poses)


@dataclass
class Chosen(Derived):
    """Some frames of ``source``, and what it has of these: those with the ``indices``."""

    indices: Sequence[int] = field(kw_only=True)

    @cached_property
    def frame_names(self) -> Sequence[str]:
        return [self.source.frame_names[index] for index in self.indices]

    def stamps(self) -> Sequence[float] | NDArray[np.float64]:
        stamps = self.source.stamps()
        return [float(stamps[index]) for index in self.indices]

    def pose(self, index: int) -> Pose:
        return self.source.pose(self.indices[index])

    def sensor_of(self, index: int) -> str:
        return self.source.sensor_of(self.indices[index])

    def read(self, index: int) -> Frame:
        return self.source.read(self.indices[index])


def chosen(dataset: Dataset, indices: Sequence[int]) -> Chosen:
    """Some frames of a dataset, in the order of their ``indices``."""
    return Chosen(dataset.name, dataset.camera, source=dataset, indices=indices)


@dataclass
class Resampled(Derived):
    """The frames of ``source``, each pixel of them picked from the recorded image. ``rows`` and ``columns``
    (H, W) int64 say which pixel each of this camera's pixels takes, -1 where its ray did not meet the
    recorded image, which is no measurement. Recorded images are ``turned`` (conventions.py). One in
    ``stride`` pixels is kept; if they are not ``distorted``, frames may have cameras of their own."""

    rows: NDArray[np.int64] = field(kw_only=True)
    columns: NDArray[np.int64] = field(kw_only=True)
    turned: str = field(kw_only=True)
    stride: int = field(kw_only=True)
    distorted: bool = field(kw_only=True)

    def read(self, index: int) -> Frame:
        """Read the source's frame and pick its pixels. Raises what the source raises."""
        frame = self.source.read(index)
        if frame.depth_m.shape != self.source.camera.shape:
            raise FrameError(f"{frame.name}: the image has the shape {frame.depth_m.shape}")
        outside = self.rows < 0
        sigma_m = None if frame.sigma_m is None else frame.sigma_m[self.rows, self.columns]
        no_return = None if frame.no_return is None else frame.no_return[self.rows, self.columns] * ~outside
        return replace(
            frame,
            depth_m=self._picked(frame.depth_m),
            camera=self._camera(frame),
            color=None if frame.color is None else self._picked(frame.color),
            sigma_m=sigma_m,
            no_return=no_return,
            images={name: self._picked(image) for name, image in frame.images.items()},
        )

    def _picked(self, image: NDArray) -> NDArray:
        """The pixels of an image, 0 for those without a recorded one."""
        found = image[self.rows, self.columns]
        found[self.rows < 0] = 0
        return found

    def _camera(self, frame: Frame) -> Camera:
        """The camera of the pixels that are kept of a frame."""
        if frame.camera == self.source.camera:
            return self.camera
        if self.distorted:
            raise FrameError(f"frame {frame.name}: has intrinsics of its own; --undistort needs --camera too")
        recorded = pinhole(frame.camera, "--image-scale")
        return strided(sensor_camera(recorded, self.turned), self.stride)[0]


def resampled(dataset: Dataset, distortion: Sequence[float], stride: int, turned: str = "") -> Dataset:
    """The dataset with its images put back where they are ``turned`` (conventions.py), undistorted, and one
    in ``stride`` of their rows and columns kept. ``distortion`` are OpenCV's coefficients of the recorded
    images (none or zeros: they are a pinhole camera's). The camera keeps its intrinsics but for the stride.
    Raises DatasetError if nothing would be left of an image, and if its camera is no pinhole."""
    distorted = any(distortion)
    if not (distorted or turned) and stride == 1:
        return dataset
    with naming(dataset.name, ConfigError):
        flag = "--undistort" if distorted else "--image-is" if turned else "--image-scale"
        stored = pinhole(dataset.camera, flag)
    recorded = sensor_camera(stored, turned)
    with naming(f"{dataset.name}: image_scale 1/{stride} leaves no pixel", ConfigError):
        camera, first = strided(recorded, stride)
    rows, columns = np.meshgrid(
        first[0] + stride * np.arange(camera.height),
        first[1] + stride * np.arange(camera.width),
        indexing="ij",
    )
    notes = list(dataset.notes)
    if distorted:
        rows, columns = _recorded_pixels(recorded, distortion, rows, columns)
        share = float((rows < 0).mean())
        notes.append(
            f"images undistorted with {', '.join(f'{k:g}' for k in distortion)}, "
            f"{share:.1%} of their pixels lie outside the recorded ones"
        )
    if turned:
        place = put_back(np.arange(stored.width * stored.height).reshape(stored.shape), turned)
        outside, place = rows < 0, place[rows, columns]
        rows, columns = (np.where(outside, -1, each) for each in np.divmod(place, stored.width))
    if stride > 1:
        notes.append(f"one in {stride} rows and columns is read: {camera.width} x {camera.height} pixels")
    return Resampled(
        name=dataset.name,
        camera=camera,
        notes=notes,
        dropped=dataset.dropped,
        source=dataset,
        rows=rows,
        columns=columns,
        turned=turned,
        stride=stride,
        distorted=distorted,
    )


def strided(camera: PinholeCamera, stride: int) -> tuple[PinholeCamera, tuple[int, int]]:
    """The camera of every ``stride``-th row and column, and the (row, column) of the first that is kept. Its
    rays are exactly those of the kept pixels: a principal point that were scaled about the image's corner
    would be off by up to half a recorded pixel. Raises ConfigError if no row or no column is left."""
    first = (stride - 1) // 2
    thin = PinholeCamera(
        width=len(range(first, camera.width, stride)),
        height=len(range(first, camera.height, stride)),
        fx=camera.fx / stride,
        fy=camera.fy / stride,
        cx=(camera.cx - first) / stride,
        cy=(camera.cy - first) / stride,
    )
    return thin, (first, first)


def _recorded_pixels(
    camera: PinholeCamera, distortion: Sequence[float], rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Recorded pixel that saw along the ray of each undistorted pixel, -1 where none did."""
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    rays = camera.rays()[rows, columns]
    seen, _ = cv2.projectPoints(
        rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, np.asarray(distortion, np.float64)
    )
    u, v = np.rint(seen.reshape(*rows.shape, 2)).transpose(2, 0, 1)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    inside &= np.hypot(rays[..., 0], rays[..., 1]) < _validity(distortion, camera.largest_slant())
    return np.where(inside, v, -1).astype(np.int64), np.where(inside, u, -1).astype(np.int64)


def _validity(distortion: Sequence[float], reach: float) -> float:
    """The tangent of the angle off the axis up to which the lens model is one-to-one, at most ``reach``:
    beyond, a polynomial that was fitted to the image turns back and would show its inside once more."""
    k1, k2, _, _, k3, k4, k5, k6 = (*distortion, *[0.0] * (8 - len(distortion)))
    r = np.linspace(0.0, reach, 4096)
    bent = r * (1 + r**2 * (k1 + r**2 * (k2 + r**2 * k3))) / (1 + r**2 * (k4 + r**2 * (k5 + r**2 * k6)))
    turns = np.flatnonzero(np.diff(bent) <= 0)
    return float(r[turns[0]]) if len(turns) else float("inf")


NEAR_ORIGIN_M = 1000.0
"""The origin is moved where the first pose is farther from it, as in coordinates of a country. Maps reach
65,536 voxels to each side, and up to here a kernel's 32-bit numbers are exact to a tenth of a millimetre."""

ORIGIN_STEP_M = 1000.0
"""Origins are multiples of it, so that recordings of one place have the same one."""

T_AXES_OPTICAL: dict[str, NDArray[np.float64]] = {
    "opengl": np.diag([1.0, -1.0, -1.0]),
    "ros": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
    "ned": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
}
"""The rotations that take optical axes to others."""


def pose_of(T_recorded: Pose, conventions: Conventions) -> Pose:
    """T_world_camera, (4, 4), of a recorded pose."""
    T = T_recorded.copy()
    if conventions.w_first:
        w, x, y, z = quaternion(T[:3, :3])
        T = pose_from_quaternion(np.array([*T[:3, 3], x, y, z, w]))
    if conventions.unit:
        T[:3, 3] /= POSE_UNITS[conventions.unit]
    if conventions.inverse:
        T = inverse(T)
    if conventions.axes:  # a product with the identity would lose the sign of zeros, which orders keyframes
        T[:3, :3] = T[:3, :3] @ T_AXES_OPTICAL[conventions.axes]
    if conventions.mounting:
        T = T @ pose_from_quaternion(np.array(conventions.mounting))
    return T


def axial_depth(
    depth_m: NDArray[np.float32], camera: Camera, conventions: Conventions
) -> NDArray[np.float32]:
    """Depth along the rays as :class:`Frame` has it, (H, W) metres, of recorded depth."""
    if not conventions.along_ray:
        return depth_m
    length = np.linalg.norm(camera.rays(), axis=-1)
    return (depth_m / length).astype(np.float32)


def origin_of(position_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """The origin (3,) near a position: zero, unless that is far from it."""
    far = np.abs(position_m).max() > NEAR_ORIGIN_M
    return np.rint(position_m / ORIGIN_STEP_M) * ORIGIN_STEP_M if far else np.zeros(3)


def stated_origin(dataset: Dataset) -> tuple[float, ...] | None:
    """The origin as a dataset's frames state it, None if it was not moved."""
    origin_m = dataset.origin_m
    return tuple(origin_m.tolist()) if origin_m.any() else None


def moved_note(origin_m: NDArray[np.float64]) -> str:
    """A note that the origin was moved."""
    return "the origin of the world is moved to {:.0f} {:.0f} {:.0f}".format(*(origin_m + 0.0))


@dataclass
class Mended(Derived):
    """The frames of ``source`` with ``conventions`` undone and the origin moved by ``moved_m`` (3,). Where
    poses are late, ``timed`` are the mended ones, in which those of frames are interpolated; else None."""

    conventions: Conventions = field(kw_only=True)
    timed: TimedPoses | None = field(kw_only=True)
    gap_s: float = field(kw_only=True)
    moved_m: NDArray[np.float64] = field(kw_only=True)

    @property
    def origin_m(self) -> NDArray[np.float64]:
        """The source's, and by how much it is moved on."""
        return self.source.origin_m + self.moved_m

    def pose(self, index: int) -> Pose:
        if self.timed is None:
            T = pose_of(self.source.pose(index), self.conventions)
        else:
            found = self.timed.at(float(self.source.stamps()[index]) + self.conventions.late_s, self.gap_s)
            if found is None:
                raise FrameError(
                    f"frame {self.frame_names[index]}: no pose {self.conventions.late_s:g} s later"
                )
            T = found
        T[:3, 3] -= self.moved_m
        return T

    def read(self, index: int) -> Frame:
        frame = self.source.read(index)
        depth_m = axial_depth(frame.depth_m, frame.camera, self.conventions)
        T = pose_of(frame.T_world_camera, self.conventions)
        T[:3, 3] -= self.moved_m
        T = T if self.timed is None else self.pose(index)
        return replace(frame, depth_m=depth_m, T_world_camera=T, origin_m=stated_origin(self))


def mended(dataset: Dataset, conventions: Conventions, max_time_gap: float | None = None) -> Dataset:
    """The dataset with its conventions undone and its origin near the first pose. Raises DatasetError if none
    of its frames has a pose."""
    origin_m = np.zeros(3)
    if not dataset.tracked and not dataset.endless:
        first = _first_pose(dataset, conventions)
        origin_m = np.zeros(3) if first is None else origin_of(first[:3, 3])
    if conventions == AS_USUAL and not origin_m.any():
        return dataset
    timed, gap_s, said = None, 0.0, list[str]()
    if conventions.late_s:
        dataset, timed, gap_s, said = _shifted(dataset, conventions, max_time_gap)
    notes = [*dataset.notes, *said]
    if conventions != AS_USUAL:
        notes.append(f"conventions: {' '.join(conventions.flags())}")
    if origin_m.any():
        notes.append(moved_note(origin_m))
    return Mended(
        dataset.name,
        dataset.camera,
        notes,
        dataset.dropped,
        dataset.distortion,
        dataset.tracked,
        source=dataset,
        conventions=conventions,
        timed=timed,
        gap_s=gap_s,
        moved_m=origin_m,
    )


def _first_pose(dataset: Dataset, conventions: Conventions) -> Pose | None:
    """The pose of the first frame that has one."""
    for index in range(len(dataset)):
        with suppress(FrameError):
            return pose_of(dataset.pose(index), conventions)
    return None


def _shifted(
    dataset: Dataset, conventions: Conventions, max_time_gap: float | None
) -> tuple[Dataset, TimedPoses, float, list[str]]:
    """The frames that have a pose ``late_s`` later, all mended poses, the largest gap between two, and
    notes. Poses are interpolated in their own times where the recording has these, else in the frames'."""
    stamps, notes = np.asarray(dataset.stamps(), np.float64), list[str]()
    track = dataset.own_poses()
    if track is None:
        track = _of_frames(dataset, stamps)
        notes.append("late: the recording has only the poses of frames; those between are interpolated")
    timed = TimedPoses(track[0], [pose_of(T, conventions) for T in track[1]])
    usual_s = float(np.median(np.diff(timed.stamps))) if len(timed) > 1 else 0.0
    gap_s = max_time_gap or max(INTERPOLATION_GAP, 2.0 * usual_s)
    kept = [
        i for i in range(len(dataset)) if timed.at(float(stamps[i]) + conventions.late_s, gap_s) is not None
    ]
    if not kept:
        raise DatasetError(f"{dataset.name}: no frame has a pose {conventions.late_s:g} s later")
    if len(kept) == len(dataset):
        return dataset, timed, gap_s, notes
    notes.append(f"{len(dataset) - len(kept)} frames dropped: no poses {conventions.late_s:g} s later")
    picked: Chosen = chosen(dataset, kept)
    picked.notes = list(dataset.notes)
    return picked, timed, gap_s, notes


def _of_frames(dataset: Dataset, stamps: NDArray[np.float64]) -> StampedPoses:
    """The poses of the frames that have one."""
    known: list[int] = []
    poses: list[Pose] = []
    for index in range(len(dataset)):
        with suppress(FrameError):
            poses.append(dataset.pose(index))
            known.append(index)
    return stamps[known], poses
