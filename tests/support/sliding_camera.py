"""A camera that slides along a wall: the smallest sequence for tests of mapping."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taichi_mrf.config.schema import Config, EvaluationConfig
from taichi_mrf.datasets import Dataset
from taichi_mrf.errors import FrameError
from taichi_mrf.mapping.pipeline import Event
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame

CAMERA = PinholeCamera(width=32, height=24, fx=30.0, fy=30.0, cx=15.5, cy=11.5)
WALL_M = 1.5
ALL_FRAMES = Config(voxel_size=0.1, evaluation=EvaluationConfig(hold_out=0))


@dataclass
class SlidingCamera(Dataset):
    """A camera that looks at a wall and slides 10 cm a frame along it. Frames in ``broken`` cannot be
    read, those in ``blind`` measure nothing."""

    count: int = 6
    broken: Sequence[int] = ()
    blind: Sequence[int] = ()

    @property
    def frame_names(self) -> Sequence[str]:
        return [f"frame {index}" for index in range(self.count)]

    def read(self, index: int) -> Frame:
        name = self.frame_names[index]
        if index in self.broken:
            raise FrameError(f"{name}: the image is damaged")
        T_world_camera = np.eye(4)
        T_world_camera[0, 3] = 0.1 * index
        depth_m = np.full(CAMERA.shape, 0.0 if index in self.blind else WALL_M, np.float32)
        return Frame(depth_m, T_world_camera, CAMERA, 0.1 * index, name)


def sequence(count: int = 6, broken: Sequence[int] = (), blind: Sequence[int] = ()) -> SlidingCamera:
    return SlidingCamera("sliding", CAMERA, count=count, broken=broken, blind=blind)


def names(m: MRFMap) -> list[str]:
    return [keyframe.name for keyframe in m.keyframes.values()]


class StopAfter:
    """A listener and a stop request in one: asks to stop once there were ``count`` events, or frames'
    answers, of a kind."""

    def __init__(self, kind: type, count: int) -> None:
        self.kind, self.left = kind, count

    def listen(self, event: Event) -> None:
        self.left -= isinstance(event, self.kind) or isinstance(getattr(event, "answer", None), self.kind)

    def __call__(self) -> bool:
        return self.left <= 0
