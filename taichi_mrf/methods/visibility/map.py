"""Visibility-aware occupancy mapping: the baseline for stereo cameras.

A measurement behind an occluding voxel is likely to be an error, so a voxel is updated only to the extent
that it is visible in the map so far. In unknown space visibility ends after a few voxels, so the mapped space
grows scan by scan.
"""

import dataclasses
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.method import Method
from taichi_mrf.config.schema import Config, SensorConfig, VolumeConfig
from taichi_mrf.config.sections import InferenceConfig, TimeConfig, VisibilityConfig
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.inference.footprint import find_footprint
from taichi_mrf.inference.keyframe import DepthImage, Footprint
from taichi_mrf.inference.ray_list import RayBundler
from taichi_mrf.methods.brick_map import own_parameters, own_section
from taichi_mrf.methods.recursive import RecursiveMap, Scan
from taichi_mrf.methods.recursive_update import log_odds
from taichi_mrf.methods.visibility import scan as visibility_scan
from taichi_mrf.methods.visibility.plug import METHOD
from taichi_mrf.sensor.noise import NoiseModel
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.memory import check_memory
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.pool import BrickPool
from taichi_mrf.voxels.traversal import FAR
from taichi_mrf.voxels.window import WindowIndex

SCRATCH_BYTES = 12
"""Scratch for each voxel of the bricks that a scan's rays cross: P(C), P(V) and P(I)."""


class VisibilityMap(RecursiveMap[Footprint]):
    """A map that integrates scans as Schauwecker & Zell do (IROS 2014), with their Table I, except that it
    grows to the extent of an image at once (VisibilityConfig.visible_if_occluded).

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


class VisibilityIntegrator:
    """Integrates scans. They share one scratch memory, which grows to the largest of them."""

    def __init__(
        self, voxel_size: float, sensor: SensorConfig, visibility: VisibilityConfig, volume: VolumeConfig
    ) -> None:
        self.voxel_size, self.visibility, self.volume = voxel_size, visibility, volume
        self.max_range = visibility.max_range or FAR
        # A depth is never more than its range, so deeper bricks cannot be reached.
        self.sensor = dataclasses.replace(sensor, max_depth=min(sensor.max_depth, self.max_range))
        self.limits = visibility_scan.RayLimits(
            voxel_size, self.sensor.max_depth, self.max_range,
            visibility.visible_if_occluded, visibility.visible_if_clear, visibility.q_min, visibility.q_max,
        )  # fmt: skip
        self.index, self.crossed = WindowIndex(), WindowIndex()
        self.bundler = RayBundler(voxel_size, InferenceConfig(ray_density=0.0), visibility_scan.SURE_SIGMAS)
        self.occluded = ti.ndarray(ti.f32, VOXELS)
        self.visible = ti.ndarray(ti.i32, VOXELS)
        self.inside = ti.ndarray(ti.i32, VOXELS)

    @property
    def nbytes(self) -> int:
        """Bytes of the scratch."""
        cells = self.index.bricks.shape[0] + self.crossed.bricks.shape[0]
        return self.occluded.shape[0] * SCRATCH_BYTES + cells * 4

    def reach(self, image: DepthImage, T_world_camera: Pose) -> Footprint:
        """The bricks that a scan's rays cross if everything up to their ends is visible. ``surface`` equals
        ``crossed``, so that all are allocated. Raises CapacityError if there is not enough memory."""
        beyond_m = visibility_scan.BEYOND_VOXELS * self.voxel_size
        footprint = find_footprint(
            image, self.bundler.rays_of(image), T_world_camera, self.voxel_size, self.sensor,
            self.volume, self.bundler.end_sigmas, beyond_m,
        )  # fmt: skip
        voxels = len(footprint.crossed) * VOXELS
        check_memory(
            voxels * (4.0 + SCRATCH_BYTES),
            f"a scan of {voxels / 1e6:.3g} million voxels of {self.voxel_size:g} m",
            self.volume.memory_limit_gb,
        )
        return dataclasses.replace(footprint, surface=footprint.crossed, seen=footprint.crossed)

    def integrate(
        self,
        image: DepthImage,
        T_world_camera: Pose,
        footprint: Footprint,
        slots: NDArray[np.int32],
        pool: BrickPool,
    ) -> None:
        """Update the log-odds of the voxels that the scan observes. All bricks of the footprint must be
        allocated; ``slots`` (n,) are their places in the pool."""
        config, window, cells = self.visibility, footprint.window, footprint.crossed
        view = window.viewpoint(T_world_camera)
        self._reserve(len(slots) * VOXELS)
        seen = visibility_scan.SeenVoxels(self.occluded, self.visible, self.inside)

        # Eq. 1, in the map before the scan. A neighbour may lie in a brick that this scan does not cross.
        in_use = pool.in_use
        all_cells = window.cells_of(pool.bricks[in_use])
        there = all_cells >= 0
        self.index.fill(window, all_cells[there], in_use[there])
        space = self.index.space(window, self.volume.lower, self.volume.upper)
        visibility_scan.hide(cells, view.centre, space, pool.belief, seen)
        occluded: visibility_scan.Occluded = visibility_scan.OccludedFromCentre(self.occluded)
        if image.sensor.moving:
            occluded = visibility_scan.OccludedFromRay(space, pool.belief)

        # Eqs. 2, 3 and 7: each ray's visibility, and its probability of being inside the measured obstacle.
        self.crossed.fill(window, cells, np.arange(len(cells), dtype=np.int32))
        crossed = self.crossed.space(window, self.volume.lower, self.volume.upper)
        visibility_scan.follow(image.depth, image.sensor, view, crossed, occluded, self.limits, seen)
        self.crossed.clear(window, cells)
        self.index.clear(window, all_cells[there])

        # Eqs. 4 to 6 and 8: the update of each voxel.
        visibility_scan.update(
            slots, pool.belief, self.visible, self.inside,
            config.hit_if_occupied, config.hit_if_free, config.hit_if_hidden,
            log_odds(config.lowest), log_odds(config.highest),
        )  # fmt: skip

    def _reserve(self, voxels: int) -> None:
        if voxels > self.visible.shape[0]:
            runtime.settle()
            self.occluded = ti.ndarray(ti.f32, voxels)
            self.visible = ti.ndarray(ti.i32, voxels)
            self.inside = ti.ndarray(ti.i32, voxels)
