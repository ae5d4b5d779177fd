"""A moving chessboard with known poses: what a camera sees of it, and what motion capture says of both."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from calibration_scenes import Tables
from numpy.typing import NDArray

from taichi_mrf.calibration.chessboard import BoardView, board_depth, camera_matrix, corner_points
from taichi_mrf.calibration.options import BoardConfig
from taichi_mrf.datasets.timed_poses import TimedPoses
from taichi_mrf.geometry.poses import inverses, rotations
from taichi_mrf.sensor.camera import PinholeCamera

CAMERA = PinholeCamera(width=320, height=240, fx=290, fy=292, cx=159.0, cy=120.5)
BOARD = BoardConfig(columns=8, rows=5, square=0.08)
BOARD_FLAGS = ("--board.columns", "8", "--board.rows", "5", "--board.square", "0.08")
CAMERA_TEXT = "320 240 290 292 159 120.5\n"

SUPERSAMPLING = 4
"""Rendered pixels along each side of one image pixel."""


def board_motion(times: NDArray[np.float64]) -> NDArray[np.float64]:
    """T_camera_board (N, 4, 4): the board's middle sways before the camera from 1 to 2.4 m, and tilts."""
    t = np.asarray(times, np.float64)
    T = np.repeat(np.eye(4)[None], len(t), axis=0)
    turn = np.stack([0.5 * np.sin(1.9 * t), 0.5 * np.sin(1.3 * t + 1), 0.3 * np.sin(2.3 * t + 2)], axis=-1)
    T[:, :3, :3] = rotations(turn)
    depth = 1.7 + 0.7 * np.sin(0.7 * t)
    sway = np.stack([0.18 * np.sin(1.1 * t + 0.5), 0.14 * np.sin(1.7 * t), np.ones_like(t)], axis=-1)
    middle = np.array([(BOARD.columns - 1) / 2, (BOARD.rows - 1) / 2, 0]) * BOARD.square
    T[:, :3, 3] = sway * depth[:, None] - T[:, :3, :3] @ middle
    return T


def ideal_view(
    T_camera_board: NDArray[np.float64], random: np.random.Generator, noise_px: float
) -> BoardView:
    """The view that a corner detector with this noise would give, with its own pose from these corners."""
    points = corner_points(BOARD)
    K = camera_matrix(CAMERA)
    seen = points @ T_camera_board[:3, :3].T + T_camera_board[:3, 3]
    corners = (seen @ K.T)[:, :2] / seen[:, 2:] + noise_px * random.standard_normal((len(points), 2))
    _, rotation, position = cv2.solvePnP(points, corners, K, None, flags=cv2.SOLVEPNP_IPPE)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], position.ravel()
    return BoardView(corners, T, noise_px)


def render_board(
    T_camera_board: NDArray[np.float64], board: BoardConfig, camera: PinholeCamera
) -> NDArray[np.uint8]:
    """A grey image of the board on a grey wall, drawn larger and averaged; pixel centres are integers."""
    cell = 60
    v, u = np.indices(((board.rows + 1) * cell, (board.columns + 1) * cell))
    squares = np.where((u // cell + v // cell) % 2 == 0, 25, 230).astype(np.uint8)
    printed = cv2.copyMakeBorder(squares, cell, cell, cell, cell, cv2.BORDER_CONSTANT, value=230)
    # The first inner corner, the board's origin, lies between two pixels of the print.
    metres = board.square / cell
    offset = (2 * cell - 0.5) * metres
    to_board = np.array([[metres, 0, -offset], [0, metres, -offset], [0, 0, 1]])
    plane = np.column_stack([T_camera_board[:3, 0], T_camera_board[:3, 1], T_camera_board[:3, 3]])
    s = SUPERSAMPLING
    larger = np.array([[s, 0, 0.5 * (s - 1)], [0, s, 0.5 * (s - 1)], [0, 0, 1.0]])
    large = cv2.warpPerspective(
        printed,
        larger @ camera_matrix(camera) @ plane @ to_board,
        (camera.width * s, camera.height * s),
        flags=cv2.INTER_LINEAR,
        borderValue=120,
    )
    return cv2.resize(large, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


@dataclass(frozen=True)
class Capture:
    """Motion capture of the board's motion: marker bodies that sit somewhere on camera and board."""

    camera: TimedPoses
    board: TimedPoses
    T_camera_body: NDArray[np.float64]
    T_body_board: NDArray[np.float64]


def captured(lag: float, seconds: float, random: np.random.Generator, noise: float = 0.0) -> Capture:
    """Motion capture at 120 Hz whose stamps are ``lag`` after the images' stamps of the same instant, of a
    camera that is moved about. ``noise`` is in metres, and in radians at 0.2 m from the body's centre."""
    image_time = np.arange(-1.0, seconds + 1.0, 1 / 120)
    T_camera_body, T_body_board = np.eye(4), np.eye(4)
    T_camera_body[:3, :3] = rotations(np.array([[0.3, -1.1, 0.4]]))[0]
    T_camera_body[:3, 3] = [0.03, -0.06, -0.02]
    T_body_board[:3, :3] = rotations(np.array([[-2.0, 0.2, 0.9]]))[0]
    T_body_board[:3, 3] = [-0.31, 0.12, 0.04]
    T_world_camera = np.repeat(np.eye(4)[None], len(image_time), axis=0)
    T_world_camera[:, :3, :3] = rotations(
        np.stack([np.sin(0.6 * image_time), 0.4 * np.cos(0.5 * image_time), 2 + 0 * image_time], axis=-1)
    )
    T_world_camera[:, :3, 3] = [2.0, -1.0, 1.3]
    camera_body = T_world_camera @ T_camera_body
    board_body = T_world_camera @ board_motion(image_time) @ inverses(T_body_board[None])
    for poses in (camera_body, board_body):
        poses[:, :3, 3] += noise * random.standard_normal((len(poses), 3))
        poses[:, :3, :3] = poses[:, :3, :3] @ rotations(noise / 0.2 * random.standard_normal((len(poses), 3)))
    stamps = image_time + lag
    return Capture(
        TimedPoses(stamps, camera_body), TimedPoses(stamps, board_body), T_camera_body, T_body_board
    )


def write_recording(
    folder: Path, stamps: NDArray[np.float64], tables: Tables, with_images: bool = True
) -> None:
    """``depth/`` and ``ir/`` of the moving board, images named by number, camera.txt, and stamps.txt."""
    (folder / "depth").mkdir(parents=True)
    (folder / "ir").mkdir()
    (folder / "depth" / "camera.txt").write_text(CAMERA_TEXT, encoding="utf-8")
    lines = ["# stamp file"]
    for number, (stamp, T) in enumerate(zip(stamps, board_motion(stamps), strict=True)):
        random = np.random.default_rng([7, number])
        true_m = board_depth(T, BoardConfig(8, 5, 0.08, border=1.0), CAMERA)
        true_m[true_m == 0] = 4.0
        np.save(folder / "depth" / f"{number:04d}.npy", tables.measured(true_m, random))
        if with_images:
            image = render_board(T, BOARD, CAMERA) + 2 * random.standard_normal(CAMERA.shape)
            cv2.imwrite(str(folder / "ir" / f"{number:04d}.png"), np.clip(image, 0, 255).astype(np.uint8))
        lines.append(f"{stamp:.6f} depth/{number:04d}.npy")
    (folder / "stamps.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
