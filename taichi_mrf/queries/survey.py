"""Every ray of a view followed through the map, and how much each voxel dims it.

Occupancy is read as a medium: a voxel of probability p has the occlusion density alpha = -ln(1 - p) / voxel
size (MRFMap, section III-D).

A ray's surface is where it is likeliest, in the piecewise constant medium of MRFMap, section III-D, with
visibility by eq. 15, the probability Omega that the surface lies in a voxel by eq. 16, its density omega by
eq. 18, all with the true lengths of the ray's segments. Depths are axial, in metres.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.sensor.forward import SEGMENT
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, F32Array, Struct, Template
from taichi_mrf.voxels.log_odds import exp_of_negative, softplus
from taichi_mrf.voxels.traversal import FAR, Space, Viewpoint, clip, pixel_ray, walk_voxels


@dataclass(frozen=True)
class Occlusion(Bundle):
    """The voxels that let every ray through, and how sure a view is of the others, by their log-odds of
    being occupied."""

    unknown: F32 = FAR
    """Log-odds that stand for "never seen" in maps that mark it so."""

    empty_below: F32 = -FAR
    """Voxels with less than this are taken for empty, as in a map that keeps occupied voxels only."""

    least: F32 = -FAR
    """A voxel with less counts as one with these log-odds: none is surer to be free."""

    most: F32 = FAR
    """A voxel with more counts as one with these log-odds: none is surer to be occupied."""


def doubting(share: float, passing: float, prior: float) -> Occlusion:
    """The rule of a view in which a voxel is occupied with at least the ``share`` of its ``prior``
    probability, however often it was seen to be free, and lets a ray pass with at least the chance
    ``passing``, however often it was seen to be occupied; 0 trusts what was seen.

    Poses and noise are never as exact as they are said to be, so that evidence that agrees with itself a
    hundred times is wrong more often than its log-odds say.
    """
    least = -math.log(1.0 / (share * prior) - 1.0) if share * prior > 0 else -FAR
    most = math.log(1.0 / passing - 1.0) if passing > 0 else FAR
    return Occlusion(least=least, most=most)


@ti.func
def occlusion(log_odds: F32, rule: Template) -> F32:
    """alpha times the voxel size by a ``rule`` (Occlusion): -ln(1 - p), or 0 for a voxel that lets every ray
    through."""
    alpha = softplus(ti.max(rule.least, ti.min(rule.most, log_odds)))
    if log_odds == rule.unknown or log_odds < rule.empty_below:
        alpha = 0.0
    return alpha


@ti.func
def stopped_share(thickness: F32) -> F32:
    """1 - e^-thickness: the share of a ray that is stopped where alpha times the length is ``thickness``.

    By its series near 0, where the difference has no digits left and most voxels are.
    """
    share = ti.cast(thickness * (1.0 - thickness * (0.5 - thickness * (1.0 / 6.0))), ti.f32)
    if thickness >= 0.05:
        share = 1.0 - ti.exp(-thickness)
    return share


OPAQUE = 1e-3
"""A ray that has lost this much of its visibility meets nothing more."""


@dataclass(frozen=True)
class SurfaceSurvey:
    """Surfaces that a view's rays meet, all (H, W) float32.

    ``near`` and ``far`` bound the ray's segment in the voxel with the largest omega, 0 where the ray meets
    nothing; ``visibility`` is what is left of the ray at its end; ``expected`` the mean depth of the
    surface, given that there is one, 0 where there is none and in a rendered view. ``likelihood`` is the
    density, per metre, of the measurement if the surface is distributed as Omega; 0 without a measurement.
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
def dim(ray: Template, alpha: F32, near: F32, far: F32) -> F32:
    """Renew a ray's visibility, eq. 15, behind a voxel of density ``alpha``, per voxel size, in which it is
    from depth ``near`` to ``far``; returns the chance that its surface lies there, eq. 16."""
    thickness = alpha * (far - near) * ray.voxels_per_depth
    here = ray.visibility * stopped_share(thickness)
    ray.visibility *= exp_of_negative(-thickness)
    return here


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
    here = dim(ray, alpha, near, far)
    if ti.static(surveyed.judged):
        ray.stopped += here
        ray.moment += here * 0.5 * (near + far)
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
