"""Pixels that looked and got nothing back: the chance that a surface gives no return, by its depth.

    q(d) = share + (1 - share) / (1 + exp((depth - d) / width))

Near surfaces give none with the chance ``share``: dark, wet, shiny and slanted ones do. Far ones give none
because too little light comes back. With the visibility vis_i and the occupancy m_i of the voxels of the ray,
of length l_i in them,

    P(no return | map) = prod_i (1 - m_i)^l_i + sum_i vis_i (1 - (1 - m_i)^l_i) q(d_i)

which has the form of the likelihood of a measurement (inference/sum_product.py): q takes the place of nu, and
what lies beyond the last voxel has the chance 1.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.schema import SensorConfig
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.limits import TERMS
from taichi_mrf.sensor.noise import NoiseTable

if TYPE_CHECKING:
    from taichi_mrf.sensor.no_return_law import NoReturnSensor

_BEYOND_ALL_M = 1e6


def no_return_chance(
    depth_m: ArrayLike, share: ArrayLike, half_m: ArrayLike, width_m: ArrayLike
) -> NDArray[np.float64]:
    """q at depths in metres, with which the parameters broadcast; ``half_m`` is the formula's depth."""
    exponent = np.minimum((np.asarray(half_m) - np.asarray(depth_m, np.float64)) / np.asarray(width_m), 80.0)
    share = np.asarray(share, np.float64)
    chance: NDArray[np.float64] = share + (1.0 - share) / (1.0 + np.exp(exponent))
    return chance


@dataclass(frozen=True)
class NoReturnLaw:
    """The chance that a surface gives no return: a noise model of the pixels without one."""

    share: float
    depth_m: float
    width_m: float

    begin_m: float
    """Depth from which a missing return counts: the sensor's minimum range."""

    reach_m: float
    """Depth up to which surfaces are likelier to give a return than not. What lies further is not judged."""

    @staticmethod
    def of(config: SensorConfig) -> "NoReturnLaw | None":
        """The law that a configuration states; None if missing returns are ignored, or count nowhere."""
        share, depth, width = config.no_return_share, config.no_return_depth, config.no_return_width
        if config.no_return == "ignore":
            return None
        if config.no_return == "free":
            share, reach, depth = 0.0, depth, _BEYOND_ALL_M
        else:  # where q is 1/2
            reach = depth - width * math.log(0.5 / (0.5 - share))
        reach = min(reach, config.max_depth)
        return NoReturnLaw(share, depth, width, config.min_depth, reach) if reach > config.min_depth else None

    @staticmethod
    def sure(config: SensorConfig) -> "NoReturnLaw":
        """The law of pixels that are known to be free up to a depth of their own: a surface before it would
        have been seen."""
        return NoReturnLaw(0.0, _BEYOND_ALL_M, 1.0, 0.0, config.max_depth)

    def chance(self, depth_m: ArrayLike) -> NDArray[np.float64]:
        """q at depths in metres."""
        return no_return_chance(depth_m, self.share, self.depth_m, self.width_m)

    def table(self, camera: Camera) -> "NoReturnTable":
        """The law for the pixels of a camera."""
        none = np.zeros((1, 2, TERMS), np.float32)
        return NoReturnTable(none, max(camera.width, camera.height), 1, self)


@dataclass(frozen=True)
class NoReturnTable(NoiseTable):
    """A table without noise, since no depth was measured; kernels get the law."""

    law: NoReturnLaw

    def sensor(self, camera: Camera) -> "NoReturnSensor":
        """A camera with this law as kernels take it."""
        from taichi_mrf.sensor.no_return_law import NoReturnChance, NoReturnSensor

        chance = NoReturnChance(self.law.share, self.law.depth_m, self.law.width_m)
        return NoReturnSensor(camera.in_kernels(), chance)
