"""The calibrated reading: against its formula voxel by voxel, across chunks, and of a wall."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from one_pixel import VOXEL
from uncertain_wall import WALL_M, uncertain_wall

from taichi_mrf.methods.mrf import calibrated
from taichi_mrf.methods.mrf.calibrated import calibrate, carry
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.voxels.distance_field import DistanceField, blended_sums
from taichi_mrf.voxels.layout import BRICK, VOXELS, grid_keys, offsets_in_brick

# Written out, and not imported: these tests hold the values.
BLUR = 0.17
DOUBT = 0.56
FLATTEST = 0.7
LEAST_WEIGHT = 0.001
MARGINAL = 0.29
NOISE = 0.41
PRIOR = 0.55
REACH = 1.67
STEEPEST = 3.0
SUREST = 10.0
UNLIKELIEST = 0.0001
MARGIN = 1
CALLED, BLENDED_BELOW = 0.01, 0.3

pytestmark = pytest.mark.usefixtures("one_backend")


def by_hand(d: float, extent: float, steep: float, weight: float) -> float:
    """The evidence for a voxel whose centre lies ``d`` voxels in front of a surface."""
    s = math.sqrt(NOISE / (16 * weight * steep**2) + BLUR**2)
    below, above = (1 / (1 + math.exp(-(d + side * REACH * extent) / s)) for side in (-1, 1))
    z = min(max(above - below, 1e-4), 1 - 1e-4)
    return math.log(z / (1 - z))


def evidence_of(weight: NDArray, distance: NDArray) -> tuple[NDArray, NDArray]:
    """The oracle: log(z / (1 - z)) of the voxels of a box without its outermost, from the sums of weights and
    of distances times weight, and whether each is behind the surface; NaN where there is no distance."""
    seen = weight > LEAST_WEIGHT
    mean = np.where(seen, distance / np.maximum(weight, LEAST_WEIGHT), 0.0)
    inner = (slice(1, -1),) * 3
    normal = np.stack([part[inner] for part in np.gradient(mean)])
    steep = np.sqrt((normal * normal).sum(axis=0))
    extent = 0.5 * np.abs(normal).sum(axis=0) / np.maximum(steep, 1e-6)
    steep = np.clip(steep, FLATTEST, STEEPEST)
    d, w = mean[inner] / steep, np.maximum(weight[inner], LEAST_WEIGHT)
    s = np.sqrt(NOISE / (16.0 * w * steep * steep) + BLUR**2)
    z = 0.5 * (np.tanh(0.5 * (d + REACH * extent) / s) - np.tanh(0.5 * (d - REACH * extent) / s))
    z = np.clip(z, UNLIKELIEST, 1.0 - UNLIKELIEST)
    return np.where(seen[inner], np.log(z / (1.0 - z)), np.nan), d < 0


def calibrated_by_hand(field: DistanceField, brick: NDArray, marginal: NDArray, prior: float) -> NDArray:
    """The oracle's log-odds of a brick's voxels, (512,), by themselves: a chunk ends nowhere."""
    first = brick.astype(np.int64) * BRICK - 1 - MARGIN
    sums = [each.astype(np.float64) for each in field.box(first, BRICK + 2 + 2 * MARGIN)[:2]]
    evidence, behind = (each.reshape(-1) for each in evidence_of(*blended_sums(*sums)))
    expected = evidence - DOUBT + PRIOR * prior + MARGINAL * np.clip(marginal - prior, -SUREST, SUREST)
    expected[behind] = np.maximum(expected[behind], np.minimum(marginal, prior)[behind])
    return np.where(np.isnan(evidence), marginal, expected)


def plane(at: float, weight: float, normal: NDArray, steep: float) -> DistanceField:
    """A field in one brick."""
    centre = offsets_in_brick() - 3.5
    distance = (steep * (centre @ normal - at)).astype(np.float32)
    sums = np.full((1, VOXELS), weight, np.float32)
    return DistanceField(np.zeros((1, 3), np.int32), sums, sums * distance, np.zeros_like(sums))


def calibrated_of(field: DistanceField, marginal: NDArray, prior: float) -> NDArray:
    """Calibrated log-odds (n, 512) of a field's own bricks, from marginals of that shape."""
    found = marginal.astype(np.float32)
    slots = np.arange(len(field.bricks), dtype=np.int32)
    calibrate(field, field.bricks, slots, found.reshape(-1), prior)
    return found


