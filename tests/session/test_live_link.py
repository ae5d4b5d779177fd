"""The line to the viewer: mapping never waits for it, and a viewer that is slow or gone does no harm."""

import os
import signal
from collections.abc import Callable

import numpy as np
import pytest
import stand_in_viewers
from hypothesis import given
from hypothesis import strategies as st
from live_program import wait_for
from live_scene import Shown

from taichi_mrf.session.link import ViewerLink
from taichi_mrf.session.outbox import BRICKS_AT_ONCE, Outbox, merged
from taichi_mrf.viewer.messages import (
    Alive,
    Bricks,
    File,
    Hello,
    Layer,
    Listening,
    Notice,
    Quit,
    Status,
    Step,
    Update,
)
from taichi_mrf.voxels.layout import VOXELS, grid_keys

HELLO = Hello("room", "cpu", "", "mrf", 0.05, -2.2, 0.1, "")


def status(frame: int = 0) -> Status:
    return Status("working", 0.0, frame, 9, 0, 0, 0.0, 0, 0, 0.0, False, False, False)


def bricks(there: dict[int, int], gone: tuple[int, ...] = (), layer: Layer = "map") -> Bricks:
    """Bricks along x, each filled with one value, and bricks that are gone."""
    places = np.array([(x, -x, 3) for x in there], np.int32).reshape(-1, 3)
    values = np.array(list(there.values())).reshape(-1, 1)
    return Bricks(
        layer,
        places,
        np.repeat(values, VOXELS, axis=1).astype(np.int16),
        np.repeat(values, VOXELS, axis=1).astype(np.uint8),
        np.array([(x, -x, 3) for x in gone], np.int32).reshape(-1, 3),
    )


def known(view: Shown) -> dict[str, dict[int, tuple[int, int]]]:
    """Layer -> x of the brick -> its value and seen."""
    return {
        layer: {place[0]: (int(a[0]), int(b[-1])) for place, (a, b) in rows.items()}
        for layer, rows in view.bricks.items()
        if rows
    }


def drained(outbox: Outbox) -> list[Update]:
    updates = []
    while len(outbox):
        update = outbox.take()
        assert not isinstance(update, Quit)
        updates.append(update)
    return updates


PLACES = st.integers(0, 7)


@st.composite
def brick_updates(draw: st.DrawFn) -> Bricks:
    there = draw(st.dictionaries(PLACES, st.integers(0, 255), max_size=5))
    gone = draw(st.sets(PLACES, max_size=4)) - there.keys()
    return bricks(there, tuple(gone), draw(st.sampled_from(["map", "baseline"])))


@given(st.lists(st.one_of(brick_updates(), st.just(HELLO), st.just(None)), max_size=30))
def test_whatever_is_merged_a_viewer_ends_up_with_what_was_said(actions: list[Update | None]) -> None:
    outbox, told, expected = Outbox(), Shown(), Shown()
    for action in actions:
        if action is None:  # the sender takes one
            if len(outbox):
                update = outbox.take()
                assert not isinstance(update, Quit)
                told.hear(update)
        else:
            outbox.put(action)
            expected.hear(action)
    for update in drained(outbox):
        told.hear(update)
    assert known(told) == known(expected)


@given(st.lists(brick_updates(), min_size=1, max_size=8))
def test_merged_updates_name_no_brick_twice(parts: list[Bricks]) -> None:
    whole = merged(parts)
    keys = grid_keys(np.concatenate([whole.bricks, whole.removed]))
    assert len(np.unique(keys)) == len(keys)
    assert whole.bricks.dtype == whole.removed.dtype == np.int32
    assert (whole.log_odds.dtype, whole.seen.dtype) == (np.int16, np.uint8)


def test_what_waits_is_never_much_more_than_the_map() -> None:
    outbox = Outbox()
    for step in range(200):
        outbox.put(bricks(dict.fromkeys(range(50), step)))
        waiting = outbox._waiting["bricks", "map"]
        assert sum(len(part.bricks) for part in waiting._parts) <= 3 * 50
    (update,) = drained(outbox)
    assert len(update.bricks) == 50
    assert (update.log_odds == 199).all()


def test_a_large_map_goes_in_pieces_between_which_other_updates_get_through() -> None:
    outbox = Outbox()
    outbox.put(bricks({x: x % 100 for x in range(2 * BRICKS_AT_ONCE + 5)}))
    outbox.put(status(1))
    first, second, *rest = drained(outbox)
    assert isinstance(first, Bricks)
    assert isinstance(second, Status)
    view = Shown()
    for update in (first, *rest):
        assert len(update.bricks) <= BRICKS_AT_ONCE
        view.hear(update)
    assert len(view.bricks["map"]) == 2 * BRICKS_AT_ONCE + 5


