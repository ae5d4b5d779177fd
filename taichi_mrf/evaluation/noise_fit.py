"""Factors by which a map's noise is off, from held-out measurements: a wrong noise file is noticed here.

A measurement's density under the map is that of its ray's surface, spread by sigma. It is computed for sigmas
from an eighth to 32 times the assumed one; the factor under which all measurements together are likeliest is
the answer. Unlike the ratio of residuals to sigma it does not depend on rays that meet another surface, or
none: their density is the same for all sigmas.

Sigma may also be off by other factors near than far: errors of poses add as much to a precise near
measurement as to a coarse far one. So a law of two parameters is fitted in the same way, added + scale times
what is stated.

The map of a right noise, too, is off by a part of a voxel: it does not know where in a voxel a surface is,
nor always in which of two neighbours. The variance of a place that may be anywhere in a voxel, voxel_size^2 /
12, is no noise of the sensor and is set aside.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.evaluation.accuracy import log_density
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.queries.survey import OPAQUE, Medium, dim, occlusion
from taichi_mrf.queries.view import viewed_box
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.forward import SEGMENT
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.limits import LEAST_SIGMA_M
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.sensor.noise import CameraNoise, NoiseModel, unwidened_noise
from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, F32Array, F32Array2, I32Array, Struct, Template
from taichi_mrf.voxels.traversal import FAR, Space, Viewpoint, clip, pixel_ray, walk_voxels

OCTAVES = np.arange(-3.0, 5.01, 0.5)
"""Binary logarithms of the factors on sigma that are tried."""

PIXELS = 5_000
"""Measurements of a view that are looked at."""

LEAST_PIXELS = 200
"""With fewer nothing is said."""

VOXEL_SPREAD = 12.0**-0.5
"""Standard deviation of a place that may be anywhere in a voxel, in voxels."""

LEAST_SCALE = 0.01
"""A law keeps this share of the stated sigma: a parameter that is 0 would never grow again."""

CLOSE = 1.02
"""Factor to which the parameters of a law are found."""


@dataclass(frozen=True)
class SigmaLaw:
    """Sigma is ``added_m`` metres more than ``scale`` times the stated one."""

    scale: float = 1.0
    added_m: float = 0.0


@dataclass(frozen=True)
class Explained:
    """Fit of a map to n measurements. ``sigma_m`` (n,) is the assumed standard deviation of each, in metres,
    ``stated_m`` (n,) the one before learning, and ``log_likelihood`` (n, OCTAVES) the log density, per metre,
    under each multiple of ``sigma_m``. ``voxel_m`` is the standard deviation that the size of a voxel
    adds."""

    sigma_m: NDArray[np.float64]
    stated_m: NDArray[np.float64]
    log_likelihood: NDArray[np.float64]
    voxel_m: float = 0.0

    def mean(self, sigma_m: ArrayLike) -> float:
        """Mean log density with other standard deviations, (n,), to which the voxel's is added; between the
        tried ones by parabolas."""
        factor = np.sqrt(np.square(sigma_m) + self.voxel_m**2) / self.sigma_m
        place = (np.log2(factor) - OCTAVES[0]) / (OCTAVES[1] - OCTAVES[0])
        place = np.clip(place, 0.0, len(OCTAVES) - 1.0)
        middle = np.clip(np.rint(place).astype(np.int64), 1, len(OCTAVES) - 2)
        t, cell = place - middle, middle + len(OCTAVES) * np.arange(len(middle))
        before, at, after = (self.log_likelihood.take(cell + k) for k in (-1, 0, 1))
        return float(np.mean(at + t * (0.5 * (after - before) + t * (0.5 * (before + after) - at))))

    def under(self, law: SigmaLaw) -> float:
        """Mean log density with a law of sigma."""
        return self.mean(np.maximum(law.added_m + law.scale * self.stated_m, LEAST_SIGMA_M))


def explained(
    m: VoxelMap,
    depth_m: NDArray[np.float32],
    T_world_camera: ArrayLike,
    camera: Camera,
    noise: NoiseModel,
    stated: NoiseModel | None = None,
) -> Explained | None:
    """Fit of a map to a depth image (H, W) that it has not seen. ``noise`` is the noise assumed for the
    image; ``stated`` is the noise before learning, if that differs. None without a measurement to judge."""
    table = noise.table(camera)
    pixels = np.flatnonzero((depth_m > 0) & (depth_m <= m.sensor.max_depth))
    if not len(pixels):
        return None
    # Evenly over the image, but not in columns: a stride that divides the width would make some.
    kept = pixels[np.linspace(0, len(pixels) - 1, min(len(pixels), PIXELS)).astype(np.int64)].astype(np.int32)
    some = np.zeros_like(depth_m)
    some.flat[kept] = depth_m.flat[kept]
    measured = some > 0
    sigma_m = table.at_pixels(some)[0][measured]
    stated_m = sigma_m if stated is None else stated.table(camera).at_pixels(some)[0][measured]
    densities = _log_densities(m, kept, depth_m.flat[kept], as_pose(T_world_camera), camera, table)
    return Explained(sigma_m, stated_m, densities, VOXEL_SPREAD * m.voxel_size)


def _log_densities(
    m: VoxelMap,
    pixels: NDArray[np.int32],
    depth_m: NDArray[np.float32],
    T_world_camera: Pose,
    camera: Camera,
    noise: CameraNoise,
) -> NDArray[np.float64]:
    """The log density of the measurements of some pixels (n,) under each multiple of sigma, (n, OCTAVES)."""
    view, reach_m = m.view, m.sensor.max_depth
    density, visibility = np.zeros((len(pixels), len(OCTAVES)), np.float32), np.ones(len(pixels), np.float32)
    window = view.fill(np.stack(viewed_box(camera, T_world_camera, reach_m)))
    if window is not None:
        # A doubt in the map would bear a part of what sigma has to.
        medium = Medium(m.voxel_size, reach_m, -FAR, replace(view.predicting, least=-FAR, most=FAR))
        _explain_rays(
            noise.sensor(camera), window[0].viewpoint(T_world_camera),
            view.index.space(window[0], view.volume.lower, view.volume.upper), view.pool.belief, medium,
            pixels, depth_m, (2.0**OCTAVES).astype(np.float32), _Densities(density, visibility),
        )  # fmt: skip
        view.index.clear(*window)
        runtime.settle()
    return log_density(density, visibility[:, None], reach_m)


@dataclass(frozen=True)
class _Densities(Bundle):
    """Output of :func:`_explain_rays`: the ``density`` (n, OCTAVES), per metre, of each measurement under
    each multiple of sigma, if the surface is distributed as the map has it, and the ``visibility`` (n) of the
    ray at its end."""

    density: F32Array2
    visibility: F32Array


@dataclass(frozen=True)
class _Explaining(Bundle):
    """Inputs of a step along ray ``i`` of :func:`_explain_rays`."""

    belief: F32Array
    medium: Medium
    sensor: Sensor
    noise: Template  # of the ray's pixel
    factors: F32Array
    measured: F32
    i: I32
    out: _Densities


@ti.dataclass
class _Seen(Struct):
    """A ray on its way from the camera."""

    voxels_per_depth: F32  # length of the ray, in voxels, for one metre of depth
    visibility: F32  # what is left of it


@ti.func
def _explain_voxel(ray: Template, given: Template, voxel: I32, near: F32, far: F32) -> I32:
    """One voxel of a ray."""
    here = dim(ray, occlusion(given.belief[voxel], given.medium.occlusion), near, far)
    for k in range(given.factors.shape[0]):
        noise = given.sensor.noise.times(given.noise, given.factors[k])
        given.out.density[given.i, k] += here * given.sensor.likelihood(
            given.measured, near, far, noise, given.medium.voxel_size, SEGMENT
        )
    return ti.cast(ray.visibility > OPAQUE, ti.i32)


@kernel
def _explain_rays(
    sensor: Sensor, view: Viewpoint, space: Space, belief: F32Array, medium: Medium,
    pixels: I32Array, measured: F32Array, factors: F32Array, out: _Densities,
) -> None:  # fmt: skip
    """Follow the rays of some ``pixels`` (n), which ``measured`` (n) metres."""
    for i in range(pixels.shape[0]):
        u, v = sensor.pixel(pixels[i])
        path = pixel_ray(sensor, view, u, v)
        begin, end = 0.0, medium.max_depth
        clip(path, begin, end, space.lower, space.upper)
        given = _Explaining(belief, medium, sensor, sensor.noise_at(u, v), factors, measured[i], i, out)
        ray = _Seen(path.direction.norm(), 1.0)
        walk_voxels(path, begin, end, space, _explain_voxel, ray, given)
        out.visibility[i] = ray.visibility


def pooled(parts: Iterable[Explained | None]) -> Explained | None:
    """The measurements of several views together; None if there are fewer than LEAST_PIXELS."""
    found = [part for part in parts if part is not None]
    if sum(len(part.sigma_m) for part in found) < LEAST_PIXELS:
        return None
    sigma_m, stated_m, log_likelihood = (
        np.concatenate([getattr(part, name) for part in found])
        for name in ("sigma_m", "stated_m", "log_likelihood")
    )
    return Explained(sigma_m, stated_m, log_likelihood, found[0].voxel_m)


def sigma_factor(measurements: Explained) -> float:
    """The factor on sigma under which the measurements are likeliest."""
    octaves = np.linspace(OCTAVES[0], OCTAVES[-1], 8 * (len(OCTAVES) - 1) + 1)
    means = [measurements.mean(2.0**octave * measurements.sigma_m) for octave in octaves]
    return float(2.0 ** octaves[int(np.argmax(means))])


def sigma_law(measurements: Explained, factor: float) -> SigmaLaw:
    """The law under which the measurements are likeliest, whose :func:`sigma_factor` is ``factor``."""
    stated_m, mean = measurements.stated_m, measurements.under
    scale = factor * float(np.median(measurements.sigma_m / stated_m))
    middle_m = scale * float(np.median(stated_m))
    starts = [SigmaLaw(scale), SigmaLaw(0.5 * scale, 0.5 * middle_m), SigmaLaw(0.1 * scale, 0.9 * middle_m)]
    return max((_improved(start, mean) for start in starts), key=mean)


def _improved(law: SigmaLaw, mean: Callable[[SigmaLaw], float]) -> SigmaLaw:
    """A law at which no step of either parameter helps, with steps that grow small."""
    best, step = mean(law), 2.0
    while step > CLOSE:
        tried = [
            SigmaLaw(law.scale * scale, law.added_m * added)
            for scale, added in (
                (step, 1),
                (1 / step, 1),
                (1, step),
                (1, 1 / step),
                (step, 1 / step),
                (1 / step, step),
            )
        ]
        tried = [SigmaLaw(max(each.scale, LEAST_SCALE), each.added_m) for each in tried]
        values = [mean(each) for each in tried]
        if max(values) > best:
            best = max(values)
            law = tried[values.index(best)]
        else:
            step **= 0.5
    return law


MOST_FRAMES = 8
"""Held-out frames that are looked at, evenly spread: a factor needs no more."""

DOUBTED, CONTRADICTED = 1.25, 2.0
"""A default sigma that is off by more than the first factor is doubted; one that was stated, or learnt from
other frames, by more than the second,"""

LEAST_GAIN = 0.02
"""if measurements are likelier by so many nats each with the right one. Where voxels are much larger than
sigma, no factor on it makes a difference. Right noises came out at up to .004, the kitchen's at .05."""


