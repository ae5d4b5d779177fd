"""Requests that wait: which replace each other, and in which order the others stay."""

import numpy as np
import pytest

from taichi_mrf.session.session_core import WaitingRequests
from taichi_mrf.viewer.messages import Freeze, Move, Pause, Request, Reset, Save, Speed, Step, Switch, Undo
from taichi_mrf.viewer.tune.messages import SaveTries


def move(keyframe: int, x: float) -> Move:
    T = np.eye(4)
    T[0, 3] = x
    return Move(keyframe, T)


@pytest.mark.parametrize(
    ("asked", "kept"),
    [
        ([Save("map", 1)] * 150, [0]),
        ([Save("map", 1), Save("ply", 1), Save("map", 2)], [0, 1, 2]),
        ([Speed(1.0), Pause(True), Speed(2.0)], [1, 2]),
        ([move(3, 0.1), move(4, 0.1), move(3, 0.2)], [1, 2]),
        ([move(3, 0.1), Freeze(3), move(3, 0.2)], [0, 1, 2]),
        ([Switch(2, None), Switch(2, None), Undo(), Undo(), Freeze(1), Freeze(2)], [0, 1, 2, 3, 4, 5]),
        ([move(3, 0.1), Undo(), move(3, 0.2), Switch(4, None), move(3, 0.3)], [0, 1, 2, 3, 4]),
        ([Switch(2, None)] * 1500 + [Pause(True)], [*range(1000), 1500]),
        ([Pause(True), Step(), Pause(False)], [0, 1, 2]),
        ([move(3, 0.1), Switch(1, False), Step(), Speed(1.0), Reset()], [3, 4]),
        ([SaveTries("yaml", 1, 7), SaveTries("yaml", 2, 7), SaveTries("yaml", 1, 7)], [1, 2]),
    ],
)
def test_a_later_request_replaces_a_waiting_one_of_its_kind(asked: list[Request], kept: list[int]) -> None:
    requests = WaitingRequests()
    for request in asked:
        requests.put(request)
    waiting = list(requests)
    assert len(waiting) == len(kept)
    # The later one of equal requests is kept, so look only at what they say.
    assert all(repr(a) == repr(asked[i]) for a, i in zip(waiting, kept, strict=True))


def test_requests_that_are_put_back_come_first() -> None:
    requests = WaitingRequests()
    requests.put(Speed(1.0))
    requests.put_back([Freeze(1), Freeze(2)])
    assert list(requests) == [Freeze(1), Freeze(2), Speed(1.0)]
    assert requests.has_edits()
    assert requests.take() == Freeze(1)
