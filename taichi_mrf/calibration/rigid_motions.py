"""Rotations as axis times angle, and inverses, for many rigid transforms at once."""

import numpy as np
from numpy.typing import NDArray


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
