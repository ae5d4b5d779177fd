"""The truth of cells and paths, and the experiment that judges a map by it."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from small_scenes import CAMERA, clean_depth, make_data, poses, room

from taichi_mrf.datasets.synthetic.analytic_mesh import scene_mesh
from taichi_mrf.evaluation.cell_truth import SeenSpace, occupied_bricks, true_cells
from taichi_mrf.evaluation.occupancy_truth import OccupancyTruth, occupancy_truth
from taichi_mrf.experiments import cells
from taichi_mrf.experiments.cells import recall_at_precision
from taichi_mrf.experiments.run import run_experiment
from taichi_mrf.queries.known_bricks import bricks_between

pytestmark = pytest.mark.usefixtures("one_backend")

VOXEL = 0.1
BOX_TOP_M = 0.93


@pytest.fixture(scope="module")
def views() -> tuple[list[np.ndarray], list[np.ndarray]]:
    places = poses(4, np.pi / 2)
    return clean_depth(places), places


@pytest.fixture(scope="module")
def truth(views: tuple[list[np.ndarray], list[np.ndarray]]) -> OccupancyTruth:
    return occupancy_truth(scene_mesh(room()), *views, CAMERA, VOXEL)


def test_a_cell_is_occupied_if_a_voxel_is_and_free_if_all_are(truth: OccupancyTruth) -> None:
    occupied = {tuple(voxel) for voxel in truth.occupied().tolist()}
    free = {tuple(voxel) for voxel in truth.free().tolist()}
    bricks = np.concatenate([bricks_between(np.array([-1, -1, 0]), np.array([0, 0, 1])), [[900, 0, 0]]])
    assert {tuple(b) for b in (np.array(list(occupied)) // 8).tolist()} == set(
        map(tuple, occupied_bricks(truth).tolist())
    )
    for side in (1, 4):
        found = true_cells(truth, bricks, side)
        corners = np.indices((8 // side,) * 3).reshape(3, -1).T * side
        inside = np.indices((side,) * 3).reshape(3, -1).T
        for brick, states in zip(bricks, found.tolist(), strict=True):
            for corner, state in zip(brick * 8 + corners, states, strict=True):
                voxels = set(map(tuple, (corner + inside).tolist()))
                assert state == (1 if voxels & occupied else 0 if voxels <= free else -1)
        assert len(np.unique(found)) == 3


def test_paths_hit_what_views_show_and_are_not_judged_beyond(
    truth: OccupancyTruth, views: tuple[list[np.ndarray], list[np.ndarray]]
) -> None:
    pytest.importorskip("scipy")
    space = SeenSpace(truth, *views, CAMERA)
    above = np.linspace([-0.2, 0.0, 1.25], [0.2, 0.0, 1.25], 30)
    lower = np.where([[False, False, True]], BOX_TOP_M + 0.08, above)
    within = np.linspace([-0.05, 0.0, 0.4], [0.05, 0.0, 0.4], 30)  # inside the box, where no view looks
    paths = np.stack([above, lower, within])
    assert space.judge_paths(paths, 0.1).tolist() == [0, 1, -1]
    assert space.judge_paths(paths[:, :1] + [0, 0, 50], 0.1).tolist() == [-1, -1, -1]
    points = space.free_points(50, np.random.default_rng(0))
    assert (room().signed_distance(points) > 0).all()


def test_recall_at_a_precision_by_hand() -> None:
    occupied = np.array([True, True, False, True, True, False])
    p = np.array([0.9, 0.8, 0.7, 0.6, 0.6, 0.1])
    assert recall_at_precision(p, occupied, 0.9) == 0.5
    assert recall_at_precision(p, occupied, 0.75) == 1.0
    assert recall_at_precision(p, ~occupied, 0.9) == 0.0


def test_cells_are_found_more_often_than_voxels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("scipy")
    data = make_data(tmp_path)
    monkeypatch.setattr(cells, "PATHS", 200)
    monkeypatch.setattr(cells, "SIDES", (1, 8))
    monkeypatch.setattr(cells, "RADII_M", (0.2,))
    monkeypatch.setattr(cells, "reliability_figure", lambda _: Figure())  # drawing takes long
    monkeypatch.setattr(cells, "_ROOM", "synthetic:room?width=80&height=60&frames=3")
    tables, paths = run_experiment("cells", data, tmp_path, (0.1,), (0,), None, lambda *_: None)
    of_cells, of_paths = (table.rows for table in tables)
    assert len(of_cells) == len(of_paths) == 4 * 2 * 2  # scenes as they stand and turned, two readings
    assert all(path.is_file() for path in paths)
    for first in range(0, len(of_cells), 2):
        recall = [float(row[8]) for row in of_cells[first : first + 2]]
        assert recall == sorted(recall)
        assert recall[0] < recall[-1]
    assert all(float(row[7]) > 0.8 for row in of_cells if row[2] == "marginal")
    errors = [[float(row[9]) for row in of_cells[first::4]] for first in (1, 3)]  # of cells of 8 voxels
    assert np.mean(errors[1]) < np.mean(errors[0])
