"""Which cells and paths truly hold something, to judge the answers on many voxels by.

A cell of several voxels is *occupied* if one of its voxels is (occupancy_truth.py), and *free* if all are. A
ball, or a path of one, *hits* if a surface that was seen comes nearer than its radius, and *misses* if that
is not so and it meets no voxel that no view shows. All others are not judged.
"""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.evaluation.occupancy_truth import OccupancyTruth
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.libraries import library
from taichi_mrf.voxels.layout import BRICK, VOXELS
from taichi_mrf.voxels.marks import WORDS, Marks

FREE, OCCUPIED, NOT_JUDGED = 0, 1, -1

_POINTS_AT_ONCE = 1 << 20


def occupied_bricks(truth: OccupancyTruth) -> NDArray[np.int32]:
    """The bricks (n, 3) that hold an occupied voxel."""
    some = truth.occupied_marks.reshape(-1, WORDS).any(axis=1)
    return truth.window.bricks_of(np.flatnonzero(some).astype(np.int32))


def true_cells(truth: OccupancyTruth, bricks: NDArray[np.int32], side: int) -> NDArray[np.int8]:
    """FREE, OCCUPIED or NOT_JUDGED for the cells of ``side`` voxels of bricks (n, 3): (n, (8 / side)^3)."""
    cells = truth.window.cells_of(bricks)
    occupied = _in_cells(_bits(truth.occupied_marks, cells), side).any(axis=2)
    free = _in_cells(_bits(truth.free_marks, cells), side).all(axis=2)
    return np.where(occupied, OCCUPIED, np.where(free, FREE, NOT_JUDGED)).astype(np.int8)


def hidden_voxels(truth: OccupancyTruth, bricks: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Which voxels of bricks (n, 3) are hidden, (n, 512)."""
    return _bits(truth.hidden_marks, truth.window.cells_of(bricks))


def _bits(marks: Marks, cells: NDArray[np.int32]) -> NDArray[np.bool_]:
    """The marks of the voxels of a window's cells, (n,) -> (n, 512); none for a cell of -1."""
    words = np.where(cells[:, None] >= 0, marks.reshape(-1, WORDS)[cells], 0).astype("<i4")
    bits = np.unpackbits(words.view(np.uint8), axis=1, bitorder="little")
    return bits.reshape(-1, VOXELS).astype(np.bool_)


def _in_cells(voxels: NDArray[np.bool_], side: int) -> NDArray[np.bool_]:
    """Values of voxels (n, 512) -> (n, cells, side^3)."""
    across = BRICK // side
    parts = voxels.reshape(-1, across, side, across, side, across, side).transpose(0, 1, 3, 5, 2, 4, 6)
    return parts.reshape(len(voxels), across**3, side**3)


class SeenSpace:
    """The surfaces that some views see, and the space that they do not."""

    def __init__(
        self,
        truth: OccupancyTruth,
        clean_depths_m: list[NDArray[np.float32]],
        poses: list[Pose],
        camera: PinholeCamera,
    ) -> None:
        """The arguments are those of occupancy_truth.occupancy_truth, with what it gave. Raises
        TaichiMRFError without SciPy."""
        spatial = library("scipy.spatial", "the truth of paths needs", "mesh")
        image = library("scipy.ndimage", "the truth of paths needs", "mesh")
        self.truth = truth
        ends = [_ends(depth_m, T, camera) for depth_m, T in zip(clean_depths_m, poses, strict=True)]
        self._surface = spatial.cKDTree(np.concatenate(ends), balanced_tree=False, compact_nodes=False)
        window = truth.window
        every = np.arange(window.cells, dtype=np.int32)
        seen = _bits(truth.free_marks, every) | _bits(truth.occupied_marks, every)
        shape = window.shape
        grid = seen.reshape(*shape, BRICK, BRICK, BRICK).transpose(0, 3, 1, 4, 2, 5)
        distance = image.distance_transform_edt(grid.reshape([n * BRICK for n in shape]))
        self._hidden_m = ((distance - 0.5) * window.voxel_size).astype(np.float32)

    def free_points(self, count: int, draw: np.random.Generator) -> NDArray[np.float64]:
        """Points (count, 3) in metres, evenly distributed in the free voxels."""
        voxels = self.truth.free()
        chosen = voxels[draw.integers(0, len(voxels), count)]
        points: NDArray[np.float64] = (chosen + draw.random((count, 3))) * self.truth.window.voxel_size
        return points

    def judge_paths(self, places: NDArray[np.float64], radius_m: float) -> NDArray[np.int8]:
        """Verdict on balls at places (P, N, 3) along paths: OCCUPIED, FREE or NOT_JUDGED, (P,)."""
        points = places.reshape(-1, 3)
        near, unseen = np.empty(len(points)), np.empty(len(points))
        low = np.asarray(self.truth.window.lowest) * BRICK
        for begin in range(0, len(points), _POINTS_AT_ONCE):
            part = slice(begin, begin + _POINTS_AT_ONCE)
            near[part] = self._surface.query(points[part], distance_upper_bound=radius_m)[0]
            voxel = np.floor(points[part] / self.truth.window.voxel_size).astype(np.int64) - low
            inside = ((voxel >= 0) & (voxel < self._hidden_m.shape)).all(axis=1)
            at = np.clip(voxel, 0, np.array(self._hidden_m.shape) - 1)
            unseen[part] = np.where(inside, self._hidden_m[tuple(at.T)], -1.0)
        hit = (near < radius_m).reshape(places.shape[:2]).any(axis=1)
        seen = (unseen > radius_m).reshape(places.shape[:2]).all(axis=1)
        return np.where(hit, OCCUPIED, np.where(seen, FREE, NOT_JUDGED)).astype(np.int8)


def _ends(depth_m: NDArray[np.float32], T: Pose, camera: PinholeCamera) -> NDArray[np.float64]:
    """The points in the world, (n, 3) in metres, at which an image's rays end."""
    measured = np.isfinite(depth_m) & (depth_m > 0)
    measured[1::2], measured[:, 1::2] = False, False  # far denser than any ball
    points: NDArray[np.float64] = camera.rays()[measured] * depth_m[measured][:, None]
    return points @ T[:3, :3].T + T[:3, 3]
