"""Which bricks are told: all that differ from what was told, and no others, whatever happens to the map."""

import live_scene
import numpy as np
import pytest
import small_room
from hypothesis import given, settings
from hypothesis import strategies as st
from live_scene import Shown, map_voxels

from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.registry import create_map
from taichi_mrf.session.publish import Publisher
from taichi_mrf.viewer.messages import Bricks, pack_log_odds

pytestmark = pytest.mark.usefixtures("one_backend")

FRAMES = 4


def publisher_of(m: OccupancyMap) -> Publisher:
    return Publisher("map", m.view.pool, m.seen_by)


def told(m: OccupancyMap) -> dict[tuple[int, ...], tuple[bytes, bytes]]:
    """Knowledge of a viewer that has all of a map, by brick."""
    pool = m.view.pool
    slots = pool.in_use
    rows = zip(
        pool.bricks[slots].tolist(), pack_log_odds(pool.read("belief", slots)), m.seen_by(slots), strict=True
    )
    return {tuple(brick): (log_odds.tobytes(), seen.tobytes()) for brick, log_odds, seen in rows}


def known(view: Shown) -> dict[tuple[int, ...], tuple[bytes, bytes]]:
    return {k: (a.tobytes(), b.tobytes()) for k, (a, b) in view.bricks.get("map", {}).items()}


def assert_minimal(update: Bricks | None, before: dict, after: dict) -> None:
    """The update names the bricks that differ, those that are gone, and no others."""
    changed = {brick for brick in after if after[brick] != before.get(brick)}
    gone = before.keys() - after.keys()
    if update is None:
        assert not changed
        assert not gone
        return
    assert sorted(map(tuple, update.bricks.tolist())) == sorted(changed)
    assert sorted(map(tuple, update.removed.tolist())) == sorted(gone)


@settings(max_examples=10)
@given(
    st.lists(
        st.tuples(st.sampled_from(["add", "remove", "freeze", "sweep", "infer"]), st.integers(0, FRAMES - 1)),
        max_size=8,
    )
)
def test_a_viewer_knows_the_map_after_any_history(history: list[tuple[str, int]]) -> None:
    m = MRFMap(0.12)
    publisher, view, ids = publisher_of(m), Shown(), {}
    for verb, which in history:
        if verb == "add" and which not in ids:
            ids[which] = small_room.add(m, small_room.frames()[which])
        elif verb == "infer":
            m.infer(sweeps=1)
        elif which in ids and verb == "sweep":
            m.infer(sweeps=1, keyframes=[ids[which]])
        elif which in ids and verb == "remove":
            m.remove_keyframe(ids.pop(which))
        elif which in ids and verb == "freeze" and m.keyframes[ids[which]].messages is not None:
            m.freeze_keyframe(ids.pop(which))
        before, update = known(view), publisher.changes()
        if update is not None:
            view.hear(update)
        assert known(view) == told(m)
        assert_minimal(update, before, told(m))


def test_nothing_is_told_where_nothing_has_changed() -> None:
    m = small_room.build([0, 1])
    publisher = publisher_of(m)
    assert publisher.changes() is not None
    assert publisher.changes() is None
    m.infer()  # touches everything, and ends where it was
    assert publisher.changes() is None


def test_a_change_in_one_brick_costs_one_brick(monkeypatch: pytest.MonkeyPatch) -> None:
    m = small_room.build([0, 1])
    publisher, pool = publisher_of(m), m.view.pool
    publisher.changes()
    read: list[int] = []
    whole = type(pool).read

    def counting(self: object, channel: str, slots: np.ndarray) -> np.ndarray:
        read.append(len(slots))
        return whole(pool, channel, slots)

    slots = pool.in_use[3:4]
    pool.write("total", slots, pool.read("belief", slots) + 1.0)
    monkeypatch.setattr(type(pool), "read", counting)
    update = publisher.changes()
    assert update is not None
    np.testing.assert_array_equal(update.bricks, pool.bricks[slots])
    assert read == [1]


