"""The built-in room on two days: frames of yesterday, and of today in a world of its own."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from inputs_frames import Frames, of_frames

from taichi_mrf.config.schema import Config, EvaluationConfig
from taichi_mrf.config.values import overridden
from taichi_mrf.datasets.synthetic.analytic_render import ray_depths
from taichi_mrf.datasets.synthetic.analytic_scene import Scene, Solid, translated
from taichi_mrf.datasets.synthetic.room_furniture import ROOM_IN_WORLD, camera_pose, chair, room_solids
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame

CAMERA = PinholeCamera(160, 120, 140.0, 140.0, 79.5, 59.5)
COUNT = 16
SIGMA_M = 0.005
CONFIG = overridden(
    Config(voxel_size=0.08, evaluation=EvaluationConfig(hold_out=0)),
    {"sensor": {"sigma": (SIGMA_M,)}},
    "tests",
)
YESTERDAY, TODAY = range(0, 2 * COUNT, 2), range(1, 2 * COUNT, 2)


def turned_away(seed: int = 0) -> Pose:
    """T_today_yesterday (4, 4): any turn, and metres away."""
    random = np.random.default_rng(seed)
    rotation, _ = np.linalg.qr(random.normal(size=(3, 3)))
    T = np.eye(4)
    T[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    T[:3, 3] = random.uniform(-5, 5, 3)
    return T


@cache
def room_frames(added: tuple[Solid, ...] = (), name: str = "frame", around: int = 2 * COUNT) -> list[Frame]:
    """The first frames of so many ``around`` the room, with things ``added`` to its furniture, and noise."""
    scene = Scene(translated([*room_solids(), *added], ROOM_IN_WORLD), light=(0.0, 0.0, 1.0))
    random, frames = np.random.default_rng(0), []
    for index in range(around):
        T = camera_pose(index / around)
        depth_m = ray_depths(scene, CAMERA, T)
        noisy = depth_m + random.normal(0, SIGMA_M, depth_m.shape) * (depth_m > 0)
        frames.append(Frame(noisy.astype(np.float32), T, CAMERA, float(index), f"{name}-{index:03d}"))
    return frames


STOOL = tuple(chair(0.2, 1.0, 0.4))
"""A chair where nothing else stands."""


def recorded(
    indices: Sequence[int],
    T_world_room: Pose | None = None,
    added: tuple[Solid, ...] = (),
    name: str = "frame",
    tracked: bool = False,
    around: int = 2 * COUNT,
) -> Frames:
    """Some frames as a recording, in a world that ``T_world_room`` takes the room's to."""
    T = np.eye(4) if T_world_room is None else T_world_room
    frames = [room_frames(added, name, around)[index] for index in indices]
    frames = [replace(frame, T_world_camera=T @ frame.T_world_camera) for frame in frames]
    return of_frames(frames, "the room", tracked=tracked)
