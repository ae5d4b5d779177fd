"""Queries of maps made by hand, against NumPy: points, voxels, rendered depth, and the profile of a ray."""

import numpy as np
import pytest
from hand_made import (
    BRICK_M,
    CAMERA,
    PRIOR,
    VIEWS,
    VOXEL,
    HandMade,
    made,
    profile_of,
    rays_into,
)
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from oracles.traversal import clip_to_box, segments

from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.errors import ConfigError
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.queries.extract import extract_voxels
from taichi_mrf.queries.points import FREE, OCCUPIED, UNKNOWN, classify, point_log_odds, probability
from taichi_mrf.queries.view import View
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.voxels.layout import BRICK
from taichi_mrf.voxels.pool import BrickPool

pytestmark = pytest.mark.usefixtures("backend")

SEEN_FREE = PRIOR - 6.9


def points_in(bricks: NDArray[np.int32], count: int, seed: int) -> NDArray[np.float64]:
    """Points (n, 3) in metres in and around some bricks, none within rounding of a voxel's face."""
    random = np.random.default_rng(seed)
    low, high = (bricks.min(axis=0) - 1) * BRICK, (bricks.max(axis=0) + 2) * BRICK
    return (random.integers(low, high, (count, 3)) + random.uniform(0.001, 0.999, (count, 3))) * VOXEL


def test_point_log_odds_are_those_of_the_points_voxel(random_map: HandMade) -> None:
    points = points_in(random_map.bricks, 5000, seed=1)
    found = point_log_odds(points, VOXEL, random_map.topology, random_map.pool, SEEN_FREE)
    expected = random_map.at(np.floor(points / VOXEL).astype(np.int64))
    assert 500 < np.isfinite(expected).sum() < 4500
    np.testing.assert_array_equal(found, np.nan_to_num(expected, nan=PRIOR).astype(np.float32))


def test_crossed_bricks_that_do_not_exist_are_seen_free(backend: str) -> None:
    """A brick with a slot answers with its voxels, however many rays cross it."""
    bricks = np.array([[0, 0, 0], [-1, 0, 0]], np.int32)
    hand = made(backend, bricks, np.full((2, BRICK, BRICK, BRICK), 0.75, np.float32))
    hand.topology.add_crossings(np.array([[0, 0, 0], [1, 0, 0], [0, -1, 0]], np.int32), 1)
    centres = (np.array([[0, 0, 0], [-1, 0, 0], [1, 0, 0], [0, -1, 0], [5, 5, 5]]) + 0.5) * BRICK_M
    found = point_log_odds(centres, VOXEL, hand.topology, hand.pool, SEEN_FREE)
    np.testing.assert_allclose(found, [0.75, 0.75, SEEN_FREE, SEEN_FREE, PRIOR], rtol=1e-6)
    hand.topology.add_crossings(np.array([[1, 0, 0]], np.int32), -1)
    found = point_log_odds(centres, VOXEL, hand.topology, hand.pool, SEEN_FREE)
    np.testing.assert_allclose(found, [0.75, 0.75, PRIOR, SEEN_FREE, PRIOR], rtol=1e-6)


@pytest.mark.parametrize("far", [1e3, -1e5, 1e12, -1e300])
def test_points_beyond_all_maps_are_unseen(random_map: HandMade, far: float) -> None:
    points = np.array([[far, 0, 0], [0, far, 0], [0, 0, far], [far, far, far]])
    found = point_log_odds(points, VOXEL, random_map.topology, random_map.pool, SEEN_FREE)
    np.testing.assert_allclose(found, PRIOR)


