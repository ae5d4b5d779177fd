"""The systems and their settings, from fast to thorough.

OctoMap runs through its Python binding. Its finished tree is read as a log-odds map, whose values are the
same, so that it answers held-out views by the same rules as ours. Open3D's fusion of signed distances
(VoxelBlockGrid) has no probabilities: a voxel within half a voxel of the surface counts as occupied for
certain, one further in front as free, all others as unknown.
"""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf import Config, LogOddsMap
from taichi_mrf.config.schema import SensorConfig
from taichi_mrf.datasets.lidar.scans import LIDAR_PASS_THROUGH
from taichi_mrf.datasets.synthetic.mesh_scene import MeshScene, TriangleMesh
from taichi_mrf.evaluation.accuracy import OUTLIERS
from taichi_mrf.evaluation.experiments.peers.our_maps import (
    BONXAI,
    NO_OTHERS,
    MrfPeer,
    RecursivePeer,
    log_odds,
    visibility,
    wavemap,
)
from taichi_mrf.evaluation.experiments.peers.peer import Answers, Cells, Knob, Mesh, System
from taichi_mrf.evaluation.experiments.scenes import Scene, SceneView
from taichi_mrf.export.octomap_reader import read_octomap
from taichi_mrf.methods.map_file import MapHeader
from taichi_mrf.methods.recursive import RecursiveContents, write_recursive
from taichi_mrf.sensor.camera import pinhole
from taichi_mrf.system.libraries import library

ALONE = {"renew_tolerance": NO_OTHERS}
"""Earlier keyframes keep their messages."""

MRF = "MRFMap"
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


class OctomapPeer:
    """A tree with OctoMap's defaults. The parameter ``discretise`` casts one ray for each voxel that is hit,
    instead of one for each point."""

    def __init__(self, scene: Scene, voxel_size: float, knob: Knob) -> None:
        """Raises TaichiMRFError without pyoctomap."""
        self._tree: Any = library("pyoctomap", "the comparison needs", "bench").OcTree(voxel_size)
        self._scene, self._voxel_size = scene, voxel_size
        self._discretise = bool(knob.parameters.get("discretise", False))
        self.stages_ms: dict[str, float] = {}

    def integration(self, view: SceneView) -> Callable[[], object]:
        """One cloud in the world's frame; what lies beyond the scene's range is left out."""
        T, camera = view.T_world_camera, view.camera or self._scene.camera
        measured = (view.measured_m > 0) & (view.measured_m <= self._scene.max_depth)
        points_m = (camera.rays() * view.measured_m[..., None].astype(np.float64))[measured]
        points_m = np.ascontiguousarray(points_m @ T[:3, :3].T + T[:3, 3])
        origin_m = np.ascontiguousarray(T[:3, 3])
        return lambda: self._tree.insertPointCloud(points_m, origin_m, -1.0, False, self._discretise)

    def conclude(self) -> None:
        """Nothing is left to do."""

    def answers(self, view: SceneView) -> Mapping[str, Answers]:
        """As a log-odds map answers."""
        return self._read.answers(view)

    def cells(self, points_m: NDArray[np.float64]) -> Mapping[str, Cells]:
        """As a log-odds map answers."""
        return self._read.cells(points_m)

    def mesh(self) -> Mesh:
        """Surface where the probability is one half."""
        return self._read.mesh()

    @property
    def memory_mb(self) -> float:
        """The tree's own figure."""
        return float(self._tree.memoryUsage()) / 1e6

    @cached_property
    def _read(self) -> RecursivePeer:
        scene = self._scene
        sensor = SensorConfig(max_depth=scene.max_depth)
        config = Config(self._voxel_size, LogOddsMap.METHOD.name, sensor=sensor, volume=scene.volume)
        with tempfile.TemporaryDirectory() as folder:
            tree, file = Path(folder) / "tree.ot", Path(folder) / "map.npz"
            self._tree.write(str(tree))
            bricks, log_odds = read_octomap(tree).bricks()
            header = MapHeader(config, scene.noise, [], 0)
            write_recursive(file, RecursiveContents(header, bricks, log_odds, stale=False))
            return RecursivePeer(LogOddsMap.load(file), scene)


def systems(lidar: bool) -> Sequence[System]:
    """All of them; on a lidar without those that take images only."""
    return [system for system in (_mrf(lidar), *_OTHERS) if not (lidar and system.images_only)]


def _mrf(lidar: bool) -> System:
    beam = {"pass_through": LIDAR_PASS_THROUGH} if lidar else {}
    coarse = Knob("1/8, 0.25 rays per cm, alone", 8, {"ray_density": 0.25, **ALONE, **beam})
    standard = Knob("all pixels, re-inference", 1, beam, standard=True)
    knobs = [
        coarse.of_keyframes(),
        coarse,
        Knob("1/8, 0.5 rays per cm, alone", 8, {"ray_density": 0.5, **ALONE, **beam}),
        Knob("1/4, 1 ray per cm, alone", 4, {"ray_density": 1.0, **ALONE, **beam}),
        Knob("1/2, re-inference", 2, beam),
        Knob("all pixels, alone", 1, {**ALONE, **beam}),
        standard.of_keyframes(),
        standard,
        Knob("all pixels, three full sweeps", 1, {"full_sweeps": 3, **ALONE, **beam}),
    ]
    return System(MRF, MrfPeer, knobs)


def _strided(strides: Sequence[int], **parameters: object) -> list[Knob]:
    """A setting for each stride; the one with all pixels is the standard."""
    return [Knob(_pixels(stride), stride, parameters, standard=stride == 1) for stride in strides]


def _octomap() -> list[Knob]:
    """One ray for each voxel that is hit, and at last one for each pixel."""
    cheap = [
        Knob(f"{_pixels(stride)}, a ray per voxel", stride, {"discretise": True}) for stride in (8, 4, 1)
    ]
    full = Knob("all pixels", 1, standard=True)
    return [*cheap, full.of_keyframes(), full]


def _tsdf() -> list[Knob]:
    """A narrow truncation, which suits coarse voxels better, and Open3D's default of 8 voxels."""
    narrow, wide = {"truncation": 4.0}, {"truncation": 8.0}
    full = Knob("all pixels", 1, narrow, standard=True)
    thin = Knob("1/4", 4, narrow)
    return [thin.of_keyframes(), thin, full, Knob("all pixels, truncation 8", 1, wide)]


def _pixels(stride: int) -> str:
    return f"1/{stride}" if stride > 1 else "all pixels"


_OTHERS = (
    System("OctoMap", OctomapPeer, _octomap()),
    System("hit/miss (Bonxai)", log_odds, _strided((8, 4, 1), **BONXAI)),
    System("log-odds", log_odds, _strided((8, 4, 1))),
    System("visibility", visibility, _strided((4, 1))),
    System("wavemap's model", wavemap, _strided((8, 4, 1))),
    System("TSDF (Open3D)", TsdfPeer, _tsdf(), images_only=True),
)
