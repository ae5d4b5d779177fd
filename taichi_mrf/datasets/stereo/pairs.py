"""Rectified stereo pairs as depth frames, independent of the recording's layout.

Depth is not recorded: it is matched when a frame is read, and so is the sigma of each pixel.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from taichi_mrf.datasets.base import Row, StatedSensor, Table
from taichi_mrf.datasets.images import image_size, read_color
from taichi_mrf.datasets.stereo.confidence import disparity_sigma
from taichi_mrf.datasets.stereo.matching import SIGMA_D_PX, StereoMatching, StereoRig, stereo_depth
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.system.files import read_text


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
