"""The weight of a keyframe's recorded pose, beside the evidence of its depth.

Recorded poses are wrong by PoseConfig's sigmas. Thousands of points err together, by whole surfaces, as
sensors are bent and scaled a little: together they count no more than one measurement along each direction
with the standard deviation SURFACE_SIGMA_M.
"""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.se3 import twist
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.geometry.poses import Pose, inverse

SURFACE_SIGMA_M = 0.001
"""What the alignment of two surfaces is worth, in metres."""


class Recorded:
    """The recorded pose of one keyframe as a quadratic cost, |e|^2 / 2 with e = log(inv(T_recorded) T) in
    units of the sigmas."""

    def __init__(self, T_recorded: Pose, config: PoseConfig) -> None:
        self._T_recorded_world = inverse(T_recorded)
        self._information = np.repeat([config.translation_sigma, config.rotation_sigma], 3) ** -2.0

    @property
    def H(self) -> NDArray[np.float64]:
        """(6, 6) second derivatives by a step of the pose."""
        return np.diag(self._information)

    def gradient(self, T_world_camera: Pose) -> NDArray[np.float64]:
        """(6,) first derivatives at a pose."""
        return self._information * twist(self._T_recorded_world @ T_world_camera)

    def cost(self, T_world_camera: Pose) -> float:
        """The cost of a pose."""
        return float(0.5 * self._information @ twist(self._T_recorded_world @ T_world_camera) ** 2)
