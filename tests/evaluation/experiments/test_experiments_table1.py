"""Table I on a small room: its rows, its figures computed once more by hand, and interrupted runs."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_scenes import COFFIN_VIEWS, experiment

from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.accuracy import TOLERANCES, judge_view
from taichi_mrf.evaluation.experiments import folds, tuning
from taichi_mrf.evaluation.experiments.contenders import Contender
from taichi_mrf.evaluation.experiments.scenes import Scene, coffin_scene
from taichi_mrf.evaluation.experiments.table1 import PAPER, run_table1
from taichi_mrf.evaluation.experiments.tuning import COLUMNS, GRID
from taichi_mrf.evaluation.tables import Spread, Table
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.queries.view import View
from taichi_mrf.voxels.traversal import FAR

SIZES = (0.2, 0.05)
SEEDS = (0, 1)
FOLDS = 2
"""The runs here are limited to these, of which the first is tuned."""

ROWS = [
    "MRFMap",
    "MRFMap, omega",
    "OctoMap-style, all leaves",
    "OctoMap-style, occupied leaves",
    "OctoMap-style, bias removed, all leaves",
    "OctoMap-style, bias removed, occupied leaves",
    "visibility map, all leaves",
    "visibility map, occupied leaves",
    "log-odds per ray, tuned, all leaves",
    "log-odds per ray, tuned, occupied leaves",
]
NAMES = ("table1", "table1_noise_seeds", "table1_log_odds_weights")
Row = dict[str, Any]


@pytest.fixture(scope="module")
def scenes(data: Path) -> list[Scene]:
    """One for each draw of the noise."""
    return [coffin_scene(data, seed) for seed in SEEDS]


@pytest.fixture(scope="module")
def out(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("out")


@pytest.fixture(scope="module")
def tables(data: Path, out: Path) -> list[Table]:
    """Those of a run to its end."""
    run = experiment(data, out, voxel_sizes=SIZES, seeds=SEEDS, limit=FOLDS)
    tables, paths = run_table1(run)
    assert run.ledger.computed == len(run.ledger.done) > 0
    assert [path.name for path in paths] == [f"{n}.{end}" for n in NAMES for end in ("csv", "tex", "png")]
    assert all(path.stat().st_size > 0 for path in paths)
    return tables


def row_of(table: Table, *key: str) -> Row:
    """The one row that begins so, by column."""
    (row,) = (row for row in table.rows if tuple(row[: len(key)]) == key)
    return dict(zip(table.columns, row, strict=True))


def figures_by_hand(m: OccupancyMap, scene: Scene, fold: int, view: View | None = None) -> dict[str, float]:
    """Every figure of the table, of one held-out view; by omega through ``view``, if there is one."""
    seen = scene.views[fold]
    judged, every = (
        judge_view(
            m, seen.true_m, seen.T_world_camera, scene.camera,
            measured_m=seen.measured_m, noise=scene.noise, mask=mask, view=view,
        )
        for mask in (seen.judged, None)
    )  # fmt: skip
    figures = {name: judged.accuracy(name).score for name in TOLERANCES}
    # The camera stands in the volume, so what lies beyond its boundary lies outside.
    rays = scene.camera.rays() * seen.true_m[..., None].astype(np.float64)
    ends = rays @ seen.T_world_camera[:3, :3].T + seen.T_world_camera[:3, 3]
    outside = ((ends < scene.volume.lower) | (ends > scene.volume.upper)).any(axis=-1)
    near = every.answered & (abs(seen.true_m - every.survey.middle.astype(float)) <= 1.5 * m.voxel_size)
    right = np.where(every.survey.visibility > 0.5, outside, near)[every.judged]
    figures["leaving"] = right.mean()
    figures["unanswered"] = judged.accuracy("5cm").unanswered
    figures["median_abs"] = judged.depth_error().median_abs
    figures["rms"] = judged.depth_error().rms
    figures["expected_median_abs"] = judged.expected_depth_error().median_abs
    figures["log_likelihood"] = judged.log_likelihood()
    return figures


def mapped(m: OccupancyMap, scene: Scene, fold: int) -> OccupancyMap:
    """The map of all views but one."""
    for view in scene.views:
        if view is not scene.views[fold]:
            m.add_keyframe(view.measured_m, view.T_world_camera, scene.camera, view.name)
    m.infer()
    return m


def test_every_row_is_there_beside_the_paper(tables: list[Table]) -> None:
    table = tables[0]
    assert table.columns == ["voxels", "map", *COLUMNS.values(), "paper", "map (s)", "views"]
    assert [row[:2] for row in table.rows] == [[size, row] for size in ("20 cm", "5 cm") for row in ROWS]
    for row in (dict(zip(table.columns, row, strict=True)) for row in table.rows):
        size = {"20 cm": 0.2, "5 cm": 0.05}[row["voxels"]]
        assert row["paper"] == PAPER.get((row["map"], size))
        assert row["views"] == (1 if "tuned" in row["map"] else FOLDS)
        assert row["map (s)"].mean > 0
    assert row_of(table, "5 cm", "MRFMap, omega")["paper"] == Spread(0.843, 0.017)
    assert row_of(table, "5 cm", "OctoMap-style, all leaves")["paper"] == Spread(0.213, 0.049)
    assert any("leave one out" in note for note in table.notes)


@pytest.mark.parametrize("size", SIZES)
def test_mrfmap_scores_what_the_judge_says(tables: list[Table], scenes: list[Scene], size: float) -> None:
    scene = scenes[0]
    found: list[dict[str, float]] = []
    for fold in range(FOLDS):
        every_pixel = {"volume": scene.volume, "max_depth": scene.max_depth, "ray_density": 0.0}
        m = MRFMap(size, scene.noise, **every_pixel)
        found.append(figures_by_hand(mapped(m, scene, fold), scene, fold, m.view))
    row = row_of(tables[0], f"{size * 100:g} cm", "MRFMap, omega")
    for figure, heading in COLUMNS.items():
        assert row[heading] == Spread.of([each[figure] for each in found]), heading
    assert row["1.5sigma"].mean > 0.4


def test_rays_end_on_the_measured_surface_where_it_is_near(tables: list[Table], scenes: list[Scene]) -> None:
    scene, size = scenes[0], 0.05
    errors, right = [], []
    for fold in range(FOLDS):
        m = MRFMap(size, scene.noise, volume=scene.volume, max_depth=scene.max_depth, ray_density=0.0)
        mapped(m, scene, fold)
        view = scene.views[fold]
        parts = (view.true_m, view.T_world_camera, scene.camera)
        voxel_m = judge_view(m, *parts, mask=view.judged, by="omega").answer_m
        surface_m = m.measured_depth(voxel_m, scene.camera, view.T_world_camera)
        near = ~np.isnan(surface_m)
        assert 0.2 < near.mean() < 1.0
        off = np.abs(np.where(near, surface_m, voxel_m) - view.true_m)[view.judged & (view.true_m > 0)]
        errors.append(np.nanmedian(off))
        right.append(np.mean(off <= 0.05))
    row, voxels = (row_of(tables[0], "5 cm", f"MRFMap{reading}") for reading in ("", ", omega"))
    assert row["median error (m)"].mean == pytest.approx(np.mean(errors), rel=1e-4)
    assert row["5cm"].mean == pytest.approx(np.mean(right), abs=1e-6)
    assert row["median error (m)"].mean < voxels["median error (m)"].mean
    assert row["log-likelihood"].mean > voxels["log-likelihood"].mean


def test_log_odds_are_read_with_and_without_free_leaves(tables: list[Table], scenes: list[Scene]) -> None:
    scene = scenes[0]
    found: dict[str, list[dict[str, float]]] = {"all leaves": [], "occupied leaves": []}
    for fold in range(FOLDS):
        m = LogOddsMap(0.2, scene.noise, volume=scene.volume, max_depth=scene.max_depth, correct_bias=True)
        mapped(m, scene, fold)
        for reading, view in (
            ("all leaves", m.view.with_occlusion(empty_below=-FAR)),
            ("occupied leaves", m.view.with_occlusion(empty_below=0.0)),
        ):
            found[reading].append(figures_by_hand(m, scene, fold, view))
    for reading, figures in found.items():
        row = row_of(tables[0], "20 cm", f"OctoMap-style, bias removed, {reading}")
        for figure, heading in COLUMNS.items():
            assert row[heading] == Spread.of([each[figure] for each in figures]), heading


def test_other_draws_of_the_noise_have_their_own_means(tables: list[Table], scenes: list[Scene]) -> None:
    table = tables[1]
    assert table.columns == ["voxels", "figure", "noise 0", "noise 1", "all"]
    assert len(table.rows) == len(SIZES) * 3
    found = []
    for fold in range(FOLDS):
        every_pixel = {"max_depth": scenes[1].max_depth, "ray_density": 0.0}
        m = MRFMap(0.05, scenes[1].noise, volume=scenes[1].volume, **every_pixel)
        found.append(figures_by_hand(mapped(m, scenes[1], fold), scenes[1], fold))
    for figure in ("1.5sigma", "5cm", "sensor"):
        row = row_of(table, "5 cm", figure)
        first = row_of(tables[0], "5 cm", "MRFMap")[COLUMNS[figure]].mean
        assert row["noise 0"] == first
        assert row["noise 1"] == Spread.of([each[figure] for each in found]).mean
        assert row["all"] == Spread.of([row["noise 0"], row["noise 1"]])
    assert row["noise 0"] != row["noise 1"]


def test_every_weight_of_the_grid_is_shown(tables: list[Table]) -> None:
    expected = [
        [size, weights.name, reading]
        for size in ("20 cm", "5 cm")
        for weights in GRID
        for reading in ("all leaves", "occupied leaves")
    ]
    assert [row[:3] for row in tables[2].rows] == expected
    assert tables[2].notes == ["Maps of 2 views, judged on the fold's held-out view."]
    means = [row[3].mean for row in tables[2].rows]
    assert len(set(means)) > len(GRID)
    assert np.isfinite(means).all()


def test_csv_holds_the_table(tables: list[Table], out: Path) -> None:
    with open(out / "table1.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    for row, found in zip(rows, tables[0].rows, strict=True):
        by_name = dict(zip(tables[0].columns, found, strict=True))
        for heading in COLUMNS.values():
            spread = by_name[heading]
            assert float(row[heading]) == pytest.approx(spread.mean, rel=1e-15, nan_ok=True)
            deviation = row[f"{heading} (std)"]
            assert (float(deviation) if deviation else None) == spread.deviation


def csv_without_times(folder: Path) -> dict[str, list[list[str]]]:
    """Name -> cells of every CSV file in a folder, but for how long the maps took."""
    tables = {}
    for path in sorted(folder.glob("*.csv")):
        with path.open(newline="") as file:
            rows = list(csv.reader(file))
        kept = [i for i, name in enumerate(rows[0]) if name != "map (s)"]
        tables[path.name] = [[row[i] for i in kept] for row in rows]
    return tables


def test_a_finished_run_computes_nothing_again(tables: list[Table], data: Path, out: Path) -> None:
    before = {path.name: path.read_bytes() for path in out.glob("*.csv")}
    again = experiment(data, out, voxel_sizes=SIZES, seeds=SEEDS, limit=FOLDS)
    run_table1(again)
    assert again.ledger.computed == 0
    assert {path.name: path.read_bytes() for path in out.glob("*.csv")} == before


def test_an_interrupted_run_ends_in_the_same_tables(data: Path, tmp_path: Path) -> None:
    options: dict[str, Any] = {"voxel_sizes": (0.2,), "seeds": SEEDS, "limit": 1}
    whole = experiment(data, tmp_path / "whole", **options)
    run_table1(whole)
    reports: list[tuple[str, int, int]] = []

    def stop(what: str, done: int, total: int) -> None:
        reports.append((what, done, total))
        if len(reports) == 8:
            raise KeyboardInterrupt

    stopped = experiment(data, tmp_path / "stopped", **options, report=stop)
    with pytest.raises(KeyboardInterrupt):
        run_table1(stopped)
    assert reports[0] == ("MRFMap, 20 cm, noise 0", 0, 1)
    assert all(0 <= done < total for _, done, total in reports)
    assert stopped.ledger.computed == 7
    assert list(stopped.out.glob("*.csv")) == []
    with open(stopped.ledger.path, "a") as file:
        file.write('{"key": "half')
    resumed = experiment(data, stopped.out, **options)
    assert len(resumed.ledger.done) == 7
    run_table1(resumed)
    assert resumed.ledger.computed == whole.ledger.computed - 7
    assert csv_without_times(resumed.out) == csv_without_times(whole.out)


def test_results_of_other_sizes_draws_and_parameters_are_kept_apart(tables: list[Table], out: Path) -> None:
    keys = list(experiment(Path(), out).ledger.done)
    for part in ("coffin_world | noise 0 | MRFMap (", "| noise 1 | MRFMap (", "| 0.2 m | view 00", "0.05 m"):
        assert any(part in key for key in keys), part
    # In each fold 4 contenders, MRFMap for the other draw; in one a map for each weight, and the chosen one.
    assert len(keys) == len(SIZES) * (FOLDS * (4 + 1) + len(GRID) + 1)


def test_without_a_limit_every_view_is_held_out(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[Sequence[int], Sequence[int]]] = []

    def judge(
        contender: Contender, scene: Scene, size: float, keyframes: Sequence[int], judged: Sequence[int]
    ) -> dict[str, Any]:
        asked.append((keyframes, judged))
        views = {scene.views[i].name: dict.fromkeys(COLUMNS, 0.5) for i in judged}
        return {"readings": dict.fromkeys(contender.readings, views), "build_seconds": 1.0}

    for module in (folds, tuning):
        monkeypatch.setattr(module, "build_and_judge", judge)
    tables, _ = run_table1(experiment(data, tmp_path, voxel_sizes=(0.05,), seeds=(7,)))
    assert [table.name for table in tables] == ["table1", "table1_log_odds_weights"]
    assert {row[-1] for row in tables[0].rows[:-2]} == {COFFIN_VIEWS}
    assert len(asked) == COFFIN_VIEWS * 4 + len(GRID) + 1
    for keyframes, judged in asked:
        assert sorted([*keyframes, *judged]) == list(range(COFFIN_VIEWS))


def test_too_few_views_are_refused(data: Path, tmp_path: Path) -> None:
    (tmp_path / "coffin_world").mkdir()
    for path in (data / "coffin_world").iterdir():
        (tmp_path / "coffin_world" / path.name).write_bytes(path.read_bytes())
    with np.load(data / "coffin_world" / "clean_depth.npz") as file:
        few = {name: file[name][:2] if name != "K" else file[name] for name in file}
    np.savez(tmp_path / "coffin_world" / "clean_depth.npz", **few)
    with pytest.raises(ConfigError, match="coffin_world: 2 views; the experiment needs at least 3"):
        run_table1(experiment(tmp_path, tmp_path / "out"))
