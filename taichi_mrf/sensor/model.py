"""The sensor as all kernels see it: one bundle with the directions of rays and the likelihoods of
measurements.

A kernel takes a ``Sensor`` and asks nothing else about cameras or noise. What can be plugged in:

- a camera: a subclass of ``CameraRays`` with ``direction`` and ``plane`` (rays.py), and ``origin`` if its
  rays do not start at its centre. On the host it is a class that serves ``Camera`` (camera.py), whose
  ``in_kernels`` makes the bundle;
- noise: a subclass of ``SensorNoise`` with ``at_pixel``, the noise of a pixel (polynomials.py): its ``sigma``
  and ``bias`` at a depth, and their derivatives;
- another law of measurements: a subclass of ``Sensor`` with its own ``likelihood`` and ``likelihood_beyond``.

On the host the last two are a noise model (noise.py), whose table's ``sensor`` makes this bundle for a
camera.

"Depth" is the parameter of a ray along ``direction``: axial depth for a pinhole, range where directions have
the length 1. It is what depth images hold, and what noise is a function of.
"""

from dataclasses import dataclass

from taichi_mrf.sensor.forward import SUPPORT, beyond_likelihood, depth_of_deviation, surface_likelihood
from taichi_mrf.sensor.polynomials import SensorNoise
from taichi_mrf.sensor.rays import CameraRays
from taichi_mrf.system.bundles import Bundle
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, Template


@dataclass(frozen=True)
class Sensor(Bundle):
    """A camera with normally distributed errors of depth."""

    camera: CameraRays
    noise: SensorNoise

    @property
    def moving(self) -> bool:
        """True if rays have an ``origin`` (CameraRays.moving)."""
        return self.camera.moving

    @ti.func
    def pixel(self, number: I32):
        """Column and row of a pixel from its number, row by row."""
        return self.camera.pixel(number)

    @ti.func
    def origin(self, u: F32, v: F32):
        """Start of the ray through (u, v) of a moving camera, in metres in the camera frame."""
        return self.camera.origin(u, v)

    @ti.func
    def direction(self, u: F32, v: F32):
        """The ray through (u, v) in the camera frame: the way for one metre of depth."""
        return self.camera.direction(u, v)

    @ti.func
    def noise_at(self, u: I32, v: I32):
        """The noise of pixel (u, v), which the functions below take."""
        return self.noise.at_pixel(u, v)

    @ti.func
    def surface_depth(self, measured: F32, noise: Template):
        """The depth of the surface that gives this measurement on average: the measurement without its
        bias."""
        return depth_of_deviation(measured, 0.0, noise)

    @ti.func
    def nearest_depth(self, measured: F32, noise: Template, sigmas: F32):
        """The depth of a surface whose measurement would be ``sigmas`` too far."""
        return depth_of_deviation(measured, sigmas, noise)

    @ti.func
    def farthest_depth(self, measured: F32, noise: Template, sigmas: F32):
        """The depth of a surface whose measurement would be ``sigmas`` too near: where a ray may stop."""
        return depth_of_deviation(measured, -sigmas, noise)

    @ti.func
    def until(self, measured: F32, last: F32):
        """End of the ray of a measurement; ``last`` is where its evidence ends."""
        return last

    @ti.func
    def support(self, measured: F32, noise: Template):
        """The depth before which no surface can give this measurement."""
        return depth_of_deviation(measured, SUPPORT, noise)

    @ti.func
    def likelihood(
        self, measured: F32, near: F32, far: F32, noise: Template, voxel_size: F32, mode: Template
    ):
        """Density, per metre, of the measurement if the first surface lies between depths near and far."""
        return surface_likelihood(measured, near, far, noise, voxel_size, mode)

    @ti.func
    def likelihood_beyond(self, measured: F32, depth: F32, noise: Template):
        """Density, per metre, of the measurement if the first surface lies somewhere beyond ``depth``."""
        return beyond_likelihood(measured, depth, noise)
