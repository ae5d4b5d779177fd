"""True occupancy of voxels, to judge a map's probabilities by: which have a surface, which are free.

A voxel is *occupied* if a surface passes through it and a clean ray ends there. It is *free* if a clean ray
crosses it and no surface touches it. All other voxels are not judged: no view shows what lies inside solids
or is hidden, and a surface in the plane between two voxels is in neither: which of them holds it is a matter
of rounding.
A voxel is *hidden* if no clean ray reaches it and no surface touches it: a map that is occupied there has
walls that are too thick. Voxels are those of the map's grid: voxel i covers [i, i + 1) times the voxel size
along each axis.
"""

# ruff: noqa: ANN202 - Taichi does not allow `-> None` on a kernel or a func.

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.synthetic.mesh_scene import TriangleMesh
from taichi_mrf.errors import FrameError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.rays import CameraRays
from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, F32Array, I32Array, IVec3, Struct, Template
from taichi_mrf.voxels.layout import BRICK, CHUNK
from taichi_mrf.voxels.marks import (
    WORDS,
    Marks,
    blocks,
    count,
    mark,
    mark_triangles,
    marked_voxels,
    no_marks,
    voxel_in_window,
)
from taichi_mrf.voxels.numbering import flat
from taichi_mrf.voxels.traversal import Space, Viewpoint, clip, pixel_ray, walk_voxels, within
from taichi_mrf.voxels.window import Window

SLACK = 0.01
"""In voxels: a ray ends in all voxels that lie this close to its end along the ray, and crosses none there.
Rounding decides nothing then where a surface lies in the plane between voxels."""


@dataclass(frozen=True)
class OccupancyTruth:
    """True states of a window's voxels where they are certain, one bit each: :func:`occupancy_truth`."""

    window: Window
    occupied_marks: Marks
    free_marks: Marks
    hidden_marks: Marks

    @property
    def counts(self) -> tuple[int, int]:
        """Number of occupied voxels, and number of free ones."""
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


@dataclass(frozen=True)
class SeenVoxels:
    """Marks of the voxels of ``window`` that rays pass through in front of their end, for some length, and
    of those that they end in."""

    window: Window
    crossed: Marks
    ended: Marks


def seen_voxels(
    depths_m: Sequence[NDArray[np.float32]], poses: Sequence[Pose], camera: PinholeCamera, voxel_size: float
) -> SeenVoxels:
    """Follow all rays of clean axial depth images (H, W), taken at poses T_world_camera, from the camera to
    the surface. A pixel of 0 or NaN has no ray.

    Taichi has to run. Raises FrameError if there are not as many poses as images or an image is not of the
    camera's size, CapacityError if the space that the images see has too many voxels.
    """
    if len(depths_m) != len(poses):
        raise FrameError(f"{len(depths_m)} clean depth images do not match {len(poses)} poses")
    images = [_checked(depth_m, camera) for depth_m in depths_m]
    lower_m, upper_m = _box(images, poses, camera)
    window = Window.covering(lower_m - SLACK * voxel_size, upper_m + SLACK * voxel_size, voxel_size)
    crossed, ended = no_marks(window), no_marks(window)
    bricks, chunks = ti.ndarray(ti.i32, window.cells), ti.ndarray(ti.i32, window.cells // CHUNK**3)
    _enter_all(bricks, chunks)
    space = Space(window.shape_vector, *window.clip_box(None, None), chunks, bricks)
    for image, T_world_camera in zip(images, poses, strict=True):
        _see(image, camera.in_kernels(), window.viewpoint(T_world_camera), space, crossed, ended)
        # Makes 30 views of a room 3 to 4 times as fast as walking through every voxel for every ray.
        _leave_finished(crossed, window.shape_vector, bricks, chunks)
    found = SeenVoxels(window, crossed.to_numpy(), ended.to_numpy())
    runtime.settle()
    return found


def _checked(depth_m: NDArray[np.float32], camera: PinholeCamera) -> NDArray[np.float32]:
    """Pixels row by row, (H * W,), 0 where there is no depth."""
    depth_m = np.asarray(depth_m, np.float32)
    if depth_m.shape != camera.shape:
        raise FrameError(f"clean depth of shape {depth_m.shape} does not fit a camera of {camera.shape}")
    return np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, np.float32(0)).ravel()


def _box(
    images: Sequence[NDArray[np.float32]], poses: Sequence[Pose], camera: PinholeCamera
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two corners, in metres, of an upright box around all rays; around the origin if there is none."""
    rays = camera.rays().reshape(-1, 3).T
    corners = [np.zeros(3)] if not poses else []
    for image, T_world_camera in zip(images, poses, strict=True):
        # A pixel without a ray counts as the camera's place, which is part of the box anyway.
        ends = [image * (axis @ rays) for axis in T_world_camera[:3, :3]]
        for extreme in (np.min, np.max):
            corners.append(T_world_camera[:3, 3] + [extreme(along) for along in ends])
    return np.min(corners, axis=0), np.max(corners, axis=0)


@ti.dataclass
class _Nothing(Struct):
    unused: I32


@ti.func
def _cross(state: Template, crossed: Template, voxel: I32, t: F32, t_leave: F32):
    """One voxel of a ray."""
    mark(crossed, voxel)
    return 1


@kernel
def _see(
    depth: F32Array, camera: CameraRays, view: Viewpoint, space: Space, crossed: I32Array, ended: I32Array
) -> None:
    """Mark the voxels that each ray crosses, and those that it ends in.

    ``depth`` is (H * W) metres, 0 for a pixel without a ray. All bricks of the ``space`` exist, but those
    whose voxels have all been crossed; ``crossed`` and ``ended`` are marks of its window (voxels/marks.py).
    """
    for pixel in range(depth.shape[0]):
        depth_here = depth[pixel]
        if depth_here > 0.0:
            u, v = camera.pixel(pixel)
            ray = pixel_ray(camera, view, u, v)
            slack = SLACK / ray.direction.norm()
            begin, end = 0.0, depth_here - slack
            clip(ray, begin, end, space.lower, space.upper)
            state = _Nothing(0)
            walk_voxels(ray, begin, end, space, _cross, state, crossed)
            for side in ti.static((-1, 0, 1)):
                cell = ti.floor(view.centre + (depth_here + side * slack) * ray.direction, ti.i32)
                if within(cell, space.shape * BRICK):
                    mark(ended, voxel_in_window(cell, space.shape))


@ti.kernel
def _enter_all(bricks: I32Array, chunks: I32Array):
    """Make all bricks of a window exist: ``bricks`` and ``chunks`` of traversal.Space, with bricks
    counted."""
    for brick in range(bricks.shape[0]):
        bricks[brick] = brick
    for chunk in range(chunks.shape[0]):
        chunks[chunk] = CHUNK * CHUNK * CHUNK


@ti.kernel
def _leave_finished(crossed: I32Array, shape: IVec3, bricks: I32Array, chunks: I32Array):
    """Take bricks whose voxels have all been crossed out of what rays walk through."""
    for brick in range(bricks.shape[0]):
        finished = ti.cast(bricks[brick] >= 0, ti.i32)
        word = 0
        while finished == 1 and word < WORDS:
            finished = ti.cast(crossed[brick * WORDS + word] == -1, ti.i32)
            word += 1
        if finished == 1:
            bricks[brick] = -1
            cell = IVec3(brick // (shape[1] * shape[2]), brick // shape[2] % shape[1], brick % shape[2])
            ti.atomic_sub(chunks[flat(cell // CHUNK, shape // CHUNK)], 1)
