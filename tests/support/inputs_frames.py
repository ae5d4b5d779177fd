"""Frames in memory as a recording or written as one, and a pose some time before or after another."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from taichi_mrf.calibration.chessboard import camera_matrix
from taichi_mrf.datasets import Dataset
from taichi_mrf.errors import FrameError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.frame import Frame


@dataclass
class Frames(Dataset):
    """A sequence that is in memory; frames in ``broken`` cannot be read."""

    frames: Sequence[Frame] = field(kw_only=True)
    broken: Collection[int] = field(default=(), kw_only=True)

    @property
    def frame_names(self) -> Sequence[str]:
        return [frame.name for frame in self.frames]

    def read(self, index: int) -> Frame:
        if index in self.broken:
            raise FrameError(f"{self.frames[index].name}: the image is damaged")
        return self.frames[index]


def of_frames(frames: Sequence[Frame], name: str = "frames", **options: Any) -> Frames:
    return Frames(name, frames[0].camera, frames=frames, **options)


def write_frames(path: Path, frames: Sequence[Frame], stamped: bool = False) -> Path:
    """An .npz of depth and poses, perhaps with stamps, in a folder that is made if need be."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fields = ("depth_m", "T_world_camera", *(["stamp"] if stamped else []))
    arrays = {name: np.stack([getattr(frame, name) for frame in frames]) for name in fields}
    np.savez(path, K=camera_matrix(frames[0].camera), **arrays)
    return path


def moved(T_world_body: Pose, displacement: Sequence[float], turn: Sequence[float], sign: float) -> Pose:
    """A pose some time before (``sign`` -1) or after (1) another one: displaced in the world by metres,
    turned in the body's frame by a rotation vector. Half way between the two lies the pose itself."""
    T = T_world_body.copy()
    T[:3, :3] = T_world_body[:3, :3] @ Rotation.from_rotvec(sign * np.array(turn)).as_matrix()
    T[:3, 3] += sign * np.array(displacement)
    return T
