"""Measured depth beside the true depth of the same pixels: the common form of every kind of ground truth."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.calibration.chessboard import board_depth
from taichi_mrf.calibration.depth_files import DepthFiles
from taichi_mrf.calibration.options import BoardConfig
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera


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
