"""Figures 7 and 10 on a small room: the ray and the scores that are shown, and what another image costs."""

import csv
import itertools
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_scenes import COFFIN_VIEWS, HOUSE_VIEWS, experiment

from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.accuracy import NO_ANSWER, NOT_JUDGED, RIGHT, WRONG, judge_view
from taichi_mrf.evaluation.bench import octomap_available
from taichi_mrf.evaluation.experiments.fig7 import COLORS, NAMES, beside_an_edge, run_fig7
from taichi_mrf.evaluation.experiments.fig8 import run_fig8, run_fig9
from taichi_mrf.evaluation.experiments.fig10 import FULL_AT, run_fig10
from taichi_mrf.evaluation.experiments.scenes import SceneView, coffin_scene, house_scene
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap

HELD_OUT = COFFIN_VIEWS - 1
"""The paper's view 4 is not among the small room's, so it is the last."""


def test_fig7_shows_the_held_out_view(data: Path, tmp_path: Path) -> None:
    run = experiment(data, tmp_path, voxel_sizes=(0.2, 0.1), seeds=(1,))
    (table,), paths = run_fig7(run)
    pictures = ["fig7_200mm.png", "fig7_100mm.png"]
    assert [path.name for path in paths] == ["fig7.csv", "fig7.tex", "fig7.png", *pictures]
    for name in pictures:
        assert len(np.unique(cv2.imread(str(tmp_path / name)).reshape(-1, 3), axis=0)) > 10
    scene = coffin_scene(data, 1)
    view = scene.views[HELD_OUT]
    assert str(beside_an_edge(view)) in table.notes[0]
    expected = []
    for size in (0.2, 0.1):
        for name, make in (("MRFMap", partial(MRFMap, ray_density=0.0)), ("OctoMap-style", LogOddsMap)):
            m = make(size, scene.noise, volume=scene.volume, max_depth=scene.max_depth)
            for each in scene.views[:HELD_OUT]:
                m.add_keyframe(each.measured_m, each.T_world_camera, scene.camera, each.name)
            m.infer()
            judged = judge_view(
                m, view.true_m, view.T_world_camera, scene.camera, mask=view.judged, by="omega"
            )
            score = judged.accuracy("1.5sigma")
            expected.append([f"{size * 100:g} cm", name, score.score, score.unanswered])
    assert table.rows == expected


def test_fig8_draws_both_maps_and_counts_what_is_away_from_surfaces(data: Path, tmp_path: Path) -> None:
    (table,), paths = run_fig8(experiment(data, tmp_path, voxel_sizes=(0.1,)))
    assert [path.name for path in paths] == ["fig8.csv", "fig8.tex", "fig8.png", "fig8_100mm.png"]
    scene = house_scene(data)
    ends = []
    for view in scene.views:
        rays = scene.camera.rays()[view.judged] * view.true_m[view.judged][:, None]
        ends.append(rays @ view.T_world_camera[:3, :3].T + view.T_world_camera[:3, 3])
    near = {tuple(each) for each in np.floor(np.concatenate(ends) / 0.1).astype(int).tolist()}
    beside = list(itertools.product((-1, 0, 1), repeat=3))
    for row, make in zip(table.rows, (LogOddsMap, partial(MRFMap, ray_density=0.0)), strict=True):
        m = make(0.1, scene.noise, volume=scene.volume, max_depth=scene.max_depth)
        for each in (scene.views[i] for i in (0, 2, 4)):
            m.add_keyframe(each.measured_m, each.T_world_camera, scene.camera, each.name)
        m.infer()
        voxels = np.floor(m.decided.voxels(min_probability=0.5)[0] / 0.1).astype(int)
        away = [not any(tuple(v + step) in near for step in beside) for v in voxels]
        assert row[2:] == [len(voxels), pytest.approx(np.mean(away))]
    picture = cv2.imread(str(paths[-1]))
    left, right = np.array_split(picture, 2, axis=1)
    assert min(len(np.unique(half.reshape(-1, 3), axis=0)) for half in (left, right)) > 1000


def test_fig9_is_coloured_by_probability(data: Path, tmp_path: Path) -> None:
    _, paths = run_fig9(experiment(data, tmp_path, voxel_sizes=(0.1,)))
    picture = cv2.imread(str(paths[-1]))[:, :, ::-1].astype(int)
    bright_yellow = (picture[..., 0] > 180) & (picture[..., 1] > 180) & (picture[..., 2] < 80)
    assert bright_yellow.mean() > 0.002
    with pytest.raises(ConfigError, match="0 views; the experiment needs at least 1"):
        run_fig9(experiment(data, tmp_path, voxel_sizes=(0.1,), limit=0))


def test_each_kind_of_pixel_has_its_colour() -> None:
    # Pictures are drawn by the position of a colour in the list.
    assert list(COLORS) == [NOT_JUDGED, NO_ANSWER, WRONG, RIGHT] == [0, 1, 2, 3]
    assert NAMES.keys() == COLORS.keys()


def view_of(depth_m: np.ndarray, judged: np.ndarray | None = None) -> SceneView:
    return SceneView("v", np.eye(4), depth_m, depth_m, depth_m > 0 if judged is None else judged)


def test_the_ray_passes_beside_the_nearer_surface() -> None:
    depth = np.full((40, 60), 3.0, np.float32)
    depth[15:25, 25:33] = 1.0
    u, v = beside_an_edge(view_of(depth))
    assert 15 <= v < 25
    assert 33 <= u < 36
    assert depth[v, u] == 3.0
    # Neither pixels without a depth nor those that do not count are edges.
    depth[15:25, 33:60] = 0
    depth[28, 20:30] = 2.0
    judged = depth > 0
    u, v = beside_an_edge(view_of(depth, judged))
    assert (v, depth[v, u]) == (28, 3.0)
    judged[28] = False
    u, v = beside_an_edge(view_of(depth, judged))
    assert v != 28
    assert judged[v, u]


def test_a_view_without_pixels_to_judge_is_refused() -> None:
    with pytest.raises(ConfigError, match="v: no pixel in the middle of the image can be judged"):
        beside_an_edge(view_of(np.zeros((40, 60), np.float32)))


@pytest.mark.skipif(not octomap_available(), reason="pyoctomap (the extra bench) is not installed")
def test_fig10_times_every_image(data: Path, tmp_path: Path) -> None:
    sizes = (0.2, 0.1)
    run = experiment(data, tmp_path, voxel_sizes=sizes)
    (table,), paths = run_fig10(run)
    assert [path.name for path in paths] == ["fig10.csv", "fig10.tex", "fig10.png", "fig10_curves.png"]
    assert cv2.imread(str(paths[-1])) is not None
    assert [row[:2] for row in table.rows] == [
        [size, number] for size in ("20 cm", "10 cm") for number in range(1, HOUSE_VIEWS + 1)
    ]
    for _, number, full, new, octomap in table.rows:
        assert (full is not None) == (number in FULL_AT)
        assert full is None or full > 0
        assert new > 0
        assert octomap > 0
    before = paths[0].read_bytes()
    again = experiment(data, tmp_path, voxel_sizes=sizes)
    run_fig10(again)
    assert (run.ledger.computed, again.ledger.computed) == (2, 0)
    assert paths[0].read_bytes() == before
    (limited,), _ = run_fig10(experiment(data, tmp_path / "limited", voxel_sizes=(0.2,), limit=2))
    assert [row[1] for row in limited.rows] == [1, 2]
    with open(tmp_path / "limited" / "fig10.csv", newline="") as file:
        assert [float(row["OctoMap"]) for row in csv.DictReader(file)] == [row[4] for row in limited.rows]
