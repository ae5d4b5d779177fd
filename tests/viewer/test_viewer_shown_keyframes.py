"""The page's memory of keyframes: all that can be changed, and a bounded share of what is frozen."""

from dataclasses import replace

import numpy as np

from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.viewer.messages import KeyframeInfo, KeyframeState
from taichi_mrf.viewer.scene.keyframe_layer import MOST_FROZEN, MOST_WAYPOINTS, ShownKeyframes

CAMERA = PinholeCamera(8, 6, 5.0, 5.0, 3.5, 2.5)


def keyframe(id: int, state: KeyframeState = "on") -> KeyframeInfo:
    T = np.eye(4)
    T[0, 3] = id
    crossed = np.array([[id, 0, 0], [id + 1, 0, 0]], np.int32)
    return KeyframeInfo(id, f"frame {id}", T, CAMERA, 1, state, np.zeros((2, 2, 3), np.uint8), crossed, T)


def bricks(roster: ShownKeyframes) -> set[tuple[int, ...]]:
    return {tuple(brick) for each in roster.crossed() for brick in each.tolist()}


def places(roster: ShownKeyframes) -> np.ndarray:
    """Where along x the camera's path leads, from line to line."""
    lines = roster.path()[0][:, :, 0]
    np.testing.assert_array_equal(lines[1:, 0], lines[:-1, 1])
    return np.append(lines[:1, 0], lines[:, 1])


def test_frozen_keyframes_are_forgotten_but_not_what_they_saw_nor_where_they_were() -> None:
    roster, forgotten = ShownKeyframes(), []
    for id in range(3 * MOST_FROZEN):
        roster.put(keyframe(id))
        forgotten += roster.put(keyframe(id, "frozen"))
    assert forgotten == list(range(2 * MOST_FROZEN))
    assert sorted(roster.keyframes) == list(range(2 * MOST_FROZEN, 3 * MOST_FROZEN))
    assert bricks(roster) == {(x, 0, 0) for x in range(3 * MOST_FROZEN + 1)}
    np.testing.assert_array_equal(places(roster), np.arange(3 * MOST_FROZEN))


def test_what_can_be_changed_is_never_forgotten() -> None:
    roster = ShownKeyframes()
    for id in range(4 * MOST_FROZEN):
        assert roster.put(keyframe(id)) == []
    assert len(roster.keyframes) == 4 * MOST_FROZEN


def test_a_long_way_keeps_its_ends_and_its_order() -> None:
    roster = ShownKeyframes()
    count = 3 * MOST_WAYPOINTS
    for id in range(count):
        roster.put(keyframe(id, "frozen"))
    path = places(roster)
    assert len(path) <= MOST_WAYPOINTS + MOST_FROZEN
    assert path[0] == 0
    assert path[-1] == count - 1
    assert np.all(np.diff(path) > 0)
    assert np.diff(path).max() <= 4


def test_a_keyframe_that_is_off_has_seen_nothing() -> None:
    roster = ShownKeyframes()
    roster.put(keyframe(1))
    roster.put(keyframe(1, "off"))
    assert bricks(roster) == set()


def test_no_line_leads_from_an_earlier_day_to_today() -> None:
    roster = ShownKeyframes()
    for id in range(3 * MOST_FROZEN):
        roster.put(replace(keyframe(id, "frozen"), earlier=id < 7))
    steps = roster.path()[0][:, :, 0].tolist()
    assert steps == [[id, id + 1] for id in range(3 * MOST_FROZEN - 1) if id != 6]
