"""Occupancy mapping with independent log-odds: OctoMap's method, the usual baseline.

Every voxel is updated independently of its neighbours. OctoMap's octree merges equal voxels into one node;
here each voxel is stored by itself, which changes no value.
"""

from typing import Any, ClassVar

from taichi_mrf.config.baselines import LogOddsConfig
from taichi_mrf.config.method import Method
from taichi_mrf.config.schema import Config, SensorConfig, VolumeConfig
from taichi_mrf.config.time import TimeConfig
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.inference.keyframe import DepthImage
from taichi_mrf.methods.brick_map import own_parameters, own_section
from taichi_mrf.methods.log_odds.plug import METHOD
from taichi_mrf.methods.log_odds.scan import RayFootprint, ScanIntegrator
from taichi_mrf.methods.recursive import RecursiveMap, Scan
from taichi_mrf.sensor.no_return import NoReturnLaw
from taichi_mrf.sensor.noise import NoiseModel


class LogOddsMap(RecursiveMap[RayFootprint]):
    """A map that integrates scans as OctoMap does (Hornung et al. 2013)."""

    METHOD: ClassVar[Method] = METHOD

    def __init__(
        self,
        voxel_size: float = 0.02,
        noise: NoiseModel | None = None,
        *,
        log_odds: LogOddsConfig | None = None,
        volume: VolumeConfig | None = None,
        time: TimeConfig | None = None,
        min_depth: float = SensorConfig.min_depth,
        max_depth: float = SensorConfig.max_depth,
        **parameters: Any,
    ) -> None:
        """``parameters`` are fields of LogOddsConfig, such as ``hit=0.7`` or ``max_range=4.0``.

        ``noise`` (a Kinect 1 by default) is only asked for the bias, with ``correct_bias=True``.
        Raises ConfigError for an unknown or impossible parameter.
        """
        section = own_section(log_odds, LogOddsConfig, parameters, "log_odds", "LogOddsMap")
        shared = own_parameters(voxel_size, volume, min_depth, max_depth, time)
        self._set_up(Config(**shared, log_odds=section), noise)

    def _set_up(self, config: Config, noise: NoiseModel | None) -> None:
        super()._set_up(config, noise)
        law = NoReturnLaw.of(self.sensor) if self._takes_no_return else None
        self._integrator = ScanIntegrator(
            self.voxel_size, self.sensor.max_depth, config.log_odds, config.volume, law
        )

    @property
    def _takes_no_return(self) -> bool:
        return self.sensor.no_return == "free"

    def _reach(self, image: DepthImage, T_world_camera: Pose) -> RayFootprint:
        return self._integrator.reach(image, T_world_camera)

    def _integrate(self, scan: Scan[RayFootprint]) -> None:
        self._integrator.integrate(scan.footprint, scan.slots, self._pool)

    @property
    def _scratch_bytes(self) -> int:
        return self._integrator.nbytes
