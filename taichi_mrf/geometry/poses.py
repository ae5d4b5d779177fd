"""Rigid transforms: the checks that every pose passes on its way in, and the norms that select keyframes;
rotations as axis times angle, and inverses, for many at once.

A pose ``T_world_camera`` is a (4, 4) float64 matrix that takes points of the camera frame
(OpenCV axes: x right, y down, z forward) to the world frame, in metres.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.errors import KeyframeError

Pose = NDArray[np.float64]

NEARLY_ORTHONORMAL = 1e-2
"""Largest entry of |R^T R - I| that still counts as a rotation with rounding errors. Recorded
trajectories are orthonormal only to the digits that were written (7-Scenes: 5e-4)."""


def as_pose(T: ArrayLike) -> Pose:
    """Check a (4, 4) or (3, 4) rigid transform and project a nearly orthonormal rotation on SO(3).

    Returns a new (4, 4) float64 matrix. Raises KeyframeError for a wrong shape, a value that is not
    finite, a last row other than (0, 0, 0, 1), or a rotation that is not one.
    """
    try:
        matrix = np.array(T, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise KeyframeError("a pose is not a matrix of numbers") from error
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    if matrix.shape != (4, 4):
        raise KeyframeError(f"a pose has the shape {matrix.shape}, not (4, 4)")
    if not np.isfinite(matrix).all():
        raise KeyframeError("a pose holds a value that is not finite (NaN or infinity)")
    if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
        transposed = np.abs(matrix[:, 3] - [0.0, 0.0, 0.0, 1.0]).max() <= 1e-6
        hint = ", but its last column is: write it transposed" if transposed else ""
        raise KeyframeError(f"the last row of a pose is not 0 0 0 1{hint}")
    matrix[:3, :3] = nearest_rotation(matrix[:3, :3])
    return matrix


def nearest_rotation(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation closest to a nearly orthonormal (3, 3) matrix (orthogonal Procrustes).

    Raises KeyframeError if R is further than NEARLY_ORTHONORMAL from a rotation, or is a reflection.
    """
    deviation = float(np.abs(R.T @ R - np.eye(3)).max())
    if deviation > NEARLY_ORTHONORMAL:
        raise KeyframeError(f"the rotation of a pose is not one: |R^T R - I| is {deviation:.3g}")
    if np.linalg.det(R) < 0:
        raise KeyframeError("the rotation of a pose is a reflection (its determinant is -1)")
    if deviation < 1e-12:  # leave a rotation as it is, to the last bit: a pose may come back to be moved
        return R
    U, _, Vt = np.linalg.svd(R)
    return U @ Vt


def inverse(T: Pose) -> Pose:
    """The inverse of a rigid transform."""
    R, t = T[:3, :3], T[:3, 3]
    out = np.eye(4)
    out[:3, :3] = R.T
    out[:3, 3] = -R.T @ t
    return out


def rotation_angle(R: NDArray[np.float64]) -> float:
    """The norm of the rotation's tangent vector, in radians (0 to pi)."""
    # The sine from the antisymmetric part keeps the digits that arccos loses near zero.
    sine = 0.5 * np.linalg.norm([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return float(np.arctan2(sine, 0.5 * (np.trace(R) - 1.0)))


def tangent_norms(T_world_a: Pose, T_world_b: Pose) -> tuple[float, float]:
    """Distance of b from a: (rotation in radians, translation in metres), each a tangent norm."""
    T_a_b = inverse(T_world_a) @ T_world_b
    with np.errstate(over="ignore"):  # a damaged pose may lie anywhere: the square of 1e200 is infinity
        return rotation_angle(T_a_b[:3, :3]), float(np.linalg.norm(T_a_b[:3, 3]))


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Pose:
    """The pose of a camera at ``eye`` that looks at ``target`` with its image upright along ``up``."""
    eye_, target_, up_ = (np.asarray(x, dtype=np.float64) for x in (eye, target, up))
    forward = target_ - eye_
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up_)
    if np.linalg.norm(right) < 1e-9:  # looking along `up`: any sideways axis will do
        right = np.cross(forward, np.roll(up_, 1))
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = eye_
    return T


def rotation_vectors(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Axis times angle (0 to pi, radians) of rotations (..., 3, 3), (..., 3)."""
    axis = 0.5 * np.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1
    )
    sine = np.linalg.norm(axis, axis=-1)
    angle = np.arctan2(sine, 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1.0))
    return axis * (angle / np.maximum(sine, 1e-15))[..., None]


def rotations(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotations (..., 3, 3) from axis times angle (..., 3) (Rodrigues)."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    K = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)
    safe = np.maximum(angle, 1e-12)
    return np.eye(3) + np.sin(angle) / safe * K + (1 - np.cos(angle)) / safe**2 * (K @ K)


def inverses(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """The inverses of rigid transforms (N, 4, 4)."""
    out = np.repeat(np.eye(4)[None], len(T), axis=0)
    out[:, :3, :3] = _transposed(T[:, :3, :3])
    out[:, :3, 3] = -np.einsum("nij,nj->ni", out[:, :3, :3], T[:, :3, 3])
    return out


def _transposed(R: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.swapaxes(R, -1, -2)
