"""The colour of each voxel: what the pixels saw, by the posterior that they saw this voxel.

A pixel's colour c_r goes to every voxel i on its ray by the probability that the voxel is the surface that
made the measurement, given all that the other keyframes know (nu, m, vis as in sum_product.py, o for
outliers):

    w_ri = nu_i m_i vis_i / (sum_j nu_j m_j vis_j + beyond + o)        colour_i = sum_r w_ri c_r / sum_r w_ri

What stands behind gets nothing of it, and a measurement that the map holds for an outlier gives nothing.
Where more rays than ENOUGH meet a voxel, one of up to MOST_STRIDE is followed and counts for all of them: a
mean colour needs fewer rays than a message.
"""

from dataclasses import dataclass, replace

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from taichi_mrf.inference import sum_product
from taichi_mrf.inference.color_sums import ColorShare, ColorSums, weigh
from taichi_mrf.inference.keyframe import Keyframe, RayList
from taichi_mrf.inference.messages import new_messages
from taichi_mrf.inference.ray_list import block_of, listed_ray
from taichi_mrf.inference.ray_model import RayModel, SweptVoxels, Trace
from taichi_mrf.inference.sum_product import TINY
from taichi_mrf.inference.sweep import TRACE_BYTES, Sweeper, least_log_odds
from taichi_mrf.inference.workers import Workers, workers_for
from taichi_mrf.kernels.bundles import Bundle, kernel
from taichi_mrf.kernels.log_odds import exp_of_negative
from taichi_mrf.kernels.types import F32, I32, F32Array, I32Array, I64Array, Struct, Template, Vec4
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.system import runtime
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.pool import BrickPool
from taichi_mrf.voxels.strips import strip_length
from taichi_mrf.voxels.traversal import Space, Viewpoint, clip, walk_voxels

ENOUGH = 2.5
"""Rays at a voxel that faces the camera, of which all are followed."""

MOST_STRIDE = 4
"""Of more rays than this one is followed in any case."""

COLOR_SHARE = 1.0 / 512.0
"""Of the scale of the sums of lengths: colours reach 255, and a ray that counts for several may do so in a
voxel that those do not meet."""


