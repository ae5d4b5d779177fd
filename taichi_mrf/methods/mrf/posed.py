"""The poses of an MRFMap's keyframes: one that is moved or refined, and a whole trajectory that changes while
the map lives, as a pose graph does when a loop closes; and the sweeps that bring the marginals up to date."""

import math
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.alignment.refine import Aligner, RefinedPose, log_likelihood, map_of_others
from taichi_mrf.config.arguments import real
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.errors import KeyframeError
from taichi_mrf.geometry.poses import Pose, as_pose, inverse
from taichi_mrf.geometry.spread import furthest_first
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.schedule import InferReport, Progress
from taichi_mrf.methods.brick_map import check_inference
from taichi_mrf.methods.mrf.inferring import restore_messages
from taichi_mrf.methods.mrf.parts import MapParts
from taichi_mrf.sensor.pose_doubt import Covariance, checked_covariance
from taichi_mrf.system.interrupts import interrupts_wait
from taichi_mrf.voxels.layout import BRICK

EXACT = np.zeros((6, 6))
"""The covariance of a pose that is taken as exact."""

WRONG_MOTION = 0.5
"""Motion of what a keyframe sees, in voxels, above which its messages are no longer right."""

GAZE_M = 2.0
"""A viewpoint is the camera's position and the place so far ahead of it, so that cameras that look into
different directions from the same place are far apart."""


@dataclass(frozen=True)
class PoseUpdate:
    """Result of MRFMap.update_poses: the keyframes ``moved``, those ``kept`` in place because their poses
    hardly changed, and the new poses (4, 4) ``left`` for the next call. ``report`` is that of the sweeps
    after all motions or, if some are left, of the sweeps so far."""

    moved: tuple[int, ...]
    kept: tuple[int, ...]
    left: Mapping[int, Pose]
    report: InferReport

    @property
    def complete(self) -> bool:
        """True if all poses are in the map, and no keyframe's evidence is out of date."""
        return not self.left and self.report.complete


def move_keyframe(
    parts: MapParts, id: int, T_world_camera: ArrayLike, pose_covariance: ArrayLike | None = None
) -> None:
    """MRFMap.move_keyframe."""
    keyframe = parts.find(id)
    T, image = as_pose(T_world_camera), keyframe.image
    if pose_covariance is not None:
        image = image.doubting(checked_covariance(pose_covariance))
    restore_messages(parts)
    parts.settled = False
    with interrupts_wait():
        parts.allocator.take_out(keyframe)
        try:
            parts.keyframes[id] = parts.allocator.place_again(keyframe, image, T)
        except Exception:
            parts.keyframes[id] = parts.allocator.put_back(keyframe)
            raise


def update_poses(
    parts: MapParts,
    poses: Mapping[int, ArrayLike],
    least: float,
    tolerance: float | None,
    seconds: float | None,
    covariances: Mapping[int, ArrayLike],
) -> PoseUpdate:
    """MRFMap.update_poses."""
    begin = time.perf_counter()
    voxel_size, keyframes = parts.config.voxel_size, parts.keyframes
    least_m = real(least, "least", least=0) * voxel_size
    if seconds is not None:
        real(seconds, "seconds", least=0)
    wanted = {parts.find(id).id: _pose_of(id, T) for id, T in poses.items()}
    doubts = {id: _covariance_of(id, covariances[id]) for id in wanted if id in covariances}
    motions_m = {id: _largest_motion_m(keyframes[id], T) for id, T in wanted.items()}
    kept = tuple(
        id for id in wanted if motions_m[id] <= least_m and _has_covariance(keyframes[id], doubts.get(id))
    )
    moving = sorted(wanted.keys() - set(kept), key=lambda id: (-motions_m[id], id))

    def time_left() -> float | None:
        return None if seconds is None else max(0.0, seconds - (time.perf_counter() - begin))

    # 1. What was said of wrong places goes first.
    wrong = [id for id in moving if motions_m[id] > WRONG_MOTION * voxel_size]
    restore_messages(parts)
    if moving:
        parts.settled = False
    for id in wrong:
        with interrupts_wait():
            parts.allocator.withdraw(keyframes[id])
            keyframes[id].withdrawn = True
    # 2. Evidence comes back where there is least of it.
    left = {id: wanted[id] for id in moving}
    others = [keyframe for id, keyframe in keyframes.items() if id not in left]
    there = [_viewpoint(each.T_world_camera) for each in others if each.messages is not None]
    moved: list[int] = []
    for place in furthest_first([_viewpoint(wanted[id]) for id in moving], there):
        id = moving[place]
        if moved and time_left() == 0.0:
            break
        move_keyframe(parts, id, left.pop(id), doubts.get(id))
        parts.incremental.sweep(keyframes[id])
        moved.append(id)
    # 3. The others follow.
    if left:
        rays = sum(keyframes[id].rays for id in moved)
        report = InferReport(time.perf_counter() - begin, 1.0, len(moved), rays, complete=False)
    else:
        back = [id for id in kept if keyframes[id].withdrawn]  # an earlier call had another pose
        report = renew(parts, back, tolerance, time_left())
    return PoseUpdate(tuple(moved), kept, left, report)


