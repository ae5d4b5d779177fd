"""A trajectory that changes under a map: which keyframes move, in which order, and what map it becomes."""

import os
import signal

import cv2
import numpy as np
import pytest
import small_room
from hypothesis import example, given, settings
from hypothesis import strategies as st

from taichi_mrf.errors import CapacityError, ConfigError, KeyframeError
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.mrf.memory_budget import MemoryBudget

pytestmark = pytest.mark.usefixtures("backend")

COUNT = 5


def built() -> MRFMap:
    return small_room.build(range(COUNT))


def shifted(number: int, *tangent: float) -> np.ndarray:
    """The recorded pose of a frame, moved by a rotation vector and a translation."""
    step = np.eye(4)
    step[:3, :3], step[:3, 3] = cv2.Rodrigues(np.array(tangent[:3], np.float64))[0], tangent[3:]
    return step @ small_room.frames()[number].T_world_camera


def near_share(a: MRFMap, b: MRFMap) -> float:
    """Share of the voxels of ``b`` whose probability in ``a`` differs by no more than 0.02."""
    centres, p = b.marginals.voxels(0.0)
    return float((np.abs(a.marginals.occupancy(centres) - p) <= 0.02).mean())


small = st.floats(-0.05, 0.05)


@settings(max_examples=8)
@example(motions={1: (0.0,) * 6}, at_once=True)  # the same numbers, but some -0.0 become 0.0
@given(
    motions=st.dictionaries(st.integers(0, COUNT - 1), st.tuples(*[small] * 6), min_size=1),
    at_once=st.booleans(),
)
def test_inference_afterwards_makes_the_map_that_is_made_anew(
    motions: dict[int, tuple[float, ...]], at_once: bool
) -> None:
    m = built()
    poses = {number: shifted(number, *motion) for number, motion in motions.items()}
    if at_once:
        assert not m.update_poses(poses, least=0.0).left
    else:
        left = poses
        while left:
            left = dict(m.update_poses(left, least=0.0, seconds=0.0).left)
    m.infer()
    small_room.assert_same_voxels(m.marginals, small_room.build(range(COUNT), poses).marginals)


def test_a_map_is_nearly_the_one_made_anew_without_inference_over_all() -> None:
    m = built()
    poses = {number: shifted(number, 0.0, 0.0, 0.05, 0.3, 0.0, 0.0) for number in (1, 3)}
    before = near_share(m, small_room.build(range(COUNT), poses))
    update = m.update_poses(poses, tolerance=0.02)
    after = near_share(m, small_room.build(range(COUNT), poses))
    assert update.complete
    assert set(update.moved) == {1, 3}
    assert after > max(0.95, before + 0.03)


def test_the_furthest_viewpoint_comes_first_and_time_that_is_over_leaves_the_others() -> None:
    m = built()
    poses = {i: shifted(i, 0.0, 0.0, 0.0, 0.2, 0.0, 0.0) for i in range(1, COUNT)}
    first = m.update_poses(poses, seconds=0.0)
    eyes = {i: np.concatenate([T[:3, 3], T[:3, 3] + 2.0 * T[:3, 2]]) for i, T in poses.items()}
    stays = small_room.frames()[0].T_world_camera
    start = np.concatenate([stays[:3, 3], stays[:3, 3] + 2.0 * stays[:3, 2]])
    furthest = max(eyes, key=lambda i: np.linalg.norm(eyes[i] - start))
    assert first.moved == (furthest,)
    assert set(first.left) == set(poses) - {furthest}
    assert not first.complete
    # Those that wait have no evidence in the map meanwhile, whatever else is brought up to date.
    m.renew()
    assert [m.keyframes[i].messages is None for i in range(COUNT)] == [i in first.left for i in range(COUNT)]
    second = m.update_poses(first.left)
    assert set(second.moved) == set(first.left)
    for number, T in poses.items():
        np.testing.assert_array_equal(m.keyframes[number].T_world_camera, T)


def test_a_pose_that_is_taken_back_brings_the_evidence_back() -> None:
    m = built()
    poses = {i: shifted(i, 0.0, 0.0, 0.0, 0.2, 0.0, 0.0) for i in range(1, COUNT)}
    left = m.update_poses(poses, seconds=0.0).left
    m.update_poses({i: small_room.frames()[i].T_world_camera for i in left})
    assert all(keyframe.messages is not None for keyframe in m.keyframes.values())


def test_small_motions_keep_their_evidence_until_their_turn() -> None:
    m = built()
    poses = {i: shifted(i, 0, 0, 0, 0.02, 0, 0) for i in range(COUNT)}
    first = m.update_poses(poses, seconds=0.0)
    assert len(first.left) == COUNT - 1
    assert all(keyframe.messages is not None for keyframe in m.keyframes.values())


@pytest.mark.usefixtures("own_interrupts")
@pytest.mark.parametrize("error", [CapacityError, KeyboardInterrupt])
def test_a_call_that_ends_early_leaves_a_map_that_infers_exactly(
    error: type[BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    m = built()
    poses = {i: shifted(i, 0.0, 0.0, 0.02, 0.2, 0.0, 0.0) for i in range(COUNT)}
    check, calls = MemoryBudget.check, []

    def fails(*arguments: object) -> None:
        calls.append(arguments)
        if len(calls) != 3:
            check(*arguments)
        elif error is CapacityError:
            raise CapacityError("there is not enough memory")
        else:
            os.kill(os.getpid(), signal.SIGINT)  # takes effect after the keyframe

    with monkeypatch.context() as patch:
        patch.setattr(MemoryBudget, "check", fails)
        with pytest.raises(error):
            m.update_poses(poses)
    there = {i for i, T in poses.items() if (m.keyframes[i].T_world_camera == T).all()}
    assert len(there) == (2 if error is CapacityError else 3)
    m.infer()
    small_room.assert_same_voxels(
        m.marginals, small_room.build(range(COUNT), {i: poses[i] for i in there}).marginals
    )
    m.update_poses(poses, least=0.0)
    m.infer()
    small_room.assert_same_voxels(m.marginals, small_room.build(range(COUNT), poses).marginals)


def test_a_pose_that_hardly_changes_leaves_the_keyframe_where_it_is() -> None:
    m = built()
    revision = m.keyframes[0]
    update = m.update_poses({0: shifted(0, 0, 0, 0, 1e-4, 0, 0), 1: shifted(1, 0, 0, 0, 0.1, 0, 0)})
    assert (update.moved, update.kept) == ((1,), (0,))
    assert m.keyframes[0] is revision
    # A turn counts by what it does to the far end of the view.
    turned = m.update_poses({0: shifted(0, 0, 0, 0.01, 0, 0, 0)})
    assert turned.moved == (0,)


def test_a_wrong_pose_or_id_is_refused_before_anything_moves() -> None:
    m = built()
    before = {id: keyframe.T_world_camera.copy() for id, keyframe in m.keyframes.items()}
    good = shifted(0, 0, 0, 0, 0.2, 0, 0)
    with pytest.raises(KeyframeError, match="the new pose of keyframe 2: "):
        m.update_poses({0: good, 2: np.zeros((4, 4))})
    with pytest.raises(KeyframeError, match="17"):
        m.update_poses({0: good, 17: good})
    with pytest.raises(ConfigError, match="least"):
        m.update_poses({0: good}, least=-1.0)
    for id, T in before.items():
        np.testing.assert_array_equal(m.keyframes[id].T_world_camera, T)
