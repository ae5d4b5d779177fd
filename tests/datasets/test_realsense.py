"""RealSense cameras and recordings, played by a stand-in for their library; and what is said of it."""

import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import tracked_room
from datasets_recordings import write_stamped
from realsense_library import (
    COUNT,
    FIRST,
    PLACE_M,
    RATE,
    STEPS,
    UP,
    Config,
    MotionSensor,
    Pipeline,
    colors,
    installed,
    stamp,
)
from refusals import refused

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.base import start_pose
from taichi_mrf.datasets.realsense.device import MISSES
from taichi_mrf.errors import DatasetError, FrameError
from taichi_mrf.geometry.poses import inverse, look_at
from taichi_mrf.mapping.pipeline import map_sequence
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.motion import GRAVITY

CAMERA = "realsense:width=4&height=3"


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> type[Pipeline]:
    """A pyrealsense2 whose pipelines are this test's."""
    return installed(monkeypatch)


def test_images_come_in_metres_with_the_cameras_own_intrinsics(library: type[Pipeline]) -> None:
    source = open_dataset(CAMERA)
    assert source.endless
    assert library.asked["depth"][:2] == (4, 3)
    assert (source.camera.fx, source.camera.fy, source.camera.cx, source.camera.cy) == (4.0, 5.0, 1.5, 1.0)
    frame = source.read(7)
    np.testing.assert_allclose(frame.depth_m, STEPS * 0.0005, rtol=1e-6)
    assert frame.depth_m.dtype == np.float32
    assert (frame.name, frame.stamp) == ("realsense-000007", FIRST)
    np.testing.assert_allclose(frame.T_world_camera[:3, 2], [1, 0, 0], atol=1e-12)
    assert any("?poses=still" in note for note in source.notes)
    del source
    assert library.stopped == library.starts


def test_colours_come_aligned_to_depth_where_the_camera_has_them(library: type[Pipeline]) -> None:
    alone = open_dataset(CAMERA)
    assert alone.read(0).color is None
    assert any("depth alone: Couldn't resolve requests" in note for note in alone.notes)
    library.colored = True
    frame = open_dataset(CAMERA).read(0)
    np.testing.assert_array_equal(frame.color, colors(0))
    np.testing.assert_allclose(frame.depth_m, STEPS * 0.0005, rtol=1e-6)
    assert open_dataset(CAMERA, color=False).read(0).color is None


def test_a_missed_image_is_a_broken_frame_and_many_are_the_end(library: type[Pipeline]) -> None:
    library.images = (None, STEPS, *[None] * MISSES)
    source = open_dataset(CAMERA)
    with pytest.raises(FrameError, match="no image"):
        source.read(0)
    source.read(1)
    for index in range(MISSES - 1):
        with pytest.raises(FrameError):
            source.read(index)
    with pytest.raises(DatasetError, match="the camera is lost") as caught:
        source.read(9)
    assert not isinstance(caught.value, FrameError)


def test_an_image_of_another_size_is_a_broken_frame(library: type[Pipeline]) -> None:
    library.images = (STEPS[:2],)
    with pytest.raises(FrameError, match="shape"):
        open_dataset(CAMERA).read(0)


def test_a_camera_that_cannot_be_opened_says_why(library: type[Pipeline], tmp_path: Path) -> None:
    refused("realsense:heigth=3", "heigth")
    refused(f"realsense:?poses={tmp_path}/nowhere.txt", "nowhere.txt")
    library.problem = "No device connected"
    refused("realsense:", "realsense: cannot be started: No device connected")


def test_the_gyroscope_turns_with_the_camera_and_the_first_image_is_level(library: type[Pipeline]) -> None:
    library.motion = MotionSensor(FIRST - 1.0, stamp(COUNT))
    source = open_dataset(CAMERA)
    assert library.motion.opened == [("gyro", 200), ("accel", 250)]
    first, second = source.read(0), source.read(1)
    R = second.gyro.turn(FIRST - 0.3, FIRST)
    np.testing.assert_allclose(R, cv2.Rodrigues(RATE * 0.3)[0], atol=1e-9)
    np.testing.assert_allclose(first.T_world_camera[:3, :3] @ UP, [0, 0, 1], atol=1e-9)
    np.testing.assert_array_equal(second.T_world_camera, first.T_world_camera)
    np.testing.assert_allclose(second.acceleration.accelerations_m_s2[7], GRAVITY * UP, atol=1e-9)
    np.testing.assert_array_equal(second.acceleration.position_m, PLACE_M)
    assert any("imu: it measures turns" in note for note in source.notes)
    del source
    assert library.motion.stopped
    assert library.motion.closed


