"""Tables II and III on a small room: keyframes and held-out views, probabilities against the mesh, notes."""

import csv
import re
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.polynomial.polynomial import polyval
from small_scenes import HOUSE_VIEWS, KITCHEN_VIEWS, experiment

from taichi_mrf.datasets.synthetic.mesh_scene import load_mesh
from taichi_mrf.errors import ConfigError, DatasetError
from taichi_mrf.evaluation.accuracy import judge_view
from taichi_mrf.evaluation.experiments import table2
from taichi_mrf.evaluation.experiments.contenders import standard_contenders
from taichi_mrf.evaluation.experiments.folds import Experiment
from taichi_mrf.evaluation.experiments.scenes import Scene, house_scene, kitchen_scene
from taichi_mrf.evaluation.experiments.table2 import run_table2
from taichi_mrf.evaluation.experiments.table3 import PAPER as PAPER3
from taichi_mrf.evaluation.experiments.table3 import run_table3
from taichi_mrf.evaluation.experiments.tuning import COLUMNS, GRID
from taichi_mrf.evaluation.experiments.tuning import NAME as TUNED
from taichi_mrf.evaluation.occupancy_scores import score_occupancy
from taichi_mrf.evaluation.occupancy_truth import occupancy_truth
from taichi_mrf.evaluation.tables import Spread, Table
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.simulate import KINECT_1_LATERAL

KEYFRAMES = (0, 2, 4)
"""Of the house: its views are 0.3 radians apart, and it takes more than half a radian."""

SIZE = 0.1
OCCUPANCY = [
    "precision", "recall", "ROC area", "Brier score", "expected calibration error", "occupied",
    "judged voxels",
]  # fmt: skip


@pytest.fixture(scope="module")
def second(
    data: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Experiment, list[Table], list[Path]]:
    """A whole run of Table II."""
    run = experiment(data, tmp_path_factory.mktemp("out"), voxel_sizes=(SIZE,), seeds=(3,))
    return run, *run_table2(run)


@pytest.fixture(scope="module")
def third(data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Experiment, list[Table], list[Path]]:
    """A whole run of Table III, at a voxel size that the paper has too."""
    run = experiment(data, tmp_path_factory.mktemp("out"), voxel_sizes=(0.05,))
    return run, *run_table3(run)


def row_of(table: Table, name: str) -> dict[str, Any]:
    (row,) = (row for row in table.rows if row[1] == name)
    return dict(zip(table.columns, row, strict=True))


def mrf_map(scene: Scene, size: float, keyframes: tuple[int, ...]) -> MRFMap:
    m = MRFMap(size, scene.noise, volume=scene.volume, max_depth=scene.max_depth, ray_density=0.0)
    for index in keyframes:
        view = scene.views[index]
        m.add_keyframe(view.measured_m, view.T_world_camera, scene.camera, view.name)
    m.infer()
    return m


def within_5cm(m: MRFMap, scene: Scene, judged: tuple[int, ...]) -> Spread:
    scores = []
    for view in (scene.views[i] for i in judged):
        seen = judge_view(m, view.true_m, view.T_world_camera, scene.camera, mask=view.judged)
        scores.append(seen.accuracy("5cm").score)
    return Spread.of(scores)


def test_table2_judges_all_views_and_held_out_ones(second: tuple, data: Path) -> None:
    _, (table, held_out, _), _ = second
    scene = house_scene(data, 3)
    m = mrf_map(scene, SIZE, KEYFRAMES)
    row = row_of(table, "MRFMap")
    assert row["views"] == HOUSE_VIEWS
    assert row["5cm"] == within_5cm(m, scene, tuple(range(HOUSE_VIEWS)))
    rest = tuple(i for i in range(HOUSE_VIEWS) if i not in KEYFRAMES)
    assert row_of(held_out, "MRFMap")["5cm"] == within_5cm(m, scene, rest)
    assert row_of(held_out, "MRFMap")["views"] == len(rest)
    for each in (table, held_out):
        assert each.columns == ["voxels", "map", *COLUMNS.values(), "paper", "map (s)", "views"]
        assert len(each.rows) == 2 + 4 * 2
        assert {entry[0] for entry in each.rows} == {"10 cm"}
    assert any("3 keyframes of 5 views" in note for note in table.notes)


