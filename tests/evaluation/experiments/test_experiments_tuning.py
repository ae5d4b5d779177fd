"""Tuned log-odds: weights are chosen by views that may choose, never by the one they are judged on."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_scenes import experiment

from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.evaluation.experiments import tuning
from taichi_mrf.evaluation.experiments.contenders import BOTH, Contender
from taichi_mrf.evaluation.experiments.folds import Scored
from taichi_mrf.evaluation.experiments.scenes import Scene, SceneView
from taichi_mrf.evaluation.experiments.tuning import (
    EVERY,
    GRID,
    MOST_KEYFRAMES,
    Weights,
    tuned_contender,
    tuned_leave_one_out,
)
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise

COUNT = 11
FOLDS = list(range(0, COUNT, EVERY))
BY_NAME = {weights.contender().name: weights for weights in GRID}
Score = Callable[[Weights, int, int, str], float]
"""Score of a map with these weights on a view, in a fold, under a reading."""


def scene(count: int = COUNT) -> Scene:
    nothing = np.zeros((1, 1), np.float32)
    views = [SceneView(f"view {i}", np.eye(4), nothing, nothing, nothing > 0) for i in range(count)]
    return Scene("scene", PinholeCamera(1, 1, 1, 1, 0, 0), PolynomialNoise((0.01,)), VolumeConfig(), 1, views)


@dataclass
class Judge:
    """Stands in for mapping and judging: scores are made up, and who asked for what is written down."""

    score: Score
    asked: list[tuple[Weights, tuple[int, ...], tuple[int, ...]]] = field(default_factory=list)

    def __call__(
        self, contender: Contender, s: Scene, size: float, keyframes: Sequence[int], judged: Iterable[int]
    ) -> dict[str, Any]:
        judged = tuple(judged)
        weights = BY_NAME[contender.name]
        self.asked.append((weights, tuple(keyframes), judged))
        readings = {
            reading: {
                f"view {view}": {"sensor": self.score(weights, view, judged[-1], reading)} for view in judged
            }
            for reading in contender.readings
        }
        return {"readings": readings, "build_seconds": 0.0}

    def chosen(self, fold: int) -> Weights:
        """The weights of the map of all views but the fold's."""
        (weights,) = {w for w, keyframes, judged in self.asked if judged == (fold,)}
        return weights


def tuned(folder: Path, score: Score, limit: int | None = None) -> tuple[Judge, list[Scored], list[Scored]]:
    judge = Judge(score)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tuning, "build_and_judge", judge)
        found = tuned_leave_one_out(experiment(Path(), folder, limit=limit), scene(), 0, 0.2)
    return judge, *found


def made_up(best: Sequence[int], test: float) -> Score:
    """On a fold's validation view GRID[best[fold]] scores best; on its test view whatever ``test`` makes."""

    def score(weights: Weights, view: int, fold: int, reading: str) -> float:
        place = GRID.index(weights)
        if view == fold:
            return ((place + 1) * (fold + 1) * test) % 1.0
        assert view == (fold + 1) % COUNT
        return 0.9 if place == best[fold] and reading == "occupied leaves" else 0.5 - 0.01 * place

    return score


@pytest.mark.parametrize("seed", range(4))
def test_the_best_on_the_validation_view_is_taken_whatever_the_test_view_says(
    tmp_path: Path, seed: int
) -> None:
    random = np.random.default_rng(seed)
    best, test = random.integers(len(GRID), size=COUNT).tolist(), float(random.uniform(0.01, 0.99))
    judge, rows, _ = tuned(tmp_path, made_up(best, test))
    assert [judge.chosen(fold) for fold in FOLDS] == [GRID[best[fold]] for fold in FOLDS]
    # What is reported is the chosen weights' score on the test view, good or bad.
    for row in rows:
        fold = int(row.view.removeprefix("view "))
        assert row.figures["sensor"] == ((best[fold] + 1) * (fold + 1) * test) % 1.0


def test_no_map_holds_the_view_it_is_judged_on(tmp_path: Path) -> None:
    judge, rows, every = tuned(tmp_path, made_up([0] * COUNT, 0.3))
    for _, keyframes, judged in judge.asked:
        assert not set(keyframes) & set(judged)
        assert set(keyframes) | set(judged) == set(range(COUNT))
    trials = [asked for asked in judge.asked if len(asked[2]) == 2]
    assert len(trials) == len(FOLDS) * len(GRID)
    assert {judged for _, _, judged in trials} == {((fold + 1) % COUNT, fold) for fold in FOLDS}
    assert len(judge.asked) == len(trials) + len(FOLDS)
    assert [row.row for row in rows[:2]] == [f"{tuning.NAME}, {reading}" for reading in BOTH]
    assert {row.view for row in rows} == {f"view {fold}" for fold in FOLDS}
    # Shown of the trials is the test view alone.
    assert len(every) == len(FOLDS) * len(GRID) * len(BOTH)
    assert all(each.figures["sensor"] != 0.9 for each in every)


@pytest.mark.parametrize("keyframes", [[0, 3, 4, 7, 8], list(range(0, 80, 2)), [2, 5], [6]])
def test_weights_for_given_keyframes_are_tuned_on_these_alone(tmp_path: Path, keyframes: list[int]) -> None:
    best = GRID[4]

    def score(weights: Weights, view: int, _: int, reading: str) -> float:
        return 0.8 if weights == best and reading == "all leaves" else 0.3

    judge = Judge(score)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tuning, "build_and_judge", judge)
        contender = tuned_contender(experiment(Path(), tmp_path), scene(80), 0, 0.2, keyframes)
    assert contender.name == tuning.NAME
    assert contender.signature(scene(), 0.2) == best.contender().signature(scene(), 0.2)
    assert [weights for weights, _, _ in judge.asked] == list(GRID)
    ((training, judged),) = {(training, judged) for _, training, judged in judge.asked}
    assert len(judged) == 1
    assert set(training) | set(judged) <= set(keyframes)
    assert not set(training) & set(judged)
    assert len(training) + 1 == min(
        len(keyframes), len(range(0, len(keyframes), -(-len(keyframes) // MOST_KEYFRAMES)))
    )


def test_a_limit_is_the_number_of_folds(tmp_path: Path) -> None:
    judge, rows, every = tuned(tmp_path, made_up([1] * COUNT, 0.3), limit=2)
    assert {row.view for row in [*rows, *every]} == {f"view {fold}" for fold in FOLDS[:2]}
    assert len(judge.asked) == 2 * (len(GRID) + 1)


def test_weights_are_what_they_say() -> None:
    assert len(set(GRID)) == len(GRID) == len(BY_NAME)
    for weights in GRID:
        config = weights.contender().make(scene(), 0.1).config.log_odds
        assert np.log(config.hit / (1 - config.hit)) == pytest.approx(weights.hit)
        assert np.log(config.miss / (1 - config.miss)) == pytest.approx(weights.miss)
        assert (config.update, config.correct_bias) == ("ray", True)
        assert weights.hit > 0 > weights.miss
