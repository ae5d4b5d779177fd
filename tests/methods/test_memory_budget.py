"""Room for one more keyframe: sums that are kept must be those that would be found by counting."""

import numpy as np
import pytest
import small_room

from taichi_mrf.errors import CapacityError
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.voxels.layout import VOXELS

pytestmark = pytest.mark.usefixtures("one_backend")


def assert_counts_all(m: MRFMap, bricks: dict[int, int]) -> None:
    """The sums are those of the keyframes, whose ``bricks`` are as many as when they came."""
    budget, keyframes = m._parts.allocator.budget, m.keyframes.values()
    assert budget._messages == sum(2 * VOXELS * bricks[k.id] for k in keyframes)
    assert budget._images == sum(k.image_bytes for k in keyframes)
    assert budget._reserved == sum(2 * VOXELS * bricks[k.id] for k in keyframes if k.messages is None)


def test_the_sums_are_those_of_the_keyframes_whatever_has_happened() -> None:
    m, bricks = MRFMap(small_room.VOXEL_SIZE), {}

    def add(i: int) -> int:
        id = small_room.add(m, small_room.frames()[i])
        bricks[id] = len(m.keyframes[id].visible.slots)
        assert_counts_all(m, bricks)
        return id

    first, second, third = add(0), add(1), add(2)
    m.infer(sweeps=1, keyframes=[second])
    assert_counts_all(m, bricks)
    m.infer(sweeps=1)
    add(3)
    m.remove_keyframe(second)
    assert_counts_all(m, bricks)
    T = m.keyframes[first].T_world_camera.copy()
    T[0, 3] += 0.2
    m.move_keyframe(first, T)
    bricks[first] = len(m.keyframes[first].visible.slots)
    assert_counts_all(m, bricks)
    m.freeze_keyframe(third)
    assert_counts_all(m, bricks)


def test_a_keyframe_that_does_not_fit_is_not_counted() -> None:
    m = MRFMap(small_room.VOXEL_SIZE)
    small_room.add(m, small_room.frames()[0])
    m._pool.memory_limit_gb = 1e-6
    with pytest.raises(CapacityError, match="a map of 2 keyframes"):
        small_room.add(m, small_room.frames()[5])
    assert len(m.keyframes) == len(m._parts.allocator.budget._shares) == 1


def test_a_full_inference_that_is_given_up_reserves_memory_for_the_messages_again() -> None:
    m = MRFMap(small_room.VOXEL_SIZE)
    for i in range(3):
        small_room.add(m, small_room.frames()[i])
    bricks = {id: len(k.visible.slots) for id, k in m.keyframes.items()}
    checkpoint = m.checkpoint()
    m.infer(progress=lambda step: False)
    assert m._parts.allocator.budget._reserved == 0
    m.restore(checkpoint)
    assert_counts_all(m, bricks)
    assert m._parts.allocator.budget._reserved > 0


def test_a_keyframe_that_cannot_be_moved_stays_although_the_map_is_over_its_limit() -> None:
    m = MRFMap(small_room.VOXEL_SIZE)
    ids = [small_room.add(m, small_room.frames()[i]) for i in range(3)]
    m.infer()
    before = m.occupancy(small_room.probes())
    m._pool.memory_limit_gb = 1e-6
    T = m.keyframes[ids[1]].T_world_camera.copy()
    T[0, 3] += 0.1
    with pytest.raises(CapacityError):
        m.move_keyframe(ids[1], T)
    m._pool.memory_limit_gb = 0.0
    m.infer()
    np.testing.assert_array_equal(m.occupancy(small_room.probes()), before)
    m.remove_keyframe(ids[1])
    assert len(m.keyframes) == len(m._parts.allocator.budget._shares) == 2


def test_a_move_that_does_not_fit_leaves_the_keyframe_counted() -> None:
    m = MRFMap(small_room.VOXEL_SIZE)
    id = small_room.add(m, small_room.frames()[0])
    before = m._parts.allocator.budget._messages
    far = np.eye(4)
    far[0, 3] = 1e7
    with pytest.raises(CapacityError):
        m.move_keyframe(id, far)
    assert m._parts.allocator.budget._messages == before
