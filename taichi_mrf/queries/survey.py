"""Every ray of a view followed through the map: where its surface is likeliest, and how likely it is.

The piecewise constant medium of MRFMap, section III-D: visibility by eq. 15, the probability Omega that
the surface lies in a voxel by eq. 16, its density omega by eq. 18, all with the true lengths of the ray's
segments. Depths are axial, in metres.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.kernels.bundles import Bundle, kernel
from taichi_mrf.kernels.log_odds import exp_of_negative
from taichi_mrf.kernels.types import F32, I32, F32Array, Struct, Template
from taichi_mrf.queries.occlusion import Occlusion, occlusion, stopped_share
from taichi_mrf.sensor.forward import SEGMENT
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.system.compiler import ti
from taichi_mrf.voxels.traversal import Space, Viewpoint, clip, pixel_ray, walk_voxels

OPAQUE = 1e-3
"""A ray that has lost this much of its visibility meets nothing more."""


@dataclass(frozen=True)
class SurfaceSurvey:
    """Surfaces that a view's rays meet, all (H, W) float32.

    ``near`` and ``far`` bound the ray's segment in the voxel with the largest omega, 0 where the ray meets
    nothing; ``visibility`` is what is left of the ray at its end; ``expected`` the mean depth of the
    surface, given that there is one, 0 where there is none. ``likelihood`` is the density, per metre, of
    the measurement if the surface is distributed as Omega; 0 without a measurement.
    """

    near: NDArray[np.float32]
    far: NDArray[np.float32]
    visibility: NDArray[np.float32]
    expected: NDArray[np.float32]
    likelihood: NDArray[np.float32]

    @property
    def middle(self) -> NDArray[np.float32]:
        """Axial depth of the likeliest surface, 0 where the ray meets nothing."""
        return np.float32(0.5) * (self.near + self.far)


@dataclass(frozen=True)
class Medium(Bundle):
    """A survey's way of reading the map (View)."""

    voxel_size: F32
    """Metres."""

    max_depth: F32
    """Metres of depth at which rays end."""

    learnt: F32
    """Log-odds above which a voxel can be the surface."""

    occlusion: Occlusion
    """The voxels that let rays through, and the way others dim them."""


@dataclass(frozen=True)
class Answers(Bundle):
    """Output of a survey: arrays (H * W), as in SurfaceSurvey."""

    near: F32Array
    far: F32Array
    visibility: F32Array
    expected: F32Array
    likelihood: F32Array


@ti.dataclass
class RaySurvey(Struct):
    """A ray on its way from the camera."""

    voxels_per_depth: F32  # length of the ray, in voxels, for one metre of depth
    measured: F32
    visibility: F32
    omega: F32  # the largest so far
    near: F32
    far: F32
    stopped: F32  # sum of Omega
    moment: F32  # sum of Omega times depth
    likelihood: F32


@dataclass(frozen=True)
class _Surveyed(Bundle):
    """Inputs of a step of the survey."""

    belief: F32Array
    medium: Medium
    sensor: Sensor
    noise: Template  # of the ray's pixel
    judged: Template


@ti.func
def survey_voxel(ray: Template, surveyed: Template, voxel: I32, near: F32, far: F32):
    """One voxel of a ray, whose segment in it reaches from depth ``near`` to ``far``."""
    log_odds = surveyed.belief[voxel]
    alpha = occlusion(log_odds, surveyed.medium.occlusion)
    # Eq. 18. A voxel that may not be the surface still dims the ray as eq. 15 has it.
    omega = alpha * ray.visibility
    if omega > ray.omega and log_odds > surveyed.medium.learnt:
        ray.omega = omega
        ray.near = near
        ray.far = far
    # Eqs. 15 and 16.
    thickness = alpha * (far - near) * ray.voxels_per_depth
    here = ray.visibility * stopped_share(thickness)
    ray.visibility *= exp_of_negative(-thickness)
    ray.stopped += here
    ray.moment += here * 0.5 * (near + far)
    if ti.static(surveyed.judged):
        ray.likelihood += here * surveyed.sensor.likelihood(
            ray.measured, near, far, surveyed.noise, surveyed.medium.voxel_size, SEGMENT
        )
    return ti.cast(ray.visibility > OPAQUE, ti.i32)


@kernel
def survey_rays(
    sensor: Sensor, view: Viewpoint, space: Space, belief: F32Array, medium: Medium,
    measured: F32Array, answers: Answers, judged: Template,
) -> None:  # fmt: skip
    """Follow the ray of each pixel; with ``judged`` only where ``measured`` (H * W, metres) is not 0.

    A negative value stands for a ray that is to be followed and has no measurement. ``belief`` (pool * 512)
    holds log-odds.
    """
    for pixel in range(answers.near.shape[0]):
        u, v = sensor.pixel(pixel)
        ray = RaySurvey(0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        noise = sensor.noise_at(u, v)
        wanted = 1
        if ti.static(judged):
            ray.measured = measured[pixel]
            wanted = ti.cast(ray.measured != 0.0, ti.i32)
        if wanted == 1:
            path = pixel_ray(sensor, view, u, v)
            ray.voxels_per_depth = path.direction.norm()
            begin, end = 0.0, medium.max_depth
            clip(path, begin, end, space.lower, space.upper)
            walk_voxels(
                path, begin, end, space, survey_voxel, ray, _Surveyed(belief, medium, sensor, noise, judged)
            )
        answers.near[pixel] = ray.near
        answers.far[pixel] = ray.far
        answers.visibility[pixel] = ray.visibility
        answers.expected[pixel] = ray.moment / ray.stopped if ray.stopped > 0.0 else 0.0
        answers.likelihood[pixel] = ray.likelihood
