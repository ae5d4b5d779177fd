"""The colours of an MRFMap's voxels: computed from the keyframes when they are asked for.

They follow from the keyframes and the beliefs, so edits need no bookkeeping. What frozen keyframes gave to
each voxel is kept, because their images are gone.
"""

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.inference.color_sums import ColorShare, ColorSums
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.sweep import Sweeper
from taichi_mrf.methods.brick_registry import BrickRegistry
from taichi_mrf.system.later import later
from taichi_mrf.voxels.layout import CHUNK, VOXELS, grid_keys
from taichi_mrf.voxels.pool import BrickPool

if TYPE_CHECKING:
    from taichi_mrf.inference import voxel_colors
else:
    (voxel_colors,) = later("taichi_mrf.inference", "voxel_colors")


class MapColors:
    """The colours of one map."""

    def __init__(
        self,
        registry: BrickRegistry,
        keyframes: Mapping[int, Keyframe],
        sweeper: Sweeper,
        refresh: Callable[[Keyframe], object],
        pool: BrickPool | None = None,
    ) -> None:
        """``keyframes`` are those of the map, now and later; ``refresh`` brings one's bricks and messages up
        to date. ``pool`` (default: the registry's) has the beliefs."""
        self._beliefs = pool
        self._registry, self._keyframes, self._refresh = registry, keyframes, refresh
        self._sweeper = sweeper
        self._frozen = ColorShare.nothing()
        self._gone: list[NDArray[np.int32]] = []  # bricks whose part of it is still to be dropped
        self._colors = np.zeros((0, 4), np.uint8)
        self._found_at: tuple[int, int] | None = None
        self._sums: ColorSums | None = None  # kept with follow()
        self._counted: dict[int, Keyframe] = {}

    @cached_property
    def _pass(self) -> "voxel_colors.ColorPass":
        return voxel_colors.ColorPass(self._sweeper)

    def of_some(self, keyframes: Mapping[int, Keyframe], pool: BrickPool, with_frozen: bool) -> "MapColors":
        """The colours that some keyframes gave, and perhaps frozen ones, by the beliefs of ``pool``."""
        parts = (self._registry, keyframes, self._sweeper, self._refresh, pool)
        some = MapColors(*parts)
        some._frozen = self.frozen if with_frozen else some._frozen
        return some

    def __bool__(self) -> bool:
        """True if any voxel may have a colour."""
        with_images = any(keyframe.color is not None for keyframe in self._keyframes.values())
        return with_images or len(self.frozen.numbers) > 0 or (self.is_current and bool(self._colors.any()))

    @property
    def nbytes(self) -> int:
        """Bytes of the colours, and of what frozen keyframes gave."""
        sums = 0 if self._sums is None else 16 * self._sums.rg.shape[0]
        return self._colors.nbytes + 32 * len(self.frozen.numbers) + sums

    def at(self, points: ArrayLike) -> NDArray[np.uint8]:
        """Colours (N, 4) of the voxels that hold points (N, 3) in metres: red, green, blue, and how much was
        seen; 0 for none."""
        slots, numbers = self._registry.places_of(points)
        inside, out = slots >= 0, np.zeros((len(slots), 4), np.uint8)
        if inside.any() and self:
            out[inside] = self._found()[slots[inside].astype(np.int64) * VOXELS + numbers[inside]]
        return out

    def within(self, slots: NDArray[np.int32]) -> NDArray[np.uint8]:
        """Colours of the voxels of some bricks, (n,) slots -> (n, 512, 4); none where a slot is -1."""
        inside, out = slots >= 0, np.zeros((len(slots), VOXELS, 4), np.uint8)
        if inside.any() and self:
            out[inside] = self._found().reshape(-1, VOXELS, 4)[slots[inside]]
        return out

    def follow(self) -> NDArray[np.uint8]:
        """Colours (capacity * 512, 4) by slot, brought up to date at the price of the keyframes that are new
        since the last call: those of others stay as they were found then, although beliefs have changed. A
        removal or a move starts over. The sums over keyframes, 16 bytes for each voxel, are kept from now on.
        """
        pool = self._registry.pool
        gone = any(self._keyframes.get(id) is not keyframe for id, keyframe in self._counted.items())
        if self._sums is None or gone or self._sums.capacity != pool.capacity:
            self._sums, self._counted = self._of_frozen(), {}
        for id, keyframe in self._keyframes.items():
            if id not in self._counted and keyframe.messages is not None:
                self._refresh(keyframe)
                self._pass.add(keyframe, pool, self._sums)
                self._counted[id] = keyframe
        return self._sums.colors()

    @property
    def frozen(self) -> ColorShare:
        """What frozen keyframes gave to the voxels that there still are."""
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
        if keyframe.color is not None:
            self._refresh(keyframe)
            self._frozen = self.frozen.plus(self._pass.share(keyframe, self._registry.pool))
        self._counted.pop(keyframe.id, None)  # its share stays in the sums

    def frozen_in(self, chunks: NDArray[np.int32]) -> ColorShare:
        """Colours that frozen keyframes gave to the voxels of some chunks, (n, 3)."""
        return self.frozen.chosen(self._inside(chunks))

    def release(self, chunks: NDArray[np.int32]) -> None:
        """Remove what frozen keyframes gave to the voxels of some chunks, (n, 3)."""
        self._frozen = self.frozen.chosen(~self._inside(chunks))

    def restore(self, share: ColorShare) -> None:
        """Add to what frozen keyframes gave."""
        if len(share.numbers):
            self._frozen, self._sums = self.frozen.plus(share), None

    def stored(self, slots: NDArray[np.int32], settled: bool) -> NDArray[np.uint8]:
        """Colours of all bricks for a map file, (n,) slots -> (n, 512, 4); (0, 512, 4) if there are none, or
        if they are not known and the map is not ``settled``, so that a checkpoint takes no time for them."""
        kept = self.is_current or (settled and bool(self))
        return self.within(slots) if kept else np.zeros((0, VOXELS, 4), np.uint8)

    def show(self, slots: NDArray[np.int32], colors: NDArray[np.uint8]) -> None:
        """Show colours of a map file, (n,) slots and (n, 512, 4), until the map changes."""
        if len(colors):
            self._colors = np.zeros((self._registry.pool.capacity * VOXELS, 4), np.uint8)
            self._colors.reshape(-1, VOXELS, 4)[slots] = colors
            self._found_at = self._state

    @property
    def is_current(self) -> bool:
        """True if the colours are known that belong to the beliefs as they are now."""
        return self._found_at == self._state

    @property
    def _state(self) -> tuple[int, int]:
        return self._registry.pool.revision, self._registry.version

    def _found(self) -> NDArray[np.uint8]:
        """Colours (capacity * 512, 4) by slot, computed if the map has changed."""
        if not self.is_current:
            sums, pool = self._of_frozen(), self._beliefs or self._registry.pool
            for keyframe in self._keyframes.values():
                if keyframe.color is not None and keyframe.messages is not None:
                    self._refresh(keyframe)
                    self._pass.add(keyframe, pool, sums)
            self._colors, self._found_at = sums.colors(), self._state
        return self._colors

    def _of_frozen(self) -> ColorSums:
        sums = ColorSums(self._registry.pool)
        sums.add(self.frozen, self._registry.topology.slots(self.frozen.bricks))
        return sums

    def _inside(self, chunks: NDArray[np.int32]) -> NDArray[np.bool_]:
        return np.isin(grid_keys(self.frozen.bricks // CHUNK), grid_keys(chunks))