@pytest.mark.parametrize(
    ("points", "problem"),
    [
        (np.zeros(3), r"shape \(N, 3\), not \(3,\)"),
        (np.zeros((2, 2)), r"not \(2, 2\)"),
        (np.full((1, 3), np.nan), "not finite"),
        (np.full((1, 3), np.inf), "not finite"),
    ],
)
def test_wrong_points_are_refused(random_map: HandMade, points: NDArray, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        point_log_odds(points, VOXEL, random_map.topology, random_map.pool, SEEN_FREE)


def test_no_points_have_no_answers(random_map: HandMade) -> None:
    found = point_log_odds(np.zeros((0, 3)), VOXEL, random_map.topology, random_map.pool, SEEN_FREE)
    assert found.shape == (0,)
    assert found.dtype == np.float32


@given(st.lists(st.floats(-60, 60, width=32), min_size=1), st.floats(-6, 3), st.floats(0, 2))
def test_states_follow_their_definition(log_odds: list[float], prior: float, evidence: float) -> None:
    values = np.array(log_odds, np.float32)
    for value, state in zip(values.tolist(), classify(values, prior, evidence).tolist(), strict=True):
        if np.isclose(abs(value - prior), evidence, atol=1e-5):
            continue
        learnt = abs(value - prior) > evidence
        more_likely_than_not = value > 0
        if learnt and more_likely_than_not:
            assert state == OCCUPIED
        elif learnt and value < prior:
            assert state == FREE
        else:
            assert state == UNKNOWN


@given(st.lists(st.floats(-80, 80, width=32), min_size=1))
def test_probability_is_the_logistic_function(log_odds: list[float]) -> None:
    found = probability(np.array(log_odds, np.float32))
    np.testing.assert_allclose(found, 1 / (1 + np.exp(-np.array(log_odds))), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("least", [0.0, 0.02, 0.5, 0.85, 1.0])
def test_extracted_voxels_are_those_of_the_probability(random_map: HandMade, least: float) -> None:
    centres, found = extract_voxels(random_map.pool, VOXEL, least)
    n, i, j, k = np.nonzero(probability(random_map.log_odds) >= least)
    voxels = random_map.bricks[n].astype(np.int64) * BRICK + np.stack([i, j, k], axis=1)
    assert len(found) == len(voxels)
    assert (least == 0.0) == (len(found) == random_map.log_odds.size)
    order = np.lexsort(np.floor(centres / VOXEL).T)
    expected_order = np.lexsort(voxels.T)
    np.testing.assert_allclose(centres[order], (voxels[expected_order] + 0.5) * VOXEL, atol=1e-9)
    expected = probability(random_map.log_odds)[n, i, j, k]
    np.testing.assert_allclose(found[order], expected[expected_order], rtol=1e-6)


def test_an_empty_map_has_no_voxels() -> None:
    centres, found = extract_voxels(BrickPool(PRIOR), VOXEL, 0.5)
    assert centres.shape == (0, 3)
    assert found.shape == (0,)


@pytest.mark.parametrize("least", [-0.1, 1.1, float("nan")])
def test_a_probability_outside_its_range_is_refused(random_map: HandMade, least: float) -> None:
    with pytest.raises(ConfigError, match="min_probability must lie between 0 and 1"):
        extract_voxels(random_map.pool, VOXEL, least)


def test_ray_profiles_follow_eqs_15_to_18(random_map: HandMade) -> None:
    view = View(random_map.pool, VOXEL, VolumeConfig())
    met = 0
    for number, (origin, direction) in enumerate(rays_into(random_map, 120, seed=2)):
        found = view.ray_profile(origin, direction * (1 + number), 3.0)  # its length does not matter
        expected = profile_of(random_map, origin, direction, 3.0)
        # Corners that are cut by less than a thousandth of a voxel may be there or not.
        mine, theirs = found.length > 1e-3 * VOXEL, expected.far - expected.near > 1e-3 * VOXEL
        assert mine.sum() == theirs.sum()
        met += mine.sum()
        middle = 0.5 * (expected.near + expected.far)
        for name, value, tolerance in (
            ("distance", middle, 1e-4),
            ("length", expected.far - expected.near, 1e-3 * VOXEL),
            ("occupancy", expected.occupancy, 1e-5),
            ("visibility", expected.visibility, 2e-3),
            ("omega", expected.omega, 4e-3 * max(1, expected.omega.max(initial=0))),
        ):
            np.testing.assert_allclose(getattr(found, name)[mine], value[theirs], rtol=0, atol=tolerance)
        assert (np.diff(found.distance) > 0).all()
    assert met > 1000


def test_a_profile_ends_at_its_range_and_at_the_volume(random_map: HandMade) -> None:
    lower, upper = (-2.0, 1.0, -1.2), (-0.5, 2.0, 0.4)
    view = View(random_map.pool, VOXEL, VolumeConfig(lower=lower, upper=upper))
    longest = 0.0
    for origin, direction in rays_into(random_map, 30, seed=3):
        found = view.ray_profile(origin, direction, 1.7)
        begin, end = clip_to_box(origin, direction, 0.0, 1.7, lower, upper)
        cells, near, far = segments(origin / VOXEL, direction / VOXEL, begin, end)
        lengths = (far - near)[np.isfinite(random_map.at(cells))]
        assert found.length.sum() == pytest.approx(lengths.sum(), abs=1e-3)
        if len(found.distance):
            assert found.distance[0] > begin
            assert found.distance[-1] < end
        longest = max(longest, lengths.sum())
    assert longest > 0.5


def test_a_ray_that_meets_no_brick_has_an_empty_profile(random_map: HandMade) -> None:
    view = View(random_map.pool, VOXEL, VolumeConfig())
    for origin in ((0.0, -5.0, 0.0), (500.0, 0.0, 0.0)):
        found = view.ray_profile(origin, (0, -1, 0), 10.0)
        assert len(found.distance) == len(found.omega) == 0


@pytest.mark.parametrize(
    ("origin", "direction"),
    [((0, 0, 0), (0, 0, 0)), ((0, 0), (1, 0, 0)), ((0, 0, 0), (np.nan, 0, 1)), ((0, np.inf, 0), (1, 0, 0))],
)
def test_what_is_no_ray_is_refused(random_map: HandMade, origin: tuple, direction: tuple) -> None:
    with pytest.raises(ConfigError, match="origin and a direction of three finite numbers"):
        View(random_map.pool, VOXEL, VolumeConfig()).ray_profile(origin, direction, 5.0)


LEARNT = np.log1p(np.exp(PRIOR + VolumeConfig.min_evidence))
"""Value of -ln(1 - p) where the log-odds are as far above the prior as they are in unknown space."""


def rendered_by_oracle(hand: HandMade, camera: PinholeCamera, T: Pose, max_depth: float) -> NDArray:
    """(H * W, 3): depth of the largest omega among voxels of more than the prior (0 if there is none), how
    much larger it is than the next, and what gets through."""
    out = np.zeros((camera.height * camera.width, 3))
    directions = camera.rays().reshape(-1, 3)
    for row, local in zip(out, directions, strict=True):
        profile = profile_of(hand, T[:3, 3], T[:3, :3] @ local, max_depth, float(np.linalg.norm(local)))
        row[:] = (0, 1, 1)
        if len(profile.omega):
            learnt = profile.omega / profile.visibility * VOXEL > LEARNT
            omega = np.where(learnt, profile.omega, 0.0)
            best = omega.argmax()
            others = np.delete(omega, best).max(initial=0)
            if learnt.any():
                row[0] = 0.5 * (profile.near[best] + profile.far[best])
                row[1] = 1 - others / omega[best]
            row[2] = profile.through
    return out


@pytest.mark.parametrize("number", range(len(VIEWS)))
def test_rendered_depth_is_the_largest_omegas(random_map: HandMade, number: int) -> None:
    T = VIEWS[number]
    found = View(random_map.pool, VOXEL, VolumeConfig()).render_depth(CAMERA, T, 5.0)
    assert found.shape == CAMERA.shape
    assert found.dtype == np.float32
    found = found.reshape(-1)
    depth, margin, through = rendered_by_oracle(random_map, CAMERA, T, 5.0).T
    # Where half of the ray gets through, or two voxels explain it equally well, rounding may decide.
    clear = (np.abs(through - 0.5) > 0.01) & (margin > 0.01)
    assert clear.mean() > 0.8
    surface = (through < 0.5) & (depth > 0)
    np.testing.assert_array_equal(np.isnan(found)[clear], ~surface[clear])
    seen = clear & surface
    assert 100 < seen.sum() < len(found) - 100
    np.testing.assert_allclose(found[seen], depth[seen], atol=1e-3 * VOXEL)


def test_an_empty_map_and_a_view_away_from_it_show_nothing(random_map: HandMade) -> None:
    for pool, T in (
        (BrickPool(PRIOR), VIEWS[0]),
        (random_map.pool, look_at((3, -3, 0), (9, -9, 0))),
    ):
        assert np.isnan(View(pool, VOXEL, VolumeConfig()).render_depth(CAMERA, T, 4.0)).all()
