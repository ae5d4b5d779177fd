"""Finding the board in a folder of images, and recording which images were not used and why."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from taichi_mrf.calibration.chessboard import BoardView, find_board
from taichi_mrf.calibration.options import BoardConfig
from taichi_mrf.datasets.images import read_color
from taichi_mrf.errors import DatasetError
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.files import is_folder

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
