"""OctoMap through its Python binding. Its finished tree is read as a log-odds map, whose values are the same,
so that it answers held-out views by the same rules as ours."""

import tempfile
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf import Config, LogOddsMap
from taichi_mrf.config.schema import SensorConfig
from taichi_mrf.experiments.peers.our_maps import RecursivePeer
from taichi_mrf.experiments.peers.peer import Answers, Cells, Knob, Mesh
from taichi_mrf.experiments.scenes import Scene, SceneView
from taichi_mrf.export.octomap_reader import read_octomap
from taichi_mrf.methods.map_file import MapHeader
from taichi_mrf.methods.recursive import RecursiveContents, write_recursive
from taichi_mrf.system.libraries import library


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