def renew(
    parts: MapParts,
    keyframes: Iterable[int] = (),
    tolerance: float | None = None,
    seconds: float | None = None,
    progress: Progress | None = None,
) -> InferReport:
    """MRFMap.renew."""
    first = [parts.find(id).id for id in check_inference(None, tolerance, keyframes) or ()]
    if seconds is not None:
        real(seconds, "seconds", least=0)
    restore_messages(parts)
    if tolerance is None:
        tolerance = parts.config.inference.renew_tolerance
    parts.settled = False
    return parts.incremental.run(parts.keyframes, first, tolerance, seconds, progress)


def aligner_of(parts: MapParts) -> Aligner:
    """The aligner of a map's keyframes."""
    return Aligner(parts.view, parts.surfels)


def refine_pose(
    parts: MapParts, id: int, config: PoseConfig | None = None, guesses: Sequence[ArrayLike] = ()
) -> RefinedPose:
    """MRFMap.refine_pose."""
    keyframe = _with_messages(parts, id)
    poses = [as_pose(T) for T in guesses]
    refined = aligner_of(parts).refine(keyframe, parts.keyframes, config or PoseConfig(), poses)
    if refined.accepted:
        move_keyframe(parts, id, refined.T_world_camera)
    return refined


def depth_log_likelihood(parts: MapParts, id: int) -> float:
    """MRFMap.depth_log_likelihood."""
    keyframe, view = _with_messages(parts, id), parts.view
    with map_of_others(view, keyframe):
        return log_likelihood(view, keyframe, keyframe.T_world_camera, parts.config.sensor.max_depth)


def _with_messages(parts: MapParts, id: int) -> Keyframe:
    """A keyframe whose messages, if it has any, are those of its visible bricks."""
    keyframe = parts.find(id)
    restore_messages(parts)
    if keyframe.messages is not None:
        parts.allocator.refresh(keyframe)
    return keyframe


def _has_covariance(keyframe: Keyframe, pose_covariance: Covariance | None) -> bool:
    """True if a keyframe's covariance is this one already, or if this one is None."""
    own = keyframe.own.pose_covariance
    return pose_covariance is None or np.array_equal(EXACT if own is None else own, pose_covariance)


def _pose_of(id: int, T_world_camera: ArrayLike) -> Pose:
    try:
        return as_pose(T_world_camera)
    except KeyframeError as error:
        raise KeyframeError(f"the new pose of keyframe {id}: {error}") from error


def _covariance_of(id: int, pose_covariance: ArrayLike) -> Covariance:
    """A covariance (6, 6), zeros for that of an exact pose."""
    try:
        covariance = checked_covariance(pose_covariance)
    except KeyframeError as error:
        raise KeyframeError(f"the new pose of keyframe {id}: {error}") from error
    return EXACT if covariance is None else covariance


def _largest_motion_m(keyframe: Keyframe, T_world_camera: Pose) -> float:
    """Largest motion, in metres, of anything in a keyframe's view if it is moved to another pose: one of the
    corners of the box around its bricks moves furthest. 0 only for the same pose, bit for bit, because the
    order of inference follows from the bits."""
    if T_world_camera.tobytes() == keyframe.T_world_camera.tobytes():
        return 0.0
    footprint = keyframe.footprint
    bricks = footprint.window.bricks_of(footprint.crossed)
    if len(bricks) == 0:
        return math.inf
    lower, upper = bricks.min(axis=0), bricks.max(axis=0) + 1
    corners_m = np.where(list(np.ndindex(2, 2, 2)), upper, lower) * (BRICK * footprint.window.voxel_size)
    step = T_world_camera @ inverse(keyframe.T_world_camera) - np.eye(4)
    motions_m = np.linalg.norm(corners_m @ step[:3, :3].T + step[:3, 3], axis=1)
    return max(float(motions_m.max()), sys.float_info.min)


def _viewpoint(T_world_camera: Pose) -> NDArray[np.float64]:
    """(6,) metres: two viewpoints are as far apart as what is seen from them differs."""
    position_m, ahead = T_world_camera[:3, 3], T_world_camera[:3, 2]
    return np.concatenate([position_m, position_m + GAZE_M * ahead])