def test_a_camera_whose_imu_cannot_help_is_tracked_without(library: type[Pipeline]) -> None:
    without = open_dataset(CAMERA)
    assert without.read(0).gyro is None
    assert not any("imu" in note for note in without.notes)
    library.motion = MotionSensor(FIRST - 1.0, stamp(COUNT), shake=2.0)
    shaken = open_dataset(CAMERA).read(0)
    assert shaken.gyro is not None
    np.testing.assert_array_equal(shaken.T_world_camera, start_pose())
    library.motion = MotionSensor(FIRST - 1.0, stamp(COUNT), clock="another")
    assert open_dataset(CAMERA).read(0).gyro is None
    library.motion = MotionSensor(FIRST - 1.0, stamp(COUNT))
    library.motion.problem = "Device is busy"
    busy = open_dataset(CAMERA)
    assert busy.read(0).gyro is None
    assert "imu: it is not used: Device is busy" in busy.notes


def test_an_imu_may_be_left_alone(library: type[Pipeline]) -> None:
    library.motion = MotionSensor(FIRST - 1.0, stamp(COUNT))
    for query in ("imu=none", "poses=still"):
        assert open_dataset(f"{CAMERA}&{query}").read(0).gyro is None
    assert library.motion.opened == []
    refused("realsense:imu=yes", "imu may be none, not 'yes'")


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "walk.bag"
    path.write_bytes(b"#ROSBAG V2.0\n")
    return path


@pytest.fixture
def poses(tmp_path: Path) -> Path:
    """From 0.05 s before the second image to 0.05 s after the fifth, every 0.1 s."""
    times = [0.05 + 0.1 * i for i in range(5)]
    poses = [look_at([t, 0, 0], [9, 0, 0]) for t in times]
    return write_stamped(tmp_path / "track.txt", [FIRST + t for t in times], poses)


def test_a_recording_with_colour_gives_it_aligned_to_depth(library: type[Pipeline], recording: Path) -> None:
    assert open_dataset(f"realsense:{recording}").read(0).color is None
    library.colored = True
    source = open_dataset(f"realsense:{recording}")
    for i in (1, 4, 2):
        frame = source.read(i)
        np.testing.assert_array_equal(frame.color, colors(i))
        np.testing.assert_allclose(frame.depth_m, (STEPS + 10 * i) * 0.0005, rtol=1e-6)


def test_a_recording_is_a_sequence_that_ends(library: type[Pipeline], recording: Path) -> None:
    source = open_dataset(f"realsense:{recording}")
    assert (len(source), source.endless, source.name) == (COUNT, False, "walk")
    assert source.camera == PinholeCamera(4, 3, 4.0, 5.0, 1.5, 1.0)
    assert list(source.frame_names) == [f"realsense-{100 + i:06d}" for i in range(COUNT)]
    for i in (0, 1, 3, 5, 2, 2, 4):
        frame = source.read(i)
        np.testing.assert_allclose(frame.depth_m, (STEPS + 10 * i) * 0.0005, rtol=1e-6)
        assert frame.stamp == pytest.approx(stamp(i))
    assert any("tracked" in note and "?poses=FILE" in note for note in source.notes)
    del source
    assert library.stopped == library.starts


def test_a_recording_gets_the_poses_of_a_file(library: type[Pipeline], recording: Path, poses: Path) -> None:
    source = open_dataset(f"realsense:{recording}?poses={poses}")
    assert (len(source), source.dropped) == (4, 2)
    for index, i in enumerate(range(1, 5)):
        frame = source.read(index)
        assert frame.name == f"realsense-{100 + i:06d}"
        np.testing.assert_allclose(frame.T_world_camera[:3, 3], [0.1 * i, 0, 0], atol=1e-6)
    assert not any("stand still" in note for note in source.notes)
    words = ("walk.bag: none of 6 depth images", "within 0.01 s")
    refused(f"realsense:{recording}?poses={poses}", *words, max_time_gap=0.01)


def test_an_image_that_does_not_come_again_is_a_broken_frame(
    library: type[Pipeline], recording: Path
) -> None:
    source = open_dataset(f"realsense:{recording}")
    source.read(5)
    library.lost = (2,)
    with pytest.raises(FrameError, match=r"frame realsense-000102: .* the image is missing"):
        source.read(2)
    np.testing.assert_allclose(source.read(3).depth_m, (STEPS + 30) * 0.0005, rtol=1e-6)


