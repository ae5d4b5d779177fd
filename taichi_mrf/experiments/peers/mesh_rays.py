"""Where the rays of a view first meet a mesh, for systems whose answer is a surface."""

import importlib.util
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.experiments.peers.peer import Mesh
from taichi_mrf.experiments.scenes import SceneView
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.system.libraries import library


def open3d_available() -> bool:
    """Whether Open3D (extra ``bench``) is installed."""
    return importlib.util.find_spec("open3d") is not None


class MeshRays:
    """A mesh that rays can meet, by Open3D's casting. Raises TaichiMRFError without Open3D."""

    def __init__(self, mesh: Mesh) -> None:
        self._o3d: Any = library("open3d", "the comparison needs", "bench")
        self._scene = self._o3d.t.geometry.RaycastingScene()
        vertices_m, triangles = mesh
        if len(triangles):
            corners = self._o3d.core.Tensor(np.ascontiguousarray(vertices_m, np.float32))
            self._scene.add_triangles(
                corners, self._o3d.core.Tensor(np.ascontiguousarray(triangles, np.uint32))
            )

    def depth_m(self, view: SceneView, camera: Camera) -> NDArray[np.float64]:
        """Depth along the rays of a view in metres, (H, W), NaN where a ray meets nothing."""
        T = view.T_world_camera
        directions = camera.rays() @ T[:3, :3].T  # one metre of depth each
        rays = np.concatenate([np.broadcast_to(T[:3, 3], directions.shape), directions], axis=-1)
        found = self._scene.cast_rays(self._o3d.core.Tensor(rays.astype(np.float32)))
        depth_m = found["t_hit"].numpy().astype(np.float64)
        depth_m[~np.isfinite(depth_m)] = np.nan
        return depth_m
