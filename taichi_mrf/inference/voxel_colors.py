"""The colour of each voxel: what the pixels saw, by the posterior that they saw this voxel.

A pixel's colour c_r goes to every voxel i on its ray by the probability that the voxel is the surface that
made the measurement, given all that the other keyframes know (nu, m, vis as in sum_product.py, o for
outliers):

    w_ri = nu_i m_i vis_i / (sum_j nu_j m_j vis_j + beyond + o)        colour_i = sum_r w_ri c_r / sum_r w_ri

What stands behind gets nothing of it, and a measurement that the map holds for an outlier gives nothing.
Where n rays meet a voxel, about sqrt(n) of them are followed, each of which counts for sqrt(n): a mean
colour needs fewer rays than a message.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.inference.color_sums import ColorShare, ColorSums, weigh
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.messages import new_messages
from taichi_mrf.inference.ray_list import block_of
from taichi_mrf.inference.ray_model import Trace
from taichi_mrf.inference.ray_posterior import FreeLogs, RayVisitor, follow_rays
from taichi_mrf.inference.sum_product import TINY
from taichi_mrf.inference.sweep import Sweeper
from taichi_mrf.kernels.types import F32, I32, I32Array, I64Array, Struct, Template, Vec4
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.pool import BrickPool

MOST_STRIDE = 4
"""Of so many rays one is followed in any case."""

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
        """The colours that a keyframe would add."""
        visible = keyframe.visible
        n = len(visible.slots) * VOXELS if self._spread(keyframe, pool) else 0
        rg, bw = (a.to_numpy()[:n] for a in (self._sweeper.sums, self._bw))
        rows = np.flatnonzero(bw)
        bricks = keyframe.footprint.window.bricks_of(visible.cells)[rows // VOXELS]
        return ColorShare(bricks, (rows % VOXELS).astype(np.int32), rg[rows], bw[rows])

    def _spread(self, keyframe: Keyframe, pool: BrickPool) -> bool:
        """Leave a keyframe's mean colours times weight in the scratch; False if it has none to give."""
        color, visible = keyframe.color, keyframe.visible
        if color is None or keyframe.messages is None or len(visible.slots) == 0:
            return False
        s, image = self._sweeper, keyframe.image
        n = len(visible.slots)
        if n * VOXELS > self._bw.shape[0]:
            runtime.settle()
            self._bw = ti.ndarray(ti.i64, n * VOXELS)
        self._bw.fill(0)
        # Beliefs that have a date are no sums of messages: there the keyframe's own evidence stays in.
        messages = keyframe.messages if pool.dated is None else new_messages(visible, s.limits.precision)
        with s.casting(keyframe, pool.belief, messages, pool.prior_log_odds) as cast:
            scale = cast.swept.scale * COLOR_SHARE
            model = s.model()
            free_logs = FreeLogs.with_bricks(cast.swept.log_free, n, pool.prior_log_odds, model)
            spread = _Spread(
                _pixels(color), image.camera.width, cast.swept.sums, self._bw, scale, cast.trace,
                (s.voxel_size * image.camera.pixels_per_radian) ** 2,
                200.0 * s.voxel_size * s.inference.ray_density,
            )  # fmt: skip
            follow_rays(
                keyframe.ray_list, image.sensor, cast.view, cast.space,
                model, free_logs, cast.workers, spread,
            )  # fmt: skip
        weigh(n * VOXELS, cast.swept.sums, self._bw, scale)
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
class _Spread(RayVisitor):
    """Adds the colours of rays' pixels to the voxels that they see.

    ``image`` (H * W) are packed colours, 0 for none. Red and green go to ``rg``, blue and weight to ``bw``
    (visible bricks * 512), in units of 1 / ``scale``. ``crowded`` / (depth^2 * pixels of a ray) is how many
    rays meet a voxel if those beside it have as many pixels; beyond ``most_many`` it is a ray of its own, as
    at edges, and is followed.
    """

    image: I32Array
    width: I32
    rg: I64Array
    bw: I64Array
    scale: F32
    trace: Trace
    crowded: F32
    most_many: F32

    @ti.func
    def stride(self, measured: F32, pixels: I32):
        """One of so many rays like this is followed, and counts for all of them."""
        many = self.crowded / (measured * measured * pixels)
        stride = 1
        if many <= self.most_many:
            stride = ti.max(1, ti.min(MOST_STRIDE, ti.cast(ti.sqrt(many) + 0.5, ti.i32)))
        return stride

    @ti.func
    def wants(self, rays: Template, number: I32):
        _, _, wide, high = block_of(rays.blocks[number], self.width)
        return ti.cast(number % self.stride(rays.depth[number], wide * high) == 0, ti.i32)

    @ti.func
    def begin(self, sight: Template):
        return _Ahead(1.0, 0.0, 0)

    @ti.func
    def meet(self, ahead: Template, sight: Template, voxel: I32, here: F32):
        if here > 0.0:
            j = sight.worker * self.trace.longest + ahead.voxels
            self.trace.voxel[j] = voxel
            self.trace.step[j] = Vec4(here, 0.0, 0.0, 0.0)
            ahead.voxels += 1
        return 1

    @ti.func
    def end(self, ahead: Template, sight: Template, beyond: F32):
        if ahead.voxels > 0:
            total = ahead.explained + sight.model.floor + TINY + beyond
            stride = self.stride(sight.measured, sight.pixels)
            red, green, blue, pixels = _block_color(sight.block, self.image, self.width)
            for step in range(ahead.voxels):
                j = sight.worker * self.trace.longest + step
                unit = self.trace.step[j][0] / total * self.scale * stride
                voxel = self.trace.voxel[j]
                weight = ti.cast(unit * pixels + 0.5, ti.i64)
                if weight > 0:
                    # As shares of the rounded weight, so that the mean lies between the colours.
                    share = ti.cast(weight, ti.f32) / pixels
                    _add_pair(self.rg, voxel, share * red, share * green)
                    ti.atomic_add(self.bw[voxel], (ti.cast(share * blue + 0.5, ti.i64) << 32) + weight)


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