@dataclass(frozen=True)
class NoiseCheck:
    """``factor`` is what sigma has to be multiplied by so that ``pixels`` measurements of ``frames`` held-out
    frames are likeliest, and ``gain`` by how many nats each they are then likelier. ``law`` is the law of
    sigma under which they are likeliest where sigma is off, else None."""

    factor: float
    gain: float
    frames: int
    pixels: int
    law: SigmaLaw | None = None

    @property
    def wrong(self) -> bool:
        """True if sigma is off."""
        return self.law is not None


def enough_of(held_out: Sequence[int]) -> Sequence[int]:
    """Those of the held-out frames that :func:`check_noise` needs."""
    return held_out[:: max(1, -(-len(held_out) // MOST_FRAMES))]


def check_noise(
    m: VoxelMap,
    frames: Iterable[Frame],
    on_frame: Callable[[], None] = lambda: None,
    most: float = DOUBTED,
) -> NoiseCheck | None:
    """Compare the noise of a map with some frames that it has not seen. None if these do not tell.
    ``on_frame`` is called after each; ``most`` is the factor from which on sigma is off."""
    parts: list[Explained] = []
    for frame in frames:
        part = explained_frame(m, frame)
        if part is not None:
            parts.append(part)
        on_frame()
    together = pooled(parts)
    if together is None:
        return None
    return checked(together, len(parts), most)


def checked(measured: Explained, frames: int, most: float = DOUBTED) -> NoiseCheck:
    """The check of the measurements of some frames, sigma being off from the factor ``most`` on.

    How much of a voxel a map does not know depends on the scene, so the factor is the one next to 1 of those
    between that for a whole voxel and that for none.
    """
    without = replace(measured, voxel_m=0.0)
    of_whole, of_none = sigma_factor(measured), sigma_factor(without)
    factor, by = (of_whole, measured) if of_whole > 1.0 else (min(of_none, 1.0), without)
    gain = by.mean(factor * by.sigma_m) - by.mean(by.sigma_m)
    wrong = gain > LEAST_GAIN and not 1.0 / most <= factor <= most
    return NoiseCheck(factor, gain, frames, len(measured.sigma_m), sigma_law(by, factor) if wrong else None)


def explained_frame(m: VoxelMap, frame: Frame) -> Explained | None:
    """Fit of a map to a frame that it has not seen, by the noise that both state."""
    noise = frame.own_for(m.sensor).noise_model(m.noise, frame.depth_m)
    plain = replace(m.sensor, sigma_scale=1.0, sigma_added=0.0)
    stated = frame.own_for(plain).noise_model(unwidened_noise(m.noise, m.sensor), frame.depth_m)
    return explained(m, frame.depth_m, frame.T_world_camera, frame.camera, noise, stated)
