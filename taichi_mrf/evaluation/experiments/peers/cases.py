"""The scenes of the comparison: the views mapped and those judged, the truth that is known, and the measuring
of one system with one setting on one scene.

States and probabilities are judged by points of which it is known whether they are free or occupied. Where
the scene's geometry is known these are the centres of voxels that clean rays of the mapped views cross or end
in (evaluation/occupancy_truth.py). In recordings they are points along the rays of held-out views, occupied
where the measurement is and free at places in front of it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf import PolynomialNoise
from taichi_mrf.datasets.synthetic.mesh_scene import TriangleMesh, load_mesh, scene_mesh
from taichi_mrf.datasets.synthetic.room_furniture import room_scene as furnished_room
from taichi_mrf.evaluation.experiments.exact import room_scene
from taichi_mrf.evaluation.experiments.folds import require_views
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.experiments.peers.peer import Answers, Cells, Knob, Peer, System, thinned
from taichi_mrf.evaluation.experiments.scenes import (
    Scene,
    SceneView,
    house_scene,
    kitchen_scene,
    lidar_scene,
    turned,
)
from taichi_mrf.evaluation.keyframe_cost import timed
from taichi_mrf.evaluation.occupancy_scores import score_occupancy
from taichi_mrf.evaluation.occupancy_truth import occupancy_truth
from taichi_mrf.evaluation.surface_scores import SurfaceTruth, surface_truth
from taichi_mrf.mapping.selection import KeyframeSelector
from taichi_mrf.mapping.tracking import STEPS

MOST_POINTS = 400_000

PIXELS_A_VIEW = 5000
FREE_A_PIXEL = 4

MARGIN_SIGMAS, MARGIN_VOXELS = 4.0, 2.0
"""A point counts as free if it lies this far in front of the measurement, whichever is more."""

ABOVE_EVEN = 0.5001
"""The least probability that is taken for occupied: unknown voxels of recursive maps have one half."""


@dataclass(frozen=True)
class KnownPoints:
    """Points (N, 3) in metres, and whether each is occupied (else it is free), (N,)."""

    points_m: NDArray[np.float64]
    occupied: NDArray[np.bool_]


def of_geometry(scene: Scene, mesh: TriangleMesh, mapped: Sequence[int], voxel_size: float) -> KnownPoints:
    """Voxels that the mapped views could see, thinned at random where there are too many."""
    views = [scene.views[i] for i in mapped]
    truth = occupancy_truth(
        mesh,
        [np.where(view.measured_m > 0, view.true_m, 0).astype(np.float32) for view in views],
        [view.T_world_camera for view in views],
        scene.pinhole,
        voxel_size,
    )
    share, rng = min(1.0, MOST_POINTS / max(1, sum(truth.counts))), np.random.default_rng(0)
    points, occupied = [], []
    for centres, states in truth.blocks():
        kept = rng.random(len(centres)) < share
        points.append(centres[kept])
        occupied.append(states[kept])
    return KnownPoints(np.concatenate(points), np.concatenate(occupied))


def along_rays(scene: Scene, held_out: Sequence[int], voxel_size: float) -> KnownPoints:
    """Points on the rays of held-out views."""
    rng = np.random.default_rng(0)
    points, occupied = [], []
    for view in (scene.views[i] for i in held_out):
        camera = view.camera or scene.camera
        sigma, _ = scene.noise.table(camera).at_pixels(view.true_m)
        free_to = view.true_m - np.maximum(MARGIN_SIGMAS * sigma, MARGIN_VOXELS * voxel_size)
        usable = np.flatnonzero(view.judged & (view.true_m <= scene.max_depth) & (free_to > 0))
        chosen = rng.choice(usable, min(PIXELS_A_VIEW, len(usable)), replace=False)
        rays, depth = camera.rays().reshape(-1, 3)[chosen], view.true_m.ravel()[chosen].astype(np.float64)
        free = rng.random((FREE_A_PIXEL, len(chosen))) * free_to.ravel()[chosen]
        depths = np.concatenate([depth[None], free])
        there = (rays * depths[..., None]).reshape(-1, 3)
        T = view.T_world_camera
        points.append(there @ T[:3, :3].T + T[:3, 3])
        occupied.append(np.repeat([True, *[False] * FREE_A_PIXEL], len(chosen)))
    return KnownPoints(np.concatenate(points), np.concatenate(occupied))


def cell_scores(cells: Cells, truth: KnownPoints) -> dict[str, float]:
    """Precision and recall of what is called occupied and of what is called free, the expected calibration
    error of the probabilities, and the area under their ROC curve."""
    scores = score_occupancy(np.clip(cells.probability, 0, 1), truth.occupied, threshold=ABOVE_EVEN)

    def shares(called: NDArray[np.bool_], right: NDArray[np.bool_]) -> tuple[float, float]:
        found = float((called & right).sum())
        return found / max(1, int(called.sum())), found / max(1, int(right.sum()))

    occupied, free = shares(cells.occupied, truth.occupied), shares(cells.free, ~truth.occupied)
    return {
        "occupied precision": occupied[0],
        "occupied recall": occupied[1],
        "free precision": free[0],
        "free recall": free[1],
        "calibration error": scores.calibration_error,
        "roc area": scores.roc_area,
    }


JUDGED_STRIDE = 2
"""One in so many rows and columns of a held-out view is judged."""

WARM_UP = 2
"""Frames for which kernels are compiled, on a map that is thrown away."""

NEAR_VOXELS, NEAR_M = 1.5, 0.05
"""An answer within this of the truth is right."""

RIGHT = "within 1.5 voxels"


@dataclass(frozen=True)
class Case:
    """A scene at a voxel size, the views that are mapped and those that are judged, and what is known of it.
    ``surface`` is None where there is no truth."""

    scene: Scene
    voxel_size: float
    mapped: Sequence[int]
    judged: Sequence[int]
    points: KnownPoints
    surface: SurfaceTruth | None


def measured(system: System, knob: Knob, case: Case) -> Result:
    """The figures, as plain values; times in milliseconds of all processors together."""
    frames = [thinned(case.scene.views[i], case.scene, knob.stride) for i in case.mapped]
    warm = system.make(case.scene, case.voxel_size, knob)
    for frame in frames[:WARM_UP]:
        warm.integration(frame)()
    warm.conclude()
    del warm
    peer = system.make(case.scene, case.voxel_size, knob)
    taken = keyframes(frames) if knob.selected else frames
    times = [timed(peer.integration(frame)) for frame in taken]
    end = timed(peer.conclude)
    cpu_ms = 1e3 * (sum(time.cpu for time in times) + end.cpu)
    wall_ms = 1e3 * (sum(time.wall for time in times) + end.wall)
    memory_mb = peer.memory_mb  # before readings and surfaces take some
    reading, answers = _answers(peer, case)
    vertices_triangles = peer.mesh() if knob.standard and case.surface is not None else None
    mesh = None
    if vertices_triangles is not None and case.surface is not None and len(vertices_triangles[1]):
        mesh = case.surface.scores(*vertices_triangles).to_json()
    return {
        "frames": len(frames),
        "keyframes": len(taken),
        "cpu_ms": cpu_ms / len(frames),
        "cpu_ms_keyframe": cpu_ms / len(taken),
        "wall_ms": wall_ms / len(frames),
        "stages_ms": {name: ms / len(taken) for name, ms in peer.stages_ms.items()}
        | {"conclusion": 1e3 * end.cpu / len(taken)},
        "memory_mb": memory_mb,
        "reading": reading,
        "answers": answers,
        "cells": {
            name: cell_scores(cells, case.points) for name, cells in peer.cells(case.points.points_m).items()
        },
        "mesh": mesh,
    }


def keyframes(frames: Sequence[SceneView]) -> list[SceneView]:
    """Those that a run with tracked poses takes for keyframes."""
    selector, kept = KeyframeSelector(STEPS), []
    for frame in frames:
        if selector.wants(frame.T_world_camera):
            selector.accept(frame.T_world_camera)
            kept.append(frame)
    return kept


def _answers(peer: Peer, case: Case) -> tuple[str, dict[str, float]]:
    """The reading that is right most often, and the means of its figures over the held-out views."""
    views = [thinned(case.scene.views[i], case.scene, JUDGED_STRIDE) for i in case.judged]
    by_reading: dict[str, list[dict[str, float]]] = {}
    for view in views:
        for name, answers in peer.answers(view).items():
            by_reading.setdefault(name, []).append(answer_scores(answers, view, case))
    means = {
        name: {key: float(np.mean([each[key] for each in figures])) for key in figures[0]}
        for name, figures in by_reading.items()
    }
    best = max(means, key=lambda name: means[name][RIGHT])
    return best, means[best]


def answer_scores(answers: Answers, view: SceneView, case: Case) -> dict[str, float]:
    """Shares of the judged pixels of a view; those without an answer are wrong."""
    judged = view.judged & (view.true_m > 0) & (view.true_m <= case.scene.max_depth)
    depth_m = answers.depth_m[judged]
    off = np.abs(depth_m - view.true_m[judged])
    return {
        RIGHT: float(np.mean(off <= NEAR_VOXELS * case.voxel_size)),
        "within 5 cm": float(np.mean(off <= NEAR_M)),
        "unanswered": float(np.mean(np.isnan(depth_m))),
        "log-likelihood": answers.log_likelihood,
    }


VIEWS = 20
"""The first so many views of each scene, one after the other as a live run meets them."""

EVERY, FIRST = 5, 2
"""Every fifth view is held out, from the third on."""

SURFACE_STRIDE = 2
"""One in so many rows and columns of clean depth gives points of the true surface."""

LIDAR_SIGMA_M = 0.06
"""The standard deviation of ranges that `benchmarks.lab lidar` learns for 5 cm voxels of this recording."""

IMAGE = "&width=640&height=480"


@dataclass(frozen=True)
class PeerScene:
    """A scene, made when it is needed: with its mesh, or None where only measurements are known."""

    name: str
    make: Callable[[], tuple[Scene, TriangleMesh | None]]
    is_lidar: bool = False

    def case(self, voxel_size: float) -> Case:
        """Its views and its truth for a voxel size."""
        scene, mesh = self._made
        if mesh is None:
            points = along_rays(scene, self.judged, voxel_size)
        else:
            points = of_geometry(scene, mesh, self.mapped, voxel_size)
        return Case(scene, voxel_size, self.mapped, self.judged, points, self._surface)

    @property
    def judged(self) -> Sequence[int]:
        """Numbers of the held-out views."""
        return range(FIRST, len(self._made[0].views), EVERY)

    @property
    def mapped(self) -> Sequence[int]:
        """Numbers of all others."""
        return [i for i in range(len(self._made[0].views)) if i not in self.judged]

    @property
    def selects(self) -> bool:
        """True if there are fewer keyframes than frames."""
        return len(keyframes([self._made[0].views[i] for i in self.mapped])) < len(self.mapped)

    @cached_property
    def _made(self) -> tuple[Scene, TriangleMesh | None]:
        scene, mesh = self.make()
        require_views(scene, FIRST + 2)
        return scene, mesh

    @cached_property
    def _surface(self) -> SurfaceTruth | None:
        scene, mesh = self._made
        if mesh is None:
            return None
        views = [thinned(view, scene, SURFACE_STRIDE) for view in scene.views]
        camera = scene.pinhole.thinned(SURFACE_STRIDE)
        depths, poses = [np.asarray(view.true_m) for view in views], [view.T_world_camera for view in views]
        return surface_truth(depths, poses, camera, self.mapped, [view.judged for view in views])


def peer_scenes(data: Path, seed: int, limit: int | None) -> Sequence[PeerScene]:
    """The scenes; the house and the room are turned, so that no wall lies in a plane of the grid."""
    views = min(VIEWS, limit or VIEWS)

    def kitchen() -> tuple[Scene, TriangleMesh | None]:
        return kitchen_scene(data, views), None

    def room() -> tuple[Scene, TriangleMesh | None]:
        return turned(room_scene(views, IMAGE), scene_mesh(furnished_room()))

    def house() -> tuple[Scene, TriangleMesh | None]:
        return turned(house_scene(data, seed, views), load_mesh(data / "meshes" / "house.ply"))

    def lidar() -> tuple[Scene, TriangleMesh | None]:
        return replace(lidar_scene(data, views), noise=PolynomialNoise((LIDAR_SIGMA_M,))), None

    return [
        PeerScene("kitchen", kitchen),
        PeerScene("room", room),
        PeerScene("house", house),
        PeerScene("lidar", lidar, is_lidar=True),
    ]
