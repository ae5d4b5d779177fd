"""Where markers sit on a camera and on a board, from poses of the markers and of the board in the camera.

The robot-world and hand-eye problem A X = Z B in closed form (Shah, "Solving the robot-world/hand-eye
calibration problem using the Kronecker product", 2013). OpenCV 4 had it, OpenCV 5 has not.
"""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose, inverse

_LARGEST_RATIO = 0.999
"""Of the second to the first singular value: above it rotations hardly differ (by some 3 degrees)."""


def hand_eye(T_camera_board: NDArray[np.float64], M: NDArray[np.float64]) -> tuple[Pose, Pose]:
    """T_camera_body and T_body_board so that T_camera_board = T_camera_body M T_body_board.

    ``T_camera_board`` and ``M``, the board's body in the camera's body, are (N, 4, 4). Raises DatasetError
    if the board was not turned enough to tell.
    """
    R_A, R_M = T_camera_board[:, :3, :3], M[:, :3, :3]
    # R_A R_X = R_Z R_M; with columns stacked, (R_M kron R_A) vec R_X = vec R_Z for every pose.
    kron = np.einsum("nij,nkl->ikjl", R_M, R_A).reshape(9, 9)
    U, s, Vt = np.linalg.svd(kron)
    if len(M) < 3 or s[1] > _LARGEST_RATIO * s[0]:
        raise DatasetError(
            "the views of the board do not tell where the markers sit: tilt it about two axes as it moves"
        )
    R_X, R_Z = _rotation(Vt[0]), _rotation(U[:, 0])
    # R_A t_X - t_Z = R_Z t_M - t_A
    left = np.concatenate([R_A, np.repeat(-np.eye(3)[None], len(M), axis=0)], axis=2).reshape(-1, 6)
    right = (M[:, :3, 3] @ R_Z.T - T_camera_board[:, :3, 3]).ravel()
    t, *_ = np.linalg.lstsq(left, right, rcond=None)
    T_camera_body, T_board_body = np.eye(4), np.eye(4)
    T_camera_body[:3, :3], T_camera_body[:3, 3] = R_Z, t[3:]
    T_board_body[:3, :3], T_board_body[:3, 3] = R_X, t[:3]
    return T_camera_body, inverse(T_board_body)


def _rotation(stacked_columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation nearest to a matrix known up to a factor, its sign included."""
    matrix = stacked_columns.reshape(3, 3).T
    U, _, Vt = np.linalg.svd(matrix * np.sign(np.linalg.det(matrix)))
    return U @ Vt
