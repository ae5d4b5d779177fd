"""Scores of probabilities against truth, worked out again pair by pair and voxel by voxel; their pictures."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation import occupancy_scores
from taichi_mrf.evaluation.occupancy_scores import ROC_STEPS, OccupancyScores, RocCurve, score_occupancy
from taichi_mrf.evaluation.pictures.reliability import reliability_figure, roc_figure

few_values = st.sampled_from([0.0, 0.05, 0.1, 0.3, 0.5, 0.5001, 0.7, 0.95, 1.0])
probabilities = st.one_of(few_values, st.floats(0, 1, width=32, allow_subnormal=False))
cases = st.lists(st.tuples(probabilities, st.booleans()), min_size=1, max_size=60)
thresholds = st.one_of(few_values, st.floats(0, 1, width=32))


def arrays(case: list[tuple[float, bool]]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    return np.array([p for p, _ in case], np.float32), np.array([truth for _, truth in case], bool)


def same(found: float, expected: float | None) -> bool:
    """None stands for a figure that is not defined."""
    return math.isnan(found) if expected is None else found == pytest.approx(expected, abs=1e-9)


@settings(max_examples=300)
@given(cases, thresholds)
def test_precision_recall_and_f1_count_voxels(case: list[tuple[float, bool]], threshold: float) -> None:
    p, truth = arrays(case)
    found = score_occupancy(p, truth, threshold=threshold)
    right = mistaken = missed = 0
    for value, occupied in zip(p, truth, strict=True):
        right += bool(value >= np.float32(threshold) and occupied)
        mistaken += bool(value >= np.float32(threshold) and not occupied)
        missed += bool(value < np.float32(threshold) and occupied)
    assert (found.count, found.occupied, found.threshold) == (len(case), right + missed, threshold)
    assert same(found.precision, right / (right + mistaken) if right + mistaken else None)
    assert same(found.recall, right / (right + missed) if right + missed else None)
    assert same(found.f1, 2 * right / (2 * right + mistaken + missed) if right + mistaken + missed else None)


@settings(max_examples=300)
@given(cases)
def test_the_roc_area_counts_pairs(case: list[tuple[float, bool]]) -> None:
    p, truth = arrays(case)
    wins = [(a > b) + 0.5 * (a == b) for a in p[truth] for b in p[~truth]]
    assert same(score_occupancy(p, truth).roc_area, float(np.mean(wins)) if wins else None)


@settings(max_examples=300)
@given(cases)
def test_the_average_precision_steps_over_thresholds(case: list[tuple[float, bool]]) -> None:
    p, truth = arrays(case)
    area, recall_before = 0.0, 0.0
    for threshold in sorted(set(p.tolist()), reverse=True):
        taken = p >= np.float32(threshold)
        recall = (taken & truth).sum() / max(truth.sum(), 1)
        area += (recall - recall_before) * (taken & truth).sum() / taken.sum()
        recall_before = recall
    assert same(score_occupancy(p, truth).average_precision, area if truth.any() else None)


@settings(max_examples=300)
@given(cases, st.integers(1, 12))
def test_brier_score_and_reliability_follow_their_definitions(
    case: list[tuple[float, bool]], bins: int
) -> None:
    p, truth = arrays(case)
    found = score_occupancy(p, truth, bins=bins)
    assert found.brier == pytest.approx(np.mean([(float(a) - b) ** 2 for a, b in zip(p, truth, strict=True)]))
    np.testing.assert_allclose(found.reliability.edges, [i / bins for i in range(bins + 1)])
    members: list[list[tuple[float, bool]]] = [[] for _ in range(bins)]
    for value, occupied in zip(p.tolist(), truth.tolist(), strict=True):
        members[min(int(value * bins), bins - 1)].append((value, occupied))
    error = 0.0
    for i, voxels in enumerate(members):
        assert found.reliability.count[i] == len(voxels)
        if not voxels:
            assert math.isnan(found.reliability.predicted[i])
            assert math.isnan(found.reliability.observed[i])
            continue
        predicted, observed = np.mean(voxels, axis=0)
        assert found.reliability.predicted[i] == pytest.approx(predicted)
        assert found.reliability.observed[i] == pytest.approx(observed)
        assert i / bins - 1e-9 <= found.reliability.predicted[i] <= (i + 1) / bins + 1e-9
        error += len(voxels) / len(case) * abs(predicted - observed)
    assert found.calibration_error == pytest.approx(error, abs=1e-12)


@settings(max_examples=300)
@given(cases, thresholds)
def test_the_roc_curve_is_that_of_its_thresholds(case: list[tuple[float, bool]], threshold: float) -> None:
    """With few voxels nothing is thinned: the area under it is that of all pairs."""
    p, truth = arrays(case)
    found = score_occupancy(p, truth, threshold=threshold)
    roc = found.roc
    assert roc.threshold[0] == np.inf
    assert (np.diff(roc.threshold) < 0).all()
    assert np.float32(threshold) in roc.threshold
    for rate, kind in ((roc.true_positive_rate, p[truth]), (roc.false_positive_rate, p[~truth])):
        if len(kind) == 0:
            assert np.isnan(rate).all()
            continue
        np.testing.assert_allclose(rate, [(kind >= t).mean() for t in roc.threshold])
        assert (rate[0], rate[-1]) == (0, 1)
    assert same(area_under(roc), found.roc_area if 0 < truth.sum() < len(p) else None)


def area_under(roc: RocCurve) -> float:
    """The trapezoids between its points."""
    heights = 0.5 * (roc.true_positive_rate[1:] + roc.true_positive_rate[:-1])
    return float(np.sum(np.diff(roc.false_positive_rate) * heights))


def drawn(count: int, seed: int, overconfidence: float = 1.0) -> tuple[NDArray, NDArray]:
    """Voxels whose truth follows their probability, which is then stated too far from a half, or too near."""
    random = np.random.default_rng(seed)
    log_odds = random.normal(-1.5, 2.5, count)
    truth = random.random(count) < 1 / (1 + np.exp(-log_odds))
    return (1 / (1 + np.exp(-overconfidence * log_odds))).astype(np.float32), truth


def test_a_long_roc_curve_is_thinned_and_keeps_its_area() -> None:
    found = score_occupancy(*drawn(50_000, 1))
    assert ROC_STEPS < len(found.roc.threshold) <= 2 * ROC_STEPS + 2
    for rate in (found.roc.true_positive_rate, found.roc.false_positive_rate):
        assert np.diff(rate).max() < 1.5 / ROC_STEPS
    assert area_under(found.roc) == pytest.approx(found.roc_area, abs=1e-4)


def test_honest_probabilities_are_calibrated_and_others_are_not() -> None:
    honest = score_occupancy(*drawn(200_000, 2))
    bold, shy = (score_occupancy(*drawn(200_000, 2, factor)) for factor in (2.5, 0.4))
    # The standard error of a share over n voxels is at most 1 / (2 sqrt n).
    expected_error = np.average(0.5 / np.sqrt(honest.reliability.count), weights=honest.reliability.count)
    assert honest.calibration_error < 2 * expected_error
    for other in (bold, shy):
        assert other.calibration_error > 5 * honest.calibration_error
        assert other.brier > honest.brier
        # The order of the voxels is what it was.
        assert other.roc_area == pytest.approx(honest.roc_area, abs=1e-4)
    assert bold.reliability.observed[-2] < bold.reliability.edges[-3]
    assert shy.reliability.observed[-5] > shy.reliability.edges[-5]


def test_blocks_of_voxels_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    p, truth = drawn(1000, 3)
    whole = score_occupancy(p, truth)
    monkeypatch.setattr(occupancy_scores, "_BLOCK", 37)
    parts = score_occupancy(p, truth)
    assert parts.brier == pytest.approx(whole.brier, rel=1e-12)
    np.testing.assert_array_equal(parts.reliability.count, whole.reliability.count)
    np.testing.assert_allclose(parts.reliability.predicted, whole.reliability.predicted, rtol=1e-12)


@given(cases)
def test_scores_survive_json(case: list[tuple[float, bool]]) -> None:
    scores = score_occupancy(*arrays(case))
    again = OccupancyScores.from_json(json.loads(json.dumps(scores.to_json())))
    assert again.to_json().keys() == scores.to_json().keys()
    for name, value in vars(scores).items():
        if isinstance(value, int | float):
            np.testing.assert_equal(getattr(again, name), value)
        else:
            for part, values in vars(value).items():
                np.testing.assert_array_equal(getattr(getattr(again, name), part), values)
                assert getattr(getattr(again, name), part).dtype == values.dtype


@pytest.mark.parametrize(
    ("p", "truth", "problem"),
    [
        ([], np.zeros(0, bool), "there is no voxel to score"),
        ([0.5, 0.5], [True], r"shape \(2,\) and truths of shape \(1,\)"),
        ([[0.5]], [[True]], r"must have the shape \(N,\)"),
        ([0.5, 1.25], [True, False], "a probability of 1.25 does not lie between 0 and 1"),
        ([0.5, -0.25], [True, False], "a probability of -0.25"),
        ([0.5, math.nan], [True, False], "a probability of nan"),
        ([0.5, 0.2], [1, 0], "must be boolean, not int64"),
    ],
)
def test_what_cannot_be_scored_is_refused(p: list, truth: list, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        score_occupancy(np.array(p, float), truth)


def test_a_diagram_needs_a_bin() -> None:
    with pytest.raises(ConfigError, match="needs at least one bin, not 0"):
        score_occupancy([0.5], [True], bins=0)


def several() -> dict[str, OccupancyScores]:
    return {
        "honest": score_occupancy(*drawn(20_000, 4)),
        "bold, with a name of more than one line": score_occupancy(*drawn(20_000, 4, 2.5)),
        "shy": score_occupancy(*drawn(20_000, 4, 0.4)),
        "half empty": score_occupancy([0.1, 0.9, 0.91], [False, True, False]),
        "nothing occupied": score_occupancy([0.1, 0.9], [False, False]),
    }


def test_a_reliability_diagram_shows_each_methods_shares_and_counts(tmp_path: Path) -> None:
    methods = several()
    figure = reliability_figure(methods)
    panels = [axes for axes in figure.axes if axes.axison]
    assert len(panels) == 2 * len(methods)
    titled = {axes.get_title().replace("\n", " "): axes for axes in panels if axes.get_title()}
    for (title, share), (name, scores) in zip(titled.items(), methods.items(), strict=True):
        assert title.startswith(name)
        assert f"calibration error {scores.calibration_error:.2g}" in title
        filled = scores.reliability.count > 0
        np.testing.assert_allclose(
            [bar.get_height() for bar in share.patches], scores.reliability.observed[filled]
        )
        np.testing.assert_allclose(
            [bar.get_x() for bar in share.patches], scores.reliability.edges[:-1][filled]
        )
    counts = [bar.get_height() for axes in panels if not axes.get_title() for bar in axes.patches]
    assert sum(counts) == sum(scores.count for scores in methods.values())
    figure.savefig(tmp_path / "reliability.png")
    assert (tmp_path / "reliability.png").stat().st_size > 10_000


def test_a_roc_figure_draws_each_curve_and_its_threshold(tmp_path: Path) -> None:
    methods = several()
    figure = roc_figure(methods)
    for axes in figure.axes:
        lines = {line.get_label(): line for line in axes.lines}
        marks = [line for line in axes.lines if line.get_marker() == "o"]
        assert len(marks) == len(methods)
        for mark, (name, scores) in zip(marks, methods.items(), strict=True):
            curve = lines[f"{name} ({scores.roc_area:.4f})"]
            np.testing.assert_array_equal(curve.get_ydata(), scores.roc.true_positive_rate)
            np.testing.assert_allclose(mark.get_ydata(), [scores.recall])
    figure.savefig(tmp_path / "roc.png")
    assert (tmp_path / "roc.png").stat().st_size > 10_000


@pytest.mark.parametrize("draw", [reliability_figure, roc_figure])
def test_no_method_is_no_picture(draw: type) -> None:
    with pytest.raises(ConfigError, match="there are no scores to draw"):
        draw({})
