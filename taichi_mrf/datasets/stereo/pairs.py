"""Rectified stereo pairs as depth frames, independent of the recording's layout.

Depth is not recorded: it is matched when a frame is read, and so is the sigma of each pixel. Two things that
a matcher leaves behind predict its errors. One is the cost of the match: with c(x) the mean squared
difference of the two blocks when the disparity is moved by x pixels, sqrt(c(0) / c'') is about the move that
doubles the cost. It is small where the images agree and have texture, and large where either is missing. The
other is the spread of the disparities around: at an edge, and on a slope, a block holds several depths.

    sigma_d = SIGMA_PX * move^MOVE_POWER * (SPREAD_OFFSET_PX + spread)^SPREAD_POWER
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Row, StatedSensor, Table
from taichi_mrf.datasets.images import image_size, read_color
from taichi_mrf.datasets.stereo.matching import SIGMA_D_PX, StereoMatching, StereoRig, stereo_depth
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.system.files import read_text

SIGMA_PX, MOVE_POWER, SPREAD_POWER = 0.47, 0.3, 1 / 3
"""Fitted on the first 12 pairs of a street (KITTI sequence 1): the likelihood of what the next pair measures
at the same points. The scale, 1.2 times the fitted one, was chosen on pairs 25 to 38 by the likelihood of
those that were held out of the map."""

SPREAD_OFFSET_PX = 0.1
"""A spread that is no spread: disparities come in sixteenths of a pixel."""

BLOCK = 5
"""Side in pixels of the blocks whose difference and whose spread are taken."""

MOVE_RANGE_PX = (0.1, 3.0)
SPREAD_RANGE_PX = (0.06, 3.0)
"""Beyond these they predict no more."""


def disparity_sigma(
    left: NDArray[np.uint8], right: NDArray[np.uint8], disparity_px: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Standard deviation of each pixel's disparity, (H, W) float32 in pixels, 0 where there is none.

    ``left`` and ``right`` are the grey pair, (H, W), ``disparity_px`` that of the left image, 0 = none.
    """
    before, here, behind = (_cost(left, right, disparity_px, shift) for shift in (-1.0, 0.0, 1.0))
    curvature = np.maximum(before + behind - 2 * here, np.float32(1e-6))
    move = np.clip(np.sqrt(here / curvature), *MOVE_RANGE_PX)
    spread = np.clip(_spread(disparity_px), *SPREAD_RANGE_PX)
    sigma = SIGMA_PX * move**MOVE_POWER * (SPREAD_OFFSET_PX + spread) ** SPREAD_POWER
    return np.where(disparity_px > 0, sigma, 0.0).astype(np.float32)


def _cost(
    left: NDArray[np.uint8], right: NDArray[np.uint8], disparity_px: NDArray[np.float32], shift_px: float
) -> NDArray[np.float32]:
    """Mean squared difference of the blocks around each pixel and its partner, ``shift_px`` beside it. The
    mean difference does not count: the two cameras may be exposed differently."""
    rows, columns = np.indices(disparity_px.shape, dtype=np.float32)
    partner = columns - disparity_px - np.float32(shift_px)
    moved = cv2.remap(
        right.astype(np.float32), partner, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    difference = left.astype(np.float32) - moved
    difference -= cv2.boxFilter(difference, -1, (BLOCK, BLOCK))
    # OpenCV's running sums may come out just below zero.
    return np.maximum(cv2.boxFilter(difference**2, -1, (BLOCK, BLOCK)), np.float32(0.0))


def _spread(disparity_px: NDArray[np.float32]) -> NDArray[np.float32]:
    """The largest minus the smallest disparity of the block around each pixel."""
    block = np.ones((BLOCK, BLOCK), np.uint8)
    nearest = cv2.dilate(disparity_px, block)
    farthest = cv2.erode(np.where(disparity_px > 0, disparity_px, np.float32(1e4)), block)
    spread: NDArray[np.float32] = nearest - farthest
    return spread


@dataclass(frozen=True)
class RecordedPair(Row):
    """Files of one pair's images."""

    left_file: Path
    right_file: Path


@dataclass
class StereoPairs(Table[RecordedPair]):
    """Stereo pairs as depth frames of the left camera; ``color`` is the left image.

    ``matching`` may be set to other parameters before frames are read.
    """

    camera: PinholeCamera
    baseline_m: float = 1.0
    color: bool = True
    matching: StereoMatching = field(default_factory=StereoMatching)

    @property
    def stated(self) -> StatedSensor:
        """lambda z^2, from the baseline and the focal length, and by how sure the matching is, unless
        ``matching`` says otherwise."""
        return StatedSensor(self.rig.sigma(), self.matching.pixel_sigma)

    @property
    def rig(self) -> StereoRig:
        """The left camera and the baseline."""
        return StereoRig(self.camera, self.baseline_m)

    def load(self, index: int, row: RecordedPair, T_world_camera: Pose) -> Frame:
        """Read and match one pair, whose images must have the camera's size."""
        left, right = (read_color(path, self.camera) for path in (row.left_file, row.right_file))
        grey_left, grey_right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right))
        depth_m = stereo_depth(grey_left, grey_right, self.rig, self.matching)
        sigma_m = None
        if self.matching.pixel_sigma:
            sigma_d_px = disparity_sigma(grey_left, grey_right, self.rig.disparity(depth_m))
            sigma_m = self.rig.sigma_at(depth_m, sigma_d_px)
        color = left if self.color else None
        return Frame(depth_m, T_world_camera, self.camera, row.stamp, row.name, color, sigma_m)


def noise_note(rig: StereoRig, left: str, right: str) -> str:
    """The report's note on depth matched between the images ``left`` and ``right``."""
    lambda_ = rig.sigma()[2]
    return (
        f"depth comes from stereo: {left} and {right} by semi-global matching, "
        f"baseline {rig.baseline_m:.4f} m, fx {rig.camera.fx:.1f} px; with sigma_d = {SIGMA_D_PX:g} px "
        f"its sigma is lambda z^2, lambda = {lambda_:.3e} per metre"
    )


def first_size(where: Path, images: Iterable[Path]) -> tuple[int, int]:
    """(width, height) of the first image that can be read; a broken one is reported with its frame.

    Raises DatasetError, which names ``where`` they are, if none can be read."""
    for image in images:
        try:
            return image_size(image)
        except DatasetError:
            continue
    raise DatasetError(f"{where}: none of its images can be read")


def read_times(path: Path) -> list[float]:
    """A file with a stamp in seconds a line. Raises DatasetError, which names the file and the line."""
    stamps = []
    for number, line in enumerate(read_text(path, DatasetError).splitlines(), start=1):
        if not line.strip():
            continue
        try:
            stamps.append(float(line))
        except ValueError:
            raise DatasetError(f"{path} line {number}: expected a stamp in seconds") from None
        if not np.isfinite(stamps[-1]):
            raise DatasetError(f"{path} line {number}: the stamp is not finite")
    return stamps
