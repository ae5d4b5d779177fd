"""Errors with heavier tails than a normal distribution: a share of the measurements has a wider one.

A measurement that is off by five sigma is far likelier than a normal distribution has it: poses, mixed
pixels and errors that neighbours share are no noise of the sensor. With the share w and the factor k, the
measurement of a surface at the depth z has the density

    (1 - w) N(measured; z + bias, sigma) + w N(measured; z + bias, k sigma)

so that a ray whose measurement contradicts all others says little, and not that a certain surface is free.
Only what keyframes say has these tails. Predictions are those of the sensor.
"""

from dataclasses import dataclass

from taichi_mrf.kernels.types import F32, Template
from taichi_mrf.sensor.forward import (
    beyond_likelihood,
    depth_of_deviation,
    deviation,
    normal_density,
    surface_likelihood,
)
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.system.compiler import ti

REACH = 3.5
"""Sigmas of the wider distribution beyond which a measurement is impossible."""


@dataclass(frozen=True)
class TailedSensor(Sensor):
    """A camera of whose measurements a ``share`` has ``sigmas`` times the sigma."""

    share: F32
    sigmas: F32

    @ti.func
    def support(self, measured: F32, noise: Template):
        """The depth before which no surface can give this measurement."""
        return depth_of_deviation(measured, REACH * self.sigmas, noise)

    @ti.func
    def likelihood(
        self, measured: F32, near: F32, far: F32, noise: Template, voxel_size: F32, mode: Template
    ):
        """Density, per metre, of the measurement if the first surface lies between depths near and far. The
        wider distribution is taken at the middle."""
        density = surface_likelihood(measured, near, far, noise, voxel_size, mode)
        return self._mixed(density, measured, 0.5 * (near + far), noise)

    @ti.func
    def likelihood_beyond(self, measured: F32, depth: F32, noise: Template):
        """Density, per metre, of the measurement if the first surface lies somewhere beyond ``depth``."""
        surface = ti.max(depth, depth_of_deviation(measured, 0.0, noise))
        return self._mixed(beyond_likelihood(measured, depth, noise), measured, surface, noise)

    @ti.func
    def _mixed(self, density: F32, measured: F32, depth: F32, noise: Template):
        """With the share of a surface at ``depth`` that has the wider distribution."""
        in_tail = normal_density(deviation(measured, depth, noise) / self.sigmas)
        return density + self.share * (in_tail / (self.sigmas * noise.sigma(depth)) - density)


@dataclass(frozen=True)
class Tails:
    """The ``share`` of measurements with ``sigmas`` times the sigma, of a map's keyframes."""

    share: float
    sigmas: float

    def of(self, sensor: Sensor) -> Sensor:
        """The sensor with these tails; one with a law of measurements of its own as it is."""
        if type(sensor) is not Sensor:
            return sensor
        return TailedSensor(sensor.camera, sensor.noise, self.share, self.sigmas)
