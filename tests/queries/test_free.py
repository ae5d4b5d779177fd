"""Free space at a level: points, balls, boxes, paths and distances, against the voxels themselves."""

import math
from pathlib import Path

import numpy as np
import pytest
import small_room
from queried_maps import room_map
from scipy.ndimage import distance_transform_edt

from taichi_mrf.errors import ConfigError
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.queries.box import map_extent, read_box
from taichi_mrf.queries.distance import DistanceField
from taichi_mrf.queries.free import LEVELS, NEVER, FreePromise

pytestmark = pytest.mark.usefixtures("one_backend")

BOUNDS = np.linspace(-3.0, -6.5, len(LEVELS))


def promise(bound: np.ndarray = BOUNDS, blocks: int = 7) -> FreePromise:
    levels = np.array(LEVELS)
    return FreePromise(levels, bound, 0.9 * levels, levels, 0.1 * (1 - levels), blocks)


@pytest.fixture(scope="module")
def m() -> MRFMap:
    found = small_room.build(range(6))
    found.promise = promise()
    return found


def free_voxels(m: MRFMap, most: float) -> tuple[np.ndarray, np.ndarray]:
    """The oracle: which voxels of the whole map are free below a bound, and the first voxel."""
    box = read_box(m.decided, *map_extent(m))
    return (box.state == 1) & (box.log_odds < most), np.array(box.lowest)


def some_points(m: MRFMap, count: int) -> np.ndarray:
    lower, upper = map_extent(m)
    return np.random.default_rng(5).uniform(lower, upper, (count, 3))


@pytest.mark.parametrize("level", [0.8, 0.99])
def test_a_point_is_free_if_its_voxel_is(m: MRFMap, level: float) -> None:
    free, lowest = free_voxels(m, float(BOUNDS[LEVELS.index(level)]))
    points = some_points(m, 5000)
    expected = free[tuple((np.floor(points / m.voxel_size).astype(int) - lowest).T)]
    np.testing.assert_array_equal(m.free_with(points, level), expected)
    assert 0.1 < expected.mean() < 0.9


def ball_is_free(free: np.ndarray, lowest: np.ndarray, centre: np.ndarray, radius: float) -> bool:
    """In voxels; voxels outside of the array are not free."""
    low, high = (np.floor(centre + sign * radius).astype(int) for sign in (-1, 1))
    for voxel in np.ndindex(*(high - low + 1)):
        corner = low + voxel
        gap = np.maximum(np.maximum(corner - centre, centre - corner - 1), 0)
        if math.hypot(*gap) <= radius:
            index = corner - lowest
            inside = (index >= 0).all() and (index < free.shape).all()
            if not inside or not free[tuple(index)]:
                return False
    return True


def test_a_ball_is_free_if_all_voxels_that_it_reaches_are(m: MRFMap) -> None:
    free, lowest = free_voxels(m, float(BOUNDS[LEVELS.index(0.95)]))
    points = some_points(m, 300)
    expected = [ball_is_free(free, lowest, p / m.voxel_size, 0.2 / m.voxel_size) for p in points]
    np.testing.assert_array_equal(m.free_with(points, 0.95, 0.2), expected)
    assert 0.02 < np.mean(expected) < 0.98


def test_a_path_is_free_if_all_balls_on_it_are(m: MRFMap) -> None:
    points = some_points(m, 400)
    start = points[m.free_with(points, 0.9, 0.2)]
    paths = np.stack([start, start + np.array([0.3, 0.2, 0.0])], axis=1)
    told = m.path_free_with(paths, 0.15, 0.9)
    on_way = paths[:, :1] + np.linspace(0, 1, 60)[:, None] * (paths[:, 1:] - paths[:, :1])
    exact = m.free_with(on_way.reshape(-1, 3), 0.9, 0.15).reshape(len(paths), -1).all(axis=1)
    assert not (told & ~exact).any()
    wider = m.free_with(on_way.reshape(-1, 3), 0.9, 0.16).reshape(len(paths), -1).all(axis=1)
    assert not (wider & ~told).any()
    assert 0 < told.mean() < 1
    assert m.path_free_with(paths[0], 0.15, 0.9).shape == ()


def test_a_path_without_a_width_misses_no_corner_of_a_voxel(m: MRFMap) -> None:
    starts = some_points(m, 3000)
    ways = np.random.default_rng(6).normal(0, 0.2, starts.shape)
    told = m.path_free_with(np.stack([starts, starts + ways], axis=1), 0.0, 0.9)
    on_way = starts[:, None] + np.linspace(0, 1, 300)[:, None] * ways[:, None]
    exact = m.free_with(on_way.reshape(-1, 3), 0.9).reshape(len(starts), -1).all(axis=1)
    assert not (told & ~exact).any()
    assert 0.5 * exact.mean() < told.mean() <= exact.mean()


