"""Simulated sensor noise on clean axial depth: what a perfect renderer lacks to be a test of a mapper."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from taichi_mrf.camera import PinholeCamera


@dataclass(frozen=True)
class SimulatedSensor:
    """How measured depth departs from true depth. All depths are axial, in metres."""

    sigma: tuple[float, ...] = (0.001504, -0.00152, 0.0019)
    """Standard deviation as a polynomial in true depth, ascending powers. The default is the Kinect 1
    (Nguyen, Izadi and Lovell 2012)."""

    bias: tuple[float, ...] = (0.0,)
    """Mean of measured minus true depth as a polynomial in true depth, ascending powers."""

    depth_step: float = 0.0
    """Distance of neighbouring depth values at 1 m; it grows with the square of depth, as disparity is
    what such a sensor counts in. 0 means no steps."""

    largest_incidence: float = np.deg2rad(80.0)
    """A surface whose normal is further than this from the ray (radians) gives no measurement."""

    largest_jump: float = 0.1
    """A pixel next to a depth that differs by more than this share of its own gives no measurement."""

    min_depth: float = 0.4
    """Nearest depth that is measured."""

    max_depth: float = 8.0
    """Furthest depth that is measured."""


KINECT_1 = SimulatedSensor(depth_step=0.00285)
"""Kinect 1: disparity in eighths of a pixel, baseline 75 mm, focal length 585 px: 1 / (8 * 0.075 * 585)."""


def simulate(
    depth_m: NDArray[np.float32],
    camera: PinholeCamera,
    sensor: SimulatedSensor = KINECT_1,
    seed: int | Sequence[int] = 0,
) -> NDArray[np.float32]:
    """A measured depth image, (H, W) float32, from a clean one; 0 means no measurement, in both.

    The same ``seed`` gives the same image. Pixels that see a surface at a grazing angle, that lie at a
    jump of depth, or whose depth is out of range measure nothing.
    """
    true = np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, 0).astype(np.float64)
    random = np.random.default_rng(seed)
    sigma = np.maximum(polyval(true, sensor.sigma), 0.0)
    measured = true + polyval(true, sensor.bias) + sigma * random.standard_normal(true.shape)
    if sensor.depth_step > 0:
        measured = _in_disparity_steps(measured, sensor.depth_step)
    in_range = (true >= sensor.min_depth) & (true <= sensor.max_depth) & (measured > 0)
    seen = in_range & ~_at_a_jump(true, sensor.largest_jump)
    seen &= incidence(true, camera) <= sensor.largest_incidence
    return np.where(seen, measured, 0).astype(np.float32)


def incidence(depth_m: NDArray[np.float64], camera: PinholeCamera) -> NDArray[np.float64]:
    """Angle between each pixel's ray and the surface's normal, (H, W), in radians, 0 to pi / 2.

    A plane's inverse depth is linear in the image, a x + b y + c with x, y the ray at z = 1, and (a, b, c)
    is its normal; a and b are taken from central differences, one-sided at the image's edge. Where a
    neighbour has no depth the angle means nothing.
    """
    inverse = 1.0 / np.where(depth_m > 0, depth_m, np.inf)
    by_row, by_column = np.gradient(inverse)
    a, b = by_column * camera.fx, by_row * camera.fy
    rays = camera.rays()
    c = inverse - a * rays[..., 0] - b * rays[..., 1]
    length = np.sqrt(a * a + b * b + c * c)
    # The ray times the normal is the inverse depth itself.
    cosine = inverse / np.maximum(length * camera.range_per_depth(), 1e-12)
    return np.arccos(np.minimum(cosine, 1.0))


def _at_a_jump(depth_m: NDArray[np.float64], largest_share: float) -> NDArray[np.bool_]:
    """Pixels on either side of a step to a neighbour above, below, left or right."""
    jump = np.zeros(depth_m.shape, dtype=bool)
    for here, next_to_it in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        a, b = depth_m[here], depth_m[next_to_it]
        large = np.abs(a - b) > largest_share * np.minimum(a, b)
        jump[here] |= large
        jump[next_to_it] |= large
    return jump


def _in_disparity_steps(depth_m: NDArray[np.float64], step_at_1m: float) -> NDArray[np.float64]:
    """Round the inverse depth to whole steps, which at 1 m are ``step_at_1m`` of depth."""
    positive = depth_m > 0
    counts = np.round(1.0 / (np.where(positive, depth_m, 1.0) * step_at_1m))
    return np.where(positive & (counts > 0), 1.0 / (np.maximum(counts, 1.0) * step_at_1m), 0.0)
