"""Occupancy mapping with independent log-odds: OctoMap's method, the usual baseline.

Every voxel is updated independently of its neighbours. OctoMap's octree merges equal voxels into one node;
here each voxel is stored by itself, which changes no value.

A scan is integrated as OctoMap does it (Hornung et al. 2013, section 3.2).

A ray is a miss for every voxel from the camera's up to, but not including, the one in which it ends, and a
hit for that one if it ends at a measured surface. With ``sensor.no_return: free`` the ray of a pixel that got
no return is a miss from the minimum range to ``no_return_depth``. First the scan's hits and misses are
counted for each voxel, in the halves of one integer; then they are turned into one change of its log-odds.
The result does not depend on the order of the rays.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.method import Method
from taichi_mrf.config.schema import Config, SensorConfig, VolumeConfig
from taichi_mrf.config.sections import LogOddsConfig, TimeConfig
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.inference.accumulators import low_half
from taichi_mrf.inference.footprint import visible_box, window_around
from taichi_mrf.inference.keyframe import DepthImage, Footprint
from taichi_mrf.methods.brick_map import own_parameters, own_section
from taichi_mrf.methods.log_odds.plug import METHOD
from taichi_mrf.methods.log_odds.ray_ends import (
    HIT,
    MissingReturns,
    OneStart,
    Starts,
    end_of,
    free_from,
    ray_ends,
)
from taichi_mrf.methods.recursive import RecursiveMap, Scan
from taichi_mrf.methods.recursive_update import log_odds, updated
from taichi_mrf.sensor.no_return import NoReturnLaw
from taichi_mrf.sensor.noise import NoiseModel
from taichi_mrf.sensor.origins import widened
from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.memory import check_memory
from taichi_mrf.system.types import (
    F32,
    I32,
    F32Array,
    F32Array2,
    I32Array,
    I64Array,
    IVec3,
    Struct,
    Template,
    Vec3,
    Vec4,
)
from taichi_mrf.voxels.layout import BRICK, VOXELS
from taichi_mrf.voxels.numbering import flat, voxel_number
from taichi_mrf.voxels.pool import BrickPool
from taichi_mrf.voxels.traversal import Space, clip, make_ray, walk_bricks, walk_voxels
from taichi_mrf.voxels.window import Window, WindowIndex


@dataclass(frozen=True)
class RayFootprint(Footprint):
    """A footprint with the ends and starts of the rays that made it (see ray_ends.py)."""

    ends: ti.Ndarray
    starts: Starts


class ScanIntegrator:
    """Integrates scans. They share one scratch memory, which grows to the largest of them."""

    def __init__(
        self, voxel_size: float, max_depth: float, config: LogOddsConfig, volume: VolumeConfig,
        law: NoReturnLaw | None = None,
    ) -> None:  # fmt: skip
        """``law`` says where missing returns are misses, None for nowhere."""
        self.voxel_size, self.max_depth, self.config, self.volume = voxel_size, max_depth, config, volume
        self.law = law
        self.index = WindowIndex()
        self.tally = ti.ndarray(ti.i64, VOXELS)
        self.tally.fill(0)

    @property
    def nbytes(self) -> int:
        """Bytes of the scratch."""
        return self.tally.shape[0] * 8 + self.index.bricks.shape[0] * 4

    def reach(self, image: DepthImage, T_world_camera: Pose) -> RayFootprint:
        """The bricks that a scan's rays cross. Raises CapacityError if there is not enough memory."""
        config, centre_m = self.config, T_world_camera[:3, 3]
        lower_m, upper_m = visible_box(image, T_world_camera, self.max_depth, end_sigmas=0.0)
        missing = MissingReturns.of(image, self.law)
        if missing is not None:
            free = missing.box(T_world_camera)
            lower_m, upper_m = np.minimum(lower_m, free[0]), np.maximum(upper_m, free[1])
        if config.max_range > 0:
            reach = widened(
                image.camera, T_world_camera, centre_m - config.max_range, centre_m + config.max_range
            )
            lower_m, upper_m = np.maximum(lower_m, reach[0]), np.minimum(upper_m, reach[1])
        # One voxel more: the centre of a voxel may lie further out than the measurement in it.
        lower_m, upper_m = lower_m - self.voxel_size, upper_m + self.voxel_size
        window = window_around(lower_m, upper_m, self.voxel_size, self.volume)
        if window is None or (image.rays == 0 and missing is None):
            window, nothing = Window.covering(centre_m, centre_m, self.voxel_size), np.zeros(0, np.int32)
            start = OneStart(window.viewpoint(T_world_camera).centre)
            return RayFootprint(window, nothing, nothing, nothing, 1, ti.ndarray(ti.f32, (1, 4)), start)
        ends, starts = ray_ends(
            image, T_world_camera, window, max_depth=self.max_depth, max_range=config.max_range,
            discretise=config.discretise, correct_bias=config.correct_bias,
        )  # fmt: skip
        if missing is not None:
            ends, starts = missing.added_to(ends, starts, T_world_camera, window, config.max_range)
        marks = np.zeros(window.cells, np.int32)
        box = window.clip_box(self.volume.lower, self.volume.upper)
        _mark(ends, starts, window.shape_vector, *box, marks)
        crossed = np.flatnonzero(marks).astype(np.int32)
        self._reserve(len(crossed))
        return RayFootprint(window, crossed, crossed, crossed, 1, ends, starts)

    def integrate(self, footprint: RayFootprint, slots: NDArray[np.int32], pool: BrickPool) -> None:
        """Update the log-odds of the voxels that a scan's rays cross; ``slots`` (n,) are the crossed
        bricks."""
        config, window, n = self.config, footprint.window, len(slots)
        every_ray = config.update == "ray"
        self.index.fill(window, footprint.crossed, np.arange(n, dtype=np.int32))
        count_rays(
            footprint.ends, footprint.starts,
            self.index.space(window, self.volume.lower, self.volume.upper), self.tally, every_ray,
        )  # fmt: skip
        self.index.clear(window, footprint.crossed)
        weigh(
            slots, pool.belief, self.tally, log_odds(config.hit), log_odds(config.miss),
            log_odds(config.lowest), log_odds(config.highest), every_ray,
        )  # fmt: skip

    def _reserve(self, bricks: int) -> None:
        if bricks * VOXELS > self.tally.shape[0]:
            what = f"a scan of {bricks * VOXELS / 1e6:.3g} million voxels of {self.voxel_size:g} m"
            check_memory(8.0 * bricks * VOXELS, what, self.volume.memory_limit_gb)
            runtime.settle()
            self.tally = ti.ndarray(ti.i64, bricks * VOXELS)
            self.tally.fill(0)


