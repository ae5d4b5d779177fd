"""Measured depth beside the true depth of the same pixels: the common form of every kind of ground truth.

Depth images come by name, from a folder or one file. A folder holds 16-bit PNGs, ``.npy`` images and ``.npz``
stacks; a single ``.npy`` or ``.npz`` is a stack. The images of a stack are called by their number, 0000,
0001, ...; those of a stack in a folder get the file's name in front. Whole numbers are steps of a metre,
floating-point numbers are metres.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.calibration.chessboard import board_depth
from taichi_mrf.calibration.options import BoardConfig
from taichi_mrf.datasets.images import read_depth
from taichi_mrf.errors import DatasetError, said
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.files import is_file, is_folder
from taichi_mrf.system.npz_file import open_npz, read_npy

FORMATS = (".png", ".npy", ".npz")
STACK_NAME = "depth_m"
"""The array of a .npz file that is used if there are several."""


@dataclass(frozen=True)
class _Listed:
    path: Path
    number: int | None
    """Position in the stack; None where the file is one image."""


class DepthFiles:
    """The depth images under ``path``, listed at once and read one at a time."""

    def __init__(self, path: Path, steps_per_metre: float) -> None:
        """Raises DatasetError, which names the file, if there are no images or a stack cannot be read."""
        if not (np.isfinite(steps_per_metre) and steps_per_metre > 0):
            raise DatasetError(f"the depth scale must be a positive number of steps, not {steps_per_metre}")
        self.path = path
        self._steps_per_metre = steps_per_metre
        self._stack: tuple[Path, NDArray] | None = None
        if is_folder(path):
            self._places = self._of_folder(path)
        elif path.suffix in (".npy", ".npz") and is_file(path):
            self._places = self._of_stack(path, "")
        else:
            raise DatasetError(f"{path}: is neither a folder nor a .npy or .npz file of depth images")
        if not self._places:
            raise DatasetError(f"{path}: contains no depth images ({', '.join(FORMATS)})")

    @property
    def names(self) -> list[str]:
        return list(self._places)

    def file(self, name: str) -> Path:
        """The file that an image lies in."""
        return self._places[name].path

    def read(self, name: str) -> NDArray[np.float32]:
        """Axial depth in metres, (H, W); 0 where there is none. Raises DatasetError naming the file."""
        place = self._places[name]
        if place.path.suffix == ".png":
            depth_m = read_depth(place.path, self._steps_per_metre)
        else:
            array = self._array(place.path)
            depth_m = self._metres(array if place.number is None else array[place.number])
        return np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, np.float32(0))

    def _of_folder(self, folder: Path) -> dict[str, _Listed]:
        places: dict[str, _Listed] = {}
        for path in sorted(p for p in folder.iterdir() if p.suffix in FORMATS):
            found = (
                self._of_stack(path, path.stem) if path.suffix == ".npz" else {path.stem: _Listed(path, None)}
            )
            for name, place in found.items():
                if name in places:
                    raise DatasetError(f"{path}: {places[name].path.name} has the same name")
                places[name] = place
        return places

    def _of_stack(self, path: Path, prefix: str) -> dict[str, _Listed]:
        array = self._array(path)
        if array.ndim == 2:
            return {prefix or path.stem: _Listed(path, None)}
        if array.ndim != 3:
            raise DatasetError(
                f"{path}: contains an array of shape {array.shape}, not a stack (N, H, W) of depth"
            )
        start = f"{prefix}-" if prefix else ""
        return {f"{start}{number:04d}": _Listed(path, number) for number in range(len(array))}

    def _array(self, path: Path) -> NDArray:
        """The array of a file; that of the last file is kept, since stacks are read image by image."""
        if self._stack is None or self._stack[0] != path:
            self._stack = (path, _load(path))
        return self._stack[1]

    def _metres(self, image: NDArray) -> NDArray[np.float32]:
        if np.issubdtype(image.dtype, np.integer):
            return image.astype(np.float32) / np.float32(self._steps_per_metre)
        return image.astype(np.float32)


def _load(path: Path) -> NDArray:
    try:
        array = read_npy(path)
    except (OSError, ValueError) as error:
        if path.suffix != ".npz":
            raise DatasetError(f"{path}: cannot be read as an array: {said(error)}") from error
        with open_npz(path, DatasetError, "a readable array") as file:
            names = file.names
            name = STACK_NAME if STACK_NAME in names else names[0] if len(names) == 1 else None
            if name is None:
                raise DatasetError(
                    f"{path}: contains no array '{STACK_NAME}' but {', '.join(names) or 'nothing'}"
                ) from None
            array = file[name]
    if not np.issubdtype(array.dtype, np.integer) and not np.issubdtype(array.dtype, np.floating):
        raise DatasetError(f"{path}: contains no numbers")
    if array.ndim == 2 or array.ndim == 3:
        return array
    raise DatasetError(f"{path}: contains an array of shape {array.shape}, not depth images")


@dataclass(frozen=True)
class DepthPair:
    """Axial depths in metres, both (H, W) float32; 0 where there is no measurement or no truth."""

    name: str
    measured_m: NDArray[np.float32]
    true_m: NDArray[np.float32]


class PairSource(Protocol):
    """Pairs that can be read more than once, in any order."""

    @property
    def names(self) -> list[str]:
        """The names of the pairs, for reports."""

    def read(self, name: str) -> DepthPair:
        """One pair, of the camera's size. Raises DatasetError naming the file."""


class RecordedPairs:
    """Measured and true depth from files of the same names."""

    def __init__(self, measured: DepthFiles, true: DepthFiles, camera: PinholeCamera) -> None:
        """Raises DatasetError if no name is in both."""
        known = set(true.names)
        self.names = [name for name in measured.names if name in known]
        self.unpaired = len(measured.names) - len(self.names)
        if not self.names:
            raise DatasetError(
                f"{true.path}: has no image of the same name as one in {measured.path} "
                f"({true.names[0]} against {measured.names[0]})"
            )
        self._measured, self._true, self._camera = measured, true, camera

    def read(self, name: str) -> DepthPair:
        return DepthPair(
            name,
            read_checked(self._measured, name, self._camera),
            read_checked(self._true, name, self._camera),
        )


class BoardPairs:
    """Measured depth, and the depth of a board whose pose in the camera is known for each image."""

    def __init__(
        self,
        measured: DepthFiles,
        T_camera_board: Mapping[str, Pose],
        board: BoardConfig,
        camera: PinholeCamera,
    ) -> None:
        """``T_camera_board`` gives the pose by the image's name; images that it lacks are left out."""
        self.names = [name for name in measured.names if name in T_camera_board]
        self._measured, self._poses, self._board, self._camera = measured, T_camera_board, board, camera

    def read(self, name: str) -> DepthPair:
        true_m = board_depth(self._poses[name], self._board, self._camera)
        return DepthPair(name, read_checked(self._measured, name, self._camera), true_m)


def read_checked(files: DepthFiles, name: str, camera: PinholeCamera) -> NDArray[np.float32]:
    """A depth image of the camera's size. Raises DatasetError naming the file if it has another."""
    depth_m = files.read(name)
    if depth_m.shape != camera.shape:
        height, width = depth_m.shape
        raise DatasetError(
            f"{files.file(name)}: {width} x {height} pixels, but the camera has "
            f"{camera.width} x {camera.height}"
        )
    return depth_m
