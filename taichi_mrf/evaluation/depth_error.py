"""How far a depth image that the map renders lies from the measured one."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import FrameError


@dataclass(frozen=True)
class DepthError:
    """Rendered minus measured depth over some pixels, in metres; NaN where there is nothing to compare."""

    pixels: int
    """Number of pixels that have both depths."""

    unanswered: float
    """Share of the measured pixels, 0 to 1, for which the map has no surface."""

    median_abs: float
    """Median of the absolute difference in metres."""

    median: float
    """Median of the signed difference in metres; positive where the map lies behind the measurement."""

    rms: float
    """Root of the mean squared difference in metres."""


def depth_error(rendered_m: NDArray[np.floating], measured_m: NDArray[np.floating]) -> DepthError:
    """Compare a rendered depth image with a measured one, both (H, W) and in metres.

    A pixel is measured where its depth is finite and positive, and answered where the rendered depth
    is finite. Raises FrameError when the shapes differ.
    """
    return pooled_depth_error([(rendered_m, measured_m)])


def pooled_depth_error(
    pairs: Iterable[tuple[NDArray[np.floating], NDArray[np.floating]]],
) -> DepthError:
    """Depth error over the pixels of several (rendered, measured) images together.

    The residuals are pooled: a median of medians would weigh an almost empty image like a full one.
    """
    residuals: list[NDArray[np.float64]] = [np.zeros(0)]
    measured_pixels = 0
    for rendered_m, measured_m in pairs:
        residual = _residuals(rendered_m, measured_m)
        measured_pixels += residual.size
        residuals.append(residual[np.isfinite(residual)])
    pooled = np.concatenate(residuals)
    unanswered = 1.0 - pooled.size / measured_pixels if measured_pixels else float("nan")
    if pooled.size == 0:
        return DepthError(0, unanswered, float("nan"), float("nan"), float("nan"))
    return DepthError(
        pixels=pooled.size,
        unanswered=unanswered,
        median_abs=float(np.median(np.abs(pooled))),
        median=float(np.median(pooled)),
        rms=float(np.sqrt(np.mean(pooled**2))),
    )


def _residuals(rendered_m: NDArray[np.floating], measured_m: NDArray[np.floating]) -> NDArray[np.float64]:
    """Rendered minus measured at the measured pixels, (N,); not finite where the map has no surface."""
    rendered, measured = np.asarray(rendered_m, np.float64), np.asarray(measured_m, np.float64)
    if rendered.shape != measured.shape:
        raise FrameError(f"depth images of shapes {rendered.shape} and {measured.shape} cannot be compared")
    has_depth = np.isfinite(measured) & (measured > 0)
    return rendered[has_depth] - measured[has_depth]
