"""SE(3): its exponential map, the inverse of that, for one pose and for many, and steps in other frames."""

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.geometry.poses import Pose

Twists = NDArray[np.float64]
"""(n, 6): translations in metres, then rotation vectors in radians."""

_SMALL = 1e-2
"""Radians below which a series is more precise than the closed form."""

_SMALL_OF_MANY = 1e-4
"""Radians below which the limits of the closed forms are more precise than they are."""


def moved(T_world_camera: Pose, xi: ArrayLike) -> Pose:
    """T exp(xi): the camera displaced by the twist ``xi`` (6,), translation in metres and then rotation
    vector in radians, both in its own frame."""
    step = np.asarray(xi, np.float64)
    E = np.eye(4)
    E[:3, :3] = cv2.Rodrigues(step[3:])[0]
    E[:3, 3] = _left_jacobian(step[3:]) @ step[:3]
    return T_world_camera @ E


def twist(T: Pose) -> NDArray[np.float64]:
    """The xi, (6,), of T = exp(xi)."""
    omega = _rotation_vector(T[:3, :3])
    return np.concatenate([np.linalg.solve(_left_jacobian(omega), T[:3, 3]), omega])


def exps(xi: Twists) -> NDArray[np.float64]:
    """(n, 4, 4): the poses exp(xi) of many twists."""
    from scipy.spatial.transform import Rotation  # slow to import, and few runs need it

    T = np.zeros((len(xi), 4, 4))
    T[:, :3, :3] = Rotation.from_rotvec(xi[:, 3:]).as_matrix()
    angle = np.linalg.norm(xi[:, 3:], axis=1)
    safe = np.maximum(angle, _SMALL_OF_MANY)
    first = np.where(angle > _SMALL_OF_MANY, (1 - np.cos(safe)) / safe**2, 0.5)
    second = np.where(angle > _SMALL_OF_MANY, (safe - np.sin(safe)) / safe**3, 1 / 6)
    turned = np.cross(xi[:, 3:], xi[:, :3])
    T[:, :3, 3] = xi[:, :3] + first[:, None] * turned + second[:, None] * np.cross(xi[:, 3:], turned)
    T[:, 3, 3] = 1.0
    return T


def logs(T: NDArray[np.float64]) -> Twists:
    """(n, 6): the twists of many poses."""
    from scipy.spatial.transform import Rotation

    omega = Rotation.from_matrix(T[:, :3, :3]).as_rotvec()
    angle = np.linalg.norm(omega, axis=1)
    safe = np.maximum(angle, _SMALL_OF_MANY)
    bend = np.where(angle > _SMALL_OF_MANY, 1 / safe**2 - 0.5 / (safe * np.tan(0.5 * safe)), 1 / 12)
    turned = np.cross(omega, T[:, :3, 3])
    rho = T[:, :3, 3] - 0.5 * turned + bend[:, None] * np.cross(omega, turned)
    return np.concatenate([rho, omega], axis=1)


def inverse_right_jacobians(e: Twists) -> NDArray[np.float64]:
    """(n, 6, 6): what a step behind exp(e) changes of e, but for terms of the fourth order."""
    ad = np.zeros((len(e), 6, 6))
    ad[:, :3, :3] = ad[:, 3:, 3:] = cross_matrix(e[:, 3:])
    ad[:, :3, 3:] = cross_matrix(e[:, :3])
    return np.asarray(np.eye(6) + 0.5 * ad + ad @ ad / 12)


def adjoint(T_a_b: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 6, 6): what takes a twist in frame b to the same one in frame a, of poses (..., 4, 4)."""
    R = T_a_b[..., :3, :3]
    A = np.zeros((*T_a_b.shape[:-2], 6, 6))
    A[..., :3, :3] = A[..., 3:, 3:] = R
    A[..., :3, 3:] = cross_matrix(T_a_b[..., :3, 3]) @ R
    return A


def cross_matrix(v: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 3, 3): what a cross product with v (..., 3) from the left does."""
    K = np.zeros((*v.shape, 3))
    K[..., 0, 1], K[..., 0, 2], K[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return K - np.swapaxes(K, -1, -2)


def _rotation_vector(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) radians. OpenCV's own rounds angles below about 1e-5 to 0."""
    sine = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    size, cosine = float(np.linalg.norm(sine)), 0.5 * (float(np.trace(R)) - 1.0)
    if cosine <= 0:
        return np.asarray(cv2.Rodrigues(R)[0].ravel())
    return sine * (np.arctan2(size, cosine) / size) if size > 0 else sine


def _left_jacobian(omega: NDArray[np.float64]) -> NDArray[np.float64]:
    """Effect of a rotation on the translation of the same twist, (3, 3)."""
    angle = float(np.linalg.norm(omega))
    first, second = 0.5 - angle**2 / 24, 1 / 6 - angle**2 / 120
    if angle > _SMALL:
        first, second = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    K = cross_matrix(omega)
    return np.asarray(np.eye(3) + first * K + second * K @ K)
