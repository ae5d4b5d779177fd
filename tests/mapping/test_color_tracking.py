"""Tracking by colour: along a wall that depth does not determine, and not at all where nothing has a
texture."""

from dataclasses import replace

import numpy as np
import pytest
from tracked_room import CONFIG, frames

from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.datasets.synthetic.rendered_sequence import pattern
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.mapping.tracking import Tracker, wants_color
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame

pytestmark = pytest.mark.usefixtures("one_backend")

CAMERA = PinholeCamera(160, 120, 131.25, 131.25, 79.5, 59.5)
STEP_M = 0.03


def along_the_wall(index: int) -> Frame:
    """A flat wall 1.5 m away, along which the camera moves by STEP_M with every frame."""
    T = look_at((0.0, STEP_M * index, 0.0), (1.0, STEP_M * index, 0.0))
    depth_m = np.full(CAMERA.shape, 1.5)
    points = T[:3, 3] + (CAMERA.rays() * depth_m[..., None]) @ T[:3, :3].T
    gray = np.clip(110 * pattern(points, depth_m / CAMERA.fx), 1, 255).astype(np.uint8)
    return Frame(
        depth_m.astype(np.float32), T, CAMERA, index / 10, f"wall-{index}", np.dstack([gray, gray, gray])
    )


def blind(walk: list[Frame]) -> list[Frame]:
    """The frames without their colours."""
    return [replace(frame, color=None) for frame in walk]


def tracked(walk: list[Frame]) -> tuple[list[Pose], list[int]]:
    """Poses and determined directions of some frames, every third of which becomes a keyframe."""
    m = MRFMap.from_config(CONFIG, walk[0].camera)
    tracker = Tracker(m, PoseConfig())
    poses, directions = [], []
    for i, frame in enumerate(walk):
        found, told = tracker.follow(frame)
        poses.append(found.T_world_camera)
        directions.append(told.directions)
        if i % 3 == 0:
            tracker.took(m.add_keyframe(found.depth_m, found.T_world_camera, found.camera))
    return poses, directions


def test_colour_shows_the_way_along_a_flat_wall() -> None:
    walk = [along_the_wall(i) for i in range(8)]
    path = np.array([frame.T_world_camera[:3, 3] for frame in walk])
    poses, directions = tracked(walk)
    assert np.abs(np.array(poses)[:, :3, 3] - path).max() < 0.005
    assert directions == [6] * 8
    lost, undetermined = tracked(blind(walk))
    assert np.abs(np.array(lost)[:, :3, 3] - path).max() > 0.1
    assert max(undetermined[1:]) == 3


def test_without_texture_poses_are_those_of_depth_bit_for_bit() -> None:
    plain = frames()[:5]
    gray = [replace(frame, color=np.full((*frame.camera.shape, 3), 128, np.uint8)) for frame in plain]
    for frame in gray:
        assert frame.color is not None
        frame.color[frame.depth_m == 0] = 0  # as where a colour camera is registered
    np.testing.assert_array_equal(tracked(plain)[0], tracked(gray)[0])


def test_colours_are_read_where_they_are_tracked() -> None:
    assert wants_color(CONFIG, "recording", track=True)
    assert wants_color(CONFIG, "walk.bag?poses=track", track=False)
    assert wants_color(CONFIG, "realsense:walk.bag", track=False)
    assert not wants_color(CONFIG, "realsense:?poses=still", track=False)
    assert not wants_color(CONFIG, "recording", track=False)
    assert wants_color(replace(CONFIG, color=True), "recording", track=False)


def test_steps_that_change_along_a_wall_are_followed() -> None:
    """Neither standing still nor going on as before is near where the camera is."""
    walk = [along_the_wall(i) for i in (0, 5, 2, 9, 6, 12)]
    path = np.array([frame.T_world_camera[:3, 3] for frame in walk])
    poses, _ = tracked(walk)
    assert np.abs(np.array(poses)[:, :3, 3] - path).max() < 0.01


def test_where_flow_misleads_the_other_guesses_count() -> None:
    """The picture has moved sideways by half a metre, and the depth image of the room has not."""
    room = frames()[:2]
    pictures = [along_the_wall(i).color for i in (0, 17)]
    walk = [replace(frame, color=color) for frame, color in zip(room, pictures, strict=True)]
    poses, _ = tracked(walk)
    np.testing.assert_allclose(poses[1], tracked(blind(room))[0][1], atol=0.02)
