"""Rays cast through a map, against rays cut at every face of the grid in float64."""

import numpy as np
import pytest
from hand_made import BRICK_M, VOXEL
from oracles.traversal import segments
from queried_maps import HandMap, room_map

from taichi_mrf.errors import ConfigError
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.queries import cast
from taichi_mrf.queries.cast import RayHits, cast_rays

MAX_RANGE = 3.0


def rays(hand: HandMap, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """From around the map and inside it, in all directions."""
    random = np.random.default_rng(seed)
    low, high = hand.hand.bricks.min(axis=0) * BRICK_M, (hand.hand.bricks.max(axis=0) + 1) * BRICK_M
    return random.uniform(low - 0.6, high + 0.6, (count, 3)), random.normal(size=(count, 3))


def expected(
    hand: HandMap, origin: np.ndarray, direction: np.ndarray, unknown: str
) -> tuple[bool, float, bool]:
    """Hit, range, and whether unknown space ended the ray."""
    unit = direction / np.linalg.norm(direction)
    cells, near, _ = segments(origin, unit, 0.0, MAX_RANGE, VOXEL)
    for state, at in zip(hand.true_state(cells).tolist(), near.tolist(), strict=True):
        if state == 2:
            return True, at, False
        if state == 0 and unknown != "free":
            return unknown == "hit", at, True
    return False, MAX_RANGE, False


@pytest.mark.parametrize("rays_a_brick", [0, 10**9], ids=["bricks looked through", "all bricks"])
@pytest.mark.parametrize("unknown", ["free", "stop", "hit"])
def test_rays_end_where_the_oracle_says(
    hand: HandMap, unknown: str, rays_a_brick: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cast, "RAYS_A_BRICK", rays_a_brick)
    origins, directions = rays(hand, 400, seed=3)
    found = cast_rays(hand, origins, directions, MAX_RANGE, unknown)  # type: ignore[arg-type]
    wanted = [expected(hand, o, d, unknown) for o, d in zip(origins, directions, strict=True)]
    hit, range_m, in_unknown = (np.array(column) for column in zip(*wanted, strict=True))
    # A ray within rounding of a voxel's edge may pass it on either side.
    same = np.abs(found.range - range_m) < 2e-4
    assert same.mean() > 0.99
    np.testing.assert_array_equal(found.hit[same], hit[same])
    np.testing.assert_array_equal(found.in_unknown[same], in_unknown[same])
    unit = directions / np.linalg.norm(directions, axis=1)[:, None]
    np.testing.assert_allclose(found.point, origins + unit * found.range[:, None], atol=1e-6)
    assert hit.mean() > {"free": 0.1, "stop": 0.02, "hit": 0.9}[unknown]


def test_rays_that_look_through_free_space_only(hand: HandMap) -> None:
    """Begun in seen-free bricks, so that the policies for the unknown come into their own on the way."""
    with_voxels = {tuple(b) for b in hand.hand.bricks.tolist()}
    free = np.array([b for b in hand.crossed.tolist() if tuple(b) not in with_voxels])
    random = np.random.default_rng(5)
    origins = (free + random.uniform(0.05, 0.95, free.shape)) * BRICK_M
    directions = random.normal(size=free.shape)
    found = cast_rays(hand, origins, directions, MAX_RANGE, "stop")
    wanted = np.array([expected(hand, o, d, "stop")[1] for o, d in zip(origins, directions, strict=True)])
    assert (wanted > 0.01).all()
    assert (np.abs(found.range - wanted) < 2e-4).mean() > 0.97
    assert found.in_unknown.any()
    assert (~found.hit | ~found.in_unknown).all()


def test_one_direction_for_all_and_any_length(hand: HandMap) -> None:
    origins, _ = rays(hand, 50, seed=6)
    one = cast_rays(hand, origins, (0, -3.0, 0), MAX_RANGE)
    many = cast_rays(hand, origins, np.tile([0, -1.0, 0], (50, 1)), MAX_RANGE)
    assert one.hit.any()
    np.testing.assert_array_equal(one.range, many.range)
    np.testing.assert_array_equal(one.point, many.point)


def test_no_rays_and_rays_far_away(hand: HandMap) -> None:
    none = cast_rays(hand, np.zeros((0, 3)), np.zeros((0, 3)), 1.0)
    assert none.hit.shape == (0,)
    assert none.point.shape == (0, 3)
    for unknown, hit, range_m in (("free", False, 1.0), ("stop", False, 0.0), ("hit", True, 0.0)):
        far = cast_rays(hand, [[1000.0, 0, 0]], [[1.0, 0, 0]], 1.0, unknown)  # type: ignore[arg-type]
        assert (far.hit[0], far.range[0]) == (hit, range_m)
        beside = cast_rays(hand, [[0.0, 0, 0], [1000.0, 0, 0]], [[1.0, 0, 0]] * 2, 1.0, unknown)  # type: ignore[arg-type]
        assert (beside.hit[1], beside.range[1]) == (hit, range_m)


@pytest.mark.usefixtures("backend")
def test_an_empty_map_is_unknown_everywhere() -> None:
    m = MRFMap(0.1)
    assert not cast_rays(m, [[0, 0, 0.0]], [[1, 0, 0.0]], 2.0).hit[0]
    assert cast_rays(m, [[0, 0, 0.0]], [[1, 0, 0.0]], 2.0, "hit").hit[0]


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("method", ["mrf", "log_odds"])
def test_rays_in_the_room_end_in_occupied_voxels(method: str) -> None:
    m = room_map(method)
    random = np.random.default_rng(0)
    keyframe = next(iter(m.keyframes.values()))
    directions = random.normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    found: RayHits = cast_rays(m, keyframe.T_world_camera[:3, 3], directions, 6.0, "stop")
    assert found.hit.any()
    assert found.in_unknown.any()
    behind = m.state(found.point + 1e-3 * directions)
    assert (behind[found.hit] == 2).mean() > 0.99
    assert (behind[found.in_unknown] == 0).mean() > 0.99


@pytest.mark.parametrize(
    ("origins", "directions", "options", "problem"),
    [
        (np.zeros((2, 3)), np.ones((3, 3)), {}, "of shape"),
        (np.zeros(3), np.ones(3), {}, "of shape"),
        (np.zeros((2, 2)), np.ones((2, 2)), {}, "of shape"),
        (np.full((1, 3), np.inf), np.ones((1, 3)), {}, "not finite"),
        (np.zeros((1, 3)), np.zeros((1, 3)), {}, "no length"),
        (np.zeros((1, 3)), np.ones((1, 3)), {"max_range": 0.0}, "max_range must be"),
        (np.zeros((1, 3)), np.ones((1, 3)), {"unknown": "wall"}, "free, stop, hit, not 'wall'"),
    ],
)
def test_rays_that_make_no_sense(
    hand: HandMap, origins: np.ndarray, directions: np.ndarray, options: dict, problem: str
) -> None:
    with pytest.raises(ConfigError, match=problem):
        cast_rays(hand, origins, directions, **{"max_range": 1.0, **options})
