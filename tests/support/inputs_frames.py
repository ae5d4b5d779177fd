"""Frames in memory for the tests of readers: the built-in room at 80 x 60, depth in whole millimetres."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.frame import Frame

COUNT = 8


@dataclass
class Frames(Dataset):
    """A sequence that is in memory."""

    frames: Sequence[Frame] = field(kw_only=True)

    @property
    def frame_names(self) -> Sequence[str]:
        return [frame.name for frame in self.frames]

    def read(self, index: int) -> Frame:
        return self.frames[index]

    @staticmethod
    def millimetres(frame: Frame) -> NDArray[np.uint16]:
        return np.rint(frame.depth_m * 1000).astype(np.uint16)


def room() -> Frames:
    """Views around the room without noise. Taichi must run."""
    dataset = open_dataset(f"synthetic:room?frames={COUNT}&width=80&height=60&noise=none", color=False)
    frames = []
    for frame in dataset:
        steps = np.rint(frame.depth_m * 1000).astype(np.uint16)
        depth_m = steps.astype(np.float32) / np.float32(1000)
        frames.append(Frame(depth_m, frame.T_world_camera, frame.camera, 1.0 + frame.stamp, frame.name))
    return Frames("room", dataset.camera, frames=frames)


def moved(T_world_body: Pose, displacement: Sequence[float], turn: Sequence[float], sign: float) -> Pose:
    """A pose some time before (``sign`` -1) or after (1) another one: displaced in the world by metres,
    turned in the body's frame by a rotation vector. Half way between the two lies the pose itself."""
    T = T_world_body.copy()
    T[:3, :3] = T_world_body[:3, :3] @ Rotation.from_rotvec(sign * np.array(turn)).as_matrix()
    T[:3, 3] += sign * np.array(displacement)
    return T


def slerp(R_first: NDArray, R_last: NDArray, share: float) -> NDArray[np.float64]:
    """Spherical interpolation by SciPy."""
    first = Rotation.from_matrix(R_first)
    turn = (first.inv() * Rotation.from_matrix(R_last)).as_rotvec()
    return (first * Rotation.from_rotvec(share * turn)).as_matrix()
