"""Visibility-aware occupancy mapping: the baseline for stereo cameras.

A measurement behind an occluding voxel is likely to be an error, so a voxel is updated only as far as it is
visible in the map so far. In unknown space visibility ends after a few voxels, so the mapped space grows scan
by scan.
"""

from typing import Any, ClassVar

from taichi_mrf.config.baselines import VisibilityConfig
from taichi_mrf.config.method import Method
from taichi_mrf.config.schema import Config, SensorConfig, VolumeConfig
from taichi_mrf.config.time import TimeConfig
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.inference.keyframe import DepthImage, Footprint
from taichi_mrf.methods.brick_map import own_parameters, own_section
from taichi_mrf.methods.recursive import RecursiveMap, Scan
from taichi_mrf.methods.visibility.integrator import VisibilityIntegrator
from taichi_mrf.methods.visibility.plug import METHOD
from taichi_mrf.sensor.noise import NoiseModel


class VisibilityMap(RecursiveMap[Footprint]):
    """A map that integrates scans as Schauwecker & Zell do (IROS 2014), with their Table I as defaults.

    The effect of a scan depends on the map before it, so the order of the keyframes matters.
    """

    METHOD: ClassVar[Method] = METHOD

    def __init__(
        self,
        voxel_size: float = 0.2,
        noise: NoiseModel | None = None,
        *,
        visibility: VisibilityConfig | None = None,
        volume: VolumeConfig | None = None,
        time: TimeConfig | None = None,
        min_depth: float = SensorConfig.min_depth,
        max_depth: float = SensorConfig.max_depth,
        **parameters: Any,
    ) -> None:
        """``parameters`` are fields of VisibilityConfig, such as ``q_max=0.7`` or ``max_range=10.0``.

        ``noise`` (a Kinect 1 by default) gives the sigma of eq. 7: a stereo camera of baseline b, focal
        length f and disparity error sigma_d has PolynomialNoise((0, 0, sigma_d / (b * f))). A bias is
        subtracted from the measurements first; the paper's sensor has none.
        Raises ConfigError for an unknown or impossible parameter.
        """
        section = own_section(visibility, VisibilityConfig, parameters, "visibility", "VisibilityMap")
        shared = own_parameters(voxel_size, volume, min_depth, max_depth, time)
        self._set_up(Config(**shared, visibility=section), noise)

    def _set_up(self, config: Config, noise: NoiseModel | None) -> None:
        super()._set_up(config, noise)
        self._integrator = VisibilityIntegrator(
            self.voxel_size, self.sensor, config.visibility, config.volume
        )

    def _reach(self, image: DepthImage, T_world_camera: Pose) -> Footprint:
        return self._integrator.reach(image, T_world_camera)

    def _integrate(self, scan: Scan[Footprint]) -> None:
        self._integrator.integrate(scan.image, scan.T_world_camera, scan.footprint, scan.slots, self._pool)

    @property
    def _scratch_bytes(self) -> int:
        return self._integrator.nbytes
