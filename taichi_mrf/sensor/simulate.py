"""Simulated sensor noise on clean axial depth: what a perfect renderer lacks to be a test of a mapper.

There are two sensors. :func:`simulate` is a structured-light camera with all effects that the literature
describes for a Kinect 1, which no map's noise model covers in full. :func:`simulate_model` draws from a noise
model itself, such as a learnt table, so that a map can be judged with exactly the sensor that it believes in.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from taichi_mrf.errors import FrameError
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.noise import NoiseModel

Seed = int | Sequence[int]

STEEP = 2.0
"""theta / (pi/2 - theta) at 60 degrees, the incidence theta from which axial noise grows with it."""

Image = NDArray[np.float64]


@dataclass(frozen=True)
class SimulatedSensor:
    """Departure of measured depth from true depth. All depths are axial, in metres."""

    sigma: tuple[float, ...] = (0.001504, -0.00152, 0.0019)
    """Standard deviation as a polynomial in true depth, ascending powers. The default is the Kinect 1
    (Nguyen, Izadi and Lovell 2012)."""

    bias: tuple[float, ...] = (0.0,)
    """Mean of measured minus true depth as a polynomial in true depth, ascending powers."""

    steep_sigma: float = 0.0
    """At an incidence theta of 60 degrees and more, this times theta^2 / (pi/2 - theta)^2 / sqrt(depth) is
    added to sigma."""

    lateral_sigma_px: float = 0.0
    """Standard deviation, in pixels along each image axis, of the place that a pixel looks at. It lets edges
    fray, and adds to axial noise where a surface is tilted."""

    steep_lateral_sigma_px: float = 0.0
    """At an incidence theta, this times theta / (pi/2 - theta) is added to ``lateral_sigma_px``."""

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

KINECT_1_LATERAL = replace(KINECT_1, steep_sigma=0.0001, lateral_sigma_px=0.8, steep_lateral_sigma_px=0.035)
"""Kinect 1 with the full model of Nguyen, Izadi and Lovell (2012), lateral noise and steep surfaces included.
Each pixel's place is drawn by itself, as Barron and Malik (2013) and Handa et al. (2014) do."""


def simulate(
    depth_m: NDArray[np.float32],
    camera: PinholeCamera,
    sensor: SimulatedSensor = KINECT_1,
    seed: Seed = 0,
) -> NDArray[np.float32]:
    """A measured depth image, (H, W) float32, from a clean one; 0 means no measurement, in both.

    The same ``seed`` gives the same image. In this order: where a pixel looks (lateral noise), how far that
    is (bias and axial noise), rounding to steps of disparity. Pixels that look at a surface at a grazing
    angle, at a jump of depth, or at a depth out of range measure nothing. Raises FrameError if the image is
    not of the camera's size.
    """
    true = _clean(depth_m, camera)
    random = np.random.default_rng(seed)
    normal = random.standard_normal(true.shape)
    visible = incidence(true, camera) <= sensor.largest_incidence
    visible &= ~at_a_jump(true, sensor.largest_jump)
    steepness = _steepness(incidence(true, camera, across_edges=False), sensor.largest_incidence)
    if sensor.lateral_sigma_px > 0 or sensor.steep_lateral_sigma_px > 0:
        lateral_px = sensor.lateral_sigma_px + sensor.steep_lateral_sigma_px * steepness
        across, down = random.standard_normal((2, *true.shape)) * lateral_px
        true, place = sampled_beside(true, (across, down))
        steepness, visible = steepness[place], visible[place]
    measured = true + polyval(true, sensor.bias) + _sigma(true, steepness, sensor) * normal
    if sensor.depth_step > 0:
        measured = in_disparity_steps(measured, sensor.depth_step)
    in_range = (true >= sensor.min_depth) & (true <= sensor.max_depth) & (measured > 0)
    return np.where(visible & in_range, measured, 0).astype(np.float32)


def simulate_model(
    depth_m: NDArray[np.float32], camera: Camera, noise: NoiseModel, seed: Seed = 0
) -> NDArray[np.float32]:
    """Draw a measured depth image, (H, W) float32, from the ``noise`` of each pixel.

    measured = true + bias(true) + max(sigma(true), LEAST_SIGMA_M) * n with n standard normal, drawn for all
    pixels, row by row, by ``numpy.random.default_rng(seed)``. Nothing else is lost or rounded: 0 (no
    measurement) stands only where there is no clean depth, or where the draw is not positive. The
    polynomials hold at any depth, so clean depth beyond the range that they were learnt on is for the
    caller to leave out. Raises FrameError if the image is not of the camera's size, ConfigError if the noise
    model is not for this camera.
    """
    true = _clean(depth_m, camera)
    sigma, bias = noise.table(camera).at_pixels(true)
    measured = true + bias + sigma * np.random.default_rng(seed).standard_normal(true.shape)
    return np.where((true > 0) & (measured > 0), measured, 0).astype(np.float32)


