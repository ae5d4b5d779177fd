"""Live runs whose poses change: keyframes move on the page, and the map ends as that of the last poses."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import small_room
from live_scene import CONFIG, FakeLink, assert_shown_is, finished, marginals, room, shown, source

from taichi_mrf.datasets.pose_sources.base import CallbackPoses, ChangedPoses
from taichi_mrf.datasets.pose_sources.posed import posed_by
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.mapping import follow
from taichi_mrf.session.session import Session
from taichi_mrf.session.session_core import Policy
from taichi_mrf.viewer.messages import KeyframeInfo, Move, Status, Switch

pytestmark = pytest.mark.usefixtures("one_backend")


@pytest.fixture(autouse=True)
def _soon_final(monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses are final when they have not changed for a moment."""
    monkeypatch.setattr(follow, "FINAL_AFTER_S", 0.3)


def shifted(index: int, x_m: float = 0.0, y_m: float = 0.0, z_m: float = 0.0) -> Pose:
    T = small_room.frames()[index].T_world_camera.copy()
    T[:3, 3] += (x_m, y_m, z_m)
    return T


class Told:
    """Poses that the test changes; the frames of the small room are called ``frame-00000i`` there."""

    def __init__(self) -> None:
        self.news: Iterator[ChangedPoses] = iter(())
        self.latest: ChangedPoses | None = None

    def tell(self, poses: dict[int, Pose]) -> None:
        self.latest = {small_room.frames()[index].name: T for index, T in poses.items()}

    def __call__(self, stamp_s: float) -> ChangedPoses | None:
        latest, self.latest = self.latest, None
        return latest


def following(link: FakeLink, told: Told, method: str = "mrf") -> Session:
    config = replace(CONFIG, method=method)
    dataset = posed_by(room(), CallbackPoses(told), follow=True)
    made = replace(source(dataset, config), dataset=dataset)
    return Session(made, link, Policy(leave_when_done=True))


def test_keyframes_move_when_the_poses_change_and_the_map_is_that_of_the_last_poses() -> None:
    link, told = FakeLink(), Told()
    there = {3: shifted(3)}  # without a pose it would be carried along with the one before it
    first = {1: shifted(1, 0.05), 2: shifted(2, 0.0, 0.1), **there}
    told.tell(first)
    session = following(link, told)
    assert marginals(finished(session)) == marginals(small_room.build(range(4), first))
    last = {0: shifted(0, 0.3, 0.0, 0.0), 1: shifted(1, 0.0, 0.2, 0.0), 2: shifted(2, 0.0, 0.1, 1e-5)}
    told.tell(last | there)
    link.sent.clear()
    assert marginals(finished(session)) == marginals(small_room.build(range(4), last))
    assert link.errors() == []
    moved = [info.id for info in link.of_type(KeyframeInfo)]
    assert moved == [0, 1, 2]  # the one that moves most first, one at a time, the hardly moved one at the end
    told_where = {info.id: info.T_world_camera for info in link.of_type(KeyframeInfo)}
    for id, T in last.items():
        np.testing.assert_array_equal(told_where[id], T)
    activities = [status.activity for status in link.of_type(Status)]
    assert "moving keyframes to new poses: 3 left" in activities


def test_poses_that_change_while_the_map_settles_are_taken_in_before_it_ends() -> None:
    told = Told()
    last = {3: shifted(3, 0.1, 0.1, 0.0)}
    left = [last]

    def react(update: object) -> list:
        if isinstance(update, Status) and update.activity.startswith("sweeping keyframe 2 ") and left:
            told.tell(left.pop())
        return []

    link = FakeLink(react)
    session = following(link, told)
    assert marginals(finished(session)) == marginals(small_room.build(range(4), last))
    assert_shown_is(session, link)


def test_what_a_user_has_moved_or_switched_off_stays_so() -> None:
    link, told = FakeLink(), Told()
    session = following(link, told)
    finished(session)
    by_hand = shifted(1, 0.0, -0.2, 0.0)
    link.ask(Move(1, by_hand), Switch(2, on=False))
    finished(session)
    told.tell({1: shifted(1, 0.3), 2: shifted(2, 0.1), 3: shifted(3, 0.2)})
    m = finished(session)
    assert marginals(m) == marginals(small_room.build([0, 1, 3], {1: by_hand, 3: shifted(3, 0.2)}))
    assert shown(link.sent).keyframes[2].state == "off"
    link.ask(Switch(2, on=True))  # it comes back where the file has it
    poses = {1: by_hand, 2: shifted(2, 0.1), 3: shifted(3, 0.2)}
    # Its number in the map is a new one, and the sums are those of another order.
    centres, p = finished(session).voxels(0.0)
    np.testing.assert_allclose(small_room.build(range(4), poses).occupancy(centres), p, atol=0.02)


def test_a_method_without_messages_follows_too() -> None:
    link, told = FakeLink(), Told()
    session = following(link, told, "log_odds")
    session.run(lambda: False)
    told.tell({1: shifted(1, 0.3, 0.0, 0.0)})
    session.run(lambda: False)
    assert link.errors() == []
    m = session.state.mapper.map
    np.testing.assert_array_equal(m.keyframes[1].T_world_camera, shifted(1, 0.3, 0.0, 0.0))
    assert m.settled
