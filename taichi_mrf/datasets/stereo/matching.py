"""A passive stereo rig as a depth camera: rectified pairs to axial depth, and the noise of that depth.

Depth is not recorded: it is matched when a frame is read, and so is the sigma of each pixel. Matching is
OpenCV's semi-global matching (H. Hirschmueller, "Stereo Processing by Semiglobal Matching and Mutual
Information", PAMI 2008). Disparity is the column of a point in the left image minus its column in the right
one, in pixels; depth is b f / disparity. The noise follows K. Schauwecker and A. Zell, "Robust and Efficient
Volumetric Occupancy Mapping with an Application to Stereo Vision", ICRA 2014, eq. 7.

Two things that a matcher leaves behind predict its errors. One is the cost of the match: with c(x) the mean
squared difference of the two blocks when the disparity is moved by x pixels, sqrt(c(0) / c'') is about the
move that doubles the cost. It is small where the images agree and have texture, and large where either is
missing. The other is the spread of the disparities around: at an edge, and on a slope, a block holds several
depths.

    sigma_d = SIGMA_PX * move^MOVE_POWER * (SPREAD_OFFSET_PX + spread)^SPREAD_POWER
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.values import check_field
from taichi_mrf.datasets.base import Row, StatedSensor, Table
from taichi_mrf.datasets.images import first_size, read_color
from taichi_mrf.errors import ConfigError, DatasetError, FrameError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.system.files import read_text

SIGMA_D_PX = 0.286
"""Standard deviation of the disparity in pixels, with the default ``StereoMatching``, of the matches that are
off by less than 3 pixels on Wood2 and Cloth3 of Middlebury 2006, pooled
(:mod:`taichi_mrf.evaluation.stereo_error`)."""

_STEPS_PER_PX = cv2.StereoMatcher_DISP_SCALE
_PREFILTER_CAP = 63
_TEXTURE_WINDOW = 9
_MODES = {
    3: cv2.StereoSGBM_MODE_SGBM_3WAY,
    4: cv2.StereoSGBM_MODE_HH4,
    5: cv2.StereoSGBM_MODE_SGBM,
    8: cv2.StereoSGBM_MODE_HH,
}


@dataclass(frozen=True)
class StereoMatching:
    """Matching of a rectified pair into a disparity image. Grey values are 0 to 255."""

    disparities: int = 128
    """Disparities from 0 up to below this many pixels are searched; a multiple of 16. What is nearer than
    baseline * focal length / disparities has no depth."""

    paths: Literal[3, 4, 5, 8] = 3
    """Directions from which matching costs are gathered. Three take half the time of five and less than a
    quarter of that of eight, and match as well."""

    block_size: int = 5
    """Side in pixels, odd, of the blocks that are compared. Larger ones match more of a weakly textured
    image and fatten thin things."""

    small_step_penalty: float = 8.0
    """Cost, for each pixel of a block, of a disparity that differs by 1 pixel from its neighbour's."""

    large_step_penalty: float = 32.0
    """Cost, for each pixel of a block, of any larger step; more than ``small_step_penalty``."""

    uniqueness: int = 15
    """Per cent by which the best disparity must be cheaper than all others that are not next to it."""

    left_right_tolerance: float = 1.0
    """Largest difference in pixels between the disparities of a point when the left image is matched with
    the right one and the right one with the left one. It finds what only one camera sees."""

    least_texture: float = 0.1
    """Least RMS horizontal gradient (grey values per pixel, over 9 x 9 pixels) that counts as a measurement.
    In an area that is quite flat or saturated the disparity is only guessed from its surroundings. Camera
    noise makes gradients too: values above 1 drop more of a noisy sky, but also more of pale walls."""

    speckle_size: int = 200
    """Patches of disparities of up to this many pixels, cut off from what is around them, are dropped;
    0 keeps all."""

    speckle_range: float = 1.0
    """Neighbouring pixels whose disparities differ by more than this (pixels) are cut off from each other."""

    least_disparity: float = 2.0
    """Smaller disparities (pixels) are dropped, which bounds depth by baseline * focal length /
    least_disparity: the relative error of depth is sigma_d / disparity, and the sky's is near 0."""

    pixel_sigma: bool = True
    """True if frames state a sigma for each pixel, by how sure the matching is of it (disparity_sigma).
    Otherwise sigma follows from depth alone, with one sigma_d for all pixels."""

    def __post_init__(self) -> None:
        fits = 16 <= self.disparities <= 1024 and self.disparities % 16 == 0
        _check(fits, "disparities", "must be a multiple of 16 up to 1024")
        _check(self.paths in _MODES, "paths", "must be 3, 4, 5 or 8")
        _check(1 <= self.block_size <= 31 and self.block_size % 2 == 1, "block_size", "must be odd, 1 to 31")
        _check(self.small_step_penalty > 0, "small_step_penalty", "must be positive")
        larger = self.small_step_penalty < self.large_step_penalty <= 1000
        _check(larger, "large_step_penalty", "must be more than small_step_penalty, and at most 1000")
        _check(0 <= self.uniqueness < 100, "uniqueness", "must be at least 0 and less than 100 per cent")
        _check(self.left_right_tolerance > 0, "left_right_tolerance", "must be positive")
        _check(self.least_texture >= 0, "least_texture", "must not be negative")
        _check(self.speckle_size >= 0, "speckle_size", "must not be negative")
        _check(0 < self.speckle_range <= self.disparities, "speckle_range", "must lie in 0 to disparities")
        _check(0 < self.least_disparity < self.disparities, "least_disparity", "must lie in 0 to disparities")


