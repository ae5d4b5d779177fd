"""Occupancy mapping by wavemap's measurement model: the baseline for lidars.

wavemap keeps its log-odds as wavelets in an octree and chooses, for each part of a scan, the coarsest cells
that keep within an error bound. Here each voxel is updated by itself, which is its model without that error.
"""

from typing import Any, ClassVar

from taichi_mrf.config.baselines import WavemapConfig
from taichi_mrf.config.method import Method
from taichi_mrf.config.schema import Config, SensorConfig, VolumeConfig
from taichi_mrf.config.time import TimeConfig
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.inference.keyframe import DepthImage
from taichi_mrf.methods.brick_map import own_parameters, own_section
from taichi_mrf.methods.recursive import RecursiveMap, Scan
from taichi_mrf.methods.wavemap.plug import METHOD
from taichi_mrf.methods.wavemap.scan import BeamFootprint, BeamIntegrator
from taichi_mrf.sensor.noise import NoiseModel


class WavemapMap(RecursiveMap[BeamFootprint]):
    """A map that integrates scans by the measurement model of wavemap (Reijgwart et al., RSS 2023)."""

    METHOD: ClassVar[Method] = METHOD

    def __init__(
        self,
        voxel_size: float = 0.1,
        noise: NoiseModel | None = None,
        *,
        wavemap: WavemapConfig | None = None,
        volume: VolumeConfig | None = None,
        time: TimeConfig | None = None,
        min_depth: float = SensorConfig.min_depth,
        max_depth: float = SensorConfig.max_depth,
        **parameters: Any,
    ) -> None:
        """``parameters`` are fields of WavemapConfig, such as ``range_sigma=0.1`` or ``beams="nearest"``.

        ``noise`` is not used: the model has a sigma of range of its own, the same at all ranges. Rays beyond
        ``max_depth`` show free space up to there. Raises ConfigError for an unknown or impossible parameter.
        """
        section = own_section(wavemap, WavemapConfig, parameters, "wavemap", "WavemapMap")
        shared = own_parameters(voxel_size, volume, min_depth, max_depth, time)
        self._set_up(Config(**shared, wavemap=section), noise)

    def _set_up(self, config: Config, noise: NoiseModel | None) -> None:
        super()._set_up(config, noise)
        self._integrator = BeamIntegrator(
            self.voxel_size, self.sensor.max_depth, config.wavemap, config.volume
        )

    def _reach(self, image: DepthImage, T_world_camera: Pose) -> BeamFootprint:
        return self._integrator.reach(image, T_world_camera)

    def _integrate(self, scan: Scan[BeamFootprint]) -> None:
        self._integrator.integrate(scan.footprint, scan.T_world_camera, scan.slots, self._pool)

    @property
    def _scratch_bytes(self) -> int:
        return 0
