"""``taichi-mrf eval exact``: MRFMap beside the factor graph that it approximates, on small scenes."""

from pathlib import Path

import pytest
from small_scenes import experiment

from taichi_mrf.evaluation.accuracy import judge_view
from taichi_mrf.evaluation.experiments.exact import MAPS, PER_RAY, room_scene, run_exact
from taichi_mrf.evaluation.experiments.folds import Experiment
from taichi_mrf.evaluation.experiments.scenes import Scene, kitchen_scene
from taichi_mrf.evaluation.tables import Table
from taichi_mrf.methods.mrf.map import MRFMap

SIZE = 0.2
VIEWS = 4
REFERENCE = "each ray, sum-product"


@pytest.fixture(scope="module")
def exact(data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Experiment, list[Table]]:
    run = experiment(data, tmp_path_factory.mktemp("out"), voxel_sizes=(SIZE,), limit=VIEWS)
    tables, paths = run_exact(run)
    assert [path.name for path in paths[::3]] == ["exact_room_20cm.csv", "exact_kitchen_20cm.csv"]
    return run, tables


def rows_of(table: Table) -> dict[str, dict]:
    return {str(row[0]): dict(zip(table.columns, row, strict=True)) for row in table.rows}


def test_all_are_compared_with_sum_product_on_the_rays_themselves(
    exact: tuple[Experiment, list[Table]],
) -> None:
    for table in exact[1]:
        rows = rows_of(table)
        assert list(rows) == [*PER_RAY, *MAPS]
        assert rows[REFERENCE]["mean difference"] == 0
        assert rows[REFERENCE]["same label %"] == 100
        for row in list(rows.values())[1:]:
            assert 0 < row["mean difference"] < 0.5
            assert 50 < row["same label %"] < 100


def test_no_labelling_is_below_a_bound_and_the_graphs_own_methods_go_lowest(
    exact: tuple[Experiment, list[Table]],
) -> None:
    for table in exact[1]:
        rows = rows_of(table)
        bound = max(row["bound"] for row in rows.values() if row["bound"] is not None)
        assert all(row["energy"] >= bound for row in rows.values())
        assert rows["each ray, max-product"]["energy"] <= min(rows[name]["energy"] for name in MAPS)


@pytest.mark.parametrize(("number", "every"), [(0, 2), (1, 4)])
def test_maps_are_scored_on_the_views_that_they_have_not_seen(
    exact: tuple[Experiment, list[Table]], data: Path, number: int, every: int
) -> None:
    scene: Scene = room_scene(VIEWS) if number == 0 else kitchen_scene(data, VIEWS)
    m = MRFMap(SIZE, scene.noise, volume=scene.volume, max_depth=scene.max_depth)
    for view in scene.views[::2]:
        thinned = view.measured_m.copy()
        thinned[1::every] = thinned[:, 1::every] = 0
        for skipped in range(2, every):
            thinned[skipped::every] = thinned[:, skipped::every] = 0
        m.add_keyframe(thinned, view.T_world_camera, scene.camera)
    m.infer()
    scores = [
        judge_view(m, view.true_m, view.T_world_camera, scene.camera, mask=view.judged, by="omega")
        .accuracy("5cm")
        .score
        for view in scene.views[1::2]
    ]
    assert rows_of(exact[1][number])["MRFMap"]["5cm"] == pytest.approx(sum(scores) / len(scores))


def test_the_size_of_the_graph_is_told(exact: tuple[Experiment, list[Table]], data: Path) -> None:
    scene = room_scene(VIEWS)
    rays = sum(int((view.measured_m[::2, ::2] > 0).sum()) for view in scene.views[::2])
    note = exact[1][0].notes[0]
    factors = int(note.split(" factors")[0].split()[-1].replace(",", ""))
    assert factors > rays
    assert "MB" in note


def test_it_goes_on_where_it_was(exact: tuple[Experiment, list[Table]], data: Path) -> None:
    run, _ = exact
    again = experiment(data, run.out, voxel_sizes=(SIZE,), limit=VIEWS)
    run_exact(again)
    assert again.ledger.computed == 0