def test_table2_holds_probabilities_against_the_mesh(second: tuple, data: Path) -> None:
    _, tables, _ = second
    scene = house_scene(data, 3)
    seen = [scene.views[i] for i in KEYFRAMES]
    truth = occupancy_truth(
        load_mesh(data / "meshes" / "house.ply"),
        [v.true_m for v in seen],
        [v.T_world_camera for v in seen],
        scene.camera,
        SIZE,
    )
    m = mrf_map(scene, SIZE, KEYFRAMES)
    centres = [(voxels.astype(np.float64) + 0.5) * SIZE for voxels in (truth.occupied(), truth.free())]
    occupied = np.repeat([True, False], [len(each) for each in centres])
    scores = score_occupancy(m.marginals.occupancy(np.concatenate(centres)), occupied)
    row = row_of(tables[2], "MRFMap")
    expected = (scores.precision, scores.recall, scores.roc_area, scores.brier, scores.calibration_error)
    assert [row[name] for name in OCCUPANCY] == pytest.approx([*expected, scores.occupied, scores.count])
    assert tables[2].columns == ["voxels", "map", *OCCUPANCY]
    names = [*(each.name for each in standard_contenders()), TUNED]
    assert [entry[1] for entry in tables[2].rows] == names
    assert row["ROC area"] > 0.9
    assert 100 < scores.occupied < scores.count


def test_table2_writes_its_files(second: tuple) -> None:
    run, tables, paths = second
    pictures = ["table2_reliability_100mm.png", "table2_roc_100mm.png"]
    names = [f"{t.name}.{end}" for t in tables for end in ("csv", "tex", "png")] + pictures
    assert [t.name for t in tables] == ["table2", "table2_held_out", "table2_occupancy"]
    assert [path.name for path in paths] == names
    for path in paths:
        if path.suffix == ".png":
            assert cv2.imread(str(path)) is not None
    with open(run.out / "table2_occupancy.csv", newline="") as file:
        for row, entry in zip(csv.reader(file), [tables[2].columns, *tables[2].rows], strict=True):
            assert row == [str(each) for each in entry]


def test_table2_goes_on_where_it_was(second: tuple, data: Path) -> None:
    run, _, paths = second
    before = {path: path.read_bytes() for path in paths if path.suffix == ".csv"}
    assert run.ledger.computed == len(standard_contenders()) + len(GRID) + 1
    lines = run.ledger.path.read_text().splitlines(keepends=True)
    again = experiment(data, run.out, voxel_sizes=(SIZE,), seeds=(3,))
    run_table2(again)
    assert again.ledger.computed == 0
    assert {path: path.read_bytes() for path in before} == before
    assert lines == run.ledger.path.read_text().splitlines(keepends=True)


