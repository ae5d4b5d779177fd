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

from taichi_mrf.datasets import Dataset
from taichi_mrf.errors import FrameError
from taichi_mrf.evaluation.accuracy import judge_view
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.limits import LEAST_SIGMA_M
from taichi_mrf.sensor.noise import NoiseModel, NoiseTable, unwidened_noise
from taichi_mrf.voxels.traversal import FAR

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
    """How well a map explains n measurements. ``sigma_m`` (n,) is the assumed standard deviation of each, in
    metres, ``stated_m`` (n,) the one without what was learnt, and ``log_likelihood`` (n, OCTAVES) the log
    density, per metre, under each multiple of ``sigma_m``. ``voxel_m`` is the standard deviation that the
    size of a voxel adds."""

    sigma_m: NDArray[np.float64]
    stated_m: NDArray[np.float64]
    log_likelihood: NDArray[np.float64]
    voxel_m: float = 0.0

    def mean(self, sigma_m: ArrayLike) -> float:
        """Mean log density with other standard deviations, (n,), to which the voxel's is added; between the
        tried ones by parabolas."""
        factor = np.hypot(sigma_m, self.voxel_m) / self.sigma_m
        place = (np.log2(factor) - OCTAVES[0]) / (OCTAVES[1] - OCTAVES[0])
        place = np.clip(place, 0.0, len(OCTAVES) - 1.0)
        middle = np.clip(np.rint(place).astype(np.int64), 1, len(OCTAVES) - 2)
        t, pixel = place - middle, np.arange(len(middle))
        before, at, after = (self.log_likelihood[pixel, middle + k] for k in (-1, 0, 1))
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
    """How well a map explains the measurements of a depth image (H, W) that it has not seen, of which
    ``noise`` is assumed; ``stated`` is the noise without what was learnt, if that differs. None if there are
    none to judge, or noise is not made of polynomials."""
    table = noise.table(camera)
    pixels = np.flatnonzero((depth_m > 0) & (depth_m <= m.sensor.max_depth))
    if not len(pixels) or not isinstance(table, NoiseTable):
        return None
    some = np.zeros_like(depth_m)
    # Evenly over the image, but not in columns: a stride that divides the width would make some.
    kept = pixels[np.linspace(0, len(pixels) - 1, min(len(pixels), PIXELS)).astype(np.int64)]
    some.flat[kept] = depth_m.flat[kept]
    measured = some > 0
    # A doubt in the map would bear a part of what sigma has to.
    trusting = m.view.with_occlusion(least=-FAR, most=FAR)
    densities = []
    for octave in OCTAVES:
        noise_there = _Multiple(table, 2.0**octave)
        view = judge_view(m, some, T_world_camera, camera, noise=noise_there, view=trusting)
        densities.append(view.log_densities())
    sigma_m = table.at_pixels(some)[0][measured]
    stated_m = sigma_m if stated is None else stated.table(camera).at_pixels(some)[0][measured]
    return Explained(sigma_m, stated_m, np.stack(densities, axis=1), VOXEL_SPREAD * m.voxel_size)


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


def sigma_law(measurements: Explained) -> SigmaLaw:
    """The law under which the measurements are likeliest."""
    stated_m, mean = measurements.stated_m, measurements.under
    scale = sigma_factor(measurements) * float(np.median(measurements.sigma_m / stated_m))
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


@dataclass(frozen=True)
class _Multiple:
    """The noise of a table with a multiple of its sigma."""

    of: NoiseTable
    factor: float

    def table(self, camera: Camera) -> NoiseTable:
        """The table of the one camera that it is for."""
        coefficients = self.of.coefficients.copy()
        coefficients[:, 0] *= self.factor
        return replace(self.of, coefficients=coefficients)


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


def check_noise(
    m: VoxelMap,
    dataset: Dataset,
    held_out: Sequence[int],
    on_frame: Callable[[], None] = lambda: None,
    most: float = DOUBTED,
) -> NoiseCheck | None:
    """Compare the noise of a map with some of the held-out frames, indices of the dataset. None if these do
    not tell. ``on_frame`` is called after each; ``most`` is the factor from which on sigma is off."""
    some = held_out[:: max(1, -(-len(held_out) // MOST_FRAMES))]
    parts: list[Explained] = []
    for index in some:
        try:
            part = explained_frame(m, dataset.read(index))
        except FrameError:  # check_held_out names it
            part = None
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
    return NoiseCheck(factor, gain, frames, len(measured.sigma_m), sigma_law(by) if wrong else None)


def explained_frame(m: VoxelMap, frame: Frame) -> Explained | None:
    """How well a map explains a frame that it has not seen, by the noise that both state."""
    noise = frame.own_for(m.sensor).noise_model(m.noise, frame.depth_m)
    plain = replace(m.sensor, sigma_scale=1.0, sigma_added=0.0)
    stated = frame.own_for(plain).noise_model(unwidened_noise(m.noise, m.sensor), frame.depth_m)
    return explained(m, frame.depth_m, frame.T_world_camera, frame.camera, noise, stated)
