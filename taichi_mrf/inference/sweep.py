"""One sweep over one keyframe: the host's side of sum_product.py, with the scratch that it needs."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.schema import SensorConfig, VolumeConfig
from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.inference import sum_product
from taichi_mrf.inference.accumulators import finest_scale
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.ray_model import END_SIGMAS, Limits, RayModel, SweptVoxels, Trace, log_pass
from taichi_mrf.inference.workers import Workers, workers_for
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.later import later
from taichi_mrf.system.resident import on_host, vec4_array
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.numbering import strip_length
from taichi_mrf.voxels.pool import BrickPool
from taichi_mrf.voxels.traversal import Space, Viewpoint
from taichi_mrf.voxels.window import WindowIndex

if TYPE_CHECKING:
    from taichi_mrf.inference import no_returns
else:
    (no_returns,) = later("taichi_mrf.inference", "no_returns")

TRACE_BYTES = 20
"""Bytes of one step of a ray in the trace."""


def least_log_odds(free_share: float, clamp: float, prior_log_odds: float) -> float:
    """Lower bound on a voxel's log-odds for a keyframe's rays: by ``free_share``, and never beyond
    the ``clamp``."""
    chance = free_share / (1.0 + math.exp(-prior_log_odds))
    return -clamp if chance == 0 else max(-clamp, math.log(chance / (1.0 - chance)))


@dataclass(frozen=True)
class CastRays:
    """Input and output of the rays of one keyframe, as kernels take them: the scratch, ready in a ``with``
    block."""

    view: Viewpoint
    space: Space
    swept: SweptVoxels
    trace: Trace
    workers: Workers
    clear: Callable[[], None]
    """Make the scratch ready for the next keyframe."""

    def __enter__(self) -> "CastRays":
        return self

    def __exit__(self, *exception: object) -> None:
        self.clear()


class Sweeper:
    """Runs sweeps; owns the scratch that all keyframes share, which grows to the largest of them."""

    def __init__(
        self,
        voxel_size: float,
        sensor: SensorConfig,
        inference: InferenceConfig,
        volume: VolumeConfig,
        limits: Limits,
    ) -> None:
        self.limits = limits
        self.voxel_size, self.sensor, self.inference, self.volume = voxel_size, sensor, inference, volume
        self.index = WindowIndex()
        self.log_free = ti.ndarray(ti.f32, VOXELS)
        self.sums = ti.ndarray(ti.i64, VOXELS)
        self.sums_of_no_returns = ti.ndarray(ti.i64, 1)
        self.order = ti.ndarray(ti.i32, 1)
        self.trace_voxel = ti.ndarray(ti.i32, 1)
        self.trace = vec4_array(1)
        self.steps = ti.ndarray(ti.i32, 1)
        self._workers = 0  # of the last sweep

    @property
    def nbytes(self) -> int:
        """Bytes of the scratch."""
        return (
            self.log_free.shape[0] * 12
            + self.sums_of_no_returns.shape[0] * 8
            + self.order.shape[0] * 4
            + self.trace_voxel.shape[0] * TRACE_BYTES
            + self.index.bricks.shape[0] * 4
        )

    @property
    def pass_through(self) -> float:
        """Chance that a ray passes through an occupied voxel."""
        return self.inference.pass_through or 0.0

    @property
    def voxel_steps(self) -> int:
        """Voxels that the measured rays of the last sweep crossed, each ray's counted."""
        return int(self.steps.to_numpy()[: self._workers].sum(dtype=np.int64))

    def sweep(self, keyframe: Keyframe, pool: BrickPool) -> bool:
        """Compute one keyframe's messages again. ``keyframe.messages`` must fit ``keyframe.visible``.

        False if it sees no brick. The host does not wait for the device: call :meth:`take_moved` before the
        next sweep over the same keyframe.
        """
        visible, limits = keyframe.visible, self.limits
        keyframe.withdrawn = False
        if len(visible.slots) == 0:
            return False
        messages, bricks, model = keyframe.messages, visible.on_device(), self.model()

        # Step 3, cavity, eq. 6: log-odds(m) = belief - own message, of each voxel.
        with self.casting(keyframe, pool.total, messages, pool.prior_log_odds) as cast:
            # Step 4, forward, eqs. 4 and 11, and step 5, backward, eqs. 13 and 14: each ray's messages.
            if keyframe.no_returns:
                parts = (cast.view, cast.space, model, cast.swept, cast.trace, cast.workers)
                no_returns.send_no_returns(keyframe.no_returns, self._second_sums(), *parts)
            sum_product.send_messages(
                keyframe.ray_list, 0.0, keyframe.image.sensor,
                cast.view, cast.space, model, cast.swept, cast.trace, cast.workers,
            )  # fmt: skip
            if keyframe.no_returns:
                no_returns.take_where_unmeasured(
                    len(visible.slots) * VOXELS, cast.swept.sums, self._second_sums(),
                    cast.swept.scale, limits.length,
                )  # fmt: skip

        # Step 6, finish, eqs. 7 and 8: new message = mean over rays, belief += new - old.
        bricks.moved.fill(0)  # a NumPy array's method or a Taichi array's
        sum_product.finish(
            bricks.slots, pool.total, messages, cast.swept.sums, cast.swept.scale, limits.message,
            limits.length, bricks.moved, strip_length(),
        )  # fmt: skip
        pool.revision += 1
        keyframe.revision = pool.revision
        return True

    def casting(
        self, keyframe: Keyframe, belief: "ti.Ndarray", messages: "ti.Ndarray", prior_log_odds: float
    ) -> CastRays:
        """The scratch made ready for a keyframe's rays; it must see a brick. It holds the cavity of
        ``belief`` (pool * 512) without ``messages`` (eq. 6), and sums of zero, to which rays add."""
        visible, footprint, n = keyframe.visible, keyframe.footprint, len(keyframe.visible.slots)
        longest = footprint.longest
        workers = workers_for(runtime.active() or "cpu", runtime.is_software(), longest, TRACE_BYTES)
        self._reserve(n, workers.number * longest, workers.number)
        window, bricks = footprint.window, visible.on_device()
        swept = SweptVoxels(self.log_free, self.sums, self._scale(keyframe))
        sum_product.cavity(
            bricks.slots, belief, messages,
            least_log_odds(self.inference.free_share, self.limits.cavity, prior_log_odds), self.limits.cavity,
            log_pass(self.pass_through), self.pass_through > 0,
            swept.log_free, swept.sums, strip_length(),
        )  # fmt: skip
        self.index.fill(window, bricks.cells, self.order)
        return CastRays(
            window.viewpoint(keyframe.T_world_camera),
            self.index.space(window, self.volume.lower, self.volume.upper),
            swept,
            Trace(self.trace_voxel, self.trace, *workers.strides(longest), self.steps),
            workers,
            lambda: self.index.clear(window, bricks.cells),
        )

    def model(self) -> RayModel:
        """The model that the rays of all keyframes share."""
        return RayModel(
            voxel_size=self.voxel_size,
            max_depth=self.sensor.max_depth,
            end_sigmas=END_SIGMAS,
            floor=self.inference.floor,
            clamp=self.limits.message,
            pass_through=self.pass_through,
            passes=self.pass_through > 0,
            segment_lengths=self.limits.segment_lengths,
        )

    def take_moved(self, keyframe: Keyframe, pool: BrickPool) -> NDArray[np.int32]:
        """Number of voxels of each visible brick that moved in the keyframe's last sweep, (n,). The pool adds
        them to its change counts, which the keyframe keeps. Call it in the order of the sweeps."""
        visible = keyframe.visible
        moved = np.array(on_host(visible.on_device().moved))
        pool.count_changes(visible.slots, moved)
        keyframe.change_count_at_last_sweep = pool.change_count[visible.slots]
        return moved

    def _second_sums(self) -> "ti.Ndarray":
        """Scratch of the size of the sums, for rays without a return."""
        if self.sums_of_no_returns.shape[0] < self.sums.shape[0]:
            runtime.settle()  # before the old scratch is dropped
            self.sums_of_no_returns = ti.ndarray(ti.i64, self.sums.shape[0])
        return self.sums_of_no_returns

    def _scale(self, keyframe: Keyframe) -> float:
        """The accumulators' scale, which follows from where the keyframe stands and from its bricks."""
        visible, image, window = keyframe.visible, keyframe.image, keyframe.footprint.window
        if visible.scale == 0.0:
            rays, widest = image.rays, keyframe.ray_list.widest
            for each in keyframe.no_returns:
                rays, widest = rays + each.image.rays, max(widest, each.ray_list.widest)
            bricks = window.bricks_of(visible.cells)
            visible.scale = finest_scale(image.camera, rays, keyframe.T_world_camera, window, bricks, widest)
        return visible.scale

    def _reserve(self, bricks: int, steps: int, workers: int) -> None:
        grow = bricks > self.order.shape[0], steps > self.trace_voxel.shape[0], workers > self.steps.shape[0]
        if any(grow):
            runtime.settle()  # before the old scratch is dropped
        if grow[0]:
            self.log_free = ti.ndarray(ti.f32, bricks * VOXELS)
            self.sums = ti.ndarray(ti.i64, bricks * VOXELS)
            self.order = ti.ndarray(ti.i32, bricks)
            self.order.from_numpy(np.arange(bricks, dtype=np.int32))
        if grow[1]:
            self.trace_voxel = ti.ndarray(ti.i32, steps)
            self.trace = vec4_array(steps)
        if grow[2]:
            self.steps = ti.ndarray(ti.i32, workers)
        self._workers = workers
