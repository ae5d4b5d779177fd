"""One system with one setting on one scene: what its frames cost, and what its map is worth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taichi_mrf.benchmark.keyframe_cost import timed
from taichi_mrf.evaluation.surface_scores import SurfaceTruth
from taichi_mrf.experiments.ledger import Result
from taichi_mrf.experiments.peers.peer import Answers, Knob, Peer, System, thinned
from taichi_mrf.experiments.peers.truth import KnownPoints, cell_scores
from taichi_mrf.experiments.scenes import Scene, SceneView
from taichi_mrf.mapping.selection import KeyframeSelector
from taichi_mrf.mapping.tracking import STEPS

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
