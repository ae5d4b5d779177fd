"""Check of a map's noise against what held-out frames measured: a wrong noise file is noticed here."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from taichi_mrf.datasets import Dataset
from taichi_mrf.errors import FrameError
from taichi_mrf.evaluation.noise_fit import Explained, SigmaLaw, explained, pooled, sigma_factor, sigma_law
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.noise import unwidened_noise

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
