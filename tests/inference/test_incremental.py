"""Incremental inference: who has heard something new, and what comes of sweeping only those."""

import numpy as np
import pytest
import small_room
from hypothesis import given, settings
from hypothesis import strategies as st

from taichi_mrf.inference.incremental import change_count_of, moved_share
from taichi_mrf.inference.keyframe import VisibleBricks
from taichi_mrf.inference.keyframe_bounds import KeyframeBounds
from taichi_mrf.inference.messages import places_of
from taichi_mrf.inference.schedule import InferProgress
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.window import Window

pytestmark = pytest.mark.usefixtures("one_backend")

ROOM = range(6)


def shares(m: MRFMap) -> dict[int, float]:
    """How much of what each keyframe was told is out of date."""
    for keyframe in m.keyframes.values():
        m.infer(sweeps=0, keyframes=[keyframe.id])  # brings its list of bricks up to date
    return {k.id: moved_share(k, m.view.pool) for k in m.keyframes.values()}


def far_away(T_world_camera: np.ndarray) -> np.ndarray:
    moved = T_world_camera.copy()
    moved[:3, 3] += (100.0, 0.0, 0.0)
    return moved


corner = st.tuples(*[st.integers(-20, 20)] * 3)
size = st.tuples(*[st.integers(1, 12)] * 3)


@settings(max_examples=60)
@given(
    boxes=st.lists(st.tuples(st.integers(0, 9), corner, size), max_size=25),
    dropped=st.sets(st.integers(0, 9)),
    low=corner,
    extent=size,
)
def test_those_whose_box_meets_the_bricks_are_near(
    boxes: list, dropped: set[int], low: tuple, extent: tuple
) -> None:
    bounds, oracle = KeyframeBounds(), {}
    for id, lowest, shape in boxes:
        bounds.put(id, Window(lowest, shape, 1.0))
        oracle[id] = (np.array(lowest), np.array(lowest) + shape)
    for id in dropped & oracle.keys():
        bounds.drop(id)
        del oracle[id]
    bricks = np.array([low, np.array(low) + extent - 1])
    meets = {id for id, (a, b) in oracle.items() if (a <= bricks[1]).all() and (b > bricks[0]).all()}
    assert bounds.near(bricks.astype(np.int32)) == meets
    assert bounds.near(bricks[:0].astype(np.int32)) == set()


@pytest.mark.parametrize("tolerance", [0.2, 0.05])
def test_nobody_is_left_with_more_than_the_tolerance(tolerance: float) -> None:
    m = MRFMap(small_room.VOXEL_SIZE)
    for i in ROOM:
        report = m.renew([small_room.add(m, small_room.frames()[i])], tolerance=tolerance)
        assert report.complete
        assert report.residual <= tolerance
        assert max(shares(m).values()) <= tolerance


def test_a_finer_tolerance_comes_nearer_to_full_inference() -> None:
    full = small_room.build(ROOM)
    full.infer(sweeps=10)
    centres, p = full.voxels(0.0)
    apart, sweeps = {}, {}
    for tolerance in (10.0, 0.1, 0.01):
        m = MRFMap(small_room.VOXEL_SIZE)
        sweeps[tolerance] = 0
        for i in ROOM:
            sweeps[tolerance] += m.renew([small_room.add(m, small_room.frames()[i])], tolerance).sweeps
        apart[tolerance] = np.abs(m.occupancy(centres) - p).mean()
    assert sweeps[10.0] == len(ROOM) < sweeps[0.1] < sweeps[0.01]
    assert apart[10.0] > apart[0.1] > apart[0.01]
    # No more of the voxels are off than the keyframes were allowed to leave unheard.
    assert (np.abs(m.occupancy(centres) - p) > 0.02).mean() < 0.02


@settings(max_examples=6)
@given(order=st.permutations(range(5)), seed=st.integers(0, 2**20))
def test_any_history_stays_within_the_stated_distance_of_full_inference(order: list[int], seed: int) -> None:
    """Keyframes come, go and move; the map renewed on the way has the marginals of full inference, to 0.02
    for 95 of 100 voxels at a tolerance of 0.02."""
    random = np.random.default_rng(seed)
    m = MRFMap(small_room.VOXEL_SIZE)
    there = []
    for i in order:
        there.append(small_room.add(m, small_room.frames()[i]))
        m.renew([there[-1]], tolerance=0.02)
        if random.random() < 0.3 and len(there) > 1:
            m.remove_keyframe(there.pop(random.integers(len(there))))
            m.renew(tolerance=0.02)
    moved = there[random.integers(len(there))]
    T = m.keyframes[moved].T_world_camera.copy()
    T[:3, 3] += random.normal(0, 0.05, 3)
    m.move_keyframe(moved, T)
    m.renew([moved], tolerance=0.02)
    centres, _ = m.voxels(0.0)
    renewed = m.occupancy(centres)
    m.infer(sweeps=10)
    assert (np.abs(m.occupancy(centres) - renewed) > 0.02).mean() < 0.05


