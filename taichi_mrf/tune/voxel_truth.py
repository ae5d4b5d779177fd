"""True occupancy of voxels, for rendered sequences, whose scene is known."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets import Dataset
from taichi_mrf.datasets.synthetic.mesh_scene import TriangleMesh
from taichi_mrf.evaluation.occupancy_scores import reliability_bins
from taichi_mrf.evaluation.occupancy_truth import OccupancyTruth, occupancy_truth
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.sensor.camera import PinholeCamera, pinhole

MOST_VOXELS = 2_000_000
"""Most voxels that are compared; of more, every second, third, ... one is."""

_KEPT_SIZES = 4
"""Voxel sizes whose truth is kept in memory."""


class VoxelTruth:
    """The true occupancy of the voxels in some noiseless views, at any voxel size."""

    def __init__(
        self,
        mesh: TriangleMesh,
        clean_depths_m: Sequence[NDArray[np.float32]],
        poses: Sequence[Pose],
        camera: PinholeCamera,
    ) -> None:
        """The arguments are those of evaluation.occupancy_truth.occupancy_truth."""
        self._scene = (mesh, tuple(clean_depths_m), tuple(poses), camera)
        self._known: dict[float, OccupancyTruth] = {}

    def calibration_error(self, m: OccupancyMap) -> float:
        """Expected calibration error of a map's probabilities over the voxels whose truth is known."""
        probability: list[NDArray[np.float32]] = []
        occupied: list[NDArray[np.bool_]] = []
        known = self._at(m.voxel_size)
        step = -(-sum(known.counts) // MOST_VOXELS)
        for centres, truth in known.blocks():
            probability.append(m.occupancy(centres[::step]))
            occupied.append(truth[::step])
        if not probability:
            return float("nan")
        return reliability_bins(np.concatenate(probability), np.concatenate(occupied)).calibration_error

    def _at(self, voxel_size: float) -> OccupancyTruth:
        if voxel_size not in self._known:
            if len(self._known) == _KEPT_SIZES:
                del self._known[next(iter(self._known))]
            self._known[voxel_size] = occupancy_truth(*self._scene, voxel_size)
        return self._known[voxel_size]


def truth_of(dataset: Dataset, indices: Sequence[int]) -> VoxelTruth | None:
    """The true occupancy of the voxels that some frames of a dataset see; None for a real recording and for a
    scene in which something moves."""
    mesh = _mesh_of(dataset)
    if mesh is None:
        return None
    source = dataset  # SyntheticRoom or MeshSequence, which alone have what follows
    depths = [source.clean_depth(index) for index in indices]  # type: ignore[attr-defined]
    poses = [source.pose(index) for index in indices]
    return VoxelTruth(mesh, depths, poses, pinhole(dataset.camera, "the truth of a rendered scene"))


def _mesh_of(dataset: Dataset) -> TriangleMesh | None:
    # Imported late: most sequences are recorded, and have nothing of the kind.
    from taichi_mrf.datasets.synthetic.mesh_scene import scene_mesh
    from taichi_mrf.datasets.synthetic.mesh_sequence import MeshSequence
    from taichi_mrf.datasets.synthetic.room import SyntheticRoom

    if isinstance(dataset, SyntheticRoom):
        return scene_mesh(dataset.scene) if dataset.moving_scene is None else None
    return dataset.scene.mesh if isinstance(dataset, MeshSequence) else None
