"""Keyframes switched off and on, moved and frozen in a live run: the map ends as that of what is left."""

import numpy as np
import pytest
import small_room
from live_scene import (
    FakeLink,
    assert_shown_is,
    during_settling,
    finished,
    last_status,
    marginals,
    room,
    session_of,
    shown,
)

from taichi_mrf.viewer.messages import Bricks, Freeze, KeyframeInfo, Move, Request, Switch, Undo, Update

pytestmark = pytest.mark.usefixtures("one_backend")


def test_off_is_the_map_without_it_and_on_brings_it_back_bit_for_bit() -> None:
    link = FakeLink()
    session = session_of(link)
    before = marginals(finished(session))
    voxels_before = len(shown(link.sent).voxels())
    link.ask(Switch(1, on=False))
    assert marginals(finished(session)) == marginals(small_room.build([0, 2, 3]))
    assert_shown_is(session, link)
    assert len(shown(link.sent).voxels()) < voxels_before
    assert shown(link.sent).keyframes[1].state == "off"
    link.ask(Switch(1, on=True))
    assert marginals(finished(session)) == before
    assert_shown_is(session, link)
    assert shown(link.sent).keyframes[1].state == "on"
    assert list(shown(link.sent).keyframes) == [0, 1, 2, 3]


@pytest.mark.parametrize("while_off", [False, True])
def test_a_moved_keyframe_gives_the_map_of_its_new_place(while_off: bool) -> None:
    T = small_room.frames()[2].T_world_camera.copy()
    T[:3, 3] += (0.2, -0.1, 0.05)
    link = FakeLink()
    session = session_of(link)
    finished(session)
    link.ask(*((Switch(2, on=False), Move(2, T), Switch(2, on=True)) if while_off else (Move(2, T),)))
    assert marginals(finished(session)) == marginals(small_room.build(range(4), {2: T}))
    assert_shown_is(session, link)
    np.testing.assert_array_equal(shown(link.sent).keyframes[2].T_world_camera, T)


def test_a_frozen_keyframe_stays_in_the_map_and_can_be_changed_no_more() -> None:
    link = FakeLink()
    session = session_of(link)
    finished(session)
    link.ask(Freeze(0))
    m = finished(session)
    assert list(m.frozen.values()) == [small_room.frames()[0].name]
    assert shown(link.sent).keyframes[0].state == "frozen"
    assert (last_status(link).keyframes, last_status(link).frozen) == (3, 1)
    assert_shown_is(session, link)
    link.ask(Switch(0, on=False), Move(0, np.eye(4)), Freeze(0))
    finished(session)
    assert len(link.errors()) == 3
    assert all("frozen" in text for text in link.errors())


def test_the_oldest_keyframes_are_frozen_as_they_age() -> None:
    link = FakeLink()
    session = session_of(link, room(6), keep_live=2)
    m = finished(session)
    assert [k.name for k in m.keyframes.values()] == [f.name for f in small_room.frames()[4:6]]
    assert len(m.frozen) == 4
    assert_shown_is(session, link)
    assert [k.state for k in shown(link.sent).keyframes.values()] == ["frozen"] * 4 + ["on"] * 2


def test_edits_while_frames_come_act_at_once_and_end_in_the_same_map() -> None:
    asked: list[Request] = [Switch(0, on=False)]

    def react(update: Update) -> list[Request]:
        return [asked.pop()] if isinstance(update, KeyframeInfo) and update.id == 2 and asked else []

    link = FakeLink(react)
    session = session_of(link, room(5))
    m = finished(session)
    assert marginals(m) == marginals(small_room.build([1, 2, 3, 4]))
    assert_shown_is(session, link)
    off = next(i for i, u in enumerate(link.sent) if isinstance(u, KeyframeInfo) and u.state == "off")
    later = [u.id for u in link.sent[off:] if isinstance(u, KeyframeInfo) and u.state == "on"]
    assert later == [3, 4]
    bricks_off = next(u for u in link.sent[off:] if isinstance(u, Bricks))
    assert len(bricks_off.removed) > 0


def test_an_edit_breaks_full_inference_off_and_is_seen_at_once() -> None:
    link = FakeLink(during_settling(Switch(3, on=False)))
    session = session_of(link)
    m = finished(session)
    assert marginals(m) == marginals(small_room.build([0, 1, 2]))
    off = next(i for i, u in enumerate(link.sent) if isinstance(u, KeyframeInfo) and u.state == "off")
    assert isinstance(link.sent[off + 1], Bricks)
    at_once = shown(link.sent[: off + 2])
    without = {tuple(b) for b in m.view.pool.bricks[m.view.pool.in_use].tolist()}
    assert set(at_once.bricks["map"]) == without
    assert len(at_once.voxels()) > 0
    assert_shown_is(session, link)


def states(link: FakeLink) -> list[str]:
    return [each.state for each in shown(link.sent).keyframes.values()]


def test_presses_before_the_first_is_answered_are_taken_back_in_their_order() -> None:
    """On/off, then Undo and On/off again, of one client or of two: after all Undo it is as at first."""
    link = FakeLink()
    session = session_of(link)
    before = marginals(finished(session))
    link.ask(Switch(1, None), Undo(), Switch(1, None))
    finished(session)
    assert states(link) == ["on", "off", "on", "on"]
    link.ask(Switch(1, None), Switch(1, None), Undo(), Undo(), Undo(), Undo())
    assert marginals(finished(session)) == before
    assert states(link) == ["on"] * 4
    assert (last_status(link).can_undo, last_status(link).can_redo) == (False, True)
    link.ask(Undo(again=True))
    finished(session)
    assert states(link) == ["on", "off", "on", "on"]
    assert link.errors() == []


def test_edits_of_one_press_are_taken_back_together() -> None:
    """They leave out what is as they want it, and what is frozen."""
    link = FakeLink()
    session = session_of(link)
    finished(session)
    link.ask(Switch(2, False), Freeze(3), Switch(1, False, last=3))
    finished(session)
    assert states(link) == ["on", "off", "off", "frozen"]
    link.ask(Undo())
    finished(session)
    assert states(link) == ["on", "on", "off", "frozen"]
    link.ask(Switch(1, None, last=2))
    finished(session)
    assert states(link) == ["on", "off", "on", "frozen"]
    link.ask(Undo(), Undo())
    finished(session)
    assert states(link) == ["on", "on", "on", "frozen"]
    link.ask(Switch(1, True), Undo())  # it did nothing, so there is nothing to take back
    finished(session)
    assert not last_status(link).can_undo
    assert link.errors() == []


def test_edits_of_a_frozen_keyframe_cannot_be_taken_back() -> None:
    link = FakeLink()
    session = session_of(link)
    finished(session)
    T = small_room.frames()[1].T_world_camera.copy()
    T[:3, 3] += 0.2
    link.ask(Move(1, T), Move(0, T), Freeze(1), Undo())
    finished(session)
    assert not last_status(link).can_undo
    known = shown(link.sent).keyframes
    np.testing.assert_array_equal(known[1].T_world_camera, T)
    np.testing.assert_array_equal(known[0].T_world_camera, small_room.frames()[0].T_world_camera)
    assert link.errors() == []
