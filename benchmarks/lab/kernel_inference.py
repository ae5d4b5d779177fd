"""Occupancy by Bayesian generalized kernel inference (Doherty, Wang and Englot, ICRA 2017): BGKOctoMap's
model, as a rival in the table of ROC areas.

Measured points are samples of occupied space, points on the rays in front of them samples of free space. A
cell's probability is the share of the occupied ones among all samples near its centre, each with a weight
that falls to nothing at the kernel's length.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf import FREE, OCCUPIED, UNKNOWN
from taichi_mrf.evaluation.experiments.scenes import SceneView
from taichi_mrf.system.libraries import library

LENGTHS_M, SPACINGS_M = (0.1, 0.2, 0.4, 0.8), (0.1, 0.25, 0.5)
"""Lengths of the kernel and spacings of free samples that are tried."""


@dataclass(frozen=True)
class KernelModel:
    """The parameters, as la3dm's configuration for this method has them."""

    length_m: float = 0.2
    """Samples further than this from a cell's centre do not count."""

    spacing_m: float = 0.5
    """Between the samples of free space on a ray, and from the last of them to the measured point."""

    grain_m: float = 0.1
    """The samples of one scan in a cube of this size are replaced by their mean."""

    prior: float = 0.001
    """Count of either state without any sample."""

    def weights(self, distance_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """The sparse kernel of distances up to ``length_m``: 1 at 0, falling to 0."""
        r = distance_m / self.length_m
        return (2 + np.cos(2 * math.pi * r)) / 3 * (1 - r) + np.sin(2 * math.pi * r) / (2 * math.pi)

    def candidates(self) -> list["KernelModel"]:
        """The models that tuning tries."""
        return [replace(self, length_m=a, spacing_m=b) for a in LENGTHS_M for b in SPACINGS_M]

    def in_words(self) -> str:
        """Tuned parameters."""
        return f"length {self.length_m * 100:g} cm, spacing {self.spacing_m * 100:g} cm"


class KernelMap:
    """The map of some scans, which is asked for points and computes their cells then. Raises ExtraError
    without SciPy."""

    def __init__(self, model: KernelModel, voxel_size: float, views: Sequence[SceneView]) -> None:
        spatial = library("scipy.spatial", "kernel inference needs", "mesh")
        self.model, self.voxel_size, self._tree_of = model, voxel_size, spatial.cKDTree
        sampled = [samples_of(view, model) for view in views]
        self._samples = [self._tree_of(np.concatenate(of_all)) for of_all in zip(*sampled, strict=True)]

    @property
    def marginals(self) -> "KernelMap":
        return self

    def occupancy(self, points: ArrayLike) -> NDArray[np.float32]:
        """Probability that the cells of points (N, 3) are occupied, (N,)."""
        occupied, free = self._counts(points)
        return (occupied / (occupied + free)).astype(np.float32)

    def state(self, points: ArrayLike) -> NDArray[np.int8]:
        """OCCUPIED, FREE, or UNKNOWN where no sample is near, (N,)."""
        occupied, free = self._counts(points)
        known = occupied + free > 2 * self.model.prior
        return np.where(known, np.where(occupied > free, OCCUPIED, FREE), UNKNOWN).astype(np.int8)

    def _counts(self, points: ArrayLike) -> list[NDArray[np.float64]]:
        """The weights of occupied and of free samples, with the prior, of the cells of points."""
        cells, cell_of = np.unique(
            np.floor(np.asarray(points, np.float64) / self.voxel_size), axis=0, return_inverse=True
        )
        centres = self._tree_of((cells + 0.5) * self.voxel_size)
        counts: list[NDArray[np.float64]] = []
        for samples in self._samples:
            near = centres.sparse_distance_matrix(samples, self.model.length_m, output_type="coo_matrix")
            weights = np.bincount(near.row, self.model.weights(near.data), minlength=len(cells))
            counts.append((self.model.prior + weights.astype(np.float64))[cell_of.reshape(-1)])
        return counts


def samples_of(view: SceneView, model: KernelModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points that one scan says to be occupied (N, 3) and free (M, 3), in metres in the world."""
    camera = view.camera
    assert camera is not None  # each scan has rays of its own
    T, seen = view.T_world_camera, view.judged
    ends = camera.rays()[seen] * view.measured_m[seen].astype(np.float64)[:, None]
    ends = _thinned(ends @ T[:3, :3].T + T[:3, 3], model.grain_m)
    ways = ends - T[:3, 3]
    range_m = np.linalg.norm(ways, axis=1)
    steps_m = np.arange(model.spacing_m, max(range_m.max(), 2 * model.spacing_m), model.spacing_m)
    at_m = np.column_stack([np.tile(steps_m, (len(ends), 1)), range_m - model.spacing_m])
    ray, step = np.nonzero((at_m > 0) & (at_m <= range_m[:, None] - model.spacing_m))
    free = T[:3, 3] + ways[ray] * (at_m[ray, step] / range_m[ray])[:, None]
    return ends, _thinned(free, model.grain_m)


def _thinned(points_m: NDArray[np.float64], grain_m: float) -> NDArray[np.float64]:
    """The mean of the points (N, 3) in each cube of a grid."""
    _, cube, count = np.unique(np.floor(points_m / grain_m), axis=0, return_inverse=True, return_counts=True)
    sums = [np.bincount(cube.reshape(-1), points_m[:, axis], minlength=len(count)) for axis in range(3)]
    return np.stack(sums, axis=1) / count[:, None]