class ColorPass:
    """Follows the rays of keyframes and adds up their colours; owns the scratch, which grows."""

    def __init__(self, sweeper: Sweeper) -> None:
        self._sweeper = sweeper
        self._bw = ti.ndarray(ti.i64, VOXELS)

    def add(self, keyframe: Keyframe, pool: BrickPool, sums: ColorSums) -> None:
        """Add a keyframe's colours. Its bricks and messages must be up to date."""
        if self._spread(keyframe, pool):
            slots = keyframe.visible.on_device().slots
            sums.add_keyframe(slots, self._sweeper.sums, self._bw)

    def share(self, keyframe: Keyframe, pool: BrickPool) -> ColorShare:
        """What a keyframe would add."""
        visible = keyframe.visible
        n = len(visible.slots) * VOXELS if self._spread(keyframe, pool) else 0
        rg, bw = (a.to_numpy()[:n] for a in (self._sweeper.sums, self._bw))
        rows = np.flatnonzero(bw)
        bricks = keyframe.footprint.window.bricks_of(visible.cells)[rows // VOXELS]
        return ColorShare(bricks, (rows % VOXELS).astype(np.int32), rg[rows], bw[rows])

    def _spread(self, keyframe: Keyframe, pool: BrickPool) -> bool:
        """Leave a keyframe's mean colours times weight in the scratch; False if it has none to give."""
        color, visible, footprint = keyframe.color, keyframe.visible, keyframe.footprint
        if color is None or keyframe.messages is None or len(visible.slots) == 0:
            return False
        s, image, rays = self._sweeper, keyframe.image, keyframe.ray_list
        n, config = len(visible.slots), s.inference
        workers = workers_for(
            runtime.active() or "cpu", runtime.is_software(), footprint.longest, TRACE_BYTES
        )
        s._reserve(n, workers.number * footprint.longest, workers.number)
        if n * VOXELS > self._bw.shape[0]:
            runtime.settle()
            self._bw = ti.ndarray(ti.i64, n * VOXELS)
        self._bw.fill(0)
        window, bricks, strip = footprint.window, visible.on_device(), strip_length()
        swept = SweptVoxels(s.log_free, s.sums, s._scale(keyframe) * COLOR_SHARE)
        # Beliefs that have a date are no sums of messages: there the keyframe's own evidence stays in.
        messages = (
            keyframe.messages if pool.dated is None else new_messages(visible, config.message_precision)
        )
        sum_product.cavity(
            bricks.slots, pool.belief, messages, least_log_odds(config, pool.prior_log_odds),
            config.cavity_clamp, swept.log_free, swept.sums, strip,
        )  # fmt: skip
        s.index.fill(window, bricks.cells, s.order)
        spread_colors(
            rays, keyframe.entry_depths, int(keyframe.entry_depths_known),
            image.sensor, window.viewpoint(keyframe.T_world_camera),
            s.index.space(window, s.volume.lower, s.volume.upper),
            replace(s.model(), maximise=False), swept,
            Trace(s.trace_voxel, s.trace, footprint.longest, s.steps),
            workers, _pixels(color), self._bw, (s.voxel_size * image.camera.pixels_per_radian) ** 2 / ENOUGH,
            200.0 * s.voxel_size * s.inference.ray_density / ENOUGH,
        )  # fmt: skip
        s.index.clear(window, bricks.cells)
        weigh(n * VOXELS, swept.sums, self._bw, swept.scale)
        runtime.settle()
        return True


def _pixels(color: NDArray[np.uint8]) -> NDArray[np.int32]:
    """An image (H, W, 3) as (H * W) integers: red + 256 green + 65536 blue."""
    wide = color.reshape(-1, 3).astype(np.int32)
    return wide[:, 0] | wide[:, 1] << 8 | wide[:, 2] << 16


@ti.dataclass
class _Ahead(Struct):
    """A ray on its way from the camera."""

    visibility: F32
    explained: F32
    voxels: I32  # that can have made the measurement


@dataclass(frozen=True)
class _Looking(Bundle):
    """One ray, and all that a step along it needs."""

    model: RayModel
    swept: SweptVoxels
    sensor: Sensor
    measured: F32
    noise: Template
    support: F32
    voxels_per_depth: F32
    trace: Trace
    first_step: I32


@ti.func
def _look(ahead: Template, looking: Template, voxel: I32, near: F32, far: F32):
    """One voxel of a ray: note it if it can have made the measurement."""
    log_free = looking.swept.log_free[voxel]
    if ti.static(looking.model.segment_lengths):
        log_free *= (far - near) * looking.voxels_per_depth
    free = exp_of_negative(log_free)
    if far > looking.support:
        density = looking.sensor.likelihood(
            looking.measured, near, far, looking.noise, looking.model.voxel_size, looking.model.likelihood
        )
        here = (1.0 - free) * density * ahead.visibility
        if here > 0.0:
            j = looking.first_step + ahead.voxels
            looking.trace.voxel[j] = voxel
            looking.trace.step[j] = Vec4(here, 0.0, 0.0, 0.0)
            ahead.explained += here
            ahead.voxels += 1
    ahead.visibility *= free
    return 1


@kernel
def spread_colors(
    rays: RayList, entry_depths: F32Array, entry_depths_known: I32,
    sensor: Sensor, view: Viewpoint, space: Space,
    model: RayModel, swept: SweptVoxels, trace: Trace, workers: Workers, image: I32Array, bw: I64Array,
    crowded: F32, most_many: F32,
) -> None:  # fmt: skip
    """Follow the rays of a keyframe, and add the colours of their pixels to the voxels that they see.

    ``image`` (H * W) are packed colours, 0 for none. Red and green go to ``swept.sums``, blue and weight to
    ``bw`` (visible bricks * 512), in units of 1 / ``swept.scale``. ``crowded`` / (depth^2 * pixels of a ray)
    is how many times ENOUGH rays meet a voxel if those beside it have as many pixels; beyond ``most_many`` it
    is a ray of its own, as at edges, and is followed.
    """
    if ti.static(workers.block > 0):
        ti.loop_config(block_dim=workers.block)
    for iteration in range(workers.number * workers.spread):
        worker = iteration // workers.spread
        turns = 0
        if iteration % workers.spread == 0:
            turns = workers.turns(rays.number)
        for turn in range(turns):
            i = workers.ray(worker, turn)
            if i < rays.number:
                measured = rays.depth[i]
                ray, noise, pixels_of_ray = listed_ray(rays, i, sensor, view)
                many = crowded / (measured * measured * pixels_of_ray)
                stride = 1
                if many <= most_many:
                    stride = ti.max(1, ti.cast(ti.min(many, MOST_STRIDE), ti.i32))
                if i % stride == 0:
                    first_step = worker * trace.longest
                    looking = _Looking(
                        model, swept, sensor, measured, noise, sensor.support(measured, noise),
                        ray.direction.norm(), trace, first_step,
                    )  # fmt: skip
                    last = sensor.farthest_depth(measured, noise, model.end_sigmas)
                    begin, end = 0.0, ti.min(last, model.max_depth)
                    if entry_depths_known == 1:
                        begin = entry_depths[i]
                    clip(ray, begin, end, space.lower, space.upper)
                    ahead = _Ahead(1.0, 0.0, 0)
                    walk_voxels(ray, begin, end, space, _look, ahead, looking)
                    if ahead.voxels > 0:
                        total = ahead.explained + model.floor + TINY
                        if end < last:
                            total += ahead.visibility * sensor.likelihood_beyond(measured, end, noise)
                        red, green, blue, pixels = _block_color(rays.blocks[i], image, sensor.camera.width)
                        for step in range(ahead.voxels):
                            j = first_step + step
                            unit = trace.step[j][0] / total * swept.scale * stride
                            voxel = trace.voxel[j]
                            weight = ti.cast(unit * pixels + 0.5, ti.i64)
                            if weight > 0:
                                # As shares of the rounded weight, so that the mean lies between the colours.
                                share = ti.cast(weight, ti.f32) / pixels
                                _add_pair(swept.sums, voxel, share * red, share * green)
                                ti.atomic_add(bw[voxel], (ti.cast(share * blue + 0.5, ti.i64) << 32) + weight)


@ti.func
def _add_pair(sums: Template, index: I32, high: F32, low: F32):
    """Add two numbers to the halves of an integer."""
    ti.atomic_add(sums[index], (ti.cast(high + 0.5, ti.i64) << 32) + ti.cast(low + 0.5, ti.i64))


@ti.func
def _block_color(ray: I32, image: Template, width: I32):
    """Sums of red, green and blue over the pixels of a ray that have a colour, and their number."""
    u, v, wide, high = block_of(ray, width)
    sums = Vec4(0.0)
    for row in range(v, v + high):
        for column in range(u, u + wide):
            packed = image[row * width + column]
            if packed != 0:
                sums += Vec4(packed & 255, packed >> 8 & 255, packed >> 16 & 255, 1.0)
    return sums[0], sums[1], sums[2], sums[3]
