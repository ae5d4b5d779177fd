"""Distances to the nearest obstacle, against all obstacles one by one."""

import sys

import numpy as np
import pytest
from hand_made import VOXEL
from hypothesis import given
from hypothesis import strategies as st
from queried_maps import HandMap, hand_map

from taichi_mrf.errors import CapacityError, ConfigError, TaichiMRFError
from taichi_mrf.queries.distance import distance_field, distances

LOWER, UPPER = np.array((-1.9, 1.1, -0.9)), np.array((-1.3, 1.6, -0.4))
MAX_DISTANCE = 0.4


@pytest.fixture(scope="module")
def hand(backend: str) -> HandMap:
    return hand_map(backend, occupied=0.002)


def obstacles(hand: HandMap, unknown: str) -> np.ndarray:
    """Centres (n, 3) of all obstacles in and around the box."""
    first = np.floor(LOWER / VOXEL).astype(int) - 12
    shape = tuple(np.ceil((UPPER - LOWER) / VOXEL).astype(int) + 24)
    voxels = np.indices(shape).reshape(3, -1).T + first
    state = hand.true_state(voxels)
    return (voxels[state == 2 if unknown == "free" else state != 1] + 0.5) * VOXEL


def nearest(points: np.ndarray, centres: np.ndarray) -> np.ndarray:
    return np.array([np.linalg.norm(centres - p, axis=1).min() for p in points])


@pytest.mark.parametrize("unknown", ["free", "occupied"])
def test_distances_at_the_centres_are_exact(hand: HandMap, unknown: str) -> None:
    field = distance_field(hand, LOWER, UPPER, MAX_DISTANCE, unknown)  # type: ignore[arg-type]
    random = np.random.default_rng(0)
    cells = random.integers(np.round(LOWER / VOXEL), np.round(UPPER / VOXEL), (300, 3))
    points = (cells + 0.5) * VOXEL
    wanted = np.minimum(nearest(points, obstacles(hand, unknown)), MAX_DISTANCE)
    assert len(np.unique(wanted.round(6))) > 5
    np.testing.assert_allclose(field.distance(points), wanted, atol=1e-6)


def test_distances_between_them_are_off_by_less_than_half_a_voxel(hand: HandMap) -> None:
    random = np.random.default_rng(1)
    points = random.uniform(LOWER, UPPER, (300, 3))
    found, _ = distances(hand, points, MAX_DISTANCE)
    wanted = np.minimum(nearest(points, obstacles(hand, "free")), MAX_DISTANCE)
    assert np.abs(found - wanted).max() < 0.5 * VOXEL
    assert np.abs(found - wanted).mean() < 0.1 * VOXEL


@given(st.integers(0, 2**32 - 1))
def test_the_gradient_is_that_of_the_distance(hand: HandMap, seed: int) -> None:
    random = np.random.default_rng(seed)
    field = distance_field(hand, LOWER, UPPER, MAX_DISTANCE)
    # Away from where the interpolation has its kinks: the planes through the voxels' centres.
    cells = random.integers(np.round(LOWER / VOXEL), np.round(UPPER / VOXEL) - 1, (20, 3))
    points = (cells + 0.5 + random.uniform(0.1, 0.9, cells.shape)) * VOXEL
    gradient, step = field.gradient(points), 1e-4
    for axis in range(3):
        aside = step * np.eye(3)[axis]
        slope = (field.distance(points + aside) - field.distance(points - aside)) / (2 * step)
        np.testing.assert_allclose(gradient[:, axis], slope, atol=1e-3)


def test_the_gradient_leads_away_from_a_wall(hand: HandMap) -> None:
    field = distance_field(hand, LOWER, UPPER, MAX_DISTANCE)
    centres = obstacles(hand, "free")
    points = np.random.default_rng(2).uniform(LOWER, UPPER, (1000, 3))
    away = points - centres[[np.linalg.norm(centres - p, axis=1).argmin() for p in points]]
    size = np.linalg.norm(away, axis=1)
    judged = (size > 2 * VOXEL) & (size < MAX_DISTANCE - VOXEL)
    assert judged.sum() > 30
    cosine = (field.gradient(points) * away).sum(axis=1) / size
    assert np.median(cosine[judged]) > 0.9


def test_beyond_the_largest_distance_there_is_nothing(hand: HandMap) -> None:
    points = [[30.0, 30.0, 30.0], [30.2, 30.1, 30.0]]
    found, gradient = distances(hand, points, MAX_DISTANCE)
    np.testing.assert_array_equal(found, np.float32(MAX_DISTANCE))
    np.testing.assert_array_equal(gradient, 0)
    found, _ = distances(hand, points, MAX_DISTANCE, "occupied")
    np.testing.assert_array_equal(found, 0)
    assert distances(hand, np.zeros((0, 3)), MAX_DISTANCE)[1].shape == (0, 3)


def test_points_outside_the_box(hand: HandMap) -> None:
    field = distance_field(hand, LOWER, UPPER, MAX_DISTANCE)
    field.distance([LOWER, UPPER])  # its faces belong to it
    with pytest.raises(ConfigError, match="outside the box"):
        field.distance([UPPER + 0.2])
    with pytest.raises(ConfigError, match=r"shape \(N, 3\), not \(3,\)"):
        field.distance(LOWER)
    with pytest.raises(ConfigError, match="not finite"):
        field.distance([[np.nan, 0, 0]])


def test_what_cannot_be_worked_out(hand: HandMap, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="max_distance must be"):
        distance_field(hand, LOWER, UPPER, 0.0)
    with pytest.raises(ConfigError, match="free or occupied, not 'stop'"):
        distance_field(hand, LOWER, UPPER, 1.0, "stop")  # type: ignore[arg-type]
    with pytest.raises(CapacityError, match="million voxels"):
        distance_field(hand, LOWER, UPPER, 1e4)
    monkeypatch.setitem(sys.modules, "scipy.ndimage", None)
    with pytest.raises(TaichiMRFError, match=r"distances need scipy.*pip install 'taichi-mrf\[mesh\]'"):
        distance_field(hand, LOWER, UPPER, 1.0)
