"""Points of which it is known whether they are free or occupied, to judge states and probabilities by.

Where the scene's geometry is known: the centres of voxels that clean rays of the mapped views cross or end in
(evaluation/occupancy_truth.py). In recordings: points along the rays of held-out views, occupied where the
measurement is and free at places in front of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.synthetic.mesh_scene import TriangleMesh
from taichi_mrf.evaluation.occupancy_scores import score_occupancy
from taichi_mrf.evaluation.occupancy_truth import occupancy_truth
from taichi_mrf.experiments.peers.peer import Cells
from taichi_mrf.experiments.scenes import Scene

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
