"""A single keyframe moved to where it fits the map of the others, or left where it is."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from small_room import VOXEL_SIZE, add, build, frames, probes

from taichi_mrf.alignment.refine import log_likelihood, map_of_others
from taichi_mrf.alignment.se3 import adjoint, moved, twist
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.errors import KeyframeError
from taichi_mrf.geometry.poses import Pose, inverse, tangent_norms
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import PinholeCamera

pytestmark = pytest.mark.usefixtures("backend")

SMALL = st.floats(-0.5, 0.5)
OFF = np.array([0.02, -0.025, 0.015, 0.01, -0.015, 0.012])
"""3.5 cm and 1.2 degrees."""


@given(st.lists(SMALL, min_size=6, max_size=6), st.lists(SMALL, min_size=6, max_size=6))
def test_twists_are_what_they_should_be(first: list[float], second: list[float]) -> None:
    xi, T = np.array(first), moved(np.eye(4), second)
    np.testing.assert_allclose(twist(moved(np.eye(4), xi)), xi, atol=1e-9)
    np.testing.assert_allclose(moved(moved(T, xi), -xi), T, atol=1e-9)
    # A step in one frame is another step in another.
    np.testing.assert_allclose(
        moved(np.eye(4), adjoint(T) @ xi), T @ moved(np.eye(4), xi) @ inverse(T), atol=1e-9
    )


@pytest.fixture(scope="module")
def whole(backend: str) -> MRFMap:
    """The room of all frames. Tests leave it as they find it."""
    return build(list(range(10)))


def far_from(T: Pose, other: Pose) -> float:
    """Metres, a radian counting as two."""
    rotation, translation = tangent_norms(T, other)
    return translation + 2 * rotation


@pytest.mark.parametrize("id", [2, 7])
def test_a_keyframe_that_stands_right_stays_put(whole: MRFMap, id: int) -> None:
    true = frames()[id].T_world_camera
    refined = whole.refine_pose(id)
    # Frames of so few pixels tell a pose to some millimetres.
    assert far_from(true, whole.keyframes[id].T_world_camera) < 0.012
    assert refined.translation_m < 0.008
    whole.move_keyframe(id, true)
    whole.infer(keyframes=[id], sweeps=1)


@pytest.mark.parametrize("id", [1, 4, 8])
def test_a_disturbed_keyframe_comes_back(whole: MRFMap, id: int) -> None:
    true = frames()[id].T_world_camera
    wrong = moved(true, OFF)
    whole.move_keyframe(id, wrong)
    refined = whole.refine_pose(id)
    assert refined.accepted, refined.reason
    assert refined.reason == ""
    np.testing.assert_array_equal(refined.T_before, wrong)
    np.testing.assert_array_equal(refined.T_world_camera, whole.keyframes[id].T_world_camera)
    before, after = (np.array(tangent_norms(true, T)) for T in (wrong, refined.T_world_camera))
    assert (after < 0.5 * before).all()
    rotation, translation = tangent_norms(wrong, refined.T_world_camera)
    assert (refined.rotation_rad, refined.translation_m) == (rotation, translation)
    assert refined.residual_after_m < refined.residual_before_m
    assert refined.log_likelihood_after > refined.log_likelihood_before
    assert refined.pixels > 500
    assert refined.overlap > 0.7
    assert refined.directions == 6
    whole.move_keyframe(id, true)
    whole.infer(keyframes=[id], sweeps=1)


def test_a_keyframe_is_judged_without_what_it_has_said_itself() -> None:
    """A map of one place seen twice: if its own messages counted, where it stands would be likeliest."""
    true = frames()[3].T_world_camera
    m = build([2, 3, 4])
    m.move_keyframe(1, moved(true, OFF))
    m.infer()
    refined = m.refine_pose(1)
    assert refined.accepted, refined.reason
    assert far_from(true, refined.T_world_camera) < 0.5 * far_from(true, refined.T_before)


def test_refining_leaves_the_map_of_the_refined_poses() -> None:
    m = build([0, 1])
    id = m.add_keyframe(frames()[2].depth_m, moved(frames()[2].T_world_camera, OFF), frames()[2].camera)
    assert m.refine_pose(id).accepted
    m.infer()
    again = MRFMap(VOXEL_SIZE)
    for i in (0, 1, 2):
        again.add_keyframe(frames()[i].depth_m, m.keyframes[i].T_world_camera, frames()[i].camera)
    again.infer()
    np.testing.assert_array_equal(m.occupancy(probes()), again.occupancy(probes()))


def test_a_keyframe_that_is_not_moved_changes_nothing(whole: MRFMap) -> None:
    before = whole.occupancy(probes())
    pose = whole.keyframes[5].T_world_camera
    refined = whole.refine_pose(5, PoseConfig(min_overlap=1.0))
    assert not refined.accepted
    assert "of its points lie near what others have measured, but 100% are needed" in refined.reason
    np.testing.assert_array_equal(whole.keyframes[5].T_world_camera, pose)
    np.testing.assert_array_equal(whole.occupancy(probes()), before)


def test_what_overlaps_with_nothing_is_refused() -> None:
    m = build([0])
    far = frames()[1].T_world_camera.copy()
    far[:3, 3] += 50.0
    alone = m.add_keyframe(frames()[1].depth_m, far, frames()[1].camera)
    refined = m.refine_pose(alone)
    assert not refined.accepted
    assert refined.reason.startswith("0% of its points")
    assert refined.pixels == 0
    np.testing.assert_array_equal(m.keyframes[alone].T_world_camera, far)


def test_what_is_too_far_away_is_refused(whole: MRFMap) -> None:
    true = frames()[6].T_world_camera
    whole.move_keyframe(6, moved(true, OFF))
    refined = whole.refine_pose(6, PoseConfig(max_translation=0.01))
    assert not refined.accepted
    assert "which is further than allowed" in refined.reason
    assert refined.translation_m == 0
    whole.move_keyframe(6, true)
    whole.infer(keyframes=[6], sweeps=1)


def test_a_guess_is_taken_where_it_fits_better(whole: MRFMap) -> None:
    true = frames()[9].T_world_camera
    whole.move_keyframe(9, moved(true, 12 * OFF))
    assert far_from(true, whole.refine_pose(9).T_world_camera) > 0.1
    refined = whole.refine_pose(9, guesses=[moved(true, 0.5 * OFF)])
    assert refined.accepted, refined.reason
    assert far_from(true, refined.T_world_camera) < 0.02
    whole.move_keyframe(9, true)
    whole.infer(keyframes=[9], sweeps=1)


def test_a_keyframe_without_points_and_one_that_is_not_there() -> None:
    m = build([0])
    empty = np.zeros(frames()[0].camera.shape, np.float32)
    empty[0, 0] = 1.0
    id = m.add_keyframe(empty, frames()[0].T_world_camera, frames()[0].camera)
    assert m.refine_pose(id).reason == "holds too few points on smooth surfaces"
    with pytest.raises(KeyframeError, match="there is no keyframe 7"):
        m.refine_pose(7)


def test_frozen_and_removed_keyframes() -> None:
    """Frozen keyframes go on to hold others, removed ones do not."""
    true = frames()[1].T_world_camera
    m = build([0, 1, 2])
    m.move_keyframe(1, moved(true, OFF))
    m.refine_pose(1)
    m.infer()
    m.freeze_keyframe(0)
    m.freeze_keyframe(2)
    m.move_keyframe(1, moved(true, OFF))
    assert m.refine_pose(1).accepted
    other = build([0, 1])
    other.refine_pose(1)
    other.remove_keyframe(0)
    assert other.refine_pose(1).overlap == 0


WALL = PinholeCamera(width=80, height=60, fx=90.0, fy=90.0, cx=39.5, cy=29.5)


def wall_view(x: float, y: float, z: float) -> Pose:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def wall_depth(distance: float, seed: int) -> NDArray[np.float32]:
    noise = np.random.default_rng(seed).normal(0, 0.002, WALL.shape)
    return (distance + noise).astype(np.float32)


def test_a_flat_wall_says_nothing_of_sliding_along_it() -> None:
    m = MRFMap(0.05)
    for seed, x in enumerate((-0.2, 0.0, 0.2)):
        m.add_keyframe(wall_depth(1.52, seed), wall_view(x, 0.0, 0.0), WALL)
    off = moved(wall_view(0.05, 0.1, 0.0), (0.03, -0.02, -0.03, 0.01, 0.015, 0.03))
    id = m.add_keyframe(wall_depth(1.52, 9), off, WALL)
    m.infer()
    refined = m.refine_pose(id)
    assert refined.accepted, refined.reason
    assert refined.directions == 3
    T = refined.T_world_camera
    # Along the wall's normal and about its two axes it comes back; in the wall it stays where it was.
    assert abs(T[2, 3]) < 0.006
    np.testing.assert_allclose(T[:3, 2], (0, 0, 1), atol=4e-3)
    np.testing.assert_allclose(T[:2, 3], off[:2, 3], atol=2e-3)
    in_plane = np.arctan2(T[1, 0], T[0, 0])
    assert abs(in_plane - np.arctan2(off[1, 0], off[0, 0])) < 3e-3


def test_a_loaded_map_can_be_refined(tmp_path: object) -> None:
    path = f"{tmp_path}/map.npz"
    m = build([0, 1])
    add(m, frames()[2])
    m.move_keyframe(2, moved(frames()[2].T_world_camera, OFF))
    m.infer()
    m.save(path)
    loaded = MRFMap.load(path)
    found = [each.refine_pose(2).T_world_camera for each in (m, loaded)]
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)


def test_the_map_of_others_is_what_they_believe() -> None:
    """Of a map of one keyframe nothing is left but the prior; afterwards it is as it was."""
    m = build([0])
    centres, before = m.marginals.voxels(min_probability=0.0)
    assert (np.abs(before - m.prior) > 0.05).mean() > 0.05
    with map_of_others(m.view, m.keyframes[0]):
        np.testing.assert_allclose(m.marginals.occupancy(centres), m.prior, atol=1e-5)
        alone = log_likelihood(m.view, m.keyframes[0], frames()[0].T_world_camera, 10.0)
    np.testing.assert_array_equal(m.marginals.occupancy(centres), before)
    assert log_likelihood(m.view, m.keyframes[0], frames()[0].T_world_camera, 10.0) > alone + 1
