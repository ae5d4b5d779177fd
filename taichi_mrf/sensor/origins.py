"""Starting points of a camera's rays, which differ from its centre if it moves while it measures.

A moving camera has ``origins_m`` as RayTable has them; the rays of every other camera start at its centre.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.geometry.poses import NEARLY_ORTHONORMAL, Pose
from taichi_mrf.sensor.camera import Camera

Points = NDArray[np.float64]


def origins_of(camera: Camera) -> Points | None:
    """Starting points of a camera's rays, (1, W, 3) or (H, W, 3) metres in the camera frame; None if all
    start at its centre."""
    origins = getattr(camera, "origins_m", None)
    return None if origins is None else np.asarray(origins, np.float64)


def points_at(camera: Camera, depth_m: NDArray[np.floating]) -> Points:
    """The points (H, W, 3) of the camera frame at depths (H, W) in metres of a camera's pixels."""
    points, origins = camera.rays() * depth_m[..., None].astype(np.float64), origins_of(camera)
    return points if origins is None else points + origins


def starts_at(camera: Camera, u: ArrayLike, v: ArrayLike) -> Points:
    """Starting points of the rays through columns and rows, (..., 3) metres in the camera frame; (3,) zeros
    if all start at its centre."""
    if origins_of(camera) is None:
        return np.zeros(3)
    starts: Points = camera.origins(u, v)  # type: ignore[attr-defined]
    return starts


def widened(camera: Camera, T_world_camera: Pose, lower_m: Points, upper_m: Points) -> tuple[Points, Points]:
    """Two corners of an upright box, in metres in the world, that holds a camera's rays if the given box
    holds them where all start at the camera's centre."""
    origins = origins_of(camera)
    if origins is None:
        return lower_m, upper_m
    places = origins.reshape(-1, 3) @ T_world_camera[:3, :3].T
    return lower_m + places.min(axis=0), upper_m + places.max(axis=0)


def ball_of(camera: Camera) -> tuple[Points, float]:
    """A ball around the places at which a camera's rays start: its centre (3,) in the camera frame and its
    radius, in metres."""
    origins = origins_of(camera)
    if origins is None:
        return np.zeros(3), 0.0
    places = origins.reshape(-1, 3)
    centre = 0.5 * (places.min(axis=0) + places.max(axis=0))
    return centre, float(np.linalg.norm(places - centre, axis=1).max())


def turned(poses: Points, directions: Points, origins_m: Points | None = None) -> tuple[Points, Points]:
    """Directions (..., 3) and origins that broadcast with them, of the frames whose poses (..., 4, 4) are
    given, in the frame of the poses. The origins are those of the frames by default. Raises ConfigError for
    poses that are none."""
    R, t = poses[..., :3, :3], poses[..., :3, 3]
    off = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max(initial=0.0)
    if not (off < NEARLY_ORTHONORMAL and (np.linalg.det(R) > 0).all() and np.isfinite(t).all()):
        raise ConfigError("poses of a moving camera hold a value that is not finite or an invalid rotation")
    origins = t if origins_m is None else (R @ origins_m[..., None])[..., 0] + t
    return (R @ directions[..., None])[..., 0], origins
