"""The built-in room before a camera on a robot, whose arm hangs before it: a slanted bar, by the closed
forms of a box, and as a URDF."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from datasets_recordings import text_of, write_image
from numpy.typing import NDArray

from taichi_mrf.alignment.se3 import moved
from taichi_mrf.datasets import open_dataset
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame

FRAMES = "synthetic:room?frames=12&width=160&height=120&noise=none"
HALF_M = np.array([0.03, 0.04, 0.2])
ELBOW_M = np.array([0.1, 0.12, 0.6])
"""Where the bar is hinged, in the camera frame."""


def T_camera_bar(angle: float) -> Pose:
    """The pose (4, 4) of the bar's middle, which turns about the camera's x at the elbow."""
    T_camera_elbow = moved(moved(np.eye(4), [*ELBOW_M, 0, 0, 0]), [0, 0, 0, angle, 0, 0])
    return moved(T_camera_elbow, [0, 0, -HALF_M[2], 0, 0, 0])


def box_depth_m(
    camera: PinholeCamera, T_camera_box: Pose, half_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Axial depth (H, W) of a box, infinite beside it: where rays enter it."""
    T = inverse(T_camera_box)
    with np.errstate(divide="ignore"):
        sides = (np.array([[-1], [1]]) * half_m - T[:3, 3])[:, None, None] / (camera.rays() @ T[:3, :3].T)
    enters, leaves = sides.min(axis=0).max(axis=-1), sides.max(axis=0).min(axis=-1)
    return np.where((enters < leaves) & (enters > 0), enters, np.inf)


def bar_depth_m(camera: PinholeCamera, angle: float) -> NDArray[np.float64]:
    """Axial depth (H, W) of the bar, infinite beside it."""
    return box_depth_m(camera, T_camera_bar(angle), HALF_M)


def to_box_m(
    points_m: NDArray[np.floating], T_camera_box: Pose, half_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The distance (...) of points (..., 3) of the camera frame to a box, negative inside of it."""
    T = inverse(T_camera_box)
    beyond = np.abs(points_m @ T[:3, :3].T + T[:3, 3]) - half_m
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=-1) + np.minimum(beyond.max(axis=-1), 0.0)


def to_bar_m(points_m: NDArray[np.floating], angle: float) -> NDArray[np.float64]:
    """The distance (...) of points (..., 3) of the camera frame to the bar, 0 in it."""
    return np.maximum(to_box_m(points_m, T_camera_bar(angle), HALF_M), 0.0)


def missed_m(camera: PinholeCamera, angle: float) -> NDArray[np.float64]:
    """By how much each pixel's ray misses the bar (H, W): the least distance of many points of it."""
    places = np.arange(0.1, 0.9, 0.004)[:, None, None, None]
    return np.min([to_bar_m(camera.rays() * depth_m, angle) for depth_m in places], axis=0)


URDF = """<robot name="arm">
  <link name="base"/>
  <link name="housing"><visual><geometry><box size="0.1 0.05 0.06"/></geometry></visual></link>
  <joint name="mount" type="fixed"><parent link="base"/><child link="housing"/><origin xyz="0 0 0.5"/></joint>
  <link name="optical"/>
  <joint name="optics" type="fixed"><parent link="housing"/><child link="optical"/>
    <origin xyz="0.01 0 0" rpy="-1.5707963267948966 0 -1.5707963267948966"/></joint>
  <link name="bar"><visual><origin xyz="0 0 {back}"/><geometry>{bar}</geometry></visual></link>
  <joint name="elbow" type="revolute"><parent link="optical"/><child link="bar"/><origin xyz="{elbow}"/>
    <axis xyz="1 0 0"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
</robot>
"""


def write_urdf(path: Path, bar: str | None = None) -> Path:
    """The housing and the camera look along x, with z up; the bar is a box, or another geometry."""
    size = " ".join(f"{2 * half:g}" for half in HALF_M)
    elbow = " ".join(f"{x:g}" for x in ELBOW_M)
    path.write_text(URDF.format(back=-HALF_M[2], bar=bar or f'<box size="{size}"/>', elbow=elbow))
    return path


@dataclass(frozen=True)
class ArmedRoom:
    """Frames of the room alone, the same with the bar before it at its angles, and folders of both."""

    bare: list[Frame]
    angles: list[float]
    armed: Path
    plain: Path

    def is_bar(self, index: int) -> NDArray[np.bool_]:
        """The pixels (H, W) of a frame that show the bar."""
        frame = self.bare[index]
        behind = np.where(frame.depth_m > 0, frame.depth_m, np.inf)
        return bar_depth_m(frame.camera, self.angles[index]) < behind


def record(folder: Path, angles: list[float]) -> ArmedRoom:
    """Write both recordings; the bar has one angle a frame. Taichi must run."""
    bare = list(open_dataset(FRAMES, color=False))
    room = ArmedRoom(bare, angles, folder / "armed", folder / "plain")
    for index, frame in enumerate(bare):
        bar = bar_depth_m(frame.camera, angles[index])
        seen = np.where(room.is_bar(index), bar, frame.depth_m)
        write(room.armed, index, frame, seen)
        write(room.plain, index, frame, frame.depth_m)
    return room


def write(folder: Path, index: int, frame: Frame, depth_m: NDArray[np.floating]) -> None:
    """One frame as 7-Scenes has it."""
    stem = f"frame-{index:06d}"
    write_image(folder / f"{stem}.depth.png", np.rint(1000 * depth_m.astype(np.float64)).astype(np.uint16))
    (folder / f"{stem}.pose.txt").write_text(text_of(frame.T_world_camera))
    k = frame.camera
    assert isinstance(k, PinholeCamera)
    (folder / "camera.txt").write_text(f"{k.width} {k.height} {k.fx} {k.fy} {k.cx} {k.cy}")