def test_less_than_a_step_of_the_log_odds_is_no_news() -> None:
    m = small_room.build([0])
    pool = m.view.pool
    slots = pool.in_use[:2]
    pool.write("total", slots, np.full((2, 512), 1.0 + 1e-5, np.float32))
    publisher = publisher_of(m)
    publisher.changes()
    pool.write("total", slots, np.full((2, 512), 1.0 + 2e-5, np.float32))
    assert publisher.changes() is None


def test_a_brick_that_goes_and_comes_back_the_same_is_no_news() -> None:
    config = live_scene.Config(voxel_size=0.12, method="log_odds")
    m = create_map(config, small_room.frames()[0].camera)
    ids = [small_room.add(m, small_room.frames()[i]) for i in range(3)]
    publisher = publisher_of(m)
    publisher.changes()
    m.move_keyframe(ids[2], small_room.frames()[2].T_world_camera)
    m.infer()  # all bricks are given back, and made anew
    assert publisher.changes() is None


@pytest.mark.parametrize("method", ["mrf", "log_odds"])
def test_what_is_told_rebuilds_the_voxels(method: str) -> None:
    config = live_scene.Config(voxel_size=0.1, method=method)
    m = create_map(config, small_room.frames()[0].camera)
    view = Shown()
    publisher = Publisher("map", m.view.pool, m.seen_by, prior_is_unknown=method != "mrf")
    for i in range(3):
        small_room.add(m, small_room.frames()[i])
        m.infer()
        update = publisher.changes()
        assert update is not None
        view.hear(update)
        assert view.voxels() == map_voxels(m.layer() if method == "mrf" else m)


def test_bricks_without_a_likely_voxel_can_be_left_out() -> None:
    m = create_map(live_scene.Config(voxel_size=0.1, method="log_odds"), small_room.frames()[0].camera)
    publisher = Publisher("baseline", m.view.pool, m.seen_by, prior_is_unknown=True, least_log_odds=0.0)
    view = Shown()
    ids = [small_room.add(m, small_room.frames()[i]) for i in range(3)]
    for _ in range(2):
        update = publisher.changes()
        assert update is not None
        view.hear(update)
        assert view.voxels("baseline") == map_voxels(m)
        pool = m.view.pool
        belief = pool.read("belief", pool.in_use)
        likely = pool.bricks[pool.in_use][(belief > 0).any(axis=1)]
        assert set(view.bricks["baseline"]) == {tuple(brick) for brick in likely.tolist()}
        assert 0 < len(likely) < len(belief)
        m.remove_keyframe(ids.pop())
        m.infer()


def test_taking_all_away_and_starting_over() -> None:
    m = small_room.build([0, 1])
    publisher, view = publisher_of(m), Shown()
    first = publisher.changes()
    assert first is not None
    view.hear(first)
    view.hear(publisher.everything_gone())
    assert known(view) == {}
    again = publisher.changes()
    assert again is not None
    view.hear(again)
    assert known(view) == told(m)
    publisher.start_over()
    once_more = publisher.changes()
    assert once_more is not None
    assert len(once_more.bricks) == len(first.bricks)


def test_an_empty_map_has_nothing_to_tell() -> None:
    assert publisher_of(MRFMap(0.1)).changes() is None


def test_who_sees_a_voxel_is_told_once_somebody_wants_to_know() -> None:
    m = small_room.build([0, 1])
    publisher = Publisher("map", m.view.pool, m.seen_by, counting=False)
    first = publisher.changes()
    assert first is not None
    assert not first.seen.any()
    publisher.count(True)
    again = publisher.changes()
    assert again is not None
    assert {tuple(b) for b in again.bricks.tolist()} == {tuple(b) for b in first.bricks.tolist()}
    slots = m.view.pool.in_use
    rows = {tuple(b): row for b, row in zip(again.bricks.tolist(), again.seen, strict=True)}
    expected = m.seen_by(slots)
    assert expected.any()
    for brick, seen in zip(m.view.pool.bricks[slots].tolist(), expected, strict=True):
        np.testing.assert_array_equal(rows[tuple(brick)], seen)
    assert publisher.changes() is None
