"""Keyframes whose poses have a covariance: what it does to a map, and how it is kept, changed and dropped."""

from pathlib import Path

import numpy as np
import pytest
import small_room
from hypothesis import given, settings
from hypothesis import strategies as st
from live_scene import marginals

from taichi_mrf.alignment.oriented_points import oriented_points
from taichi_mrf.errors import KeyframeError
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.visibility.map import VisibilityMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.sensor.pose_doubt import beside_edges, covariance_of, depth_sigma

pytestmark = pytest.mark.usefixtures("one_backend")

DOUBT = covariance_of(0.03, 0.01)
EXACT = np.zeros((6, 6))
SLANTED = DOUBT + 5e-4 * np.outer(np.arange(6.0), np.arange(6.0)) / 25


def add(m: MRFMap | VisibilityMap | LogOddsMap, number: int, pose_covariance: np.ndarray | None) -> int:
    frame = small_room.frames()[number]
    parts = (frame.depth_m, frame.T_world_camera, frame.camera, frame.name)
    return m.add_keyframe(*parts, pose_covariance=pose_covariance)


def built(*covariances: np.ndarray | None) -> MRFMap:
    m = MRFMap(small_room.VOXEL_SIZE)
    for number, covariance in enumerate(covariances):
        add(m, number, covariance)
    m.infer()
    return m


def test_no_covariance_and_one_of_zeros_make_the_same_map_bit_for_bit() -> None:
    zeros = built(EXACT, EXACT)
    assert marginals(zeros) == marginals(small_room.build([0, 1])) != marginals(built(DOUBT, None))
    assert zeros.keyframes[0].own.pose_covariance is None
    assert zeros.keyframes[0].image.certain is None


def test_a_doubtful_keyframe_is_one_of_wider_sigmas_without_the_pixels_beside_edges() -> None:
    number = 8  # a view of many edges
    frame = small_room.frames()[number]
    doubtful, stated = (MRFMap(small_room.VOXEL_SIZE) for _ in range(2))
    add(doubtful, number, DOUBT)
    doubtful.infer()
    sigma, _ = stated.noise.table(frame.camera).at_pixels(frame.depth_m)
    widened = np.hypot(sigma, depth_sigma(frame.depth_m, frame.camera, DOUBT))
    beside = beside_edges(frame.depth_m, frame.camera, DOUBT)
    assert 0.01 < beside.mean() < 0.2
    parts = (frame.depth_m, frame.T_world_camera, frame.camera, frame.name)
    stated.add_keyframe(*parts, sigma_m=np.where(beside, np.inf, widened))
    stated.infer()
    centres, p = stated.voxels(0.0)
    assert len(centres) == len(doubtful.voxels(0.0)[0])
    np.testing.assert_allclose(doubtful.occupancy(centres), p, atol=1e-3)
    # It still holds all that it has measured, and is aligned by it.
    keyframe = doubtful.keyframes[0]
    left_out = np.where(beside, frame.depth_m, 0.0)
    np.testing.assert_array_equal(keyframe.depth_m, stated.keyframes[0].depth_m + left_out)
    own, plain = (oriented_points(m.keyframes[0].image, 10.0) for m in (doubtful, small_room.build([number])))
    for name in ("points", "normals", "sigmas"):
        np.testing.assert_array_equal(getattr(own, name), getattr(plain, name))


def test_it_does_not_carve_a_wall() -> None:
    """A wall at 2 m; one keyframe, whose pose is off by 15 cm along its rays, measures it at 2.15 m."""
    camera, T = PinholeCamera(32, 24, 30.0, 30.0, 15.5, 11.5), np.eye(4)
    on_the_wall = np.array([[0.02, 0.02, 2.02]])
    p = []
    for covariance in (None, covariance_of(0.15, 0.0)):
        m = MRFMap(0.1, PolynomialNoise((0.01,)))
        m.add_keyframe(np.full(camera.shape, 2.02), T, camera)
        m.add_keyframe(np.full(camera.shape, 2.17), T, camera, pose_covariance=covariance)
        m.infer()
        p.append(float(m.occupancy(on_the_wall)[0]))
    assert p[0] < 0.3 < 0.7 < p[1]


