"""The chessboard as ground truth, on rendered images of boards whose pose is known."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from calibration_boards import BOARD, CAMERA, board_motion, render_board
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from taichi_mrf.calibration.chessboard import board_depth, corner_points, find_board, find_boards, image_files
from taichi_mrf.calibration.options import BoardConfig
from taichi_mrf.errors import ConfigError, DatasetError
from taichi_mrf.geometry.poses import rotations

TIMES = np.arange(30) * 0.37


def projected(T_camera_board: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places of the corners in the image, (corners, 2)."""
    seen = corner_points(BOARD) @ T_camera_board[:3, :3].T + T_camera_board[:3, 3]
    return seen[:, :2] / seen[:, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]


@pytest.fixture(scope="module")
def views() -> list[tuple[NDArray[np.float64], NDArray[np.uint8]]]:
    """Known poses, and rendered images."""
    return [(T, render_board(T, BOARD, CAMERA)) for T in board_motion(TIMES)]


def test_corners_and_poses_are_found_to_a_fraction_of_a_pixel(views: list) -> None:
    off, depth_errors = [], []
    for T, image in views:
        view = find_board(image, BOARD, CAMERA)
        assert view is not None
        assert view.reprojection < 0.15
        off.append(view.corners - projected(T))
        true_m, found_m = board_depth(T, BOARD, CAMERA), board_depth(view.T_camera_board, BOARD, CAMERA)
        both = (true_m > 0) & (found_m > 0)
        assert both.sum() > 0.98 * max((true_m > 0).sum(), (found_m > 0).sum())
        depth_errors.append(np.mean(found_m[both] - true_m[both]))
    # A shift of half a pixel, the usual mistake with pixel centres, would show in the mean.
    assert np.abs(np.mean(off, axis=(0, 1))).max() < 0.01
    assert np.sqrt(np.mean(np.square(off))) < 0.08
    assert np.abs(np.mean(depth_errors)) < 3e-4
    assert np.abs(depth_errors).max() < 2e-3


@given(
    turn=st.tuples(*[st.floats(-0.9, 0.9)] * 3),
    place=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(0.5, 4)),
    border=st.floats(0, 1),
)
def test_every_pixel_on_the_board_gets_the_depth_of_its_ray(
    turn: tuple[float, ...], place: tuple[float, ...], border: float
) -> None:
    """Against points spread over the board, each projected into a pixel."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotations(np.array([turn]))[0], place
    board = BoardConfig(BOARD.columns, BOARD.rows, BOARD.square, border=border)
    depth_m = board_depth(T, board, CAMERA)
    v, u = np.nonzero(depth_m)
    hit = CAMERA.rays()[v, u] * depth_m[v, u, None].astype(np.float64)
    on_board = (hit - T[:3, 3]) @ T[:3, :3] / board.square
    assert np.abs(on_board[:, 2]).max(initial=0) < 1e-3
    assert on_board[:, :2].min(initial=0) >= -border - 1e-3
    assert on_board[:, 0].max(initial=0) <= board.columns - 1 + border + 1e-3
    assert on_board[:, 1].max(initial=0) <= board.rows - 1 + border + 1e-3
    # Nothing on the board is missed: points well inside it fall on pixels that have depth.
    inside = np.stack(np.meshgrid(np.linspace(1, 6, 30), np.linspace(1, 3, 30)), axis=-1).reshape(-1, 2)
    points = np.column_stack([inside * board.square, np.zeros(len(inside))]) @ T[:3, :3].T + T[:3, 3]
    in_front = points[:, 2] > 0.3
    pixel = points[in_front, :2] / points[in_front, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
    seen = np.rint(pixel).astype(int)
    in_image = ((seen >= 0) & (seen < [CAMERA.width, CAMERA.height])).all(axis=1)
    slanted = abs(T[:3, 2] @ points.mean(axis=0)) < 0.3 * np.linalg.norm(points.mean(axis=0))
    if in_front.all() and not slanted:
        assert (depth_m[seen[in_image, 1], seen[in_image, 0]] > 0).all()


def test_a_board_upside_down_is_found_the_right_way_round(views: list) -> None:
    image = views[0][1]
    view, turned = find_board(image, BOARD, CAMERA), find_board(image[::-1, ::-1].copy(), BOARD, CAMERA)
    assert view is not None
    assert turned is not None
    last = np.array([CAMERA.width - 1, CAMERA.height - 1])
    np.testing.assert_allclose(last - turned.corners, view.corners, atol=0.1)


def test_images_without_a_board_are_counted(tmp_path: Path, views: list) -> None:
    blank = np.full(CAMERA.shape, 120, np.uint8)
    for name, image in (("a", views[0][1]), ("b", blank), ("c", views[3][1])):
        cv2.imwrite(str(tmp_path / f"{name}.png"), image)
    found = find_boards(image_files(tmp_path), ["a", "b", "c"], BOARD, CAMERA)
    assert (list(found.views), found.not_found, found.imprecise) == (["a", "c"], ["b"], [])
    with pytest.raises(DatasetError, match=r"chessboard of 8 x 5 inner corners was found in 0 of 1 images"):
        find_boards(image_files(tmp_path), ["b"], BOARD, CAMERA)


def test_a_bent_board_is_told_from_a_flat_one(tmp_path: Path, views: list) -> None:
    bent = views[0][1].astype(np.float32)
    v, u = np.indices(CAMERA.shape).astype(np.float32)
    bent = cv2.remap(bent, u + 4 * np.sin(v / 25), v + 4 * np.sin(u / 25), cv2.INTER_LINEAR)
    cv2.imwrite(str(tmp_path / "bent.png"), bent.astype(np.uint8))
    with pytest.raises(DatasetError, match="found in 1 of 1 images, but nowhere within 1 pixels of a flat"):
        find_boards(image_files(tmp_path), ["bent"], BOARD, CAMERA)


def test_a_board_must_be_described(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros(CAMERA.shape, np.uint8))
    with pytest.raises(ConfigError, match=r"board\.square must be given"):
        find_boards(image_files(tmp_path), ["a"], BoardConfig(columns=8, rows=5), CAMERA)
    with pytest.raises(ConfigError, match=r"board\.columns must be at least 3"):
        BoardConfig(columns=2)


def test_images_of_another_size_are_named(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((10, 20), np.uint8))
    with pytest.raises(DatasetError, match=r"a\.png: 20 x 10 pixels, but the depth camera has 320 x 240"):
        find_boards(image_files(tmp_path), ["a"], BOARD, CAMERA)
