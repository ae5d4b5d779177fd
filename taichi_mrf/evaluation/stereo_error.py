"""Error of measured disparities: the source of a stereo matcher's sigma_d.

Gross mismatches are no part of the noise that a map's sensor model describes, so the spread is taken over
the inliers alone and the share of the others is reported beside it.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.images import read_color
from taichi_mrf.datasets.stereo.matching import StereoMatching, left_right_consistent, stereo_disparity
from taichi_mrf.errors import FrameError

INLIER_PX = 3.0
"""A match that is off by this many pixels or more is an outlier (as in the KITTI stereo benchmark)."""

_MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True)
class DisparityError:
    """Measured minus true disparity in pixels; NaN where there is nothing to compare."""

    pixels: int
    """Pixels that have a measured and a true disparity. What only the left camera sees counts too: a
    disparity that is given there is mostly wrong."""

    completeness: float
    """Share of the pixels that both cameras see, and whose true disparity is known, that have a measured
    one, 0 to 1."""

    outliers: float
    """Share of the compared pixels that are off by INLIER_PX or more, 0 to 1."""

    bias: float
    """Mean error of the inliers."""

    sigma_std: float
    """Standard deviation of the inliers about their mean."""

    sigma_mad: float
    """1.4826 times the median absolute deviation from the median, over all compared pixels. It comes in
    steps where measured and true disparities do."""


@dataclass(frozen=True)
class TruePair:
    """A rectified grey pair, (H, W) uint8, with its true disparities, (H, W) float in pixels, 0 = unknown."""

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    left_px: NDArray[np.floating]
    right_px: NDArray[np.floating]

    def visible(self) -> NDArray[np.bool_]:
        """True for pixels of the left image that the right camera sees as well, (H, W)."""
        return left_right_consistent(self.left_px, self.right_px, tolerance_px=1.0)


def read_middlebury(folder: Path, steps_per_px: float = 2.0) -> TruePair:
    """A pair of Middlebury 2005 or 2006 (H. Hirschmueller and D. Scharstein, CVPR 2007), from a folder.

    view1 is the left and view5 the right camera; disp1 and disp5 hold their disparities in
    ``1 / steps_per_px`` pixels: 1 for images of full size, 2 for half, 3 for a third. Raises DatasetError,
    whose text names the file, or FrameError if the four images are not of one size.
    """
    left, right, left_steps, right_steps = (
        read_color(folder / f"{name}.png") for name in ("view1", "view5", "disp1", "disp5")
    )
    if len({image.shape for image in (left, right, left_steps, right_steps)}) > 1:
        raise FrameError(f"{folder}: view1, view5, disp1 and disp5 are not of one size")
    return TruePair(
        left=cv2.cvtColor(left, cv2.COLOR_RGB2GRAY),
        right=cv2.cvtColor(right, cv2.COLOR_RGB2GRAY),
        left_px=left_steps[..., 0] / steps_per_px,
        right_px=right_steps[..., 0] / steps_per_px,
    )


def measure(pairs: Iterable[TruePair], matching: StereoMatching | None = None) -> DisparityError:
    """The error of a matcher over the pixels of all pairs together."""
    return pooled_disparity_error(
        (stereo_disparity(pair.left, pair.right, matching), pair.left_px, pair.visible()) for pair in pairs
    )


def pooled_disparity_error(
    images: Iterable[tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.bool_]]],
) -> DisparityError:
    """Compare measured with true disparities, (H, W) in pixels, 0 = none, over several images together.

    Each is given with the mask, (H, W), of the pixels that both cameras see, from which alone a
    measurement can be asked for. Raises FrameError if the shapes of an image's three arrays differ.
    """
    errors: list[NDArray[np.float64]] = [np.zeros(0)]
    wanted = found = 0
    for measured_px, true_px, visible in images:
        if not measured_px.shape == true_px.shape == visible.shape:
            raise FrameError(
                f"measured disparities, true ones and visibility are of shapes {measured_px.shape}, "
                f"{true_px.shape} and {visible.shape}"
            )
        both = (true_px > 0) & (measured_px > 0)
        errors.append(measured_px[both].astype(np.float64) - true_px[both])
        wanted += int(((true_px > 0) & visible).sum())
        found += int((both & visible).sum())
    error = np.concatenate(errors)
    inliers = error[np.abs(error) < INLIER_PX]
    nan = float("nan")
    completeness = found / wanted if wanted else nan
    if inliers.size == 0:
        return DisparityError(error.size, completeness, 1.0 if error.size else nan, nan, nan, nan)
    return DisparityError(
        pixels=error.size,
        completeness=completeness,
        outliers=1.0 - inliers.size / error.size,
        bias=float(inliers.mean()),
        sigma_std=float(inliers.std()),
        sigma_mad=float(_MAD_TO_SIGMA * np.median(np.abs(error - np.median(error)))),
    )