@dataclass(frozen=True)
class StereoRig:
    """A rectified rig: two equal cameras, the right one ``baseline_m`` metres along the left one's x axis."""

    camera: PinholeCamera
    """The left camera, whose depth is computed."""

    baseline_m: float
    """Distance of the two cameras in metres."""

    def __post_init__(self) -> None:
        if not 0 < self.baseline_m < math.inf:
            raise ConfigError(f"stereo baseline_m must be a positive number of metres, not {self.baseline_m}")

    def depth(self, disparity_px: NDArray[np.floating]) -> NDArray[np.float32]:
        """Axial depth of the left camera in metres, float32, from disparity in pixels; 0 = none in both."""
        disparity = np.asarray(disparity_px, np.float64)
        depth_m = np.zeros(disparity.shape)
        np.divide(self.baseline_m * self.camera.fx, disparity, out=depth_m, where=disparity > 0)
        return depth_m.astype(np.float32)

    def disparity(self, depth_m: NDArray[np.floating]) -> NDArray[np.float32]:
        """The inverse of :meth:`depth`: pixels from metres, float32; 0 = none in both."""
        return self.depth(depth_m)  # each is baseline times focal length over the other

    def sigma_at(
        self, depth_m: NDArray[np.floating], sigma_d_px: NDArray[np.floating]
    ) -> NDArray[np.float32]:
        """Standard deviation of measured depths, (H, W) float32 in metres, from that of their disparities in
        pixels."""
        sigma_m = depth_m.astype(np.float64) ** 2 * sigma_d_px / (self.baseline_m * self.camera.fx)
        return sigma_m.astype(np.float32)

    def sigma(self, sigma_d_px: float = SIGMA_D_PX) -> tuple[float, float, float]:
        """:func:`depth_sigma` of this rig."""
        return depth_sigma(sigma_d_px, self.baseline_m, self.camera.fx)


def depth_sigma(sigma_d_px: float, baseline_m: float, fx: float) -> tuple[float, float, float]:
    """Coefficients (0, 0, lambda) of the standard deviation of depth, ascending powers of depth in metres.
    lambda = sigma_d / (b f) (Schauwecker and Zell, eq. 7), for the standard deviation of the disparity in
    pixels, the baseline in metres and the focal length in pixels. They are what ``PolynomialNoise`` and
    ``sensor.sigma`` take. Raises ConfigError if one of the three is not positive."""
    for name, value in (("sigma_d_px", sigma_d_px), ("baseline_m", baseline_m), ("fx", fx)):
        if not (math.isfinite(value) and value > 0):
            raise ConfigError(f"stereo {name} must be a positive number, not {value}")
    return 0.0, 0.0, sigma_d_px / (baseline_m * fx)


def stereo_depth(
    left: NDArray[np.uint8], right: NDArray[np.uint8], rig: StereoRig, matching: StereoMatching | None = None
) -> NDArray[np.float32]:
    """Axial depth of the left camera, (H, W) float32 in metres, 0 = none, from a rectified grey pair. Raises
    FrameError as :func:`stereo_disparity` does, and if the pair is not of the camera's size."""
    disparity_px = stereo_disparity(left, right, matching)
    if disparity_px.shape != rig.camera.shape:
        raise FrameError(
            f"the stereo pair has {left.shape[1]} x {left.shape[0]} pixels, "
            f"the camera {rig.camera.width} x {rig.camera.height}"
        )
    return rig.depth(disparity_px)