def test_table2_without_held_out_views_and_a_ray_caster(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("embreex", "embreex.rtcore_scene", "embreex.mesh_construction"):
        monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setattr(table2, "THRESHOLD", 0.1)
    run = experiment(data, tmp_path, voxel_sizes=(0.2,), limit=2)
    tables, _ = run_table2(run)
    assert [table.name for table in tables] == ["table2", "table2_occupancy"]
    assert row_of(tables[0], "MRFMap")["views"] == 2


def test_table2_says_what_reads_meshes(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(DatasetError, match=r"trimesh.*pip install 'taichi-mrf\[mesh\]'") as caught:
        run_table2(experiment(data, tmp_path, voxel_sizes=(0.2,)))
    assert "\n" not in str(caught.value)


def test_table2_names_a_missing_mesh(data: Path, tmp_path: Path) -> None:
    (tmp_path / "house_livingroom").symlink_to(data / "house_livingroom")
    with pytest.raises(DatasetError, match=r"meshes/house\.ply: the mesh is missing"):
        run_table2(experiment(tmp_path, tmp_path / "out", voxel_sizes=(0.2,)))


def test_table3_judges_every_second_frame(third: tuple, data: Path) -> None:
    run, (table,), paths = third
    assert [path.name for path in paths] == ["table3.csv", "table3.tex", "table3.png"]
    scene = kitchen_scene(data)
    row = row_of(table, "MRFMap")
    assert row["5cm"] == within_5cm(mrf_map(scene, 0.05, (0, 2)), scene, (1, 3))
    assert row["views"] == KITCHEN_VIEWS // 2
    assert row_of(table, "MRFMap, omega")["paper"] == PAPER3["MRFMap, omega", 0.05]
    assert row_of(table, "OctoMap-style, all leaves")["paper"] == PAPER3["OctoMap-style, all leaves", 0.05]
    assert row_of(table, "OctoMap-style, occupied leaves")["paper"] is None
    assert run.ledger.computed == len(standard_contenders()) + len(GRID) + 1


def test_table3_shows_the_sensors_own_noise(third: tuple, data: Path) -> None:
    _, (table,), _ = third
    views = kitchen_scene(data).views
    depth = np.concatenate([views[i].measured_m[views[i].measured_m > 0] for i in (1, 3)])
    expected = np.median(polyval(depth.astype(np.float64), KINECT_1_LATERAL.sigma))
    (said,) = re.findall(r"own noise .* median ([0-9.]+) m", " ".join(table.notes))
    assert float(said) == pytest.approx(expected, abs=6e-5)
    assert any("2 keyframes, 2 held-out frames" in note for note in table.notes)


def test_table3_goes_on_where_it_was(third: tuple, data: Path) -> None:
    run, _, (path, *_) = third
    before = path.read_bytes()
    again = experiment(data, run.out, voxel_sizes=(0.05,))
    run_table3(again)
    assert again.ledger.computed == 0
    assert path.read_bytes() == before


def test_table3_is_judged_with_the_noise_of_another_sensor(data: Path, tmp_path: Path) -> None:
    judge = tmp_path / "coarse.yaml"
    judge.write_text("sensor: {sigma: [0.3], min_depth: 0.1, max_depth: 10.0}\n")
    rows = {}
    for name in ("kinect_one", str(judge)):
        run = experiment(data, tmp_path / Path(name).stem, voxel_sizes=(0.1,), judge=name)
        (table,), _ = run_table3(run)
        rows[name] = row_of(table, "MRFMap")
        assert table.title == f"Table III: mapped by realsense_d435, judged by {Path(name).stem}"
        assert rows[name]["views"] == HOUSE_VIEWS // 2
    # A judge with a sigma of 30 cm finds few depths within 5 cm; what it measures fits its own sigma as well.
    assert rows["kinect_one"]["5cm"].mean > 2 * rows[str(judge)]["5cm"].mean
    assert rows[str(judge)]["noisy, sensor"].mean == pytest.approx(0.87, abs=0.05)


def test_a_limit_is_the_number_of_views(data: Path, tmp_path: Path) -> None:
    (table,), _ = run_table3(experiment(data, tmp_path, voxel_sizes=(0.2,), limit=3))
    assert any("2 keyframes, 1 held-out frames" in note for note in table.notes)
    assert row_of(table, "MRFMap")["views"] == 1
    (table,), _ = run_table3(experiment(data, tmp_path, voxel_sizes=(0.2,), limit=4))
    assert row_of(table, "MRFMap")["views"] == 2  # of as many keyframes, but not what was found for 3 views
    for run in (run_table2, run_table3):
        with pytest.raises(ConfigError, match="1 views; the experiment needs at least 2"):
            run(experiment(data, tmp_path, voxel_sizes=(0.2,), limit=1))
