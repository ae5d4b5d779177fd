"""``eval trajectory`` on the first frames of small walks."""

import itertools
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_scenes import experiment

from taichi_mrf.errors import ConfigError
from taichi_mrf.experiments.folds import Experiment
from taichi_mrf.experiments.trajectory import following, lost, tables, walks
from taichi_mrf.experiments.trajectory.walks import SHAKE_M, SHAKE_RAD, Source, walk_name
from taichi_mrf.geometry.poses import tangent_norms

pytestmark = pytest.mark.usefixtures("one_backend")


def chosen(tmp_path: Path, **options: Any) -> Experiment:
    return experiment(tmp_path, tmp_path / "out", voxel_sizes=(0.1,), seeds=(0,), **options)


def test_a_few_frames_of_the_room(tmp_path: Path) -> None:
    run = chosen(tmp_path, limit=12, only=("room, 10 Hz",))
    (errors, maps), paths = tables.run_trajectory(run)
    row = dict(zip(errors.columns, errors.rows[0], strict=True))
    assert (row["walk"], row["poses by"], row["frames"], row["lost"]) == ("room, 10 Hz", "tracking", 12, 0)
    assert 0 < row["RMS (cm)"] < 5
    assert row["RMS (cm)"] <= row["anchored (cm)"] <= row["largest (cm)"]
    assert 6 < row["moves (cm)"] < 10
    assert row["CPU (ms)"] > 0
    assert [each[2] for each in maps.rows][-1] == tables.TRUE
    assert all(each[4] > 0.5 and each[-1] == 1 for each in maps.rows)
    assert {path.suffix for path in paths} == {".csv", ".tex", ".png"}
    before = run.ledger.computed
    again, _ = tables.run_trajectory(run)
    assert [table.rows for table in again] == [errors.rows, maps.rows]
    assert run.ledger.computed == before


def test_parts_are_chosen_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names: list[str] = []

    def walked(experiment: Experiment, source: Source, rate: float, voxel_size: float) -> list[Any]:
        names.append(walk_name(source, rate))
        return []

    monkeypatch.setattr(tables, "_walked", walked)
    monkeypatch.setattr(tables, "_lost", lambda experiment, case, voxel_size: names.append(case) or [])
    tables.run_trajectory(chosen(tmp_path, only=("house, 5 Hz", "kitchen*")))
    assert names == ["kitchen, 3 Hz", "kitchen in colour, 3 Hz", "house, 5 Hz"]
    names.clear()
    tables.run_trajectory(chosen(tmp_path))
    assert len(names) == len(set(names)) > 15
    assert lost.SEEN in names
    with pytest.raises(ConfigError, match=r"--only leaves none of: kitchen, 3 Hz; .*room, 30 Hz"):
        tables.run_trajectory(chosen(tmp_path, only=("attic",)))


def test_an_unsure_frame_is_told_from_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The third frame of four is unsure and 10 cm off, the last is lost."""
    run = chosen(tmp_path, limit=4)
    (source,) = (each for each in walks.sources() if each.name == walks.ROOM)
    walk = source.take(run, 10.0)
    poses = {i: walk.frames[i].T_world_camera.copy() for i in range(3)}
    poses[2][0, 3] += 0.1
    stub = following.Followed(_Mapped(), poses, {2}, 0.4)  # type: ignore[arg-type]
    monkeypatch.setattr(following, "followed", lambda *rest, **options: stub)
    result = following.tracked_result(walk, following.configurations(0.1)["tracking"], judge=False)
    assert (result["of"], result["frames"], result["lost"], result["unsure"]) == (4, 3, 1, 1)
    assert result["unsure_step_m"] == pytest.approx(0.1)
    assert result["sure_step_m"] == pytest.approx(0.0, abs=1e-9)
    assert result["end_m"] == pytest.approx(0.1)
    assert result["cpu_s"] == pytest.approx(0.1)


class _Mapped:
    """The part of a MappingResult that is read."""

    class map:  # noqa: N801
        keyframes = (1, 2)


def test_a_hand_shakes_a_little_and_smoothly() -> None:
    poses = [walks.shaken(np.eye(4), i / 30) for i in range(300)]
    turns, shifts = np.transpose([tangent_norms(np.eye(4), T) for T in poses])
    assert 0.5 * SHAKE_M < shifts.max() < 2 * SHAKE_M
    assert 0.5 * SHAKE_RAD < turns.max() < 2 * SHAKE_RAD
    assert max(tangent_norms(a, b)[1] for a, b in itertools.pairwise(poses)) < 0.01


def test_a_covered_camera_leaves_the_map_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lost, "BEFORE", 12)
    monkeypatch.setattr(lost, "COVERED", 4)
    monkeypatch.setattr(lost, "AFTER", 3)
    monkeypatch.setitem(lost.PLACES, lost.SAME, (walks.room_walk, 1.2))
    run = chosen(tmp_path, only=(f"lost, {lost.SAME}", f"lost, {lost.UNSEEN}"))
    (table,), _ = tables.run_trajectory(run)
    for row in table.rows:
        figures = dict(zip(table.columns, row, strict=True))
        assert (figures["found covered"], figures["map kept"]) == (0, "yes")
        assert figures["5cm before"] > 0.8
        assert 0 < figures["error before (cm)"] < 8
        if lost.SAME in row[0]:
            assert (figures["found after"], figures["of these wrong"]) == (3, 0)
            assert figures["error after (cm)"] < 8
            assert figures["5cm after"] > figures["5cm before"] - 0.02
        else:
            assert figures["found after"] == figures["of these wrong"]


def test_without_open3d_its_rows_are_left_out_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    run = chosen(tmp_path, limit=3, only=("room, 5 Hz",))
    (table,), _ = tables.run_trajectory(run)
    assert not any("Open3D" in row[2] for row in table.rows)
    assert table.notes[-1].startswith("Open3D's rows are left out: the comparison needs open3d")
    assert table.notes[-1].endswith("pip install 'taichi-mrf[bench]'.")


def test_open3d_follows_the_room(tmp_path: Path) -> None:
    pytest.importorskip("open3d", reason="the peer needs the extra bench")
    run = chosen(tmp_path, limit=8, only=("room in colour, 10 Hz",))
    tables_, _ = tables.run_trajectory(run)
    rows = {row[2]: dict(zip(tables_[0].columns, row, strict=True)) for row in tables_[0].rows}
    for name in (tables.OPEN3D, tables.OPEN3D_GRAPH):
        assert (rows[name]["frames"], rows[name]["unsure"]) == (8, None)
        assert rows[name]["RMS (cm)"] < 10
