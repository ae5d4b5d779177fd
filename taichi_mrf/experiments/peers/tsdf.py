"""Open3D's fusion of signed distances (VoxelBlockGrid). It has no probabilities: a voxel within half a voxel
of the surface counts as occupied for certain, one further in front as free, all others as unknown."""

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.synthetic.mesh_scene import MeshScene, TriangleMesh
from taichi_mrf.evaluation.accuracy import OUTLIERS
from taichi_mrf.experiments.peers.peer import Answers, Cells, Knob, Mesh
from taichi_mrf.experiments.scenes import Scene, SceneView
from taichi_mrf.sensor.camera import pinhole
from taichi_mrf.system.libraries import library

BLOCK = 16
"""Voxels along each side of Open3D's blocks."""

MOST_BLOCKS = 2**31 // (16 * BLOCK**3)
"""Open3D makes triangles through a table with four numbers of 32 bits for each voxel of its blocks, and ends
the process if that has more than 2 GiB (0.20, on the CPU)."""

FIRST_BLOCKS = 2000
"""Blocks that the grid has room for at first; it grows by itself."""

LEAST_WEIGHT = 1.0
"""A voxel that one image has seen counts."""

FREE_STATE, OCCUPIED_STATE, UNKNOWN_STATE = 0.0, 1.0, 0.5
"""The state of a voxel in the place of a probability."""


class TsdfPeer:
    """A grid of signed distances; the parameter ``truncation`` is in voxels."""

    def __init__(self, scene: Scene, voxel_size: float, knob: Knob) -> None:
        """Raises TaichiMRFError without Open3D."""
        self._o3d = library("open3d", "the comparison needs", "bench")
        self._scene, self._voxel_size = scene, voxel_size
        self._truncation = float(knob.parameters["truncation"])
        core = self._o3d.core
        self._grid = self._o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight"), (core.float32, core.float32), ((1), (1)), voxel_size, BLOCK, FIRST_BLOCKS
        )
        self.stages_ms: dict[str, float] = {}

    def integration(self, view: SceneView) -> Callable[[], object]:
        """One image: its blocks, and their distances."""
        image = self._o3d.t.geometry.Image(self._o3d.core.Tensor(view.measured_m))
        rest = (*self._camera(view), 1.0, self._scene.max_depth, self._truncation)

        def run() -> None:
            self._grid.integrate(self._grid.compute_unique_block_coordinates(image, *rest), image, *rest)

        return run

    def conclude(self) -> None:
        """Nothing is left to do."""

    def answers(self, view: SceneView) -> Mapping[str, Answers]:
        """Depths at which rays first meet its mesh. Its own casting of rays through blocks (0.20) leaves
        pixels out or ends the process where blocks lie around the camera."""
        found = self._surface.render_depth(view.camera or self._scene.camera, view.T_world_camera)
        depth_m = np.where(found > 0, found, np.nan)
        return {"": Answers(depth_m, self._log_likelihood(view, depth_m))}

    @cached_property
    def _surface(self) -> MeshScene:
        vertices_m, triangles = self.mesh()
        return MeshScene(TriangleMesh(vertices_m, triangles.astype(np.int32)))

    def cells(self, points_m: NDArray[np.float64]) -> Mapping[str, Cells]:
        """By the distance of the voxel that a point lies in."""
        core, table = self._o3d.core, self._grid.hashmap()
        # The values of a block are those at the corners of its voxels.
        nodes = np.rint(points_m / self._voxel_size).astype(np.int64)
        blocks, inside = np.divmod(nodes, BLOCK)
        keys, row = np.unique(blocks, axis=0, return_inverse=True)
        slots, found = table.find(core.Tensor(keys.astype(np.int32)))
        slot = np.where(found.numpy(), slots.numpy(), 0).astype(np.int64)[row.ravel()]
        number = inside[:, 2] * BLOCK**2 + inside[:, 1] * BLOCK + inside[:, 0]
        tsdf, weight = (
            self._grid.attribute(name).numpy().reshape(-1, BLOCK**3)[slot, number]
            for name in ("tsdf", "weight")
        )
        known = found.numpy()[row.ravel()] & (weight >= LEAST_WEIGHT)
        distance = tsdf * self._truncation  # in voxels
        occupied, free = known & (np.abs(distance) <= 0.5), known & (distance > 0.5)
        state = np.select([occupied, free], [OCCUPIED_STATE, FREE_STATE], UNKNOWN_STATE)
        return {"": Cells(state, occupied, free)}

    def mesh(self) -> Mesh:
        """Its own extraction; empty where the grid is too large for it."""
        if self._grid.hashmap().size() >= MOST_BLOCKS:
            return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
        mesh = self._grid.extract_triangle_mesh(weight_threshold=LEAST_WEIGHT)
        vertices = mesh.vertex.positions.numpy().astype(np.float64)
        return vertices, mesh.triangle.indices.numpy().astype(np.int64)

    @property
    def memory_mb(self) -> float:
        """The blocks in use, with a distance and a weight for each voxel."""
        return float(self._grid.hashmap().size() * BLOCK**3 * 2 * 4) / 1e6

    def _camera(self, view: SceneView) -> tuple[Any, Any]:
        """Intrinsics and T_camera_world."""
        k, tensor = pinhole(view.camera or self._scene.camera, "Open3D"), self._o3d.core.Tensor
        K = np.array([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1.0]])
        return tensor(K), tensor(np.linalg.inv(view.T_world_camera))

    def _log_likelihood(self, view: SceneView, depth_m: NDArray[np.floating]) -> float:
        """As JudgedView.log_likelihood has it of a surface that is certain where there is an answer."""
        measured = view.judged & (view.true_m > 0) & (view.measured_m > 0)
        table = self._scene.noise.table(view.camera or self._scene.camera)
        there = np.nan_to_num(depth_m, nan=1.0)
        sigma, bias = table.at_pixels(there)
        off = (view.measured_m - there - bias) / sigma
        anywhere = 1.0 / self._scene.max_depth
        density = np.exp(-0.5 * off**2) / (np.sqrt(2 * np.pi) * sigma)
        explained = np.where(np.isfinite(depth_m), density, anywhere)[measured]
        return float(np.mean(np.log((1.0 - OUTLIERS) * explained + OUTLIERS * anywhere)))
