"""The surface that all keyframes of one map have measured, kept up to date as they come, move and go."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.surfels import Surfels, merged, surfels_of
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.system.later import later
from taichi_mrf.voxels.layout import CHUNK_VOXELS, grid_keys

if TYPE_CHECKING:
    from taichi_mrf.alignment import oriented_points
else:
    (oriented_points,) = later("taichi_mrf.alignment", "oriented_points")


class KeyframeSurfels:
    """Surfels by keyframe, in cells of ``cell_size`` metres. Those of keyframes that have not moved are kept;
    those of frozen ones are added up, so that they cost no more than the surface they have seen.

    ``revision`` changes with the surface.
    """

    def __init__(self, cell_size: float, max_depth: float) -> None:
        self.cell_size, self.max_depth, self.revision = cell_size, max_depth, 0
        self._kept: dict[int, tuple[Pose, Surfels]] = {}
        self._frozen: Surfels | None = None

    def update(self, keyframes: Mapping[int, Keyframe], without: int | None = None) -> None:
        """Measure what is new or has moved, and forget what is gone. ``without`` is a keyframe that may
        stay as it is."""
        gone = [id for id in self._kept if id not in keyframes]
        for id in gone:
            del self._kept[id]
        self.revision += len(gone)
        for id, keyframe in keyframes.items():
            if id != without:
                self._measure(keyframe)

    def freeze(self, keyframe: Keyframe) -> None:
        """Keep for good what a keyframe has measured. Before the first :meth:`update` nothing is kept, so
        that maps which are never aligned pay nothing."""
        if not (self._kept or self._frozen is not None):
            return
        self._measure(keyframe)
        _, surfels = self._kept.pop(keyframe.id)
        parts = [surfels] if self._frozen is None else [self._frozen, surfels]
        self._frozen = merged(parts, self.cell_size)

    def frozen_in(self, chunks: NDArray[np.int32]) -> Surfels:
        """Surfels that frozen keyframes have measured in some chunks of 64^3 cells, (n, 3)."""
        if self._frozen is None:
            return merged([], self.cell_size)
        return self._frozen.chosen(self._inside(self._frozen, chunks))

    def release(self, chunks: NDArray[np.int32]) -> None:
        """Remove what frozen keyframes have measured in some chunks, (n, 3)."""
        if self._frozen is not None:
            self._frozen = self._frozen.chosen(~self._inside(self._frozen, chunks))
            self.revision += 1

    def restore(self, surfels: Surfels) -> None:
        """Bring back what was released."""
        if len(surfels.keys):
            parts = [surfels] if self._frozen is None else [self._frozen, surfels]
            self._frozen = merged(parts, self.cell_size)
            self.revision += 1

    @staticmethod
    def _inside(surfels: Surfels, chunks: NDArray[np.int32]) -> NDArray[np.bool_]:
        return np.isin(grid_keys(surfels.cells // CHUNK_VOXELS), grid_keys(chunks))

    def around(
        self, lower_m: NDArray[np.float64], upper_m: NDArray[np.float64], without: int | None = None
    ) -> Surfels:
        """The surface in a box of metres in the world, of all keyframes but perhaps one."""
        parts = [surfels for id, (_, surfels) in self._kept.items() if id != without]
        if self._frozen is not None:
            parts.append(self._frozen)
        return merged([surfels.within(lower_m, upper_m) for surfels in parts], self.cell_size)

    def of(self, ids: Iterable[int]) -> Surfels:
        """The surface that some keyframes have measured, those among them that are known."""
        return merged([self._kept[id][1] for id in ids if id in self._kept], self.cell_size)

    def _measure(self, keyframe: Keyframe) -> None:
        known, T_world_camera = self._kept.get(keyframe.id), keyframe.T_world_camera
        if known is None or known[0] is not T_world_camera:
            points = oriented_points.oriented_points(keyframe.image, self.max_depth)
            self._kept[keyframe.id] = (T_world_camera, surfels_of(points, T_world_camera, self.cell_size))
            self.revision += 1
