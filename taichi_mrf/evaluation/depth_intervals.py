"""Calibration of the depths that a map predicts, from measurements alone.

A map and its sensor's noise predict a distribution of the measurement of each pixel: the one whose density
accuracy.py takes the logarithm of. If it is right, a measurement falls below the distribution's q-quantile
in a share q of all pixels, so the probabilities of "no more than what was measured" are spread evenly over
0 to 1 (the probability integral transform: Gneiting, Balabdaoui and Raftery, J. R. Stat. Soc. B, 2007).
"""

# mypy: disable-error-code="return-value"
# ruff: noqa: ANN202 - Taichi does not allow `-> None` on a kernel or a func.

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.evaluation.accuracy import OUTLIERS, JudgedView
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.queries.survey import OPAQUE, Occlusion, dim, occlusion
from taichi_mrf.queries.view import View
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.forward import SUPPORT, normal_density, normal_tail
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.sensor.noise import CameraNoise
from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, F32Array, I32Array, Struct, Template
from taichi_mrf.voxels.layout import BRICK
from taichi_mrf.voxels.traversal import Space, Viewpoint, clip, pixel_ray, walk_voxels
from taichi_mrf.voxels.window import Window

LEVELS = np.linspace(0.05, 0.95, 19)
"""Probabilities of the central intervals that are compared."""

INTERVAL_PIXELS = 5_000
"""Measurements of a view from which the calibration of depths is computed."""


@ti.dataclass
class Prediction(Struct):
    """State of a ray on its way from the camera; depths are axial, in metres."""

    voxels_per_depth: F32
    measured: F32
    visibility: F32
    below: F32  # probability of a surface so far whose measurement is no more than that


def probability_below(
    view: View,
    measured_m: NDArray[np.float32],
    T_world_camera: Pose,
    camera: Camera,
    noise: CameraNoise,
    max_depth: float,
) -> NDArray[np.float32]:
    """For each measurement of (H, W) ``measured_m`` that is not 0, row by row, the probability that the map
    gives to a measurement of at most that, (n,). ``max_depth`` is where rays end, in metres."""
    chosen = np.flatnonzero((measured_m > 0) & (measured_m <= max_depth)).astype(np.int32)
    below = np.zeros(len(chosen), np.float32)
    slots = view.pool.in_use
    if len(chosen) and len(slots):
        bricks = view.pool.bricks[slots]
        middles_m = (bricks + 0.5) * (BRICK * view.voxel_size)
        window = Window.covering(middles_m.min(axis=0), middles_m.max(axis=0), view.voxel_size)
        cells = window.cells_of(bricks)
        view.index.fill(window, cells, slots)
        _follow(
            chosen, np.ascontiguousarray(measured_m.reshape(-1)[chosen], np.float32),
            noise.sensor(camera), window.viewpoint(T_world_camera),
            view.index.space(window, view.volume.lower, view.volume.upper), view.pool.belief,
            max_depth, view.predicting, below,
        )  # fmt: skip
        view.index.clear(window, cells)
        runtime.settle()
    anywhere = np.clip(measured_m.reshape(-1)[chosen] / max_depth, 0.0, 1.0)
    if not len(slots):
        below = anywhere
    return ((1.0 - OUTLIERS) * below + OUTLIERS * anywhere).astype(np.float32)


def view_below(view: View, judged: JudgedView, T_world_camera: Pose, camera: Camera) -> NDArray[np.float32]:
    """:func:`probability_below`, (n,), of some measurements of a judged view, evenly spread over its rows."""
    pixels = np.flatnonzero(judged.measured_m)
    some = np.zeros_like(judged.measured_m)
    kept = pixels[:: max(1, len(pixels) // INTERVAL_PIXELS)]
    some.flat[kept] = judged.measured_m.flat[kept]
    return probability_below(view, some, T_world_camera, camera, judged.noise, judged.max_depth)


def interval_error(below: Sequence[NDArray[np.float32]]) -> float:
    """Mean absolute difference between the probability of central intervals and the share of measurements
    in them, over LEVELS; NaN without a measurement. 0 is perfect, 0.5 the worst."""
    every = np.concatenate([np.zeros(0, np.float32), *below])
    if not len(every):
        return float("nan")
    width = np.sort(np.abs(2.0 * every - 1.0))
    inside = np.searchsorted(width, LEVELS, side="right") / len(width)
    return float(np.mean(np.abs(inside - LEVELS)))


@ti.func
def _normal_below(x: F32) -> F32:
    """Standard normal probability of no more than x."""
    mass = normal_tail(ti.abs(x))
    if x >= 0.0:
        mass = 1.0 - mass
    return mass


@ti.func
def _mean_below(low: F32, high: F32) -> F32:
    """The mean of the standard normal distribution function over [low, high]."""
    mean = 0.0
    if low >= SUPPORT:
        mean = 1.0
    elif high > -SUPPORT:
        if high - low > 1e-2:
            top = high * _normal_below(high) + normal_density(high)
            bottom = low * _normal_below(low) + normal_density(low)
            mean = (top - bottom) / (high - low)
        else:
            mean = _normal_below(0.5 * (low + high))
    return mean


@dataclass(frozen=True)
class _Predicted(Bundle):
    """Inputs of a step along a ray: log-odds (pool * 512), how voxels dim the ray, and the noise of its
    pixel."""

    belief: F32Array
    occlusion: Occlusion
    noise: Template


@ti.func
def _predict_voxel(ray: Template, predicted: Template, voxel: I32, near: F32, far: F32):
    """One voxel of a ray, whose segment in it reaches from axial depth ``near`` to ``far``."""
    here = dim(ray, occlusion(predicted.belief[voxel], predicted.occlusion), near, far)
    sigma = predicted.noise.sigma(0.5 * (near + far))
    high = (ray.measured - near - predicted.noise.bias(near)) / sigma
    low = (ray.measured - far - predicted.noise.bias(far)) / sigma
    ray.below += here * _mean_below(ti.min(low, high), high)
    return ti.cast(ray.visibility > OPAQUE, ti.i32)


@kernel
def _follow(
    chosen: I32Array, measured: F32Array, sensor: Sensor, view: Viewpoint, space: Space, belief: F32Array,
    max_depth: F32, rule: Occlusion, below: F32Array,
) -> None:  # fmt: skip
    """Follow the rays of the ``chosen`` pixels (n) up to ``max_depth`` metres.

    ``measured`` (n) are their measurements in metres; ``belief`` (pool * 512) holds log-odds; ``below`` (n)
    receives the probability of measuring no more.
    """
    for i in range(chosen.shape[0]):
        u, v = sensor.pixel(chosen[i])
        path = pixel_ray(sensor, view, u, v)
        ray = Prediction(path.direction.norm(), measured[i], 1.0, 0.0)
        begin, end = 0.0, max_depth
        clip(path, begin, end, space.lower, space.upper)
        walk_voxels(
            path, begin, end, space, _predict_voxel, ray, _Predicted(belief, rule, sensor.noise_at(u, v))
        )
        below[i] = ray.below + ray.visibility * ti.min(1.0, ray.measured / max_depth)
