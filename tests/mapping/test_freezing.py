"""Who is frozen when there are too many: what has left the view."""

import numpy as np
import pytest
import small_room

from taichi_mrf.mapping.selection import surplus
from taichi_mrf.methods.mrf.map import MRFMap

pytestmark = pytest.mark.usefixtures("one_backend")


@pytest.fixture
def m() -> MRFMap:
    """Ten keyframes around the room, one after the other, and the first view once more."""
    m = MRFMap(small_room.VOXEL_SIZE)
    for frame in [*small_room.frames(), small_room.frames()[0]]:
        m.renew([small_room.add(m, frame)])
    return m


def test_those_that_see_least_of_what_the_newest_sees_go_first(m: MRFMap) -> None:
    newest = 10
    seen = set(m.keyframes[newest].visible.slots.tolist())
    shared = {id: np.mean([s in seen for s in k.visible.slots.tolist()]) for id, k in m.keyframes.items()}
    chosen = surplus(m, newest, keep=4)
    assert len(chosen) == 7
    assert [shared[id] for id in chosen] == sorted(shared[id] for id in chosen)
    kept = m.keyframes.keys() - set(chosen)
    assert max(shared[id] for id in chosen) <= min(shared[id] for id in kept)
    assert {0, newest} <= kept  # the first view is the newest once more, though it is the oldest


@pytest.mark.parametrize("keep", [11, 100])
def test_nobody_goes_while_there_is_room(m: MRFMap, keep: int) -> None:
    assert surplus(m, 10, keep) == []


def test_the_newest_stays(m: MRFMap) -> None:
    assert sorted(surplus(m, 10, keep=1)) == list(range(10))


def test_an_endless_run_holds_no_more_than_it_may() -> None:
    """Laps around the room with few keyframes that can change: bounded, and the same surfaces."""
    m, full = MRFMap(small_room.VOXEL_SIZE), MRFMap(small_room.VOXEL_SIZE)
    sizes = []
    for frame in small_room.frames() * 3:
        id = small_room.add(m, frame)
        m.renew([id])
        for old in surplus(m, id, keep=4):
            m.freeze_keyframe(old)
        size = m.statistics()
        sizes.append(size.bytes_per_voxel * size.voxels)
        small_room.add(full, frame)
    assert len(m.keyframes) == 4
    assert len(m.frozen) == 26
    assert max(sizes[20:]) <= max(sizes[10:20])
    full.infer()
    centres, p = full.voxels(0.0)
    assert ((m.occupancy(centres) > 0.5) != (p > 0.5)).mean() < 0.02
