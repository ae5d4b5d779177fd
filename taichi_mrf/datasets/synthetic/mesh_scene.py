"""A scene that is a triangle mesh in a file: reading it, and taking depth images of it.

Files are read with trimesh and rays are cast by Embree (embreex), which are only needed for meshes and come
with the extra ``mesh``. World frame, metres.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import DatasetError, said
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.origins import origins_of
from taichi_mrf.system.files import exists, is_file
from taichi_mrf.system.libraries import library


@dataclass(frozen=True)
class TriangleMesh:
    """Triangles in the world: ``vertices`` (V, 3) float64 in metres, ``triangles`` (T, 3) int32 indices of
    vertices. They need not be closed, nor wound in any order."""

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int32]

    @property
    def corners(self) -> NDArray[np.float64]:
        """The three corners of each triangle, (T, 3, 3)."""
        return self.vertices[self.triangles]


class MeshScene:
    """A mesh that depth images can be taken of."""

    def __init__(self, mesh: TriangleMesh) -> None:
        """Raises DatasetError if Embree is not installed."""
        self.mesh = mesh
        self._rays = _library("embreex.rtcore_scene")
        self._construction = _library("embreex.mesh_construction")
        # Embree counts in float32, which is most exact around zero.
        corners = mesh.vertices if len(mesh.vertices) else np.zeros((1, 3))
        self._middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))

    @cached_property
    def _tree(self) -> Any:
        # Robust: no ray slips through the common edge of two triangles.
        tree = self._rays.EmbreeScene(robust=True)
        vertices = np.ascontiguousarray(self.mesh.vertices - self._middle, np.float32)
        self._construction.TriangleMesh(tree, vertices, np.ascontiguousarray(self.mesh.triangles, np.int32))
        return tree

    def render_depth(self, camera: Camera, T_world_camera: Pose) -> NDArray[np.float32]:
        """Depth, (H, W) float32 in metres (axial for a pinhole), of the first triangle on the ray through
        each pixel's centre, seen from either side; 0 where a ray meets none."""
        if not len(self.mesh.triangles):
            return np.zeros(camera.shape, np.float32)
        rays = camera.rays()
        directions = (rays.reshape(-1, 3) @ T_world_camera[:3, :3].T).astype(np.float32)
        origins, starts = np.empty_like(directions), origins_of(camera)
        origins[:] = T_world_camera[:3, 3] - self._middle
        if starts is not None:
            turned = np.broadcast_to(starts, rays.shape).reshape(-1, 3) @ T_world_camera[:3, :3].T
            origins += turned.astype(np.float32)
        # Directions are one metre of depth long, so that is what Embree's ray parameter is.
        hit = self._tree.run(origins, directions, query="INTERSECT", output=True)
        return np.where(hit["primID"] >= 0, hit["tfar"], np.float32(0)).reshape(camera.shape)


def load_mesh(path: Path) -> TriangleMesh:
    """Read a triangle mesh from a PLY, OBJ, STL, OFF or glTF file, its parts joined into one.

    Raises DatasetError, whose text names the file, if trimesh is not installed, if the file is missing or
    cannot be read as a mesh, and for a mesh without triangles or with vertices that are not finite.
    """
    trimesh = _library("trimesh")
    if not is_file(path):
        raise DatasetError(f"{path}: {'is not a file' if exists(path) else 'the mesh is missing'}")
    try:
        loaded = trimesh.load_mesh(path, process=False)
        vertices = np.array(loaded.vertices, np.float64).reshape(-1, 3)
        # A point cloud has no faces.
        triangles = np.array(getattr(loaded, "faces", ()), np.int32).reshape(-1, 3)
    except Exception as error:  # trimesh's readers raise many kinds of errors
        raise DatasetError(f"{path}: cannot be read as a mesh: {said(error)}") from error
    if len(triangles) == 0:
        raise DatasetError(f"{path}: contains no triangles")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise DatasetError(f"{path}: a triangle names vertex {triangles.max()} of {len(vertices)}")
    if not np.isfinite(vertices).all():
        raise DatasetError(f"{path}: contains a vertex that is not finite")
    return TriangleMesh(vertices, triangles)


def _library(name: str) -> Any:
    return library(name, "meshes need", "mesh", DatasetError)
