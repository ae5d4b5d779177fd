"""The signed distances of all keyframes' rays, voxel by voxel: the host's side of surface_rays.py.

The field is made anew from the keyframes whenever it is asked for, so it follows every edit.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.inference import surface_rays
from taichi_mrf.inference.footprint import visible_box, window_around
from taichi_mrf.inference.keyframe import Keyframe, VisibleBricks
from taichi_mrf.inference.ray_model import RayModel
from taichi_mrf.inference.ray_posterior import FreeLogs, follow_rays
from taichi_mrf.inference.surface_rays import SCALE, AddDistances, Band, DistanceSums
from taichi_mrf.inference.workers import workers_without_trace
from taichi_mrf.system import runtime
from taichi_mrf.system.memory import check_memory
from taichi_mrf.system.resident import on_host, zeros
from taichi_mrf.voxels.distance_field import DistanceField
from taichi_mrf.voxels.layout import CHUNK, VOXELS, grid_keys
from taichi_mrf.voxels.pool import BrickPool, PoolPart
from taichi_mrf.voxels.window import Window, WindowIndex

BAND_VOXELS = 2.0
BAND_SIGMAS = 3.0

SCOUTS = 4
"""One of so many rays marks the bricks in its band, because each brick is met by many."""

BRICKS_AT_ONCE = 1 << 15
"""Bricks whose sums are in memory together: 400 MB."""

Bricks = NDArray[np.int32]


class SurfaceRays:
    """Follows the rays of keyframes; owns the scratch."""

    def __init__(self, pool: BrickPool | PoolPart, model: RayModel, volume: VolumeConfig) -> None:
        """``model`` is what rays share; its ``floor`` is the density of measurements from anywhere."""
        self.pool, self.model, self.volume = pool, replace(model, end_sigmas=BAND_SIGMAS), volume
        self.band = Band(BAND_VOXELS, BAND_SIGMAS, model.max_depth)
        self._index, self._field_index = WindowIndex(), WindowIndex()
        self._free_logs = FreeLogs.of(pool, model)

    def field(
        self,
        keyframes: Sequence[tuple[Keyframe, VisibleBricks]],
        between: Callable[[], object] = lambda: None,
    ) -> DistanceField:
        """The field of some keyframes, each with the bricks of the map that it sees now. ``between`` is
        called after each keyframe. Raises CapacityError if there is not enough memory."""
        bands = [self.bricks_in_band(keyframe) for keyframe, _ in keyframes]
        bricks = np.concatenate([np.zeros((0, 3), np.int32), *(w.bricks_of(cells) for w, cells in bands)])
        # In the order of chunks, so that those that are summed up together lie together.
        _, first = np.unique(grid_keys(bricks), return_index=True)
        bricks = bricks[first]
        bricks = bricks[np.argsort(grid_keys(bricks // CHUNK), kind="stable")]
        check_memory(12.0 * VOXELS * len(bricks), f"the surface in {len(bricks)} bricks")
        order = np.argsort(grid_keys(bricks))
        place, sums = np.argsort(order), np.zeros((3, len(bricks), VOXELS), np.float32)
        for begin in range(0, len(bricks), BRICKS_AT_ONCE):
            rows = slice(begin, begin + BRICKS_AT_ONCE)
            sums[:, place[rows]] = self._sums(bricks[rows], keyframes, bands, between)
        return DistanceField(bricks[order], *sums)

    def bricks_in_band(self, keyframe: Keyframe) -> tuple[Window, NDArray[np.int32]]:
        """The window around the bands of a keyframe's rays, and its cells in them."""
        image, T = keyframe.image, keyframe.T_world_camera
        beyond_m = 2.0 * self.band.voxels * self.model.voxel_size
        box = visible_box(image, T, self.model.max_depth, self.band.sigmas, beyond_m)
        window = window_around(*box, self.model.voxel_size, self.volume)
        if image.rays == 0 or window is None:
            return keyframe.footprint.window, np.zeros(0, np.int32)
        marks = np.zeros(window.cells, np.int32)
        surface_rays.mark_band(
            keyframe.ray_list, SCOUTS, image.sensor, window.viewpoint(T), window.shape_vector,
            *window.clip_box(self.volume.lower, self.volume.upper), self.band, marks,
        )  # fmt: skip
        runtime.settle()
        return window, np.flatnonzero(marks).astype(np.int32)

    def _sums(
        self,
        bricks: Bricks,
        keyframes: Sequence[tuple[Keyframe, VisibleBricks]],
        bands: Sequence[tuple[Window, NDArray[np.int32]]],
        between: Callable[[], object],
    ) -> NDArray[np.float32]:
        """Weight, distance and excess, both times weight, in some bricks: (3, n, 512)."""
        arrays = [zeros(np.int64, len(bricks) * VOXELS) for _ in range(3)]
        sums = DistanceSums(*arrays)
        keys = grid_keys(bricks)
        order = np.argsort(keys)
        for (keyframe, visible), (window, cells) in zip(keyframes, bands, strict=True):
            wanted = grid_keys(window.bricks_of(cells))
            rows = order[np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)]
            here = keys[rows] == wanted
            if not here.any():
                continue
            cells, slots = cells[here], rows[here].astype(np.int32)
            self._add(keyframe, visible, window, cells, slots, sums)
            between()
        found = np.empty((3, len(bricks), VOXELS), np.float32)
        for array, row in zip(arrays, found, strict=True):
            np.multiply(on_host(array).reshape(row.shape), 1.0 / SCALE, out=row, casting="unsafe")
        return found

    def _add(
        self, keyframe: Keyframe, visible: VisibleBricks, window: Window,
        cells: NDArray[np.int32], slots: NDArray[np.int32], sums: DistanceSums,
    ) -> None:  # fmt: skip
        """Add a keyframe's distances to ``sums``, whose bricks are cells (n) of the window at slots (n)."""
        # The map's bricks in the window of the band.
        crossed = window.cells_of(keyframe.footprint.window.bricks_of(visible.cells))
        inside = crossed >= 0
        if not inside.any():
            return
        self._index.fill(window, crossed[inside], visible.slots[inside])
        self._field_index.fill(window, cells, slots)
        lower, upper = self.volume.lower, self.volume.upper
        follow_rays(
            keyframe.ray_list, keyframe.image.sensor, window.viewpoint(keyframe.T_world_camera),
            self._index.space(window, lower, upper), self.model, self._free_logs, workers_without_trace(),
            AddDistances(self.model.floor, self.band, self._field_index.space(window, lower, upper), sums),
        )  # fmt: skip
        self._index.clear(window, crossed[inside])
        self._field_index.clear(window, cells)
        runtime.settle()
