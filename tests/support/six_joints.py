"""An arm of six joints before a camera that looks at a wall: its URDF, its joints, and by closed forms where
it is and what the camera measures."""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame

HALF_M = np.array([0.035, 0.04, 0.08])
SHOULDER_M = np.array([0.28, 0.3, 0.64])
"""Where the arm begins, in the camera frame."""

AXES = np.array([[0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0]], float)

WALL_HALF_M, ROD_HALF_M = np.array([3.0, 3.0, 0.1]), np.array([0.012, 0.5, 0.012])


def _shift(m: ArrayLike) -> Pose:
    T = np.eye(4)
    T[:3, 3] = m
    return T


T_WORLD_WALL, T_WORLD_ROD = _shift([0, 0, 1.15]), _shift([0.02, 0, 0.94])
"""What is behind the arm and near it."""


def joint_names() -> list[str]:
    return [f"joint{i}" for i in range(6)]


def angles_at(step: int) -> NDArray[np.float64]:
    """The positions (6,) of the joints, in radians."""
    return np.array([-1.0, 0.3, -0.35, 0.2, -0.3, 0.3]) + 0.09 * step * np.array([0.5, 1, -0.3, 0.5, -1, 0.4])


def _turn(axis: NDArray[np.float64], angle: float) -> Pose:
    x, y, z = axis
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    T = np.eye(4)
    T[:3, :3] += np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
    return T


def links(angles: NDArray[np.float64]) -> list[Pose]:
    """The poses (4, 4) of the links' middles in the camera frame."""
    T, found, tip = _shift(SHOULDER_M), [], np.array([0, 0, 2 * HALF_M[2]])
    for axis, angle in zip(AXES, angles, strict=True):
        T = T @ _turn(axis, angle)
        found.append(T @ _shift(tip / 2))
        T = T @ _shift(tip)
    return found


def box_depth_m(
    camera: PinholeCamera, T_camera_box: Pose, half_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Axial depth (H, W) of a box, infinite beside it."""
    T = inverse(T_camera_box)
    with np.errstate(divide="ignore"):
        sides = (np.array([[-1], [1]]) * half_m - T[:3, 3])[:, None, None] / (camera.rays() @ T[:3, :3].T)
    enters, leaves = sides.min(axis=0).max(axis=-1), sides.max(axis=0).min(axis=-1)
    return np.where((enters < leaves) & (enters > 0), enters, np.inf)


def to_arm_m(points_m: NDArray[np.float64], angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """The distance (N,) of points (N, 3) of the camera frame to the arm, negative inside of it."""
    found = []
    for T_camera_link in links(angles):
        T = inverse(T_camera_link)
        beyond = np.abs(points_m @ T[:3, :3].T + T[:3, 3]) - HALF_M
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
        found.append(outside + np.minimum(beyond.max(axis=-1), 0.0))
    return np.min(found, axis=0)


def inside_the_arm(angles: NDArray[np.float64], rng: np.random.Generator, many: int) -> NDArray[np.float64]:
    """Points (N, 3) of the camera frame in the arm's links."""
    T = np.array(links(angles))
    local = rng.uniform(-HALF_M, HALF_M, (many, 3))
    return (np.einsum("kij,nj->kni", T[:, :3, :3], local) + T[:, None, :3, 3]).reshape(-1, 3)


def frames(steps: int) -> tuple[list[Frame], list[Frame]]:
    """A camera that goes along a wall with a rod before it; and the same with the arm before the camera."""
    camera, bare, armed = PinholeCamera(160, 120, 131.25, 131.25, 79.5, 59.5), [], []
    for step in range(steps):
        T_world_camera = _shift(np.array([0.02 * step - 0.1, 0.01 * step, 0.0]))
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
    (folder / "joints.csv").write_text("\n".join([",".join(["stamp", *joint_names()]), *rows]))
    names = {"robot": str(folder / "six.urdf"), "joints": str(folder / "joints.csv")}
    return {**names, "camera_link": "optical"}