def test_the_map_moves_with_the_world() -> None:
    """A covariance is of the camera's own frame: if everything is moved by whole bricks and turned by a right
    angle, so is the map."""
    turn = np.eye(4)
    turn[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    turn[:3, 3] = 8 * small_room.VOXEL_SIZE * np.array([3.0, -2.0, 1.0])
    here, there = built(SLANTED, DOUBT), MRFMap(small_room.VOXEL_SIZE)
    for number, covariance in enumerate((SLANTED, DOUBT)):
        frame = small_room.frames()[number]
        parts = (frame.depth_m, turn @ frame.T_world_camera, frame.camera, frame.name)
        there.add_keyframe(*parts, pose_covariance=covariance)
    there.infer()
    centres, p = here.voxels(0.0)
    found = there.occupancy(centres @ turn[:3, :3].T + turn[:3, 3])
    assert np.mean(np.abs(found - p) < 1e-2) > 0.99


edits = st.lists(
    st.tuples(st.sampled_from(["add", "remove", "doubt", "trust", "infer"]), st.integers(0, 2)), max_size=7
)


@settings(max_examples=3)
@given(history=edits)
def test_edits_in_any_order_end_in_the_same_map_bit_for_bit(history: list[tuple[str, int]]) -> None:
    final = [SLANTED, None, DOUBT]
    m, present = MRFMap(small_room.VOXEL_SIZE), {}
    for verb, number in history:
        T = small_room.frames()[number].T_world_camera
        if verb == "add" and number not in present:
            present[number] = add(m, number, DOUBT)
        elif verb == "remove" and number in present:
            m.remove_keyframe(present.pop(number))
        elif verb in ("doubt", "trust") and number in present:
            m.move_keyframe(present[number], T, SLANTED if verb == "doubt" else EXACT)
        elif verb == "infer":
            m.infer(sweeps=1)
    for number in reversed(range(3)):
        if number in present:
            T, covariance = small_room.frames()[number].T_world_camera, final[number]
            m.move_keyframe(present[number], T, EXACT if covariance is None else covariance)
        else:
            add(m, number, final[number])
    m.infer()
    assert marginals(m) == marginals(built(*final))


def test_moving_keeps_the_covariance_or_changes_it() -> None:
    m, T = built(DOUBT, None), [frame.T_world_camera for frame in small_room.frames()[:2]]
    m.move_keyframe(0, T[1])
    np.testing.assert_array_equal(m.keyframes[0].own.pose_covariance, DOUBT)
    m.update_poses({0: T[0]})
    np.testing.assert_array_equal(m.keyframes[0].own.pose_covariance, DOUBT)
    update = m.update_poses({0: T[0], 1: T[1]}, covariances={0: DOUBT, 1: EXACT, 7: EXACT})
    assert (update.moved, update.kept) == ((), (0, 1))
    update = m.update_poses({0: T[0], 1: T[1]}, covariances={0: EXACT, 1: SLANTED})
    assert update.moved == (0, 1)
    m.infer()
    assert marginals(m) == marginals(built(None, SLANTED))
    with pytest.raises(KeyframeError, match="the new pose of keyframe 1: pose_covariance has the shape"):
        m.update_poses({0: T[1], 1: T[0]}, covariances={1: np.eye(3)})
    with pytest.raises(KeyframeError, match="not symmetric"):
        m.move_keyframe(0, T[1], np.arange(36.0).reshape(6, 6))
    np.testing.assert_array_equal(m.keyframes[0].T_world_camera, T[0])


def test_saved_maps_keep_it(tmp_path: Path) -> None:
    m = built(DOUBT, None, SLANTED)
    m.save(tmp_path / "map.npz")
    loaded = MRFMap.load(tmp_path / "map.npz")
    for id, keyframe in loaded.keyframes.items():
        assert keyframe.own.content() == m.keyframes[id].own.content()
        np.testing.assert_array_equal(keyframe.depth_m, m.keyframes[id].depth_m)
    loaded.infer()
    assert marginals(loaded) == marginals(m)
    loaded.move_keyframe(0, loaded.keyframes[0].T_world_camera, EXACT)
    loaded.move_keyframe(2, loaded.keyframes[2].T_world_camera, EXACT)
    loaded.infer()
    assert marginals(loaded) == marginals(small_room.build([0, 1, 2]))


def test_recursive_maps_take_keep_and_change_it(tmp_path: Path) -> None:
    for kind in (VisibilityMap, LogOddsMap):
        m, plain = kind(small_room.VOXEL_SIZE), kind(small_room.VOXEL_SIZE)
        add(m, 0, DOUBT)
        add(plain, 0, None)
        assert marginals(m) != marginals(plain)
        m.save(tmp_path / "map.npz")
        loaded = kind.load(tmp_path / "map.npz")
        loaded.move_keyframe(0, small_room.frames()[0].T_world_camera)
        loaded.infer()
        assert marginals(loaded) == marginals(m)
        loaded.move_keyframe(0, small_room.frames()[0].T_world_camera, EXACT)
        loaded.infer()
        assert marginals(loaded) == marginals(plain)
