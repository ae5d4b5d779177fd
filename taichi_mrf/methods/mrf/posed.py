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
from taichi_mrf.inference.incremental import IncrementalInference
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.schedule import InferReport, Progress
from taichi_mrf.methods.brick_map import check_inference
from taichi_mrf.methods.mrf.keyframe_allocator import KeyframeAllocator
from taichi_mrf.methods.mrf.reading import ReadableMRF
from taichi_mrf.sensor.pose_doubt import Covariance, checked_covariance
from taichi_mrf.system.interrupts import interrupts_wait
from taichi_mrf.voxels.layout import BRICK

EXACT = np.zeros((6, 6))
"""The covariance of a pose that is taken as exact."""

LEAST_MOTION = 0.1
"""Motion of what a keyframe sees, in voxels, up to which a new pose is left out."""

WRONG_MOTION = 0.5
"""Motion of what a keyframe sees, in voxels, above which its messages are no longer right."""

GAZE_M = 2.0
"""A viewpoint is the camera's position and the place so far ahead of it, so that cameras that look into
different directions from the same place are far apart."""


@dataclass(frozen=True)
class PoseUpdate:
    """Result of :meth:`PosedMRF.update_poses`: the keyframes that it ``moved``, those that it ``kept`` where
    they were because their pose has hardly changed, and the new poses (4, 4) for which time was over, which
    are ``left`` for the next call. ``report`` is that of the sweeps after all motions, or, if some are left,
    of those sweeps that were made."""

    moved: tuple[int, ...]
    kept: tuple[int, ...]
    left: Mapping[int, Pose]
    report: InferReport

    @property
    def complete(self) -> bool:
        """True if all poses are in the map, and no keyframe's evidence is out of date."""
        return not self.left and self.report.complete


