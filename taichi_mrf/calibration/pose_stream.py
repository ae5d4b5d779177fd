"""A stream of timed poses: the pose of a body at any time between two recorded ones, and its speed."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.trajectories import read_trajectory
from taichi_mrf.errors import DatasetError, KeyframeError


@dataclass(frozen=True)
class PoseStream:
    """Poses (N, 4, 4) at ``stamps`` (N,) in seconds, ascending, N at least 1."""

    stamps: NDArray[np.float64]
    poses: NDArray[np.float64]

    def at(
        self, times: NDArray[np.float64], largest_gap: float
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """The poses at ``times`` (M,), (M, 4, 4), and which of them are known: the stream has a pose
        before and one after, at most ``largest_gap`` seconds apart. A stream of one pose stands still.

        Positions lie on the line between the two, rotations on the shortest way (slerp).
        """
        times = np.asarray(times, np.float64)
        if len(self.stamps) == 1:
            return np.repeat(self.poses, len(times), axis=0), np.ones(len(times), dtype=bool)
        after = np.clip(np.searchsorted(self.stamps, times, side="right"), 1, len(self.stamps) - 1)
        before = after - 1
        gap = self.stamps[after] - self.stamps[before]
        share = (times - self.stamps[before]) / gap
        inside = (share >= 0) & (share <= 1) & (gap <= largest_gap)
        share = np.clip(share, 0, 1)
        T0, T1 = self.poses[before], self.poses[after]
        out = np.repeat(np.eye(4)[None], len(times), axis=0)
        out[:, :3, 3] = T0[:, :3, 3] + share[:, None] * (T1[:, :3, 3] - T0[:, :3, 3])
        turn = rotation_vectors(_transposed(T0[:, :3, :3]) @ T1[:, :3, :3])
        out[:, :3, :3] = T0[:, :3, :3] @ rotations(share[:, None] * turn)
        return out, inside


def read_pose_stream(path: Path) -> PoseStream:
    """Read ``stamp tx ty tz qx qy qz qw`` lines, separated by blanks or commas, in any order.

    Raises DatasetError, naming the file and the line, for anything else.
    """
    trajectory = read_trajectory(path)
    if trajectory.layout != "stamped":
        raise DatasetError(f"{path}: poses without stamps; expected stamp tx ty tz qx qy qz qw on each line")
    recorded = sorted(trajectory.poses, key=lambda pose: pose.key)
    stamps = np.array([pose.key for pose in recorded])
    first = np.concatenate([[True], np.diff(stamps) > 0])
    poses = []
    for pose in recorded:
        try:
            poses.append(pose.T_world_camera())
        except KeyframeError as error:
            raise DatasetError(f"{pose.source}: {error}") from error
    return PoseStream(stamps[first], np.stack(poses)[first])


def rotation_vectors(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Axis times angle (0 to pi, radians) of rotations (..., 3, 3), (..., 3)."""
    axis = 0.5 * np.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1
    )
    sine = np.linalg.norm(axis, axis=-1)
    angle = np.arctan2(sine, 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1.0))
    return axis * (angle / np.maximum(sine, 1e-15))[..., None]


def rotations(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotations (..., 3, 3) from axis times angle (..., 3) (Rodrigues)."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    K = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)
    safe = np.maximum(angle, 1e-12)
    return np.eye(3) + np.sin(angle) / safe * K + (1 - np.cos(angle)) / safe**2 * (K @ K)


def inverses(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """The inverses of rigid transforms (N, 4, 4)."""
    out = np.repeat(np.eye(4)[None], len(T), axis=0)
    out[:, :3, :3] = _transposed(T[:, :3, :3])
    out[:, :3, 3] = -np.einsum("nij,nj->ni", out[:, :3, :3], T[:, :3, 3])
    return out


def _transposed(R: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.swapaxes(R, -1, -2)