def test_what_is_no_recording_is_named(library: type[Pipeline], recording: Path, tmp_path: Path) -> None:
    refused(f"realsense:{tmp_path}/nowhere.bag", "nowhere.bag: no such file")
    path = tmp_path / "other.bag"
    path.write_bytes(b"no bag")
    refused(f"realsense:{path}", "other.bag: cannot be played: Failed to resolve")
    refused(f"realsense:{path}?pose=x", "unknown parameter 'pose'")
    refused(f"realsense:{path}", "depth_scale", depth_scale=1000.0)
    library.lost = tuple(range(COUNT))
    refused(f"realsense:{recording}", "walk.bag: contains no depth images")


@pytest.mark.parametrize(
    "form", ["realsense:?poses={}", "realsense:poses={}", "realsense:width=4&height=3&poses={}"]
)
def test_a_camera_gets_the_poses_of_a_file(library: type[Pipeline], poses: Path, form: str) -> None:
    source = open_dataset(form.format(poses))
    assert source.endless
    assert not any("stand still" in note for note in source.notes)
    with pytest.raises(FrameError, match=r"no poses within 0\.1 s"):
        source.read(0)
    frame = source.read(1)
    np.testing.assert_allclose(frame.T_world_camera[:3, 3], [0.1, 0, 0], atol=1e-6)


def test_a_camera_can_be_thinned_out(library: type[Pipeline]) -> None:
    source = open_dataset("realsense:", image_scale=0.5)
    assert source.endless
    assert source.camera.shape == (2, 2)
    np.testing.assert_allclose(source.read(0).depth_m, STEPS[::2, ::2] * 0.0005, rtol=1e-6)


def test_without_a_file_poses_are_tracked_or_stand_still(library: type[Pipeline], recording: Path) -> None:
    for name in ("realsense:", "realsense:?poses=track", f"realsense:{recording}"):
        source = open_dataset(name)
        assert source.tracked
        assert source.read(0).T_world_camera.shape == (4, 4)
    for name in ("realsense:?poses=still", f"realsense:{recording}?poses=still"):
        source = open_dataset(name)
        assert not source.tracked
        np.testing.assert_array_equal(source.read(0).T_world_camera, source.read(1).T_world_camera)
    assert len(open_dataset(f"realsense:{recording}?poses=still", track=True)) == COUNT


def test_the_gyroscope_of_a_recording_is_read_whole(library: type[Pipeline], recording: Path) -> None:
    library.motion = MotionSensor(FIRST - 1.0, stamp(COUNT) + 20.0)
    source = open_dataset(f"realsense:{recording}")
    assert not library.motion.real_time
    assert library.motion.closed
    for i in (0, 4, 2):
        gyro, up = source.read(i).gyro, source.read(i).T_world_camera[:3, :3] @ UP
        R = gyro.turn(stamp(i), stamp(i + 1))
        np.testing.assert_allclose(R, cv2.Rodrigues(RATE * 0.1)[0], atol=1e-9)
        np.testing.assert_allclose(up, [0, 0, 1], atol=1e-9)
        assert source.read(i).acceleration is not None
    for query in ("imu=none", "poses=still"):
        assert open_dataset(f"realsense:{recording}?{query}").read(0).gyro is None
    library.motion = None
    plain = open_dataset(f"realsense:{recording}")
    assert plain.read(0).gyro is None
    assert not any("imu" in note for note in plain.notes)


@pytest.mark.usefixtures("one_backend")
def test_a_recording_without_poses_is_mapped(
    library: type[Pipeline], recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A walk through the built-in room."""
    frames = tracked_room.frames()
    library.images = tuple(np.rint(f.depth_m / 0.0005).astype(np.uint16) for f in frames)

    class CarriedConfig(Config):
        def profile(self, sensors: list[object]) -> SimpleNamespace:
            profile, camera = super().profile(sensors), frames[0].camera
            intrinsics = profile.get_stream("depth").as_video_stream_profile().get_intrinsics()
            intrinsics.__dict__.update(width=camera.width, height=camera.height, fx=camera.fx, fy=camera.fy)
            intrinsics.__dict__.update(ppx=camera.cx, ppy=camera.cy)
            return profile

    monkeypatch.setattr(sys.modules["pyrealsense2"], "config", CarriedConfig)
    result = map_sequence(open_dataset(f"realsense:{recording}"), tracked_room.CONFIG)
    assert result.track is not None
    found = result.track.poses(result.map)
    assert list(found) == list(range(tracked_room.COUNT))
    start = inverse(found[0])
    assert tracked_room.errors({i: start @ T for i, T in found.items()})[:, 1].max() < 0.08
