"""Poses in TUM RGB-D's layout, ``stamp tx ty tz qx qy qz qw``: what ``?poses=FILE`` and other tools read."""

from collections.abc import Iterable
from pathlib import Path

from taichi_mrf.datasets.timed_poses import quaternion
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.system.atomic import write_text

HEADER = "# stamp tx ty tz qx qy qz qw (T_world_camera, metres; {axes})"
CAMERA_AXES = "camera axes x right, y down, z forward"
LIDAR_AXES = "sensor axes x forward, y left, z up"


def write_trajectory(
    path: Path,
    poses: Iterable[tuple[float, Pose]],
    axes: str = CAMERA_AXES,
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> None:
    """Write stamps in seconds with their poses, (4, 4) T_world_camera; ``axes`` describes the camera frame.
    Positions become those of the recorded world, in which the poses' origin is ``origin_m``. Raises
    MapFileError."""
    lines = [HEADER.format(axes=axes)]
    for stamp, T_world_camera in poses:
        numbers = (*(T_world_camera[:3, 3] + origin_m), *quaternion(T_world_camera[:3, :3]))
        lines.append(" ".join([f"{stamp:.6f}", *(f"{number:.9f}" for number in numbers)]))
    write_text(path, "\n".join(lines) + "\n")
