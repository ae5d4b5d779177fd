"""Copies of a recording with one of the usual mistakes of conventions made on purpose."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from datasets_recordings import quaternion_of

from taichi_mrf.datasets.timed_poses import TimedPoses
from taichi_mrf.datasets.trajectories import pose_from_quaternion
from taichi_mrf.geometry.poses import inverse
from taichi_mrf.sensor.frame import Frame

FLAGS = {
    "inverse": "--poses-are inverse",
    "wxyz": "--poses-are wxyz",
    "opengl": "--poses-are opengl",
    "ros": "--poses-are ros",
    "unit": "--depth-scale 1000",
    "range": "--depth-is range",
    "late": "--poses-are late=",
    "intrinsics": "--camera ",
    "turned-left": "--image-is turned-left",
    "upside-down": "--image-is upside-down",
    "turned-right,mirrored": "--image-is turned-right,mirrored",
    "ned": "--poses-are ned",
}
"""Flags that mend them, or how these begin."""

Break = Callable[[Sequence[Frame]], list[Frame]]


def of_poses(change: Callable[[np.ndarray], np.ndarray]) -> Break:
    return lambda frames: [replace(f, T_world_camera=change(f.T_world_camera)) for f in frames]


def opengl(T: np.ndarray) -> np.ndarray:
    """The pose of the same camera with y up and z back."""
    return T @ np.diag([1.0, -1.0, -1.0, 1.0])


def body(T: np.ndarray) -> np.ndarray:
    """The pose of a body whose x is the camera's z, whose y is its -x, and whose z is its -y."""
    return np.column_stack([T[:, 2], -T[:, 0], -T[:, 1], T[:, 3]])


def ned(T: np.ndarray) -> np.ndarray:
    """The pose of a body whose x is the camera's z, whose y is its x, and whose z is its y."""
    return T[:, [2, 0, 1, 3]]


def w_first(T: np.ndarray) -> np.ndarray:
    """The pose that a reader of x y z w makes of w x y z."""
    x, y, z, w = quaternion_of(T[:3, :3])
    return pose_from_quaternion(np.array([*T[:3, 3], w, x, y, z]))


def of_depth(change: Callable[[Frame], np.ndarray]) -> Break:
    return lambda frames: [replace(f, depth_m=change(f).astype(np.float32)) for f in frames]


def late(seconds: float) -> Break:
    def shift(frames: Sequence[Frame]) -> list[Frame]:
        stamps = np.array([f.stamp for f in frames])
        poses, known = TimedPoses(stamps, [f.T_world_camera for f in frames]).between(stamps - seconds, 9.0)
        kept = [(f, T) for f, T, there in zip(frames, poses, known, strict=True) if there]
        return [replace(f, T_world_camera=T) for f, T in kept]

    return shift


def of_camera(factor: float) -> Break:
    """Images of 1/factor of the size that the intrinsics are of."""

    def change(frame: Frame) -> Frame:
        k = frame.camera
        scaled = {n: getattr(k, n) * factor for n in ("fx", "fy")}
        centre = {n: (getattr(k, n) + 0.5) * factor - 0.5 for n in ("cx", "cy")}
        return replace(frame, camera=replace(k, **scaled, **centre))

    return lambda frames: [change(f) for f in frames]


def turned(name: str) -> Break:
    """Images of which nobody says that they are turned; poses and intrinsics are the sensor's."""
    left, mirrored = {"turned-left": (1, False), "upside-down": (2, False)}.get(name, (3, True))

    def change(frame: Frame) -> Frame:
        depth_m = np.rot90(frame.depth_m[:, ::-1] if mirrored else frame.depth_m, left).copy()
        return replace(
            frame,
            depth_m=depth_m,
            camera=replace(frame.camera, width=depth_m.shape[1], height=depth_m.shape[0]),
        )

    return lambda frames: [change(f) for f in frames]


def of_focal(factor: float) -> Break:
    """Intrinsics whose focal lengths are off by a factor."""
    return lambda frames: [
        replace(f, camera=replace(f.camera, fx=f.camera.fx * factor, fy=f.camera.fy * factor)) for f in frames
    ]


LATE_S = 0.3
BREAKS: dict[str, Break] = {
    "inverse": of_poses(inverse),
    "wxyz": of_poses(w_first),
    "opengl": of_poses(opengl),
    "ros": of_poses(body),
    "unit": of_depth(lambda f: np.rint(1000 * f.depth_m) / 5000),  # millimetres, read as TUM RGB-D's
    "range": of_depth(lambda f: f.depth_m * np.linalg.norm(f.camera.rays(), axis=-1)),
    "late": late(LATE_S),
    "intrinsics": of_camera(2.0),
    **{name: turned(name) for name in ("turned-left", "upside-down", "turned-right,mirrored")},
    "ned": of_poses(ned),
}
