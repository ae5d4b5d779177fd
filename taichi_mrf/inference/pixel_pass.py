"""Contributions of pixels to voxels, weighted by the posterior that they saw them.

A pixel gives to every voxel i on its ray by the probability that the voxel is the surface that made the
measurement, given all that the other keyframes know (nu, m, vis as in sum_product.py, o for outliers):

    w_ri = nu_i m_i vis_i / (sum_j nu_j m_j vis_j + beyond + o)

What stands behind gets nothing of it, and a measurement that the map holds for an outlier gives nothing.
Where n rays meet a voxel, about sqrt(n) of them are followed, each of which counts for sqrt(n): a mean needs
fewer rays than a message.

What is given is up to a :class:`PixelVisitor`, which a layer names (voxels/layers.py). The shortest is
voxel_colors.py.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.inference.accumulators import low_half
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.messages import new_messages
from taichi_mrf.inference.ray_list import block_of
from taichi_mrf.inference.ray_model import Trace
from taichi_mrf.inference.ray_posterior import FreeLogs, RayVisitor, follow_rays
from taichi_mrf.inference.sum_product import TINY
from taichi_mrf.inference.sweep import Sweeper
from taichi_mrf.inference.voxel_share import VoxelShare
from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.memory import check_memory
from taichi_mrf.system.resident import Resident
from taichi_mrf.system.types import F32, I32, I32Array, I64Array, Struct, Template, Vec4
from taichi_mrf.voxels.layers import FromPixels, imported
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.numbering import strip_begin, strip_length
from taichi_mrf.voxels.pool import BrickPool

MOST_STRIDE = 4
"""Of so many rays one is followed in any case."""

SHARE = 1.0 / 512.0
"""Of the scale of the sums of lengths: numbers of a pixel reach 255, and a ray that counts for several may do
so in a voxel that those do not meet."""

_MOST = 1 << 30
"""Nothing is added to a number of 31 bits that is so large, for which 16,000 keyframes are needed."""


@ti.dataclass
class _Ahead(Struct):
    """A ray on its way from the camera."""

    visibility: F32
    explained: F32
    voxels: I32  # that can have made the measurement


@dataclass(frozen=True)
class PixelVisitor(RayVisitor, ABC):
    """Adds what the pixels of rays say to the voxels that they see.

    ``image`` (H * W) is :meth:`packed`. A voxel's numbers go to the halves of ``sums`` (visible bricks * 512
    * words), in units of 1 / ``scale``. ``crowded`` / (depth^2 * pixels of a ray) is how many rays meet a
    voxel if those beside it have as many pixels; beyond ``most_many`` it is a ray of its own, as at edges,
    and is followed. A layer's visitor has five methods: packed, read, give, finish and values.
    """

    image: I32Array
    width: I32
    sums: I64Array
    scale: F32
    trace: Trace
    crowded: F32
    most_many: F32

    @staticmethod
    @abstractmethod
    def packed(image: NDArray[np.uint8]) -> NDArray[np.int32]:
        """The image beside depth (H, W, channels) as an integer for each pixel, (H * W)."""

    @ti.func
    def read(self, block: I32):
        """The evidence of a ray's pixels (``block`` is for ray_list.block_of), for :meth:`give`."""

    @ti.func
    def give(self, voxel: I32, unit: F32, said: Template):
        """Add to a voxel's sums; ``unit`` is the chance that the ray saw it, times the number of rays that it
        counts for, in the sums' units."""

    @ti.func
    def finish(self, voxel: I32):
        """Replace the sums of a voxel over the keyframe's rays by the integers that the keyframe gives it.
        None is above 2^16."""

    @staticmethod
    @abstractmethod
    def values(sums: Any) -> NDArray:
        """The layer's values (n, width) of the sums of voxels over keyframes, (n * words): a NumPy or a
        Taichi array (kernels/resident.py)."""

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
            j = self.trace.place(sight.worker, ahead.voxels)
            self.trace.voxel[j] = voxel
            self.trace.step[j] = Vec4(here, 0.0, 0.0, 0.0)
            ahead.voxels += 1
        return 1

    @ti.func
    def end(self, ahead: Template, sight: Template, beyond: F32):
        if ahead.voxels > 0:
            total = ahead.explained + sight.model.floor + TINY + beyond
            stride = self.stride(sight.measured, sight.pixels)
            said = self.read(sight.block)
            for step in range(ahead.voxels):
                j = self.trace.place(sight.worker, step)
                self.give(self.trace.voxel[j], self.trace.step[j][0] / total * self.scale * stride, said)


@ti.func
def add_pair(sums: Template, index: I32, high: F32, low: F32):
    """Add two numbers to the halves of an integer."""
    ti.atomic_add(sums[index], (ti.cast(high + 0.5, ti.i64) << 32) + ti.cast(low + 0.5, ti.i64))