@ti.func
def _end_voxel(end: Vec4) -> IVec3:
    """The voxel that a ray's end lies in."""
    return ti.floor(Vec3(end[0], end[1], end[2]), ti.i32)


@ti.func
def _in_box(voxel: IVec3, lower: Vec3, upper: Vec3) -> I32:
    """True if a voxel lies in the mapped box."""
    centre = ti.cast(voxel, ti.f32) + 0.5
    return (centre - lower).min() > 0.0 and (upper - centre).min() > 0.0


@dataclass(frozen=True)
class _Marks(Bundle):
    """The bricks of a window that rays cross."""

    shape: IVec3
    marks: I32Array


@ti.func
def _mark_brick(state: Template, marked: Template, ray: Template, brick: IVec3, t: F32, t_leave: F32):
    """One brick of a ray."""
    cell = flat(brick, marked.shape)
    if marked.marks[cell] == 0:  # most bricks are marked already, and reading is cheaper
        marked.marks[cell] = 1
    return 1


@kernel
def _mark(ends: F32Array2, starts: Starts, shape: IVec3, lower: Vec3, upper: Vec3, marks: I32Array) -> None:
    """Mark the bricks that rays cross, from their ``starts`` to their ``ends`` (n, 4) (ray_ends.py).

    ``shape`` is the window's size in bricks; ``lower`` and ``upper`` bound the mapped volume in voxels.
    ``marks`` (bricks of the window) is 1 for a brick that is crossed.
    """
    for i in range(ends.shape[0]):
        end = end_of(ends, i)
        if end[3] >= 0.0:
            start = starts.of(i)
            ray = make_ray(start, Vec3(end[0], end[1], end[2]) - start)
            t_begin, t_end = free_from(end), 1.0
            clip(ray, t_begin, t_end, lower, upper)
            nothing = 0
            walk_bricks(ray, t_begin, t_end, shape, marks, False, _mark_brick, nothing, _Marks(shape, marks))
            if _in_box(_end_voxel(end), lower, upper):
                marks[flat(_end_voxel(end) // BRICK, shape)] = 1


@ti.dataclass
class _Pass(Struct):
    """A ray on its way."""

    last: I32  # the voxel that the ray ends in, -1 outside the volume


@dataclass(frozen=True)
class _Tally(Bundle):
    """Count of rays for each voxel; with ``every_ray`` off only whether there are any."""

    tally: I64Array
    every_ray: Template


@ti.func
def _pass_voxel(state: Template, counted: Template, voxel: I32, near: F32, far: F32):
    """One voxel of a ray."""
    go = ti.cast(voxel != state.last, ti.i32)
    if go == 1:
        _count(counted.tally, voxel, ti.cast(1, ti.i64), counted.every_ray)
    return go


@ti.func
def _count(tally: Template, voxel: I32, one: ti.i64, every_ray: Template):
    """Count a ray, or only that there is one, because near the camera hundreds of rays cross each voxel."""
    if ti.static(every_ray):
        ti.atomic_add(tally[voxel], one)
    elif (tally[voxel] & one) == 0:
        ti.atomic_or(tally[voxel], one)


@kernel
def count_rays(ends: F32Array2, starts: Starts, space: Space, tally: I64Array, every_ray: Template) -> None:
    """Count hits (upper half of the ``tally``) and misses (lower half) of each voxel, or with ``every_ray``
    off only whether there were any.

    A ray goes from one of ``starts`` to its end in ``ends`` (n, 4), both in voxels (ray_ends.py).
    ``tally`` is (crossed bricks * 512).
    """
    for i in range(ends.shape[0]):
        end = end_of(ends, i)
        if end[3] >= 0.0:
            start = starts.of(i)
            ray = make_ray(start, Vec3(end[0], end[1], end[2]) - start)
            t_begin, t_end = free_from(end), 1.0
            clip(ray, t_begin, t_end, space.lower, space.upper)
            voxel = _end_voxel(end)
            state = _Pass(-1)
            if _in_box(voxel, space.lower, space.upper):
                brick = voxel // BRICK
                state.last = space.bricks[flat(brick, space.shape)] * VOXELS + voxel_number(
                    voxel - brick * BRICK
                )
            walk_voxels(ray, t_begin, t_end, space, _pass_voxel, state, _Tally(tally, every_ray))
            if state.last >= 0 and end[3] == HIT:
                _count(tally, state.last, ti.cast(1, ti.i64) << 32, every_ray)


@ti.kernel
def weigh(
    slots: I32Array, belief: F32Array, tally: I64Array,
    hit: F32, miss: F32, lowest: F32, highest: F32, every_ray: Template,
):  # fmt: skip
    """Change each voxel's log-odds by what was counted, and set the tally to zero.

    One update for each voxel, in which a hit wins, or with ``every_ray`` the sum over all rays. ``slots`` (n)
    are the bricks' places in the pool, ``belief`` (pool * 512) log-odds, ``tally`` (n * 512) the counts;
    ``hit`` and ``miss`` are log-odds of one ray, ``lowest`` and ``highest`` bound the result.
    """
    for i in range(slots.shape[0] * VOXELS):
        counted = tally[i]
        if counted != 0:
            tally[i] = 0
            hits, misses = ti.cast(counted >> 32, ti.f32), ti.cast(low_half(counted), ti.f32)
            change = hits * hit + misses * miss
            if not ti.static(every_ray):
                change = hit if hits > 0.0 else miss
            j = slots[i // VOXELS] * VOXELS + i % VOXELS
            belief[j] = updated(belief[j], change, lowest, highest)


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

        ``noise`` (a Kinect 1 by default) supplies only the bias, with ``correct_bias=True``.
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
