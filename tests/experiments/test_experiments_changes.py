"""`taichi-mrf eval changes`: what is counted, with maps that know everything or nothing, and a tiny run."""

import json
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from small_scenes import experiment

from taichi_mrf.datasets.synthetic.moving_scene import distance_to_solids
from taichi_mrf.evaluation.moving_truth import MovingTruth
from taichi_mrf.experiments import change_runs, changes
from taichi_mrf.experiments.change_runs import (
    ChangeContender,
    Watch,
    moving_truth,
    perfect_drives,
    run_script,
)
from taichi_mrf.experiments.changes import CLAMPED, DECAY, Figures, run_changes
from taichi_mrf.queries.points import FREE, OCCUPIED

VOXEL = 0.1
SMALL = "&width=80&height=60"


LOWEST, SHAPE = np.array([-12, -30, -13]), (44, 36, 22)
"""The voxels of the part of the room in which things happen."""


@cache
def _room_m(truth: MovingTruth) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The voxels' centres, and how far they are from what never moves."""
    centres = (np.indices(SHAPE).reshape(3, -1).T + LOWEST + 0.5) * VOXEL
    return centres, truth.scene.static.signed_distance(centres)


class _Known:
    """A map that has the true scene: of the newest keyframe, or, if it is ``blind``, without what moves."""

    METHOD = SimpleNamespace(has_messages=False)
    voxel_size = VOXEL

    def __init__(self, truth: MovingTruth, blind: bool) -> None:
        self.truth, self.blind = truth, blind
        self.centres, self.static_m = _room_m(truth)
        self.distance_m = self.static_m
        self.dynamic: Any = None

    def add_keyframe(self, *args: Any, stamp_s: float) -> int:
        scene = self.truth.scene
        things, new = scene.solids_of_things(stamp_s), self.truth.newly_there(stamp_s)
        if not self.blind:
            self.distance_m = np.minimum(self.static_m, distance_to_solids(things, self.centres))
        layer = self.centres[np.abs(distance_to_solids(new, self.centres)) < 0.05]
        self.dynamic = SimpleNamespace(voxels=lambda: (layer[: 0 if self.blind else None], None))
        return 0

    def voxels(self) -> tuple[NDArray[np.float64], None]:
        return self.centres[np.abs(self.distance_m) < 0.45 * VOXEL], None

    def state(self, points: ArrayLike) -> NDArray[np.int8]:
        place = np.clip(np.floor(np.asarray(points) / VOXEL).astype(int) - LOWEST, 0, np.array(SHAPE) - 1)
        distance_m = self.distance_m.reshape(SHAPE)[tuple(place.T)]
        return np.where(distance_m < 0.87 * VOXEL, OCCUPIED, FREE).astype(np.int8)


def known(truth: MovingTruth, blind: bool) -> ChangeContender:
    return ChangeContender("known", "", lambda size: _Known(truth, blind), layered=True)  # type: ignore[arg-type,return-value]


@pytest.fixture(scope="module")
def truths(one_backend: str) -> dict[str, MovingTruth]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(change_runs, "SIZE", SMALL)
        return {"things": moving_truth("things", 0, 44), "walker": moving_truth("walker", 0, 26)}


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(change_runs, "SIZE", SMALL)
    monkeypatch.setattr(change_runs, "PATHS", 12)


def test_a_map_that_is_always_right(truths: dict[str, MovingTruth]) -> None:
    results = [run_script(known(truth, False), truth, VOXEL) for truth in truths.values()]
    assert {watch["name"] for watch in results[0]["came"]} == {
        "ball 20-42 s",
        "chair 28-60 s",
        "stool 32-60 s",
    }
    assert {watch["name"] for watch in results[0]["left"]} == {"ball 20-42 s", "crate 0-24 s", "chair 0-28 s"}
    figures = Figures.of(results)
    assert (figures.came, figures.left) == (3, 3)
    assert figures.came_views == figures.left_views == 1
    assert figures.trail == figures.trail_at_end == figures.walls_lost == figures.in_the_air == 0
    assert figures.precision == 1
    assert figures.recall > 0.8
    assert figures.new_lost < 0.1
    things, walker = (result["drives"] for result in results)
    assert things["hit"] == 0
    assert 0 < walker["hit"] < 0.1 * walker["taken"]  # the person walks on after the keyframe
    assert things["taken"] > 50
    assert things["refused"] < 0.2 * things["free"]


def test_a_map_that_never_sees_what_moves(truths: dict[str, MovingTruth]) -> None:
    result = run_script(known(truths["walker"], True), truths["walker"], VOXEL)
    figures = Figures.of([result])
    assert figures.trail == 0
    assert figures.new_lost > 0.7
    assert np.isnan(figures.precision)
    assert result["drives"]["hit"] > 0.05 * result["drives"]["taken"]


def test_who_knows_the_scene_is_hit_by_what_moves_after_the_keyframe(truths: dict[str, MovingTruth]) -> None:
    things, walker = perfect_drives(truths["things"]), perfect_drives(truths["walker"])
    assert things.hit == things.refused == 0
    assert things.taken >= things.free > 0
    assert 0 < walker.hit < 0.2 * walker.taken


def test_a_watch_counts_views_until_the_map_is_right() -> None:
    watch = Watch("ball")
    for done in (False, False, True, False):
        watch.see(done)
    assert (watch.seen, watch.after) == (3, 3)
    never = Watch("crate")
    never.see(False)
    assert (never.seen, never.after) == (1, None)


def test_what_is_never_shown_counts_as_one_view_more() -> None:
    run = {
        "came": [{"seen": 2, "after": 2}, {"seen": 9, "after": None}], "left": [], "trail": [],
        "new": {"points": 0, "in_map": 0, "in_layer": 0, "voxels": 0, "right": 0},
        "walls": 10, "walls_lost": 1, "points_lost": 0.2, "no_surface": 0.0, "in_the_air": 0.0,
    }  # fmt: skip
    figures = Figures.of([run, run | {"walls": 30, "walls_lost": 0}])
    assert (figures.came, figures.came_of, figures.came_views) == (2, 4, 6.0)
    assert np.isnan(figures.left_views)
    assert figures.walls_lost == 1 / 40


def test_a_tiny_run_makes_both_tables(
    one_backend: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(changes, "HITS", (0.7,))
    monkeypatch.setattr(changes, "MISSES", (0.3,))
    monkeypatch.setattr(changes, "HALF_LIVES_S", (10.0,))
    monkeypatch.setattr(changes, "WITH_DECAY", ((0.7, 0.4),))
    monkeypatch.setattr(changes, "SCRIPTS", ("things",))
    run = experiment(tmp_path, tmp_path, voxel_sizes=(0.1,), seeds=(0,), limit=13)
    (table, drives), paths = run_changes(run)
    assert [row[0] for row in table.rows] == ["MRFMap, static", "MRFMap, dated", CLAMPED, DECAY]
    assert all(len(row) == len(table.columns) for row in table.rows)
    assert all(len(row) == len(drives.columns) for row in drives.rows)
    assert {path.name for path in paths} == {
        f"{name}.{kind}" for name in ("changes", "changes_drives") for kind in ("csv", "tex", "png")
    }
    assert any("half-life 10 s" in note for note in table.notes)
    keys = [json.loads(line)["key"] for line in run.ledger.path.read_text().splitlines()[1:]]
    assert sum("tuning" in key for key in keys) == 2
    assert len(keys) == 6
    dated = dict(zip(table.columns, table.rows[1], strict=True))
    assert np.isnan(dated["newcomer, views"])  # nothing has come yet
    assert dated["walls lost %"] < 5