def stereo_disparity(
    left: NDArray[np.uint8], right: NDArray[np.uint8], matching: StereoMatching | None = None
) -> NDArray[np.float32]:
    """Disparity of each pixel of the left image, (H, W) float32 in pixels, 0 = none; the images are grey.
    Both images are matched, each with the other: OpenCV's own check (disp12MaxDiff) only looks for pixels
    that claim one partner, within one matching, and alone leaves twice the gross errors on street scenes.
    Raises FrameError if the images are not grey, not 8-bit, not of one size, or narrower than a block."""
    settings = matching or StereoMatching()
    for side, image in (("left", left), ("right", right)):
        if image.ndim != 2 or image.dtype != np.uint8 or image.size == 0:
            raise FrameError(f"the {side} image is {image.dtype} {image.shape}; expected grey 8-bit (H, W)")
    if left.shape != right.shape:
        raise FrameError(
            f"the left image has {left.shape[1]} x {left.shape[0]} pixels, "
            f"the right one {right.shape[1]} x {right.shape[0]}"
        )
    if left.shape[1] < settings.block_size:
        raise FrameError(f"a stereo pair of {left.shape[1]} columns is narrower than a matching block")
    disparity = _semi_global(left, right, settings)
    # Mirrored, the right image is a left one; its disparities come back mirrored.
    from_right = _semi_global(right[:, ::-1], left[:, ::-1], settings)[:, ::-1]
    keep = left_right_consistent(disparity, from_right, settings.left_right_tolerance)
    keep &= _texture(left) >= settings.least_texture
    keep &= disparity >= settings.least_disparity
    return _without_speckles(np.where(keep, disparity, np.float32(0)), settings)


def left_right_consistent(
    left_px: NDArray[np.floating], right_px: NDArray[np.floating], tolerance_px: float
) -> NDArray[np.bool_]:
    """True for pixels of the left disparity image that the right one confirms, (H, W); 0 = none in both. A
    pixel at column u with disparity d is confirmed if column u - d (rounded) of the right image exists and
    has a disparity within ``tolerance_px`` of d."""
    rows, columns = np.indices(left_px.shape)
    partner = np.rint(columns - left_px).astype(np.int64)
    inside = (left_px > 0) & (partner >= 0)
    other = right_px[rows, np.where(inside, partner, 0)]
    return inside & (other > 0) & (np.abs(other - left_px) <= tolerance_px)


def _semi_global(
    left: NDArray[np.uint8], right: NDArray[np.uint8], settings: StereoMatching
) -> NDArray[np.float32]:
    """One matching without any check, (H, W) float32 in pixels, 0 = none."""
    area = settings.block_size**2
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=settings.disparities,
        blockSize=settings.block_size,
        P1=max(1, round(settings.small_step_penalty * area)),
        P2=max(2, round(settings.large_step_penalty * area)),
        disp12MaxDiff=max(1, round(settings.left_right_tolerance)),
        preFilterCap=_PREFILTER_CAP,
        uniquenessRatio=settings.uniqueness,
        speckleWindowSize=0,
        mode=_MODES[settings.paths],
    )
    # OpenCV leaves the first `disparities` columns out. With a border they are matched as well; those whose
    # partner lies in the border are outside the right camera's view, and the left-right check drops them.
    border = (0, 0, settings.disparities, 0, cv2.BORDER_REPLICATE)
    steps = matcher.compute(cv2.copyMakeBorder(left, *border), cv2.copyMakeBorder(right, *border))
    return _in_pixels(np.maximum(steps[:, settings.disparities :], 0))


def _texture(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """RMS horizontal gradient around each pixel, (H, W), grey values per pixel."""
    gradient = cv2.Sobel(image, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    return np.sqrt(cv2.boxFilter(gradient**2, -1, (_TEXTURE_WINDOW, _TEXTURE_WINDOW)))


def _without_speckles(disparity_px: NDArray[np.float32], settings: StereoMatching) -> NDArray[np.float32]:
    steps = np.rint(disparity_px * _STEPS_PER_PX).astype(np.int16)
    cv2.filterSpeckles(steps, 0, settings.speckle_size, settings.speckle_range * _STEPS_PER_PX)
    return _in_pixels(steps)


def _in_pixels(steps: NDArray[np.int16]) -> NDArray[np.float32]:
    return steps.astype(np.float32) / np.float32(_STEPS_PER_PX)


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
    """Standard deviation of each pixel's disparity, (H, W) float32 in pixels, 0 where there is none. ``left``
    and ``right`` are the grey pair, (H, W), ``disparity_px`` that of the left image, 0 = none."""
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
    return nearest - farthest


@dataclass(frozen=True)
class RecordedPair(Row):
    """Files of one pair's images."""

    left_file: Path
    right_file: Path


@dataclass
class StereoPairs(Table[RecordedPair]):
    """Stereo pairs as depth frames of the left camera; ``color`` is the left image. ``matching`` may be set
    to other parameters before frames are read."""

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


def size_of_pairs(where: Path, images: Iterable[Path]) -> tuple[int, int]:
    """(width, height) of the first image that can be read. Raises DatasetError, which names ``where`` they
    are, if none can be read."""
    size = first_size(images)
    if size is None:
        raise DatasetError(f"{where}: none of its images can be read")
    return size


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


def _check(ok: bool, name: str, problem: str) -> None:
    check_field(ok, f"stereo {name}", problem)
