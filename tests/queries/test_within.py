"""Content of a ball, or of the way of one: against lines cut voxel by voxel in float64, closed forms, and
the joint distribution of a ray's voxels."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hand_made import PRIOR, VOXEL
from oracles.inference import Ray, Segment, enumerate_marginals
from oracles.traversal import segments
from queried_maps import SEEN_FREE, HandMap, map_of, room, room_map

from taichi_mrf.errors import ConfigError
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.queries.within import occupied_within, path_collision

UNKNOWN_P = 1 / (1 + math.exp(-PRIOR))


def grid(hand: HandMap) -> tuple:
    return hand.voxel_size, hand.hand.topology, hand.hand.pool, SEEN_FREE


def ball(hand: HandMap, points: object, radius_m: float) -> np.ndarray:
    return occupied_within(points, radius_m, *grid(hand))


def path(hand: HandMap, points: object, radius_m: float) -> np.ndarray:
    return path_collision(points, radius_m, *grid(hand))


def expected(hand: HandMap, centre_m: np.ndarray, radius_m: float) -> float:
    """The likeliest line of each axis, and the least of these."""
    reach = math.floor(radius_m / VOXEL)
    of_axes = []
    for axis in range(3):
        likeliest = 0.0
        for a in range(-reach, reach + 1):
            for b in range(-reach, reach + 1):
                squared = radius_m**2 - (a * a + b * b) * VOXEL**2
                if squared <= 0:
                    continue
                beside = np.roll([0.0, a * VOXEL, b * VOXEL], axis)
                along = np.eye(3)[axis]
                start = centre_m + beside - math.sqrt(squared) * along
                cells, near, far = segments(start, along, 0.0, 2 * math.sqrt(squared), VOXEL)
                m, length = 1 / (1 + np.exp(-hand.true_log_odds(cells))), (far - near) / VOXEL
                evidence = hand.true_log_odds(cells).astype(np.float32) > np.float32(PRIOR)
                rest = (1 - m * length)[~evidence].prod()
                likeliest = max(likeliest, 1 - max(0.0, 1 - (m * length)[evidence].sum()) * rest)
        of_axes.append(likeliest)
    return min(of_axes)


@pytest.mark.parametrize("radius_m", [0.03, 0.11, 0.26])
def test_a_ball_has_the_probability_of_its_likeliest_line(hand: HandMap, radius_m: float) -> None:
    random = np.random.default_rng(3)
    low, high = hand.hand.bricks.min(axis=0) * 8 * VOXEL, (hand.hand.bricks.max(axis=0) + 1) * 8 * VOXEL
    hits = np.argwhere(hand.hand.log_odds > 0)[::40][:8]
    at_hits = (hand.hand.bricks[hits[:, 0]] * 8 + hits[:, 1:] + random.random((len(hits), 3))) * VOXEL
    points = np.concatenate([random.uniform(low - 0.4, high + 0.4, (8, 3)), at_hits])
    truth = [expected(hand, point, radius_m) for point in points]
    assert np.ptp(truth) > 0.05
    np.testing.assert_allclose(ball(hand, points, radius_m), truth, atol=2e-5)


def test_a_wall_is_one_thing_however_many_lines_meet_it(backend: str) -> None:
    """A wall that may be in any of four layers, and a ball that reaches into two of them: the lines beside
    each other add nothing, while voxels taken alone would make a collision certain."""
    log_odds = np.full((16, 16, 16), -12.0)
    log_odds[6:10] = math.log(0.25 / 0.75)
    wall = map_of(backend, (0, 0, 0), log_odds)
    centre = np.array([[6.0 * VOXEL, 8 * VOXEL, 8 * VOXEL]])  # on the face of the first layer
    found = float(ball(wall, centre, 2 * VOXEL)[0])
    assert found == pytest.approx(0.5, abs=1e-3)
    assert 1 - 0.75 ** (np.pi * 4) > 0.95  # the voxels of the half ball, taken alone


def test_a_line_is_nearly_as_likely_as_in_the_exact_joint_distribution(backend: str) -> None:
    """Rays side by side have measured the same surface. In the joint distribution of a ray's voxels one of
    them is the first surface, those before it are free, and those behind it keep the prior."""
    cells = [(i, 0, 0) for i in range(8)]
    densities = np.exp(-0.5 * ((np.arange(8) - 3.5) / 0.9) ** 2)
    ray = Ray([Segment(cell, 1.0) for cell in cells], densities.tolist(), 0.0)
    marginals = enumerate_marginals([ray], UNKNOWN_P, 1e-9)
    along = np.array([math.log(marginals[cell] / (1 - marginals[cell])) for cell in cells])
    wall = map_of(backend, (0, 0, 0), np.broadcast_to(along[:, None, None], (8, 8, 8)))
    first = densities * (1 - UNKNOWN_P) ** np.arange(8)
    first /= first.sum()
    for radius in (1, 2, 3):
        exact = 1 - first[: 4 - radius].sum() * (1 - UNKNOWN_P) ** (2 * radius) - first[4 + radius :].sum()
        found = ball(wall, np.array([[4.0, 4.5, 4.5]]) * VOXEL, radius * VOXEL)[0]
        alone = 1 - np.prod([1 - marginals[cell] for cell in cells[4 - radius : 4 + radius]])
        assert found == pytest.approx(exact, abs=0.05)
        assert exact - alone > 0.1


def test_a_path_is_as_likely_to_collide_as_at_its_likeliest_place(hand: HandMap) -> None:
    corners = np.array([[[-1.4, 2.0, -0.4], [-0.9, 2.2, 0.0], [-0.9, 2.2, 0.3]], np.zeros((3, 3))])
    found = path(hand, corners, 0.1)
    along = np.linspace(0, 1, 200)[:, None]
    dense = np.concatenate([a + along * (b - a) for a, b in pairwise(corners[0])])
    everywhere = ball(hand, dense, 0.1)
    assert everywhere.max() * 0.8 <= found[0] <= everywhere.max() + 1e-5
    assert found[1] == ball(hand, [[0, 0, 0]], 0.1)[0]
    assert path(hand, corners[0], 0.1) == found[0]
    assert path(hand, corners[0], 0.1).shape == ()


def test_answers_follow_edits(backend: str) -> None:
    """A map from which a keyframe was removed answers as the map of the others does."""
    edited, others = room(MRFMap, [0, 1, 2]), room(MRFMap, [0, 1])
    points = np.random.default_rng(5).uniform([-3, -2.5, -1], [3, 2.5, 1], (300, 3))
    before = edited.occupied_within(points, 0.25)
    edited.remove_keyframe(2)
    edited.infer()
    after = edited.occupied_within(points, 0.25)
    np.testing.assert_array_equal(after, others.occupied_within(points, 0.25))
    assert np.abs(after - before).max() > 0.1


@pytest.mark.usefixtures("one_backend")
@pytest.mark.parametrize("method", ["log_odds", "visibility", "mrf"])
def test_a_path_through_a_wall_collides_in_every_map(method: str) -> None:
    m = room_map(method)
    ends = np.array([[6.0, 0.0, 0.0], [0.1, 0.0, 0.0]])  # the room is 5.6 m long
    through, short = m.path_collision(np.stack([np.zeros((2, 3)), ends], axis=1), 0.15)
    assert short < 0.5 < through


def test_nonsense_is_refused(hand: HandMap) -> None:
    for points, radius in (
        (np.zeros((2, 2)), 0.1),
        (np.zeros((1, 3)), 0.0),
        (np.full((1, 3), np.nan), 0.1),
        ([[0, 0, 0], [1e9, 0, 0]], 0.1),
    ):
        with pytest.raises(ConfigError):
            ball(hand, points, radius)
    for points in (np.zeros((0, 3)), np.zeros(3), np.full((2, 3), np.inf)):
        with pytest.raises(ConfigError):
            path(hand, points, 0.1)
    assert ball(hand, np.zeros((0, 3)), 0.1).shape == (0,)