def test_what_others_say_far_away_is_not_even_looked_at() -> None:
    m = MRFMap(small_room.VOXEL_SIZE)
    frames = small_room.frames()
    here = [small_room.add(m, frames[i]) for i in range(3)]
    m.renew(here, tolerance=0.0)
    before = {id: (m.keyframes[id].revision, m.keyframes[id].visible.version) for id in here}
    for i in range(3):
        frame = frames[i]
        id = m.add_keyframe(frame.depth_m, far_away(frame.T_world_camera), frame.camera)
        m.renew([id], tolerance=0.0)
    assert {id: (m.keyframes[id].revision, m.keyframes[id].visible.version) for id in here} == before


def test_what_there_was_no_time_for_is_done_by_the_next_call() -> None:
    m = MRFMap(small_room.VOXEL_SIZE)
    for i in ROOM:
        report = m.renew([small_room.add(m, small_room.frames()[i])], tolerance=0.05, seconds=0.0)
        assert report.sweeps == 1
    assert not report.complete
    assert report.residual == pytest.approx(max(shares(m).values()))
    assert m.renew(tolerance=0.05).complete
    assert max(shares(m).values()) <= 0.05


def test_those_around_a_removed_keyframe_hear_of_it() -> None:
    m = small_room.build(ROOM)
    m.infer(sweeps=10)
    assert max(shares(m).values()) < 0.01
    m.remove_keyframe(0)
    assert max(shares(m).values()) > 0.01
    m.renew(tolerance=0.01)
    scratch = small_room.build(list(ROOM)[1:])
    scratch.infer(sweeps=10)
    centres, p = scratch.voxels(0.0)
    assert (np.abs(m.occupancy(centres) - p) > 0.02).mean() < 0.03


def test_a_stopped_renewal_is_taken_up_again() -> None:
    m = MRFMap(small_room.VOXEL_SIZE)
    new = [small_room.add(m, small_room.frames()[i]) for i in ROOM]
    report = m.renew(new, tolerance=0.05, progress=lambda step: step.keyframe < 2)
    assert report.sweeps == 2
    assert m.renew(tolerance=0.05).complete
    assert all(k.messages is not None for k in m.keyframes.values())


def test_a_keyframe_that_is_named_twice_is_swept_once() -> None:
    m, twin = (MRFMap(small_room.VOXEL_SIZE) for _ in range(2))
    ids = [[small_room.add(each, small_room.frames()[i]) for i in ROOM[:3]] for each in (m, twin)]
    m.infer(keyframes=[ids[0][0], ids[0][1], ids[0][0]], sweeps=1)
    twin.infer(keyframes=ids[1][:2], sweeps=1)
    np.testing.assert_array_equal(m._pool.change_count, twin._pool.change_count)


def test_what_moved_counts_even_if_progress_raises() -> None:
    m = MRFMap(small_room.VOXEL_SIZE)
    ids = [small_room.add(m, small_room.frames()[i]) for i in ROOM[:3]]

    def progress(step: InferProgress) -> bool:
        if step.keyframe == 2:
            raise RuntimeError("enough")
        return True

    with pytest.raises(RuntimeError, match="enough"):
        m.infer(keyframes=ids, sweeps=1, progress=progress)
    assert m._pool.change_count.sum() > 0
    assert [m.keyframes[id].change_count_at_last_sweep is not None for id in ids] == [True, True, False]


def test_a_call_that_tolerates_much_does_not_make_others_forgotten() -> None:
    m, twin = (MRFMap(small_room.VOXEL_SIZE, renew_tolerance=0.2) for _ in range(2))
    for i in ROOM:
        m.renew([small_room.add(m, small_room.frames()[i])], tolerance=1e9)
        twin.infer(sweeps=1, keyframes=[small_room.add(twin, small_room.frames()[i])])
    assert m.renew().sweeps == twin.renew().sweeps > 0


def listed(cells: list[int], identity: list[int]) -> VisibleBricks:
    return VisibleBricks(np.array(cells), np.arange(len(cells), dtype=np.int32), np.array(identity), 0)


def test_a_brick_that_is_new_to_a_list_counts_as_changed_in_all_voxels() -> None:
    """So does one in the place of another, and one that lies beyond all of the older list."""
    old, newer = listed([2, 5, 9], [20, 50, 90]), listed([1, 2, 5, 9, 11], [10, 20, 51, 90, 110])
    assert places_of(old, newer).tolist() == [-1, 0, -1, 2, -1]
    assert places_of(listed([], []), newer).tolist() == [-1] * 5
    seen = change_count_of(newer, old, np.array([7, 8, 9]))
    assert seen.tolist() == [-VOXELS, 7, -VOXELS, 9, -VOXELS]
    assert change_count_of(old, listed([], []), np.array([], np.int64)).tolist() == [-VOXELS] * 3


def test_without_a_tolerance_all_sweeps_are_made_even_if_nothing_moves_any_more() -> None:
    m = MRFMap(small_room.VOXEL_SIZE)
    small_room.add(m, small_room.frames()[0])
    report = m.infer(sweeps=4)
    assert (report.sweeps, report.residual) == (4, 0.0)
    assert m.infer(sweeps=4, tolerance=1e-6).sweeps == 2
