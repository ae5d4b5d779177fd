"""A layer of an MRFMap that pixels feed (voxels/layers.py): computed from the keyframes when it is asked for.

It follows from the keyframes and the beliefs, so edits need no bookkeeping. What frozen keyframes gave to
each voxel is kept, because their images are gone.
"""

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.sweep import Sweeper
from taichi_mrf.inference.voxel_share import VoxelShare
from taichi_mrf.methods.brick_registry import BrickRegistry
from taichi_mrf.system.later import later
from taichi_mrf.voxels.layers import LAYERS, BrickValues, imported, pixel_layers
from taichi_mrf.voxels.layout import VOXELS, grid_keys
from taichi_mrf.voxels.pool import BrickPool

if TYPE_CHECKING:
    from taichi_mrf.inference import pixel_pass
else:
    (pixel_pass,) = later("taichi_mrf.inference", "pixel_pass")


class PixelLayer:
    """One layer of one map."""

    def __init__(
        self,
        name: str,
        registry: BrickRegistry,
        keyframes: Mapping[int, Keyframe],
        sweeper: Sweeper,
        refresh: Callable[[Keyframe], object],
        restore: Callable[[], object],
        pool: BrickPool | None = None,
    ) -> None:
        """``keyframes`` are those of the map, now and later; ``refresh`` brings one's bricks and messages up
        to date, ``restore`` makes the messages of a loaded map. ``pool`` (default: the registry's) has the
        beliefs."""
        self._name, self._layer, self._made = name, LAYERS[name], pixel_layers()[name]
        self._beliefs = pool
        self._registry, self._keyframes = registry, keyframes
        self._sweeper, self._refresh, self._restore = sweeper, refresh, restore
        self._frozen = VoxelShare.nothing(len(self._made.words))
        self._gone: list[NDArray[np.int32]] = []  # bricks whose part of it is still to be dropped
        self._values = self._none(0).reshape(0, *self._layer.shape)
        self._found_at: tuple[int, int] | None = None
        self._sums: pixel_pass.VoxelSums | None = None  # kept with follow()
        self._counted: dict[int, Keyframe] = {}

    @cached_property
    def _pass(self) -> "pixel_pass.PixelPass":
        return pixel_pass.PixelPass(self._sweeper, self._made)

    def of_some(self, keyframes: Mapping[int, Keyframe], pool: BrickPool, with_frozen: bool) -> "PixelLayer":
        """The layer from some keyframes, and perhaps the frozen ones, by the beliefs of ``pool``."""
        parts = (self._registry, keyframes, self._sweeper, self._refresh, self._restore, pool)
        some = PixelLayer(self._name, *parts)
        some._frozen = self.frozen if with_frozen else some._frozen
        return some

    def __bool__(self) -> bool:
        """True if any voxel may have a value."""
        with_images = any(self._gives(keyframe) for keyframe in self._keyframes.values())
        return with_images or len(self.frozen.numbers) > 0 or (self.is_current and bool(self._values.any()))

    @property
    def nbytes(self) -> int:
        """Bytes of the values, and of what frozen keyframes gave."""
        return self._values.nbytes + self.frozen.nbytes + (0 if self._sums is None else self._sums.nbytes)

    def at(self, points: ArrayLike) -> NDArray:
        """Values (N, ...) of the voxels that hold points (N, 3) in metres; 0 for none."""
        slots, numbers = self._registry.places_of(points)
        inside, out = slots >= 0, np.zeros((len(slots), *self._layer.shape), self._layer.dtype)
        if inside.any() and self:
            out[inside] = self._known()[slots[inside].astype(np.int64) * VOXELS + numbers[inside]]
        return out

    def within(self, slots: NDArray[np.int32]) -> NDArray:
        """Values of the voxels of some bricks, (n,) slots -> (n, 512, ...); 0 where a slot is -1."""
        inside, out = slots >= 0, self._none(len(slots))
        if inside.any() and self:
            out[inside] = self._known().reshape(-1, *out.shape[1:])[slots[inside]]
        return out

    def follow(self) -> NDArray:
        """Values (capacity * 512, ...) by slot, brought up to date at the price of the keyframes that are new
        since the last call: those of others stay as they were found then, although beliefs have changed. A
        removal or a move starts over. The sums over keyframes are kept from now on."""
        self._restore()
        pool = self._registry.pool
        gone = any(self._keyframes.get(id) is not keyframe for id, keyframe in self._counted.items())
        if self._sums is None or gone or self._sums.capacity != pool.capacity:
            self._sums, self._counted = self._of_frozen(), {}
        for id, keyframe in self._keyframes.items():
            if id not in self._counted and keyframe.messages is not None:
                self._refresh(keyframe)
                self._pass.add(keyframe, pool, self._sums)
                self._counted[id] = keyframe
        return self._of_sums(self._sums)

    @property
    def frozen(self) -> VoxelShare:
        """The share of frozen keyframes in the voxels that still exist."""
        if self._gone:
            gone, self._gone = grid_keys(np.concatenate(self._gone)), []
            self._frozen = self._frozen.chosen(~np.isin(grid_keys(self._frozen.bricks), gone))
        return self._frozen

    def forget(self, bricks: NDArray[np.int32]) -> None:
        """Bricks (n, 3) have been released: what frozen keyframes gave to them goes with them, as evidence
        does, and their slots will be those of others."""
        self._sums = None
        if len(self._frozen.numbers):
            self._gone.append(bricks)

    def freeze(self, keyframe: Keyframe) -> None:
        """Keep for good what a keyframe gives; it is about to be frozen."""
        if self._gives(keyframe):
            self._refresh(keyframe)
            self._frozen = self.frozen.plus(self._pass.share(keyframe, self._registry.pool))
        self._counted.pop(keyframe.id, None)  # its share stays in the sums

    def frozen_values(self, chunks: NDArray[np.int32]) -> BrickValues:
        """The layer that frozen keyframes gave to the voxels of some chunks, (n, 3)."""
        return self.frozen.in_chunks(chunks).values(imported(self._made.visitor).values)

    def release(self, chunks: NDArray[np.int32]) -> None:
        """Remove what frozen keyframes gave to the voxels of some chunks, (n, 3)."""
        self._frozen = self.frozen.in_chunks(chunks, inside=False)

    def restore(self, share: VoxelShare) -> None:
        """Add to what frozen keyframes gave."""
        if len(share.numbers):
            self._frozen, self._sums = self.frozen.plus(share), None

    def stored(self, slots: NDArray[np.int32], settled: bool) -> NDArray | None:
        """Values of all bricks for a map file, (n,) slots -> (n, 512, ...); None if there are none, or if
        they are not known and the map is not ``settled``, so that a checkpoint takes no time for them."""
        kept = self.is_current or (settled and bool(self))
        return self.within(slots) if kept else None

    def show(self, slots: NDArray[np.int32], values: NDArray) -> None:
        """Show values of a map file, (n,) slots and (n, 512, ...), until the map changes."""
        everywhere = self._none(self._registry.pool.capacity)
        everywhere[slots] = values
        self._values, self._found_at = everywhere.reshape(-1, *self._layer.shape), self._state

    @property
    def is_current(self) -> bool:
        """True if the values are known that belong to the beliefs as they are now."""
        return self._found_at == self._state

    @property
    def _state(self) -> tuple[int, int]:
        return self._registry.pool.revision, self._registry.version

    def _gives(self, keyframe: Keyframe) -> bool:
        return keyframe.beside(self._made.image) is not None

    def _none(self, bricks: int) -> NDArray:
        return np.zeros((bricks, VOXELS, *self._layer.shape), self._layer.dtype)

    def _of_sums(self, sums: "pixel_pass.VoxelSums") -> NDArray:
        return np.asarray(imported(self._made.visitor).values(sums.sums))

    def _known(self) -> NDArray:
        """Values (capacity * 512, ...) by slot, computed if the map has changed."""
        if not self.is_current:
            self._restore()
            sums, pool = self._of_frozen(), self._beliefs or self._registry.pool
            for keyframe in self._keyframes.values():
                if self._gives(keyframe) and keyframe.messages is not None:
                    self._refresh(keyframe)
                    self._pass.add(keyframe, pool, sums)
            self._values, self._found_at = self._of_sums(sums), self._state
        return self._values

    def _of_frozen(self) -> "pixel_pass.VoxelSums":
        sums = pixel_pass.VoxelSums(self._registry.pool, len(self._made.words), self._name)
        sums.add(self.frozen, self._registry.topology.slots(self.frozen.bricks))
        return sums