class PosedMRF(ReadableMRF):
    """The part of an MRFMap that changes poses, and renews what follows from them."""

    aligner: Aligner
    _allocator: KeyframeAllocator
    _incremental: IncrementalInference
    _settled: bool

    def move_keyframe(
        self, id: int, T_world_camera: ArrayLike, pose_covariance: ArrayLike | None = None
    ) -> None:
        """Move a keyframe to another pose, (4, 4), as a SLAM back-end does. Its messages are dropped.

        ``pose_covariance`` (6, 6) is that of the new pose, as in :meth:`add_keyframe`, zeros if it is exact.
        Without it the keyframe keeps the covariance that it has. Raises KeyframeError, or CapacityError if
        there is not enough memory; the map is then unchanged.
        """
        keyframe = self._find(id)
        T, image = as_pose(T_world_camera), keyframe.image
        if pose_covariance is not None:
            image = image.doubting(checked_covariance(pose_covariance))
        self._restore_messages()
        self._settled = False
        with interrupts_wait():
            self._allocator.take_out(keyframe)
            try:
                self._keyframes[id] = self._allocator.place_again(keyframe, image, T)
            except Exception:
                self._keyframes[id] = self._allocator.put_back(keyframe)
                raise

    def update_poses(
        self,
        poses: Mapping[int, ArrayLike],
        least: float = LEAST_MOTION,
        tolerance: float | None = None,
        seconds: float | None = None,
        covariances: Mapping[int, ArrayLike] | None = None,
    ) -> PoseUpdate:
        """Take in the poses, id -> (4, 4), of a trajectory that was corrected, as after a closed loop.
        ``covariances``, id -> (6, 6), are those of some of these poses, as :meth:`move_keyframe` takes them.

        1. Keyframes whose view moves by more than half a voxel are withdrawn: what they said of wrong places
           no longer counts.
        2. All are moved and swept at their new poses one by one, each time the one whose viewpoint is
           furthest from those of all keyframes in their places, so that few of them soon cover the map.
        3. Those whose evidence has changed are swept again, as by :meth:`renew`, whose ``tolerance`` this is.

        A keyframe stays where it is if nothing in its view would move by more than ``least`` voxels, unless
        it is given another covariance; the pose at which it was placed still counts.

        After ``seconds`` no further keyframe is begun, but one is moved in any case: give ``left`` of the
        result to the next call. Until then those of ``left`` that were withdrawn have no evidence in the map,
        unless :meth:`infer`, or :meth:`renew` with their ids, sweeps them at their old poses.
        Afterwards :meth:`infer` makes, with ``least`` 0, the map that is made anew with these poses, bit for
        bit, also if this call was interrupted and the poses are given again. Raises KeyframeError for an
        unknown id or an impossible pose, before anything moves, and CapacityError if there is not enough
        memory for a keyframe's new pose; it and those after it are then as if they were ``left``.
        """
        begin = time.perf_counter()
        least_m = real(least, "least", least=0) * self.voxel_size
        if seconds is not None:
            real(seconds, "seconds", least=0)
        wanted = {self._find(id).id: _pose_of(id, T) for id, T in poses.items()}
        stated = {} if covariances is None else covariances
        doubts = {id: _covariance_of(id, stated[id]) for id in wanted if id in stated}
        motions_m = {id: _largest_motion_m(self._keyframes[id], T) for id, T in wanted.items()}
        kept = tuple(
            id for id in wanted if motions_m[id] <= least_m and self._has_covariance(id, doubts.get(id))
        )
        moving = sorted(wanted.keys() - set(kept), key=lambda id: (-motions_m[id], id))

        def time_left() -> float | None:
            return None if seconds is None else max(0.0, seconds - (time.perf_counter() - begin))

        # 1. What was said of wrong places goes first.
        wrong = [id for id in moving if motions_m[id] > WRONG_MOTION * self.voxel_size]
        self._restore_messages()
        if moving:
            self._settled = False
        for id in wrong:
            with interrupts_wait():
                self._allocator.withdraw(self._keyframes[id])
                self._keyframes[id].withdrawn = True
        # 2. Evidence comes back where there is least of it.
        left = {id: wanted[id] for id in moving}
        others = [keyframe for id, keyframe in self._keyframes.items() if id not in left]
        there = [_viewpoint(each.T_world_camera) for each in others if each.messages is not None]
        moved: list[int] = []
        for place in furthest_first([_viewpoint(wanted[id]) for id in moving], there):
            id = moving[place]
            if moved and time_left() == 0.0:
                break
            self.move_keyframe(id, left.pop(id), doubts.get(id))
            self._incremental.sweep(self._keyframes[id])
            moved.append(id)
        # 3. The others follow.
        if left:
            rays = sum(self._keyframes[id].rays for id in moved)
            report = InferReport(time.perf_counter() - begin, 1.0, len(moved), rays, complete=False)
        else:
            back = [id for id in kept if self._keyframes[id].withdrawn]  # an earlier call had another pose
            report = self.renew(back, tolerance, time_left())
        return PoseUpdate(tuple(moved), kept, left, report)

    def _has_covariance(self, id: int, pose_covariance: Covariance | None) -> bool:
        """True if a keyframe's covariance is this one already, or if this one is None."""
        own = self._keyframes[id].own.pose_covariance
        return pose_covariance is None or np.array_equal(EXACT if own is None else own, pose_covariance)

    def renew(
        self,
        keyframes: Iterable[int] = (),
        tolerance: float | None = None,
        seconds: float | None = None,
        progress: Progress | None = None,
    ) -> InferReport:
        """Bring the marginals up to date without starting over. Sweeps ``keyframes`` (ids) first, then those
        whose cavity changed, most changed first, until each has had at most the share ``tolerance`` of its
        voxels' marginals moved since its last sweep (default: ``inference.renew_tolerance``).

        Starts no sweep after ``seconds``; the next call continues. The report's ``residual`` is the largest
        share left, its ``sweeps`` count keyframes. The result depends slightly on the order of changes;
        that of :meth:`infer` does not.
        """
        first = [self._find(id).id for id in check_inference(None, tolerance, keyframes) or ()]
        if seconds is not None:
            real(seconds, "seconds", least=0)
        self._restore_messages()
        if tolerance is None:
            tolerance = self.config.inference.renew_tolerance
        self._settled = False
        return self._incremental.run(self._keyframes, first, tolerance, seconds, progress)

    def refine_pose(
        self, id: int, config: PoseConfig | None = None, guesses: Sequence[ArrayLike] = ()
    ) -> RefinedPose:
        """Move a keyframe to the pose near by under which its depth is most likely in the map of the others.
        The search starts at its pose or at one of ``guesses``, (4, 4) each. Raises KeyframeError."""
        keyframe = self._find(id)
        self._restore_messages()
        if keyframe.messages is not None:
            self._allocator.refresh(keyframe)
        poses = [as_pose(T) for T in guesses]
        refined = self.aligner.refine(keyframe, self._keyframes, config or PoseConfig(), poses)
        if refined.accepted:
            self.move_keyframe(id, refined.T_world_camera)
        return refined

    def depth_log_likelihood(self, id: int) -> float:
        """Mean log-likelihood, per metre, of a keyframe's depth in the map of all others; NaN if it has
        none. Raises KeyframeError."""
        keyframe = self._find(id)
        self._restore_messages()
        if keyframe.messages is not None:
            self._allocator.refresh(keyframe)
        with map_of_others(self.view, keyframe):
            return log_likelihood(self.view, keyframe, keyframe.T_world_camera, self.sensor.max_depth)


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
    """How far anything in a keyframe's view moves, at most, in metres, if it is moved to another pose: one of
    the corners of the box around its bricks moves furthest. 0 only for the same pose, bit for bit, because
    the order of inference follows from the bits."""
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
