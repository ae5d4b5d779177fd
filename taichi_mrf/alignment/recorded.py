"""The weight of what is known of keyframes' poses, beside the evidence of their depth.

Recorded poses are wrong by PoseConfig's sigmas. Thousands of points err together, by whole surfaces, as
sensors are bent and scaled a little: together they count no more than one measurement along each direction
with the standard deviation SURFACE_SIGMA_M. Of a tracked camera no pose is known, but each step from one
keyframe to the next.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.pose_equations import PoseEquations
from taichi_mrf.alignment.se3 import adjoint, twist
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.geometry.poses import Pose, inverse

SURFACE_SIGMA_M = 0.001
"""Sigma of the alignment of two surfaces, in metres."""


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


class KnownPoses(Protocol):
    """Known poses of some keyframes, in a fixed order, as a quadratic cost."""

    def add_to(self, equations: PoseEquations, poses: Sequence[Pose]) -> None:
        """Add the cost's derivatives at some poses."""
        ...


class RecordedPoses:
    """Each pose was recorded."""

    def __init__(self, T_recorded: Sequence[Pose], config: PoseConfig) -> None:
        self._recorded = [Recorded(T, config) for T in T_recorded]

    def add_to(self, equations: PoseEquations, poses: Sequence[Pose]) -> None:
        """See :class:`KnownPoses`."""
        H = np.stack([each.H for each in self._recorded])
        g = np.stack([each.gradient(T) for each, T in zip(self._recorded, poses, strict=True)])
        equations.add(np.arange(len(poses)), H, g)


class TrackedSteps:
    """The step from each pose to the next was tracked, with ``sigma_m`` metres and ``sigma_rad`` radians
    along and about each axis."""

    def __init__(self, T_tracked: Sequence[Pose], sigma_m: float, sigma_rad: float) -> None:
        self._steps_back = [inverse(b) @ a for a, b in pairwise(T_tracked)]
        self._information = np.diag(np.repeat([sigma_m, sigma_rad], 3) ** -2.0)

    def add_to(self, equations: PoseEquations, poses: Sequence[Pose]) -> None:
        """See :class:`KnownPoses`."""
        count = len(self._steps_back)
        if count == 0:
            return
        steps = [inverse(a) @ b for a, b in pairwise(poses)]
        errors = np.stack([twist(back @ step) for back, step in zip(self._steps_back, steps, strict=True)])
        to_first = np.stack([-adjoint(inverse(step)) for step in steps])
        H = np.repeat(self._information[None], count, axis=0)
        g = errors @ self._information
        equations.add_pairs(np.arange(1, count + 1), np.arange(count), to_first, H, g)
