"""Missing returns in kernels: a law of measurements that has no depth (sensor/model.py: how laws plug in)."""

from dataclasses import dataclass

from taichi_mrf.sensor.model import Sensor
from taichi_mrf.sensor.polynomials import SensorNoise
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, Struct, Template

ENDLESS = 1e9
"""A depth that no ray comes to."""


@ti.dataclass
class NoReturnHere(Struct):
    """The law at one pixel: sensor/no_return.py."""

    share: F32
    depth: F32
    width: F32

    @ti.func
    def chance(self, depth: F32):
        """q: that a surface at ``depth`` gives no return."""
        exponent = ti.min((self.depth - depth) / self.width, 80.0)
        return self.share + (1.0 - self.share) / (1.0 + ti.exp(exponent))

    @ti.func
    def sigma(self, depth: F32):
        """No depth was measured: 0."""
        return 0.0


@dataclass(frozen=True)
class NoReturnChance(SensorNoise):
    """One law of missing returns for all pixels."""

    share: F32
    depth: F32
    width: F32

    @ti.func
    def at_pixel(self, u: I32, v: I32):
        """The law of pixel (u, v)."""
        return NoReturnHere(self.share, self.depth, self.width)


@dataclass(frozen=True)
class NoReturnSensor(Sensor):
    """A camera whose pixels got nothing back. Likelihoods are chances, not densities."""

    @ti.func
    def nearest_depth(self, measured: F32, noise: Template, sigmas: F32):
        """No surface is near a measurement."""
        return ENDLESS

    @ti.func
    def farthest_depth(self, measured: F32, noise: Template, sigmas: F32):
        """A surface behind all that is looked at may have been met."""
        return ENDLESS

    @ti.func
    def until(self, measured: F32, last: F32):
        """The depth up to which nothing came back."""
        return measured

    @ti.func
    def support(self, measured: F32, noise: Template):
        """Any surface may have given no return."""
        return 0.0

    @ti.func
    def likelihood(
        self, measured: F32, near: F32, far: F32, noise: Template, voxel_size: F32, mode: Template
    ):
        """The chance of no return if the first surface lies between depths near and far."""
        return noise.chance(0.5 * (near + far))

    @ti.func
    def likelihood_beyond(self, measured: F32, depth: F32, noise: Template):
        """The chance of no return if the first surface lies beyond ``depth``, or nowhere."""
        return 1.0
