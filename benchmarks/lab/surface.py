"""The surface of a map against the truth, and against the surface that Open3D fuses from the same images.

Every second view makes the map. Open3D's VoxelBlockGrid (of the extra bench) is given the truncation and the
weight threshold under which it scores best, which a user cannot know.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf import MRFMap, PolynomialNoise, open_dataset
from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.evaluation.experiments.folds import Experiment, require_views
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.experiments.peers.systems import BLOCK, MOST_BLOCKS
from taichi_mrf.evaluation.experiments.scenes import Scene, SceneView, coffin_scene, house_scene
from taichi_mrf.evaluation.surface_scores import SurfaceScores, SurfaceTruth, surface_truth
from taichi_mrf.evaluation.tables import Entry, Table, write_table
from taichi_mrf.export.surface import smooth_surface
from taichi_mrf.sensor.noise import NoiseModel
from taichi_mrf.sensor.simulate import KINECT_1_LATERAL, simulate, simulate_model
from taichi_mrf.system import runtime
from taichi_mrf.system.libraries import library

ROOM = "synthetic:room?frames=40&width=640&height=480&noise=none"

TRUNCATIONS = (4.0, 8.0, 16.0)
"""Truncations in voxels that Open3D is tried with,"""

WEIGHTS = (1.0, 2.0, 3.0)
"""and least weights of a voxel, in images."""

SURFACE, MARGINAL = "MRFMap, surface", "MRFMap, marginal 0.5"

Mesh = tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float32] | None]

COLUMNS = ("F 2 cm", "F 5 cm", "error cm", "near truth", "found", "normals deg", "in 1 std", "in 2 std", "s")


def run_surface(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """A row for each scene, voxel size and surface."""
    rows: list[list[Entry]] = []
    cases = _cases(experiment)
    for number, case in enumerate(cases):
        for size in experiment.voxel_sizes:
            experiment.report(f"{case.name}, {size * 100:g} cm", number, len(cases))
            key = (
                f"surface | {case.name} | {experiment.limit} views | noise {experiment.seeds[0]} | {size:g} m"
            )
            result = experiment.ledger.result(key, lambda c=case, v=size: _measured(c.scene, c.truth, v))  # type: ignore[misc]
            rows += [[case.name, f"{size * 100:g} cm", *row] for row in result["rows"]]
    notes = [
        "Every second view makes the map. F is the harmonic mean of two shares: of the surface that lies "
        "near the truth, and of the visible truth that lies near the surface (near truth and found, both at "
        "2 cm). In 1 and 2 std: vertices whose error is within so many of their standard deviations. "
        "s: seconds for the surface alone, of an inferred map, and for Open3D's fusion and extraction."
    ]
    table = Table(
        "surface", "Surfaces against the truth", ["scene", "voxels", "surface", *COLUMNS], rows, notes
    )
    return [table], write_table(experiment.out, table)


@dataclass(frozen=True)
class _Case:
    """A scene, made when it is needed."""

    name: str
    make: Callable[[], Scene]

    @cached_property
    def scene(self) -> Scene:
        scene = self.make()
        require_views(scene, 2)
        return scene

    @cached_property
    def truth(self) -> SurfaceTruth:
        views = self.scene.views
        depths, poses = [view.true_m for view in views], [view.T_world_camera for view in views]
        return surface_truth(
            depths, poses, self.scene.pinhole, _used(self.scene), [view.judged for view in views]
        )


def _cases(experiment: Experiment) -> Sequence[_Case]:
    """The scenes."""
    data, seed, limit = experiment.data, experiment.seeds[0], experiment.limit
    return [
        _Case("house, Kinect 1", lambda: house_scene(data, seed, limit)),
        _Case("coffin, D435", lambda: coffin_scene(data, seed)),
        _Case("room, Kinect 1", lambda: room_scene(None, seed, limit)),
        _Case("room, D435", lambda: room_scene(coffin_scene(data).noise, seed, limit)),
    ]


def room_scene(noise: NoiseModel | None, seed: int, limit: int | None = None) -> Scene:
    """The built-in room, measured with a noise model, by default as a Kinect 1 measures."""
    runtime.init()
    room: Any = open_dataset(ROOM, color=False)
    views = []
    for i in range(len(room))[:limit]:
        true = room.clean_depth(i)
        if noise is None:
            measured = simulate(true, room.camera, KINECT_1_LATERAL, seed=(seed, i))
        else:
            measured = simulate_model(true, room.camera, noise, seed=1000 * seed + i)
        views.append(SceneView(room.frame_names[i], room.pose(i), measured, true, true > 0))
    model = noise or PolynomialNoise(KINECT_1_LATERAL.sigma, KINECT_1_LATERAL.bias)
    return Scene("room", room.camera, model, VolumeConfig(), 10.0, views)


def _used(scene: Scene) -> range:
    return range(0, len(scene.views), 2)


def _measured(scene: Scene, truth: SurfaceTruth, voxel_size: float) -> Result:
    m = MRFMap(voxel_size, scene.noise, volume=scene.volume, max_depth=scene.max_depth)
    for i in _used(scene):
        view = scene.views[i]
        m.add_keyframe(view.measured_m, view.T_world_camera, scene.camera, view.name)
    m.infer()
    m.surface()  # compiles
    lower, upper = scene.volume.lower, scene.volume.upper

    def judged(name: str, make: Callable[[], Mesh]) -> tuple[SurfaceScores, list[Entry]]:
        begin = time.perf_counter()
        vertices, triangles, std_m = make()
        seconds = time.perf_counter() - begin
        if lower is not None and upper is not None:  # Open3D knows no volume
            beyond = np.maximum(np.asarray(lower) - vertices, vertices - np.asarray(upper)).max(axis=1)
            triangles = triangles[beyond[triangles].max(axis=1) <= 0]
        s = truth.scores(vertices, triangles, std_m)
        row: list[Entry] = [name, s.f_2cm, s.f_5cm, 100 * s.accuracy_m, s.precision_2cm, s.found_2cm,
                            s.normals_deg, s.within_1_std, s.within_2_std, seconds]  # fmt: skip
        return s, row

    rows = [judged(SURFACE, lambda: _fused(m))[1], judged(MARGINAL, lambda: _marginal(m))[1]]
    images = [(scene.views[i].measured_m, scene.views[i].T_world_camera) for i in _used(scene)]
    best: tuple[float, list[Entry]] | None = None
    for truncation in TRUNCATIONS:
        grid = Open3DGrid(scene, voxel_size, truncation, len(images))
        seconds = grid.fuse(images)
        if grid.blocks >= MOST_BLOCKS:
            continue
        for least in WEIGHTS:
            name = f"Open3D, {truncation:g} voxels, weight {least:g}"
            scores, row = judged(name, lambda g=grid, w=least: g.mesh(w))  # type: ignore[misc]
            row[-1] = float(row[-1]) + seconds  # type: ignore[arg-type]
            if best is None or scores.f_2cm > best[0]:
                best = scores.f_2cm, row
    return {"rows": [*rows, best[1]] if best is not None else rows}


def _fused(m: MRFMap) -> Mesh:
    surface = m.surface()
    return surface.vertices_m, surface.triangles, surface.std_m


def _marginal(m: MRFMap) -> Mesh:
    surface = smooth_surface(m, 0.5)
    return surface.vertices_m, surface.triangles, None


class Open3DGrid:
    """Open3D's fusion of signed distances (VoxelBlockGrid)."""

    def __init__(self, scene: Scene, voxel_size: float, truncation: float, images: int) -> None:
        """``truncation`` in voxels. Raises TaichiMRFError without Open3D."""
        self._o3d = library("open3d", "the comparison needs", "bench")
        core = self._o3d.core
        k = scene.pinhole
        self._K = core.Tensor([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]], core.float64)
        self._grid = self._o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight"), (core.float32, core.float32), ((1), (1)), voxel_size, BLOCK, 50_000
        )
        self._truncation, self._max_depth = truncation, scene.max_depth

    def fuse(self, images: Sequence[tuple[NDArray[np.float32], NDArray[np.float64]]]) -> float:
        """Integrate depth images (H, W) in metres with their T_world_camera; returns the seconds."""
        begin = time.perf_counter()
        for depth_m, T_world_camera in images:
            tensor = self._o3d.core.Tensor
            image = self._o3d.t.geometry.Image(tensor(np.ascontiguousarray(depth_m)))
            T_camera_world = tensor(np.linalg.inv(T_world_camera))
            rest = (self._K, T_camera_world, 1.0, self._max_depth, self._truncation)
            blocks = self._grid.compute_unique_block_coordinates(image, *rest)
            self._grid.integrate(blocks, image, *rest)
        return time.perf_counter() - begin

    @property
    def blocks(self) -> int:
        """Blocks that hold distances; from MOST_BLOCKS on there can be no triangles."""
        return int(self._grid.hashmap().size())

    def mesh(self, least_weight: float) -> Mesh:
        """Its surface where a voxel was seen in so many images."""
        mesh = self._grid.extract_triangle_mesh(weight_threshold=least_weight)
        vertices = mesh.vertex.positions.numpy().astype(np.float64)
        return vertices, mesh.triangle.indices.numpy().astype(np.int64), None
