"""The built-in room with a ball that comes or goes: depth images, maps of them, and where the ball is."""

from functools import cache

import numpy as np
import small_room
from numpy.typing import NDArray

from taichi_mrf.config.sections import TimeConfig
from taichi_mrf.datasets.synthetic.analytic_render import render
from taichi_mrf.datasets.synthetic.analytic_scene import Scene, Solid
from taichi_mrf.datasets.synthetic.room_furniture import room_scene
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import PinholeCamera

TIME = TimeConfig(half_life_s=600.0)
BALL = Solid("sphere", (0.4, -0.36, 0.4), (0.25, 0.25, 0.25))
EVERYWHERE = list(range(10))
SEEING = [0, 1, 2, 5]
"""Views that see the ball well."""

ViewOfRoom = tuple[NDArray[np.float32], NDArray[np.float64]]


def camera() -> PinholeCamera:
    """The camera of all views."""
    return small_room.frames()[0].camera


def views(indices: list[int], ball: bool) -> list[ViewOfRoom]:
    """Clean depth images of the room, with or without the ball, from poses of the small room."""
    scene = Scene(room_scene().solids + ((BALL,) if ball else ()), room_scene().light)
    poses = [small_room.frames()[i].T_world_camera for i in indices]
    return [(render(scene, camera(), T, color=False)[0], T) for T in poses]


def in_turn(m: MRFMap, seen: list[ViewOfRoom]) -> None:
    """Add views, a second apart."""
    for depth_m, T_world_camera in seen:
        m.add_keyframe(depth_m, T_world_camera, camera())


def near_ball(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points (n, 3) lie in the ball or within two voxels of it."""
    distance = np.linalg.norm(points - np.array(BALL.center), axis=1)
    return distance < 0.25 + 2 * small_room.VOXEL_SIZE


@cache
def room_that_changed(ball_comes: bool) -> MRFMap:
    """A dated map of 20 views without the ball and SEEING with it, or the other way round with all ten views
    again. Nobody changes it."""
    m = MRFMap(small_room.VOXEL_SIZE, time=TIME)
    in_turn(m, views(EVERYWHERE * 2, ball=not ball_comes))
    in_turn(m, views(SEEING if ball_comes else EVERYWHERE, ball=ball_comes))
    m.infer()
    return m
