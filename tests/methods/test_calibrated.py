"""The calibrated reading: against its formula voxel by voxel, across chunks, and of a wall."""

import math

import numpy as np
import pytest
from one_pixel import VOXEL
from uncertain_wall import WALL_M, uncertain_wall

from taichi_mrf.export.fused_surface import MARGIN, blended_sums
from taichi_mrf.methods.mrf.calibrated import (
    BLUR,
    DOUBT,
    MARGINAL,
    NOISE,
    PRIOR,
    REACH,
    calibrated_log_odds,
    surface_evidence,
)
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.voxels.layout import BRICK

pytestmark = pytest.mark.usefixtures("one_backend")


def by_hand(d: float, extent: float, steep: float, weight: float) -> float:
    """The evidence for a voxel whose centre lies ``d`` voxels in front of a surface."""
    s = math.sqrt(NOISE / (16 * weight * steep**2) + BLUR**2)
    below, above = (1 / (1 + math.exp(-(d + side * REACH * extent) / s)) for side in (-1, 1))
    z = min(max(above - below, 1e-4), 1 - 1e-4)
    return math.log(z / (1 - z))


@pytest.mark.parametrize("weight", [0.02, 3.0])
def test_a_plane_gives_what_the_formula_says(weight: float) -> None:
    normal, steep, offset = np.array([0.8, 0.0, -0.6]), 1.3, 0.4
    centre = np.indices((7, 7, 7)).reshape(3, -1).T - 3.0
    distance = steep * (centre @ normal - offset)  # along rays that meet the plane at an angle
    sums = np.full((7, 7, 7), weight, np.float32)
    found, behind = surface_evidence(sums, (weight * distance).reshape(7, 7, 7).astype(np.float32))
    expected = np.array([by_hand(d / steep, 0.7, steep, weight) for d in distance]).reshape(7, 7, 7)
    inner = (slice(1, -1),) * 3
    np.testing.assert_allclose(found, expected[inner], atol=2e-3)
    np.testing.assert_array_equal(behind, (distance < 0).reshape(7, 7, 7)[inner])
    assert found.min() < -1
    assert (found > 2).any() == (weight > 1)


def test_without_distances_there_is_no_answer() -> None:
    weight = np.ones((5, 5, 5), np.float32)
    weight[2, 2, 2] = 0.0
    found, _ = surface_evidence(weight, np.zeros_like(weight))
    assert np.isnan(found[1, 1, 1])
    assert np.isfinite(found).sum() == 26


def test_an_uncertain_wall_is_where_it_was_measured() -> None:
    m = uncertain_wall()
    centres, p = m.calibrated().voxels()
    assert len(centres) > 3 * len(m.voxels()[0])
    assert (np.abs(centres[:, 2] - WALL_M) < 1.5 * VOXEL).mean() > 0.8
    assert p.max() <= 1
    assert p.min() > 0.5


def test_evidence_and_marginals_are_joined() -> None:
    m = uncertain_wall()
    field, pool = m.surface_field(), m.view.pool
    found = calibrated_log_odds(field, pool)
    prior, marginals = pool.prior_log_odds, pool.belief.to_numpy().reshape(found.shape)
    for slot in pool.in_use:  # each brick by itself: a chunk ends nowhere
        first = pool.bricks[slot].astype(np.int64) * BRICK - 1 - MARGIN
        evidence, behind = surface_evidence(*blended_sums(*field.box(first, BRICK + 2 + 2 * MARGIN)[:2]))
        evidence, behind = evidence.reshape(-1), behind.reshape(-1)
        expected = evidence - DOUBT + PRIOR * prior + MARGINAL * np.clip(marginals[slot] - prior, -10, 10)
        expected[behind] = np.maximum(expected[behind], np.minimum(marginals[slot], prior)[behind])
        none = np.isnan(evidence)
        expected[none] = marginals[slot][none]
        np.testing.assert_allclose(found[slot], expected, atol=1e-5)


def test_the_reading_follows_edits() -> None:
    edited, plain = uncertain_wall(3), uncertain_wall(2)
    edited.remove_keyframe(2)
    edited.infer()
    centres, _ = plain.voxels(0.0)
    np.testing.assert_array_equal(
        edited.calibrated().occupancy(centres), plain.calibrated().occupancy(centres)
    )
    assert len(MRFMap(VOXEL).calibrated().voxels()[0]) == 0


def test_balls_and_paths_are_asked_by_calibrated_probabilities_found_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    m = uncertain_wall()
    ball, way = np.array([[0.05, 0.02, WALL_M - 0.25]]), [[0.05, 0.02, 1.0], [0.05, 0.02, WALL_M - 0.25]]
    found, path = m.occupied_within(ball, 0.15), m.path_collision(way, 0.15)
    calibrated = m.calibrated()
    assert found == calibrated.occupied_within(ball, 0.15)
    assert path == calibrated.path_collision(way, 0.15)
    assert abs(found - m.layer().occupied_within(ball, 0.15)) > 0.01
    with monkeypatch.context() as patch:
        patch.setattr(m, "surface_field", lambda between: pytest.fail("the distances are found again"))
        assert m.occupied_within(ball, 0.15) == found
    m.remove_keyframe(1)
    m.infer()
    assert m.occupied_within(ball, 0.15) != found


def test_without_distances_balls_are_asked_by_marginals() -> None:
    m = uncertain_wall()
    m.freeze_keyframe(0)
    ball = np.array([[0.05, 0.02, WALL_M - 0.25]])
    assert not m.has_surface
    assert m.occupied_within(ball, 0.15) == m.layer().occupied_within(ball, 0.15)