@pytest.mark.parametrize("weight", [0.02, 3.0])
def test_a_plane_gives_what_the_formula_says(weight: float) -> None:
    normal, steep, at = np.array([0.8, 0.0, -0.6]), 1.3, 0.4  # along rays that meet the plane at an angle
    found = calibrated_of(plane(at, weight, normal, steep), np.zeros((1, VOXELS)), 0.0)[0]
    blended_weight = weight + 8 * weight * BLENDED_BELOW / (BLENDED_BELOW + weight)
    inner = np.flatnonzero(((offsets_in_brick() > 1) & (offsets_in_brick() < 6)).all(axis=1))
    d = (offsets_in_brick()[inner] - 3.5) @ normal - at
    expected = np.array([by_hand(each, 0.7, steep, blended_weight) for each in d]) - DOUBT
    expected[d < 0] = np.maximum(expected[d < 0], 0.0)
    np.testing.assert_allclose(found[inner], expected, atol=2e-3)
    assert expected.min() < -1
    assert expected.max() > 1


def test_without_distances_there_is_no_answer() -> None:
    field = plane(0.0, 1.0, np.array([1.0, 0.0, 0.0]), 1.0)
    none = DistanceField(field.bricks, 0 * field.weight, 0 * field.distance, field.excess)
    marginal = np.random.default_rng(0).normal(size=(1, VOXELS)).astype(np.float32)
    np.testing.assert_array_equal(calibrated_of(none, marginal, -2.0), marginal)
    other = marginal.copy()
    calibrate(field, np.array([[2, 0, 0]], np.int32), np.zeros(1, np.int32), other.reshape(-1), -2.0)
    np.testing.assert_array_equal(other, marginal)


def test_bricks_beside_the_fields_own_follow_the_formula(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(1)
    offsets = np.indices((3, 3, 3)).reshape(3, -1).T - 1
    bricks = offsets[random.permutation(27)[:9]].astype(np.int32)
    bricks = bricks[np.argsort(grid_keys(bricks))]
    weight = random.uniform(0, 0.5, (9, VOXELS)) * (random.uniform(size=(9, VOXELS)) > 0.3)
    distance = weight * random.normal(size=weight.shape)
    field = DistanceField(bricks, *(x.astype(np.float32) for x in (weight, distance, 0 * weight)))
    around = (np.indices((5, 5, 5)).reshape(3, -1).T - 2).astype(np.int32)[random.permutation(125)]
    marginal = random.normal(size=(125, VOXELS)).astype(np.float32)
    monkeypatch.setattr(calibrated, "BRICKS_AT_ONCE", 40)
    found = marginal.copy()
    calibrate(field, around, np.arange(125, dtype=np.int32), found.reshape(-1), -1.5)
    expected = [calibrated_by_hand(field, b, own, -1.5) for b, own in zip(around, marginal, strict=True)]
    np.testing.assert_allclose(found, expected, atol=2e-3)
    assert (found != marginal).any(axis=1).sum() > 27


def test_an_uncertain_wall_is_where_it_was_measured() -> None:
    m = uncertain_wall()
    centres, p = m.calibrated().voxels()
    assert len(centres) > 3 * len(m.marginals.voxels()[0])
    assert (np.abs(centres[:, 2] - WALL_M) < 1.5 * VOXEL).mean() > 0.8
    assert p.max() <= 1
    assert p.min() > 0.5


def test_evidence_and_marginals_are_joined() -> None:
    m = uncertain_wall()
    pool = m.view.pool
    found = m.calibrated().view.pool.belief.to_numpy().reshape(-1, VOXELS)
    marginals = pool.belief.to_numpy().reshape(found.shape)
    for slot in pool.in_use:
        bricks = pool.bricks[slot], marginals[slot]
        expected = calibrated_by_hand(m.surface_field(), *bricks, pool.prior_log_odds)
        np.testing.assert_allclose(found[slot], expected, atol=2e-3)


def test_what_is_shown_keeps_its_state() -> None:
    prior, min_evidence, least = -2.0, 0.1, 0.01
    decided = np.array([0.01, 0.01, 3.0, -3.0, -3.0, -1.0, -1.0, -1.0, -2.05, prior], np.float32)
    likely = np.array([2.0, -4.0, 1.0, -4.0, 1.0, 2.0, -1.5, -3.0, 2.0, 1.0], np.float32)
    carry(likely, decided, prior, min_evidence, least)
    expected = [2.0, 0.01, 1.0, -4.0, -2.1 - CALLED, -CALLED, -1.5, -1.9, -2.05, prior]
    np.testing.assert_allclose(decided, expected, atol=1e-6)


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