def _clean(depth_m: NDArray[np.float32], camera: Camera) -> NDArray[np.float64]:
    """Clean depth as float64, 0 where there is none."""
    depth_m = np.asarray(depth_m)
    if depth_m.shape != camera.shape:
        raise FrameError(f"clean depth of shape {depth_m.shape} does not fit a camera of {camera.shape}")
    return np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, 0).astype(np.float64)


def _steepness(angle: NDArray[np.float64], largest: float) -> NDArray[np.float64]:
    """theta / (pi/2 - theta), (H, W), of incidences up to the largest at which anything is measured."""
    angle = np.minimum(angle, min(largest, np.deg2rad(89.0)))
    return angle / (np.pi / 2 - angle)


def _sigma(
    true: NDArray[np.float64], steepness: NDArray[np.float64], sensor: SimulatedSensor
) -> NDArray[np.float64]:
    """Standard deviation of the axial noise, (H, W), in metres, never negative."""
    sigma = np.maximum(polyval(true, sensor.sigma), 0.0)
    steep = np.where(steepness >= STEEP, sensor.steep_sigma * steepness**2, 0.0)
    return sigma + steep / np.sqrt(np.maximum(true, 1e-3))


def incidence(depth_m: Image, camera: PinholeCamera, across_edges: bool = True) -> Image:
    """Angle between each pixel's ray and the surface's normal, (H, W), in radians, 0 to pi / 2.

    A plane's inverse depth is linear in the image, a x + b y + c with x, y the ray at z = 1, and (a, b, c)
    is its normal; a and b are taken from central differences, one-sided at the image's edge. At an edge
    between two surfaces these make it steep; without ``across_edges`` the difference to the nearer in depth
    of the two neighbours gives each surface's own tilt. Where a neighbour has no depth central differences
    mean nothing.
    """
    inverse = _inverse(depth_m)
    by_row, by_column = np.gradient(inverse) if across_edges else (_slope(inverse, 0), _slope(inverse, 1))
    a, b = by_column * camera.fx, by_row * camera.fy
    rays = camera.rays()
    c = inverse - a * rays[..., 0] - b * rays[..., 1]
    length = np.sqrt(a * a + b * b + c * c)
    # The ray times the normal is the inverse depth itself.
    cosine = inverse / np.maximum(length * camera.range_per_depth(), 1e-12)
    return np.arccos(np.minimum(cosine, 1.0))


def at_a_jump(depth_m: Image, largest_share: float) -> NDArray[np.bool_]:
    """Pixels on either side of a step to a neighbour above, below, left or right."""
    jump = np.zeros(depth_m.shape, dtype=bool)
    for here, next_to_it in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        a, b = depth_m[here], depth_m[next_to_it]
        large = np.abs(a - b) > largest_share * np.minimum(a, b)
        jump[here] |= large
        jump[next_to_it] |= large
    return jump


def sampled_beside(
    depth_m: Image, shift_px: tuple[Image, Image]
) -> tuple[Image, tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Depth at places that lie ``shift_px`` = (across, down) from the pixels' centres, and the index of the
    pixel that each place belongs to.

    That pixel's own surface is continued to the place as a plane, whose inverse depth is linear in the
    image. A place beyond an edge of a surface thus has the neighbour's depth, and none is ever a mixture of
    two surfaces. Places outside the image belong to its outermost pixels.
    """
    rows, columns = np.indices(depth_m.shape)
    height, width = depth_m.shape
    u = np.clip(columns + shift_px[0], 0, width - 1)
    v = np.clip(rows + shift_px[1], 0, height - 1)
    pixel = (np.rint(v).astype(np.intp), np.rint(u).astype(np.intp))
    inverse = _inverse(depth_m)
    here = inverse[pixel]
    there = here + (u - pixel[1]) * _slope(inverse, 1)[pixel] + (v - pixel[0]) * _slope(inverse, 0)[pixel]
    # Half a pixel on, a plane seen from its edge would already be behind the camera.
    seen = (here > 0) & (there > 0)
    return np.where(seen, 1.0 / np.where(seen, there, 1.0), 0.0), pixel


def in_disparity_steps(depth_m: Image, step_at_1m: float) -> Image:
    """Round the inverse depth to whole steps, which at 1 m are ``step_at_1m`` of depth."""
    positive = depth_m > 0
    counts = np.round(1.0 / (np.where(positive, depth_m, 1.0) * step_at_1m))
    return np.where(positive & (counts > 0), 1.0 / (np.maximum(counts, 1.0) * step_at_1m), 0.0)


def _inverse(depth_m: Image) -> Image:
    """1 / depth, 0 where there is none."""
    return 1.0 / np.where(depth_m > 0, depth_m, np.inf)


def _slope(values: Image, axis: int) -> Image:
    """The smaller of the differences to the two neighbours: next to an edge, the one within the surface."""
    difference = np.moveaxis(np.diff(values, axis=axis), axis, 0)
    before = np.concatenate([difference[:1], difference])
    after = np.concatenate([difference, difference[-1:]])
    return np.moveaxis(np.where(np.abs(before) < np.abs(after), before, after), 0, axis)
