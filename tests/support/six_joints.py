"""An arm of six joints before a camera that looks at a wall: its URDF, its joints, and by closed forms where
it is and what the camera measures."""

from pathlib import Path

import numpy as np
from armed_room import box_depth_m, to_box_m
from numpy.typing import NDArray

from taichi_mrf.alignment.se3 import moved
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame

HALF_M = np.array([0.035, 0.04, 0.08])
SHOULDER_M = np.array([0.28, 0.3, 0.64])
"""Where the arm begins, in the camera frame."""

AXES = np.array([[0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0]], float)

WALL_HALF_M, ROD_HALF_M = np.array([3.0, 3.0, 0.1]), np.array([0.012, 0.5, 0.012])


T_WORLD_WALL = moved(np.eye(4), [0, 0, 1.15, 0, 0, 0])
T_WORLD_ROD = moved(np.eye(4), [0.02, 0, 0.94, 0, 0, 0])
"""What is behind the arm and near it."""


def angles_at(step: int) -> NDArray[np.float64]:
    """The positions (6,) of the joints, in radians."""
    return np.array([-1.0, 0.3, -0.35, 0.2, -0.3, 0.3]) + 0.09 * step * np.array([0.5, 1, -0.3, 0.5, -1, 0.4])


def links(angles: NDArray[np.float64]) -> list[Pose]:
    """The poses (4, 4) of the links' middles in the camera frame."""
    T, found, half_way = moved(np.eye(4), [*SHOULDER_M, 0, 0, 0]), [], [0, 0, HALF_M[2], 0, 0, 0]
    for axis, angle in zip(AXES, angles, strict=True):
        found.append(moved(moved(T, [0, 0, 0, *(angle * axis)]), half_way))
        T = moved(found[-1], half_way)
    return found


def to_arm_m(points_m: NDArray[np.float64], angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """The distance (N,) of points (N, 3) of the camera frame to the arm, negative inside of it."""
    return np.min([to_box_m(points_m, T, HALF_M) for T in links(angles)], axis=0)


def inside_the_arm(angles: NDArray[np.float64], rng: np.random.Generator, many: int) -> NDArray[np.float64]:
    """Points (N, 3) of the camera frame in the arm's links."""
    T = np.array(links(angles))
    local = rng.uniform(-HALF_M, HALF_M, (many, 3))
    return (np.einsum("kij,nj->kni", T[:, :3, :3], local) + T[:, None, :3, 3]).reshape(-1, 3)


def frames(steps: int) -> tuple[list[Frame], list[Frame]]:
    """A camera that goes along a wall with a rod before it; and the same with the arm before the camera."""
    camera, bare, armed = PinholeCamera(160, 120, 131.25, 131.25, 79.5, 59.5), [], []
    for step in range(steps):
        T_world_camera = moved(np.eye(4), [0.02 * step - 0.1, 0.01 * step, 0, 0, 0, 0])
        T_camera_world = inverse(T_world_camera)
        wall = box_depth_m(camera, T_camera_world @ T_WORLD_WALL, WALL_HALF_M)
        rod = box_depth_m(camera, T_camera_world @ T_WORLD_ROD, ROD_HALF_M)
        arm = np.min([box_depth_m(camera, T, HALF_M) for T in links(angles_at(step))], axis=0)
        for each, depth_m in ((bare, np.minimum(wall, rod)), (armed, np.min([wall, rod, arm], axis=0))):
            each.append(Frame(depth_m.astype(np.float32), T_world_camera, camera, float(step), f"{step}"))
    return bare, armed


def write_robot(folder: Path, steps: int) -> dict[str, str]:
    """The URDF and the table of joints, as fields of OwnBody."""
    size = " ".join(f"{2 * half:g}" for half in HALF_M)
    parts, parent, origin = ['<link name="optical"/>'], "optical", SHOULDER_M
    for i, axis in enumerate(AXES):
        parts.append(
            f'<link name="link{i}"><visual><origin xyz="0 0 {HALF_M[2]}"/><geometry><box size="{size}"/>'
            f'</geometry></visual></link><joint name="joint{i}" type="revolute"><parent link="{parent}"/>'
            f'<child link="link{i}"/><origin xyz="{" ".join(map(str, origin))}"/>'
            f'<axis xyz="{" ".join(map(str, axis))}"/>'
            '<limit lower="-4" upper="4" effort="1" velocity="1"/></joint>'
        )
        parent, origin = f"link{i}", np.array([0, 0, 2 * HALF_M[2]])
    (folder / "six.urdf").write_text(f'<robot name="six">{"".join(parts)}</robot>')
    rows = [",".join(map(str, [step, *angles_at(step)])) for step in range(steps)]
    (folder / "joints.csv").write_text(
        "\n".join([",".join(["stamp", *(f"joint{i}" for i in range(6))]), *rows])
    )
    names = {"robot": str(folder / "six.urdf"), "joints": str(folder / "joints.csv")}
    return {**names, "camera_link": "optical"}
