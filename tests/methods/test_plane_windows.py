"""Maps whose measurements are averaged on planes: what it gains, and what keyframes keep."""

from pathlib import Path

import numpy as np
import pytest
import small_room
from live_scene import marginals

from taichi_mrf.alignment.oriented_points import oriented_points
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.sensor.pose_doubt import covariance_of

pytestmark = pytest.mark.usefixtures("one_backend")

NOISE = PolynomialNoise((0.15,))
"""More than a voxel of small_room, so that all measurements are averaged."""


def add(m: MRFMap, number: int, T_world_camera: Pose | None = None, doubt: np.ndarray | None = None) -> int:
    frame = small_room.frames()[number]
    T = frame.T_world_camera if T_world_camera is None else T_world_camera
    return m.add_keyframe(frame.depth_m, T, frame.camera, frame.name, pose_covariance=doubt)


def built(*numbers: int, plane_window: float = 1.0) -> MRFMap:
    m = MRFMap(small_room.VOXEL_SIZE, NOISE, plane_window=plane_window)
    for number in numbers:
        add(m, number)
    m.infer()
    return m


def test_without_windows_nothing_is_touched() -> None:
    m = built(0, 1, plane_window=0.0)
    plain = MRFMap(small_room.VOXEL_SIZE, NOISE)
    for number in (0, 1):
        add(plain, number)
    plain.infer()
    assert marginals(m) == marginals(plain) != marginals(built(0, 1))
    assert m.keyframes[0].image.certain is None


def test_any_history_of_edits_ends_in_the_same_map() -> None:
    edited = MRFMap(small_room.VOXEL_SIZE, NOISE, plane_window=1.0)
    frames = small_room.frames()
    gone = add(edited, 2)
    moved = add(edited, 1, frames[0].T_world_camera)
    doubted = add(edited, 0, doubt=covariance_of(0.02, 0.01))
    edited.infer()
    edited.remove_keyframe(gone)
    edited.move_keyframe(moved, frames[1].T_world_camera)
    edited.move_keyframe(doubted, frames[0].T_world_camera, pose_covariance=np.zeros((6, 6)))
    edited.infer()
    assert marginals(edited) == marginals(built(0, 1))


def test_keyframes_keep_what_was_measured_and_are_aligned_by_it(tmp_path: Path) -> None:
    m, plain = built(0), built(0, plane_window=0.0)
    kept, measured = m.keyframes[0], plain.keyframes[0]
    np.testing.assert_array_equal(kept.depth_m, measured.depth_m)
    own, other = (oriented_points(each.image, 10.0) for each in (kept, measured))
    np.testing.assert_array_equal(own.points, other.points)
    m.save(tmp_path / "map.npz")
    loaded = MRFMap.load(tmp_path / "map.npz")
    assert marginals(loaded) == marginals(m)
    loaded.infer()
    m.infer()
    assert marginals(loaded) == marginals(m)


def test_a_noisy_wall_is_found_within_a_voxel_that_is_smaller_than_sigma() -> None:
    """A wall at 2.03 m, measured three times with a sigma of six voxels."""
    camera, rng = PinholeCamera(96, 72, 90.0, 90.0, 47.5, 35.5), np.random.default_rng(0)
    images = 2.03 + 0.15 * rng.normal(size=(3, *camera.shape))
    right = []
    for plane_window in (0.0, 3.0):
        m = MRFMap(0.025, NOISE, plane_window=plane_window, ray_density=0.0)
        for depth_m in images:
            m.add_keyframe(depth_m, np.eye(4), camera)
        m.infer()
        asked = np.full(camera.shape, -1.0, np.float32)
        survey = m.view.survey(camera, np.eye(4), 5.0, asked, NOISE.table(camera))
        right.append(np.mean(np.abs(survey.middle - 2.03) < 0.0375))
    assert right[0] < 0.5
    assert right[1] > 0.9
