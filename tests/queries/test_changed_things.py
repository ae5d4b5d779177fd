"""Things that appeared and left between two maps, written by hand voxel by voxel."""

import numpy as np
import pytest
from hand_made import PRIOR, VOXEL
from numpy.typing import NDArray
from queried_maps import HandMap, map_of

from taichi_mrf.errors import ConfigError
from taichi_mrf.queries.change import compare_maps
from taichi_mrf.queries.changed_things import ChangedThing, find_changed_things, without_slack
from taichi_mrf.voxels.layout import BRICK

LOWER = (-8, 16, 0)
SHAPE = (32, 24, 16)
FREE, OCCUPIED = -5.0, 3.0


def box(lower: tuple[int, int, int], upper: tuple[int, int, int]) -> tuple[slice, ...]:
    return tuple(slice(a, b) for a, b in zip(lower, upper, strict=True))


CHAIR_BEFORE, CHAIR_AFTER = box((2, 2, 1), (6, 6, 9)), box((20, 14, 1), (24, 18, 9))
LAMP = box((14, 4, 10), (16, 6, 12))


def space() -> NDArray[np.float64]:
    log_odds = np.full(SHAPE, FREE)
    log_odds[:, :, 0] = OCCUPIED
    log_odds[:, 20:, 1:] = PRIOR
    return log_odds


@pytest.fixture
def two_maps(backend: str) -> tuple[HandMap, HandMap]:
    """A chair is moved, a lamp appears, a corner is seen for the first time."""
    before, after = space(), space()
    before[CHAIR_BEFORE] = after[CHAIR_AFTER] = after[LAMP] = OCCUPIED
    after[:10, 20:, 1:] = OCCUPIED
    return map_of(backend, LOWER, before), map_of(backend, LOWER, after)


def as_text(thing: ChangedThing) -> tuple[str, int, list[float], list[float]]:
    return thing.verb, thing.voxels, thing.size_m.round(6).tolist(), thing.centre_m.round(6).tolist()


def in_metres(lower: tuple[int, int, int], upper: tuple[int, int, int]) -> tuple[list[float], list[float]]:
    a, b = np.array(lower) + LOWER, np.array(upper) + LOWER
    return ((b - a) * VOXEL).round(6).tolist(), ((a + b) / 2 * VOXEL).round(6).tolist()


def test_a_chair_that_is_moved_left_and_appeared(two_maps: tuple[HandMap, HandMap]) -> None:
    found = find_changed_things(compare_maps(*two_maps), VOXEL)
    assert [as_text(thing) for thing in found] == [
        ("appeared", 128, *in_metres((20, 14, 1), (24, 18, 9))),
        ("left", 128, *in_metres((2, 2, 1), (6, 6, 9))),
        ("appeared", 8, *in_metres((14, 4, 10), (16, 6, 12))),
    ]
    assert [thing.voxels for thing in find_changed_things(compare_maps(*two_maps), VOXEL, 9)] == [128, 128]


def test_parts_within_reach_are_one_thing(backend: str) -> None:
    before, after = space(), space()
    after[box((4, 4, 1), (6, 6, 5))] = after[box((4, 4, 7), (6, 6, 9))] = after[LAMP] = OCCUPIED
    change = compare_maps(map_of(backend, LOWER, before), map_of(backend, LOWER, after))
    assert [thing.voxels for thing in find_changed_things(change, VOXEL)] == [16, 8, 8]
    joined = find_changed_things(change, VOXEL, reach_m=3 * VOXEL)
    assert [thing.voxels for thing in joined] == [24, 8]
    assert (joined[0].size_m / VOXEL).round(6).tolist() == [2, 2, 8]


def test_only_the_bricks_that_are_given_are_compared(two_maps: tuple[HandMap, HandMap]) -> None:
    bricks = np.array([[(LOWER[0] + 14) // BRICK, LOWER[1] // BRICK, 1]], np.int32)
    change = compare_maps(*two_maps, bricks)
    assert change.counts.sum() == BRICK**3
    (lamp,) = find_changed_things(change, VOXEL)
    assert (lamp.verb, lamp.voxels) == ("appeared", 8)


def test_equal_maps_have_no_changed_things(two_maps: tuple[HandMap, HandMap]) -> None:
    assert find_changed_things(compare_maps(two_maps[0], two_maps[0]), VOXEL) == []


@pytest.mark.parametrize(
    ("options", "words"), [({"min_voxels": 0}, "min_voxels"), ({"reach_m": 0.0}, "reach_m")]
)
def test_impossible_arguments(
    two_maps: tuple[HandMap, HandMap], options: dict[str, float], words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        find_changed_things(compare_maps(*two_maps), VOXEL, **options)


def test_a_wall_that_shifts_has_not_come_and_gone(two_maps: tuple[HandMap, HandMap], backend: str) -> None:
    """Poses that are off by two voxels move the floor and the chairs; a lamp hangs in free space."""
    before, after = space(), space()
    before[CHAIR_BEFORE] = after[box((4, 2, 1), (8, 6, 9))] = after[LAMP] = OCCUPIED
    after[:, :20, 2] = OCCUPIED
    after[:, :20, 0] = FREE
    a, b = map_of(backend, LOWER, before), map_of(backend, LOWER, after)
    change = compare_maps(a, b)
    assert {thing.verb for thing in find_changed_things(change, VOXEL, 24)} == {"appeared", "left"}
    (lamp,) = find_changed_things(without_slack(change, a, b, core=8), VOXEL)
    assert as_text(lamp) == ("appeared", 8, *in_metres((14, 4, 10), (16, 6, 12)))
    moved = find_changed_things(without_slack(compare_maps(*two_maps), *two_maps, core=8), VOXEL)
    assert [thing.voxels for thing in moved] == [128, 128, 8]
