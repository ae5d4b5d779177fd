"""A slanted wall with a pattern, and pictures of it that are right to the last pixel."""

import numpy as np

from taichi_mrf.datasets.synthetic.rendered_sequence import pattern
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame

CAMERA = PinholeCamera(width=160, height=120, fx=140.0, fy=135.0, cx=78.0, cy=61.0)
AHEAD = look_at((0.0, 0.0, 0.0), (1.0, 0.2, -0.1))
WALL_NORMAL, WALL_M = np.array([-0.9, 0.3, 0.1]), 1.6


def wall(T_world_camera: Pose, gain: float = 1.0) -> Frame:
    """A slanted wall with a pattern, from a pose, on which nothing is ever in shadow."""
    rays = CAMERA.rays() @ T_world_camera[:3, :3].T
    depth_m = (-WALL_M - T_world_camera[:3, 3] @ WALL_NORMAL) / (rays @ WALL_NORMAL)
    points = T_world_camera[:3, 3] + rays * depth_m[..., None]
    brightness = gain * 110 * pattern(points, depth_m / CAMERA.fx)
    color = np.repeat(np.clip(brightness.round(), 1, 255).astype(np.uint8)[..., None], 3, axis=-1)
    return Frame(depth_m.astype(np.float32), T_world_camera, CAMERA, 0.0, "wall", color)