def test_only_the_latest_status_is_sent_and_notices_in_their_order() -> None:
    outbox = Outbox()
    for number in range(10):
        outbox.put(status(number))
        outbox.put(Notice(f"{number}"))
    updates = drained(outbox)
    assert [u.frame for u in updates if isinstance(u, Status)] == [9]
    assert [u.text for u in updates if isinstance(u, Notice)] == [f"{number}" for number in range(10)]


def test_an_outbox_without_updates_says_that_its_process_lives() -> None:
    assert Outbox().take() == Alive()


def test_notices_without_end_take_no_memory_without_end() -> None:
    outbox = Outbox()
    for number in range(1000):
        outbox.put(Notice(f"{number}"))
    texts = [update.text for update in drained(outbox)]
    assert len(texts) < 100
    assert texts[-1] == "999"


def test_a_hello_makes_what_was_said_of_the_map_pointless_but_no_file() -> None:
    outbox = Outbox()
    for update in (bricks({1: 1}), status(), File("map.npz", b"1", 3), Notice("careful"), HELLO):
        outbox.put(update)
    assert [type(update) for update in drained(outbox)] == [File, Notice, Hello]


def wait_until(link: ViewerLink, happened: Callable[[], bool]) -> None:
    while not happened():
        link.wait(0.05)


def heard(link: ViewerLink, count: int) -> list:
    """The next requests, as many as are waited for."""
    found: list = []
    while len(found) < count:
        assert link.lost is None
        link.wait(0.05)
        found += link.requests()
    return found


def test_a_viewer_says_where_it_is_gets_updates_and_ends_when_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("taichi_mrf.session.link.GOODBYE_SECONDS", 60.0)  # as long as a busy machine needs
    link = ViewerLink("127.0.0.1", 1234, stand_in_viewers.echo)
    try:
        assert heard(link, 1) == [Listening("127.0.0.1", 1234)]
        for number in range(3):
            link.send(Notice(f"{number}"))
        assert heard(link, 3) == [Step()] * 3
    finally:
        link.close()
    assert link._process.exitcode == 0


def test_a_viewer_that_is_asked_to_end_does_so_while_the_session_works() -> None:
    with ViewerLink("127.0.0.1", 1234, stand_in_viewers.echo) as link:
        link.ask_to_end()
        wait_for(lambda: link.lost is not None, "the end of the viewer")
        assert "exit status 0" in str(link.lost)


def test_a_viewer_that_reads_nothing_holds_nobody_up_and_is_ended_by_force() -> None:
    with ViewerLink("127.0.0.1", 1234, stand_in_viewers.deaf) as link:
        heard(link, 1)
        for number in range(50):
            link.send(bricks(dict.fromkeys(range(100), number)))  # far more than a pipe holds
        process = link._process
    process.join(60.0)
    link._sender.join(60.0)
    assert not process.is_alive()
    assert not link._sender.is_alive()


def test_a_slow_viewer_gets_less_but_all_that_counts() -> None:
    with ViewerLink("127.0.0.1", 1234, stand_in_viewers.patient) as link:
        heard(link, 1)
        for number in range(500):
            link.send(bricks(dict.fromkeys(range(100), number % 256)))
        link.send(status())
        assert link._process.pid is not None
        os.kill(link._process.pid, signal.SIGUSR1)
        (answer,) = heard(link, 1)
    assert answer.port < 10


def test_a_viewer_that_dies_is_noticed() -> None:
    with ViewerLink("127.0.0.1", 1234, stand_in_viewers.dead) as link:
        heard(link, 1)
        link.send(Notice("hello"))
        wait_until(link, lambda: link.lost is not None)
        assert "exit status 3" in link.lost or "closed the connection" in link.lost
        link.send(Notice("is anybody there?"))
        assert link.requests() == []


def test_why_there_is_no_page_is_passed_on() -> None:
    with ViewerLink("203.0.113.1", 1234, stand_in_viewers.refusing) as link:
        found: list = []
        while link._lost is None:
            link.wait(0.05)
            found += link.requests()
        assert link.lost == "203.0.113.1 is not an address of this machine"
        assert found == []


@pytest.mark.parametrize("place", [(0, 0, 0), (-1, 5, -4096), (4095, -4096, 17)])
def test_grid_keys_tell_bricks_apart(place: tuple[int, int, int]) -> None:
    around = np.array(place) + np.stack(np.meshgrid(*[range(-2, 3)] * 3), axis=-1).reshape(-1, 3)
    assert len(np.unique(grid_keys(around.astype(np.int32)))) == 125
