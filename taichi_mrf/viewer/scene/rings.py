"""Keyframes of lidars in the scene: the border of what they saw on a small sphere, their picture on it."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.origins import origins_of

CLOSED = 3.0
"""The first and the last column meet if their directions differ by less than so many columns."""


def on_sphere(camera: Camera, radius_m: float) -> NDArray[np.float32]:
    """Pixels of a camera on a sphere around it, (H, W, 3), metres, camera frame. Each pixel of a moving
    camera lies as far from where its ray starts."""
    rays, origins = camera.rays(), origins_of(camera)
    points = radius_m * rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return (points if origins is None else points + origins).astype(np.float32)


def border(camera: Camera, radius_m: float) -> NDArray[np.float32]:
    """The border of a camera's image on the sphere, as line segments (n, 2, 3): two rings if it sees all
    around, otherwise one closed line."""
    points = on_sphere(camera, radius_m)
    middle = points[len(points) // 2]
    steps = np.linalg.norm(np.diff(middle, axis=0), axis=-1)
    gap = float(np.linalg.norm(middle[-1] - middle[0]))
    all_around = len(middle) > 3 and gap < CLOSED * float(np.median(steps))
    if all_around:
        lines = [np.concatenate([row, row[:1]]) for row in (points[0], points[-1])]
    else:
        lines = [points[0], points[:, -1], points[-1], points[:, 0]]
    return np.concatenate([np.stack([line[:-1], line[1:]], axis=1) for line in lines])


def hits_of_sphere(origin: ArrayLike, direction: ArrayLike, radius_m: float) -> list[float]:
    """How far along a unit ``direction`` a ray meets a sphere around zero, nearest first, in metres."""
    start, along = np.asarray(origin, np.float64), np.asarray(direction, np.float64)
    nearest = -float(start @ along)
    under = radius_m**2 - float(start @ start) + nearest**2
    if under < 0:
        return []
    half = float(np.sqrt(under))
    return [t for t in (nearest - half, nearest + half) if t > 0]
