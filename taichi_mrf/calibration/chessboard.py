"""A chessboard as ground truth: its corners in an image, its pose, and the depth of every pixel on it.

The board's frame has its origin in the first inner corner, x along the rows and y along the columns of
corners, and z = 0 on the board. Images are undistorted and taken through the depth camera's own pixels: the
infrared image of the same camera, or colour registered to it. A folder's images are searched for the board;
those that are not used are recorded with the reason.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.calibration.options import BoardConfig
from taichi_mrf.datasets.images import read_color
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.files import is_folder

_PRECISELY = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
_LARGEST_WINDOW, _LEAST_WINDOW = 11, 2
"""Half the side of the window in which a corner is refined, in pixels."""

_GRAZING = 1e-6


@dataclass(frozen=True)
class BoardView:
    """A board found in an image: corners (rows * columns, 2) in pixels, pose, and RMS reprojection error."""

    corners: NDArray[np.float64]
    T_camera_board: Pose
    reprojection: float


def find_board(image: NDArray[np.uint8], board: BoardConfig, camera: PinholeCamera) -> BoardView | None:
    """Find the board in an (H, W) grey or (H, W, 3) RGB image; None if it is not wholly in view.

    ``corners`` begin where the square between the first four is dark.
    """
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    # The sector-based detector also finds boards with squares of some eight pixels, tilted ones included.
    found, corners = cv2.findChessboardCornersSB(grey, (board.columns, board.rows))
    if not found:
        return None
    grid = corners.reshape(board.rows, board.columns, 2)
    window = _window(grid)
    corners = cv2.cornerSubPix(grey, _dark_first(grey, grid), (window, window), (-1, -1), _PRECISELY)
    return _board_view(corners.reshape(-1, 2).astype(np.float64), board, camera)


def corner_points(board: BoardConfig) -> NDArray[np.float64]:
    """The inner corners in the board's frame, (rows * columns, 3), in metres."""
    v, u = np.indices((board.rows, board.columns))
    points = np.stack([u, v, np.zeros_like(u)], axis=-1).reshape(-1, 3)
    return np.asarray(points * board.square, np.float64)


def camera_matrix(camera: PinholeCamera) -> NDArray[np.float64]:
    """The 3 x 3 matrix of the intrinsics."""
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])


def board_depth(T_camera_board: Pose, board: BoardConfig, camera: PinholeCamera) -> NDArray[np.float32]:
    """Axial depth of the board where pixels' rays meet it, (H, W) float32; 0 beside it.

    A ray r with z = 1 meets the plane through t with the normal n at the depth (n t) / (n r).
    """
    R, t = T_camera_board[:3, :3], T_camera_board[:3, 3]
    rays, normal = camera.rays(), R[:, 2]
    slope = rays @ normal
    depth = (normal @ t) / np.where(np.abs(slope) > _GRAZING, slope, np.inf)
    on_board = (rays * depth[..., None] - t) @ R[:, :2] / board.square
    inside = (depth > 0) & (on_board >= -board.border).all(axis=-1)
    inside &= (on_board <= np.array([board.columns, board.rows]) - 1 + board.border).all(axis=-1)
    return np.where(inside, depth, 0).astype(np.float32)


def _dark_first(grey: NDArray[np.uint8], grid: NDArray[np.float32]) -> NDArray[np.float32]:
    """The corners, (rows * columns, 1, 2), from the end at which the first inner square is dark.

    This distinguishes the two ends of a board if one of rows and columns is even and the other odd.
    """
    centres = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
    shade = cv2.remap(grey, centres, None, cv2.INTER_LINEAR).astype(np.float64)
    v, u = np.indices(shade.shape)
    even = (u + v) % 2 == 0
    ordered = grid if shade[even].mean() < shade[~even].mean() else grid[::-1, ::-1]
    return np.ascontiguousarray(ordered.reshape(-1, 1, 2))


def _window(corners: NDArray[np.float32]) -> int:
    """Half a window that stays within the squares around each corner, however small they appear."""
    sides = [np.linalg.norm(np.diff(corners, axis=axis), axis=-1).min() for axis in (0, 1)]
    return int(np.clip(min(sides) / 2 - 1, _LEAST_WINDOW, _LARGEST_WINDOW))


def _board_view(corners: NDArray[np.float64], board: BoardConfig, camera: PinholeCamera) -> BoardView | None:
    """The pose with the least reprojection error; a plane has two candidates, of which IPPE gives both."""
    points, K = corner_points(board), camera_matrix(camera)
    count, rotations, positions, errors = cv2.solvePnPGeneric(
        points, corners, K, None, flags=cv2.SOLVEPNP_IPPE
    )
    if count == 0:
        return None
    best = int(np.argmin(np.ravel(errors)))
    rotation, position = cv2.solvePnPRefineLM(points, corners, K, None, rotations[best], positions[best])
    projected, _ = cv2.projectPoints(points, rotation, position, K, None)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], position.ravel()
    error = float(np.sqrt(np.mean(np.sum((projected.reshape(-1, 2) - corners) ** 2, axis=1))))
    return BoardView(corners, T, error) if T[2, 3] > 0 else None


FORMATS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")


@dataclass
class FoundBoards:
    """The views of the board by image name, and the names of the images that gave none."""

    views: dict[str, BoardView] = field(default_factory=dict)
    not_found: list[str] = field(default_factory=list)
    imprecise: list[str] = field(default_factory=list)


def image_files(folder: Path) -> dict[str, Path]:
    """Name without suffix -> file, in the order of the names. Raises DatasetError if there is none."""
    if not is_folder(folder):
        raise DatasetError(f"{folder}: is not a folder of images")
    files = {path.stem: path for path in sorted(folder.iterdir()) if path.suffix.lower() in FORMATS}
    if not files:
        raise DatasetError(f"{folder}: contains no images ({', '.join(FORMATS)})")
    return files


def find_boards(
    files: dict[str, Path],
    names: Sequence[str],
    board: BoardConfig,
    camera: PinholeCamera,
    progress: Callable[[int], None] = lambda number: None,
) -> FoundBoards:
    """Look for the board in the images called ``names``; ``progress`` gets the number of images done.

    Raises ConfigError if the board is not described, DatasetError, naming the file, if an image has
    another size than the camera, and if the board is in none of them.
    """
    board.require()
    found = FoundBoards()
    for number, name in enumerate(names, start=1):
        image = read_color(files[name])
        if image.shape[:2] != camera.shape:
            height, width = image.shape[:2]
            raise DatasetError(
                f"{files[name]}: {width} x {height} pixels, but the depth camera has "
                f"{camera.width} x {camera.height}"
            )
        view = find_board(image, board, camera)
        if view is None:
            found.not_found.append(name)
        elif view.reprojection > board.largest_reprojection:
            found.imprecise.append(name)
        else:
            found.views[name] = view
        progress(number)
    if not found.views:
        raise DatasetError(_nothing_found(files[names[0]].parent, len(names), found, board))
    return found


def _nothing_found(folder: Path, images: int, found: FoundBoards, board: BoardConfig) -> str:
    text = (
        f"{folder}: a chessboard of {board.columns} x {board.rows} inner corners was found in "
        f"{len(found.imprecise)} of {images} images"
    )
    if found.imprecise:
        text += f", but nowhere within {board.largest_reprojection:g} pixels of a flat board"
    return text