def test_a_box_is_free_if_all_its_voxels_are(m: MRFMap) -> None:
    free, lowest = free_voxels(m, float(BOUNDS[LEVELS.index(0.9)]))
    told = []
    for corner in np.floor(some_points(m, 60) / m.voxel_size).astype(int):
        a, b = corner - lowest, corner - lowest + 3
        inside = (b <= free.shape).all()
        expected = inside and free[tuple(slice(*ab) for ab in zip(a, b, strict=True))].all()
        box = corner * m.voxel_size, (corner + 3) * m.voxel_size
        told.append(m.box_free_with(*box, level=0.9))
        assert told[-1] == expected
    assert 0 < np.mean(told) < 1


def test_distances_at_a_level_are_lower_bounds(m: MRFMap) -> None:
    """A voxel that is not free at the level is an obstacle: SciPy has the distances."""
    lower, upper = map_extent(m)
    box = read_box(m.decided, lower, upper)
    free, lowest = free_voxels(m, float(BOUNDS[LEVELS.index(0.98)]))
    centres = np.stack(np.indices(free.shape), -1).reshape(-1, 3) + lowest + 0.5
    obstacle = (box.state == 2) | ((box.state == 1) & ~free)
    plain, bound = (DistanceField(m, 0.3, level=level) for level in (None, 0.98))
    points = centres * m.voxel_size
    found = bound.distance(points)
    assert (found <= plain.distance(points) + 1e-6).all()
    expected = (distance_transform_edt(~obstacle) - 0.5) * m.voxel_size
    outside = ~obstacle.reshape(-1)
    np.testing.assert_allclose(found[outside], np.minimum(expected.reshape(-1), 0.3)[outside], atol=1e-5)


def test_levels_between_are_interpolated_and_others_refused() -> None:
    p = promise()
    doubt = math.log(0.1), math.log(0.07), math.log(0.05)
    share = (doubt[0] - doubt[1]) / (doubt[0] - doubt[2])
    expected = BOUNDS[1] + share * (BOUNDS[2] - BOUNDS[1])
    assert p.most_log_odds(0.93) == pytest.approx(expected)
    assert p.most_log_odds(0.5) == BOUNDS[0]
    for level in (0.0, 1.0, -1, 2, float("nan")):
        with pytest.raises(ConfigError, match="level"):
            p.most_log_odds(level)
    with pytest.raises(ConfigError, match=r"0\.9995.*allow 0\.999 at most"):
        p.most_log_odds(0.9995)
    with pytest.raises(ConfigError, match=r"allow 0\.98 at most"):
        promise(np.where(np.array(LEVELS) > 0.98, NEVER, BOUNDS)).most_log_odds(0.99)
    with pytest.raises(ConfigError, match="no level"):
        promise(np.full(len(LEVELS), NEVER)).most_log_odds(0.9)


def test_a_changed_map_promises_nothing() -> None:
    m = small_room.build([0, 1])
    m.free_with([[0, 0, 0]])
    small_room.add(m, small_room.frames()[2])
    with pytest.raises(ConfigError, match="infer"):
        m.free_with([[0, 0, 0]])
    with pytest.raises(ConfigError, match="infer"):
        DistanceField(m, 0.3, level=0.9)


@pytest.mark.parametrize("method", [MRFMap, LogOddsMap])
def test_the_promise_is_kept_in_the_file(tmp_path: Path, method: type[MRFMap] | type[LogOddsMap]) -> None:
    m = method(small_room.VOXEL_SIZE)
    small_room.add(m, small_room.frames()[0])
    m.infer()
    m.save(tmp_path / "without.npz")
    assert method.load(tmp_path / "without.npz").promise is None
    m.promise = promise()
    m.save(tmp_path / "map.npz")
    found = method.load(tmp_path / "map.npz").promise
    assert found is not None
    for name in ("levels", "bound", "held_least", "held_most", "lost_m"):
        np.testing.assert_array_equal(getattr(found, name), getattr(m.promise, name))
    assert found.blocks == 7
    assert found.sentence() == (
        "promised at 99%: 89.1 to 99.0% held on 7 frames that the map has not seen, 0.1 cm of clearance lost"
    )


def test_maps_without_held_out_frames_have_the_default_table() -> None:
    m = room_map("mrf")
    points = some_points(m, 2000)
    shares = [m.free_with(points, level).mean() for level in (0.8, 0.9, 0.95, 0.99)]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > shares[-1] > 0
    with pytest.raises(ConfigError, match="log_odds has no default"):
        room_map("log_odds").free_with(points)
