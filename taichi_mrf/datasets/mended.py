"""A recording with its conventions undone (conventions.py) and an origin near its first pose.

This is done on frames, so that it is the same for all formats.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.conventions import AS_USUAL, POSE_UNITS, Conventions
from taichi_mrf.datasets.derived import Chosen, Derived, chosen
from taichi_mrf.datasets.timed_poses import INTERPOLATION_GAP, TimedPoses, quaternion
from taichi_mrf.datasets.trajectories import pose_from_quaternion
from taichi_mrf.errors import DatasetError, FrameError
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.frame import Frame

NEAR_ORIGIN_M = 1000.0
"""The origin is moved where the first pose is farther from it, as in coordinates of a country. Maps reach
65,536 voxels to each side, and up to here a kernel's 32-bit numbers are exact to a tenth of a millimetre."""

ORIGIN_STEP_M = 1000.0
"""Origins are multiples of it, so that recordings of one place have the same one."""

T_AXES_OPTICAL: dict[str, NDArray[np.float64]] = {
    "opengl": np.diag([1.0, -1.0, -1.0]),
    "ros": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
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
        """The pose of one frame. Raises what the source raises."""
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
        """The source's frame. Raises what the source raises."""
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
    timed, gap_s = None, 0.0
    if conventions.late_s:
        dataset, timed, gap_s = _shifted(dataset, conventions, max_time_gap)
    notes = list(dataset.notes)
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
        try:
            return pose_of(dataset.pose(index), conventions)
        except FrameError:
            continue
    return None


def _shifted(
    dataset: Dataset, conventions: Conventions, max_time_gap: float | None
) -> tuple[Dataset, TimedPoses, float]:
    """The frames that have a pose ``late_s`` later, all mended poses, and the largest gap between two."""
    known: list[int] = []
    poses: list[Pose] = []
    for index in range(len(dataset)):
        try:
            poses.append(pose_of(dataset.pose(index), conventions))
            known.append(index)
        except FrameError:
            continue
    stamps = np.asarray(dataset.stamps(), np.float64)
    timed = TimedPoses(stamps[known], poses)
    usual_s = float(np.median(np.diff(timed.stamps))) if len(timed) > 1 else 0.0
    gap_s = max_time_gap or max(INTERPOLATION_GAP, 2.0 * usual_s)
    kept = [
        i for i in range(len(dataset)) if timed.at(float(stamps[i]) + conventions.late_s, gap_s) is not None
    ]
    if not kept:
        raise DatasetError(f"{dataset.name}: no frame has a pose {conventions.late_s:g} s later")
    if len(kept) == len(dataset):
        return dataset, timed, gap_s
    picked: Chosen = chosen(dataset, kept)
    picked.notes = [
        *dataset.notes,
        f"{len(dataset) - len(kept)} frames dropped: no poses {conventions.late_s:g} s later",
    ]
    return picked, timed, gap_s
