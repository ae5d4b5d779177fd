"""Every ray of a view followed through the map: where its surface is likeliest, and how likely it is.

The piecewise constant medium of MRFMap, section III-D: visibility by eq. 15, the probability Omega that
the surface lies in a voxel by eq. 16, its density omega by eq. 18, all with the true lengths of the ray's
segments. Depths are axial, in metres.
"""

from dataclasses import dataclass

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from taichi_mrf.kernels.log_odds import exp_of_negative
from taichi_mrf.kernels.types import (
    F32,
    I32,
    F32Array,
    F32Array3,
    I32Array,
    IVec3,
    Mat3,
    Struct,
    Template,
    Vec3,
    Vec4,
    Vec5,
)
from taichi_mrf.queries.occlusion import occlusion, stopped_share
from taichi_mrf.sensor.forward import SEGMENT, PixelNoise, pixel_noise, surface_likelihood
from taichi_mrf.sensor.rays import pixel_direction
from taichi_mrf.voxels.traversal import clip, make_ray, walk_voxels

OPAQUE = 1e-3
"""A ray that has lost this much of its visibility meets nothing more."""


@dataclass(frozen=True)
class SurfaceSurvey:
    """What a view's rays meet, all (H, W) float32.

    ``near`` and ``far`` bound the ray's segment in the voxel with the largest omega, 0 where the ray meets
    nothing; ``visibility`` is what is left of the ray at its end; ``expected`` the mean depth of the
    surface, given that there is one, 0 where there is none. ``likelihood`` is the density, per metre, of
    the measurement if the surface lies where Omega says; 0 without a measurement.
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


@ti.dataclass
class RaySurvey(Struct):
    """What is known of a ray on its way from the camera."""

    voxels_per_depth: F32  # length of the ray, in voxels, for one metre of axial depth
    voxel_size: F32
    learnt: F32  # log-odds above which a voxel can be the surface
    unknown: F32
    empty_below: F32
    measured: F32
    noise: PixelNoise
    visibility: F32
    omega: F32  # the largest so far
    near: F32
    far: F32
    stopped: F32  # sum of Omega
    moment: F32  # sum of Omega times depth
    likelihood: F32


@ti.func
def survey_voxel(ray: Template, context: Template, voxel: I32, near: F32, far: F32):
    """One voxel of a ray, whose segment in it reaches from axial depth ``near`` to ``far``."""
    log_odds = context[0][voxel]
    alpha = occlusion(log_odds, ray.unknown, ray.empty_below)
    # Eq. 18. A voxel that may not be the surface still dims the ray as eq. 15 has it.
    omega = alpha * ray.visibility
    if omega > ray.omega and log_odds > ray.learnt:
        ray.omega = omega
        ray.near = near
        ray.far = far
    # Eqs. 15 and 16.
    thickness = alpha * (far - near) * ray.voxels_per_depth
    here = ray.visibility * stopped_share(thickness)
    ray.visibility *= exp_of_negative(-thickness)
    ray.stopped += here
    ray.moment += here * 0.5 * (near + far)
    if ti.static(context[1]):
        ray.likelihood += here * surface_likelihood(
            ray.measured, near, far, ray.noise, ray.voxel_size, SEGMENT
        )
    return ti.cast(ray.visibility > OPAQUE, ti.i32)


@ti.kernel
def survey_rays(
    width: I32, intrinsics: Vec4, centre: Vec3, to_voxels: Mat3, voxel_size: F32,
    max_depth: F32, learnt: F32, unknown: F32, empty_below: F32,
    measured: F32Array, noise: F32Array3, patch: I32, columns: I32,
    shape: IVec3, lower: Vec3, upper: Vec3, chunks: I32Array, bricks: I32Array, belief: F32Array,
    near: F32Array, far: F32Array, visibility: F32Array, expected: F32Array, likelihood: F32Array,
    judged: Template,
):  # fmt: skip
    """Follow the ray of each pixel; with ``judged`` only where ``measured`` is not 0. A negative value stands
    for a ray that is to be followed and has no measurement."""
    for pixel in range(near.shape[0]):
        u, v = pixel % width, pixel // width
        ray = RaySurvey(
            0.0, voxel_size, learnt, unknown, empty_below, 0.0, PixelNoise(Vec5(0.0), Vec5(0.0)),
            1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
        )  # fmt: skip
        wanted = 1
        if ti.static(judged):
            ray.measured = measured[pixel]
            ray.noise = pixel_noise(noise, patch, columns, u, v)
            wanted = ti.cast(ray.measured != 0.0, ti.i32)
        if wanted == 1:
            direction = to_voxels @ pixel_direction(u, v, intrinsics)
            ray.voxels_per_depth = direction.norm()
            path = make_ray(centre, direction)
            begin, end = 0.0, max_depth
            clip(path, begin, end, lower, upper)
            walk_voxels(path, begin, end, shape, chunks, bricks, survey_voxel, ray, (belief, judged))
        near[pixel] = ray.near
        far[pixel] = ray.far
        visibility[pixel] = ray.visibility
        expected[pixel] = ray.moment / ray.stopped if ray.stopped > 0.0 else 0.0
        likelihood[pixel] = ray.likelihood
