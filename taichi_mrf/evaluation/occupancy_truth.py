"""True occupancy of voxels, to judge a map's probabilities by: which have a surface, which are free.

A voxel is *occupied* if a surface passes through it and a clean ray ends there. It is *free* if a clean ray
crosses it and no surface touches it. All other voxels are not judged: no view shows what lies inside solids
or is hidden, and a surface in the plane between two voxels is in neither: which of them holds it is a matter
of rounding.
A voxel is *hidden* if no clean ray reaches it and no surface touches it: a map that is occupied there has
walls that are too thick. Voxels are those of the map's grid: voxel i covers [i, i + 1) times the voxel size
along each axis.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.synthetic.mesh_scene import TriangleMesh
from taichi_mrf.evaluation.seen_voxels import SLACK, seen_voxels
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system import runtime
from taichi_mrf.voxels.marks import Marks, blocks, count, marked_voxels, no_marks
from taichi_mrf.voxels.triangles import mark_triangles
from taichi_mrf.voxels.window import Window


@dataclass(frozen=True)
class OccupancyTruth:
    """True states of a window's voxels where they are certain, one bit each: :func:`occupancy_truth`."""

    window: Window
    occupied_marks: Marks
    free_marks: Marks
    hidden_marks: Marks

    @property
    def counts(self) -> tuple[int, int]:
        """How many voxels are occupied, and how many are free."""
        return count(self.occupied_marks), count(self.free_marks)

    def occupied(self) -> NDArray[np.int32]:
        """Coordinates of all occupied voxels, (n, 3), in lexicographic order."""
        return marked_voxels(self.occupied_marks, self.window)

    def free(self) -> NDArray[np.int32]:
        """Coordinates of all free voxels, (n, 3), in lexicographic order: many, :meth:`blocks` takes less."""
        return marked_voxels(self.free_marks, self.window)

    def blocks(self) -> Iterator[tuple[NDArray[np.float64], NDArray[np.bool_]]]:
        """All judged voxels, at most 2 million at a time: centres (n, 3) in metres, and whether each is
        occupied (else it is free), (n,)."""
        for marks, occupied in ((self.occupied_marks, True), (self.free_marks, False)):
            for voxels in blocks(marks, self.window):
                centres = (voxels.astype(np.float64) + 0.5) * self.window.voxel_size
                yield centres, np.full(len(voxels), occupied, np.bool_)


def occupancy_truth(
    mesh: TriangleMesh,
    clean_depths_m: Sequence[NDArray[np.float32]],
    poses: Sequence[Pose],
    camera: PinholeCamera,
    voxel_size: float,
) -> OccupancyTruth:
    """True occupancy of the voxels that some view sees, from the scene's mesh and its clean depth images.

    ``clean_depths_m`` are (H, W) axial depths taken at ``poses`` T_world_camera; a pixel of 0 or NaN has no
    ray, so a pixel that the sensor cannot measure is left out by setting it to 0. Taichi has to run. Raises
    FrameError for images and poses that do not fit, CapacityError for a space of too many voxels.
    """
    seen = seen_voxels(clean_depths_m, poses, camera, voxel_size)
    surface = _surface_marks(mesh, seen.window, -SLACK)
    touched = _surface_marks(mesh, seen.window, SLACK)
    hidden = ~(seen.crossed | seen.ended | touched)
    return OccupancyTruth(seen.window, surface & seen.ended, seen.crossed & ~touched, hidden)


def surface_voxels(mesh: TriangleMesh, voxel_size: float) -> NDArray[np.int32]:
    """Coordinates of all voxels that a triangle passes through, (n, 3), in lexicographic order.

    Exact, by the overlap of triangle and box; a surface in the plane between two voxels is in the upper one.
    Taichi has to run. Raises CapacityError if the mesh's box has too many voxels.
    """
    corners = mesh.corners.reshape(-1, 3)
    window = Window.covering(corners.min(axis=0), corners.max(axis=0), voxel_size)
    return marked_voxels(_surface_marks(mesh, window, 0.0), window)


def _surface_marks(mesh: TriangleMesh, window: Window, grown: float) -> Marks:
    marks = no_marks(window)
    mark_triangles(mesh.corners, window, marks, grown)
    found = marks.to_numpy()
    runtime.settle()
    return found