class VoxelSums:
    """Sums over keyframes for the voxels of a pool, (capacity * 512 * words) int64."""

    def __init__(self, pool: BrickPool, words: int, what: str) -> None:
        """``what`` names the layer. Raises CapacityError if there is not enough memory."""
        self.capacity, self._words = pool.capacity, words
        cells = max(1, pool.capacity) * VOXELS
        check_memory(float(8 * words + 4) * cells, f"the {what} of {cells / 1e6:.3g} million voxels")
        self.sums = ti.ndarray(ti.i64, cells * words)

    @property
    def nbytes(self) -> int:
        """Bytes of the sums."""
        return 8 * int(self.sums.shape[0])

    def take(self, slots: Resident, given: "ti.Ndarray") -> None:
        """Add what a keyframe gives (n * 512 * words) to the bricks in ``slots`` (n), and leave 0 of it."""
        _take_all(slots, given, self.sums, self._words, strip_length())

    def add(self, share: "VoxelShare", slots: NDArray[np.int32]) -> None:
        """Add what keyframes have left in some voxels; ``slots`` (n,) are the places of their bricks."""
        if len(slots):
            places = (slots * VOXELS + share.numbers).astype(np.int32)
            _add_share(places, np.ascontiguousarray(share.sums.reshape(-1)), self.sums, self._words)


class PixelPass:
    """Follows the rays of keyframes and adds up what a layer's voxels get; owns the scratch, which grows."""

    def __init__(self, sweeper: Sweeper, made: FromPixels) -> None:
        self._sweeper, self._made, self._visitor = sweeper, made, imported(made.visitor)
        self._words = len(made.words)
        self._sums, self._clean = ti.ndarray(ti.i64, VOXELS * self._words), False  # clean: all 0

    def add(self, keyframe: Keyframe, pool: BrickPool, sums: VoxelSums) -> None:
        """Add what a keyframe gives. Its bricks and messages must be up to date."""
        if self._spread(keyframe, pool):
            sums.take(keyframe.visible.on_device().slots, self._sums)
            self._clean = True

    def share(self, keyframe: Keyframe, pool: BrickPool) -> VoxelShare:
        """The sums that a keyframe would add."""
        visible = keyframe.visible
        n = len(visible.slots) * VOXELS if self._spread(keyframe, pool) else 0
        found = self._sums.to_numpy()[: n * self._words].reshape(n, self._words)
        rows = np.flatnonzero(found.any(axis=1))
        bricks = keyframe.footprint.window.bricks_of(visible.cells)[rows // VOXELS]
        return VoxelShare(bricks, (rows % VOXELS).astype(np.int32), found[rows])

    def _spread(self, keyframe: Keyframe, pool: BrickPool) -> bool:
        """Leave what a keyframe gives in the scratch; False if that is nothing."""
        pixels, visible = keyframe.beside(self._made.image), keyframe.visible
        if pixels is None or keyframe.messages is None or len(visible.slots) == 0:
            return False
        s, image = self._sweeper, keyframe.image
        n = len(visible.slots)
        if n * VOXELS * self._words > self._sums.shape[0]:
            runtime.settle()
            self._sums, self._clean = ti.ndarray(ti.i64, n * VOXELS * self._words), False
        if not self._clean:
            self._sums.fill(0)
        self._clean = False
        # Beliefs that have a date are no sums of messages: there the keyframe's own evidence stays in.
        messages = keyframe.messages if pool.dated is None else new_messages(visible, s.limits.precision)
        with s.casting(keyframe, pool.belief, messages, pool.prior_log_odds) as cast:
            model = s.model()
            free_logs = FreeLogs.with_bricks(cast.swept.log_free, n, pool.prior_log_odds, model)
            visitor = self._visitor(
                self._visitor.packed(pixels), image.camera.width, self._sums, cast.swept.scale * SHARE,
                cast.trace, (s.voxel_size * image.camera.pixels_per_radian) ** 2,
                200.0 * s.voxel_size * s.inference.ray_density,
            )  # fmt: skip
            follow_rays(
                keyframe.ray_list, image.sensor, cast.view, cast.space,
                model, free_logs, cast.workers, visitor,
            )  # fmt: skip
        _finish(n * VOXELS, visitor)
        runtime.settle()
        return True


@kernel
def _finish(voxels: I32, visitor: PixelVisitor) -> None:
    """Replace the sums over a keyframe's rays by what it gives."""
    for voxel in range(voxels):
        visitor.finish(voxel)


@ti.kernel
def _take_all(slots: I32Array, given: I64Array, sums: I64Array, words: Template, strip: Template):
    """Add what a keyframe gives (n * 512 * words) in the bricks in ``slots`` (n) to the sums (pool * 512 *
    words), and set it to 0."""
    for part in range(slots.shape[0] * (VOXELS // strip)):
        i, j = strip_begin(part, slots, strip)
        for k in range(strip):
            _add(given, i + k, sums, j + k, words)
            for word in ti.static(range(words)):
                if given[words * (i + k) + word] != 0:
                    given[words * (i + k) + word] = 0


@ti.kernel
def _add_share(places: I32Array, given: I64Array, sums: I64Array, words: Template):
    """Add shares (n * words) to the sums (pool * 512 * words) at ``places`` (n), each once."""
    for i in range(places.shape[0]):
        _add(given, i, sums, places[i], words)


@ti.func
def _add(given: Template, i: I32, sums: Template, j: I32, words: Template):
    """Add the numbers of voxel ``i`` to those of voxel ``j``, unless they are full."""
    something = 0
    for word in ti.static(range(words)):
        if given[words * i + word] != 0:
            something = 1
    if something == 1:
        largest = ti.i64(0)
        for word in ti.static(range(words)):
            largest = ti.max(largest, sums[words * j + word] >> 32, low_half(sums[words * j + word]))
        if largest < _MOST:
            for word in ti.static(range(words)):
                sums[words * j + word] += given[words * i + word]
