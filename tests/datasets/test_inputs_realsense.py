"""RealSense cameras and recordings with poses from a file, played by a stand-in for the camera's library."""

import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import tracked_room
from datasets_recordings import stamped_line
from realsense_library import (
    RATE,
    STEPS,
    UP,
    MotionSensor,
    depth_image,
    installed,
    profile_of,
    sensors,
)  # fmt: skip
from refusals import refused

from taichi_mrf.datasets import open_dataset
from taichi_mrf.errors import FrameError
from taichi_mrf.geometry.poses import inverse, look_at
from taichi_mrf.mapping.pipeline import map_sequence
from taichi_mrf.sensor.camera import PinholeCamera

COUNT = 6
FIRST = 1000.0
"""Seconds of the first image; they come at 10 Hz."""


def stamp(i: int) -> float:
    return FIRST + 0.1 * i


class Pipeline:
    """Plays images 0 to COUNT - 1, each with its own depth; in real time the first one is lost on every
    second start. Without a file it is a camera, which goes on."""

    starts = 0
    stopped = 0
    lost: tuple[int, ...] = ()
    colored = False
    motion: MotionSensor | None = None

    def start(self, config: SimpleNamespace) -> SimpleNamespace:
        if config.file is not None and not Path(config.file).read_bytes().startswith(b"#ROSBAG"):
            raise RuntimeError("Failed to resolve request.\n Request to enable_device_from_file was invalid")
        if config.color and not self.colored:
            raise RuntimeError("Couldn't resolve requests")
        type(self).starts += 1
        self.left = [i for i in range(COUNT) if i not in self.lost]
        if config.playback is not None and config.playback.real_time and self.starts % 2 == 0:
            self.left.pop(0)
        return config.profile()

    def wait_for_frames(self, timeout_ms: int) -> SimpleNamespace:
        if not self.left:
            raise RuntimeError(f"Frame didn't arrive within {timeout_ms}")
        i = self.left.pop(0)
        image, colors = depth_image(STEPS + 10 * i, stamp(i), 100 + i), np.full((3, 4, 3), 10 + i, np.uint8)
        return SimpleNamespace(get_depth_frame=lambda: image, number=i, colors=colors)

    def stop(self) -> None:
        type(self).stopped += 1


class Config:
    def __init__(self) -> None:
        self.file: str | None = None
        self.playback: SimpleNamespace | None = None
        self.color = False

    def enable_device_from_file(self, file: str, repeat_playback: bool) -> None:
        assert not repeat_playback
        self.file, self.playback = file, SimpleNamespace(real_time=True)

    def enable_stream(self, kind: str, *asked: object) -> None:
        self.color = self.color or kind == "color"

    def resolve(self, wrapped: object) -> SimpleNamespace:
        return self.profile()

    def profile(self) -> SimpleNamespace:
        player = SimpleNamespace(set_real_time=lambda on: setattr(self.playback, "real_time", on))
        return profile_of(as_playback=lambda: player, query_sensors=lambda: [])


class Context:
    """Loads a recording with the sensors of a kind of pipeline; the motion sensor ends it."""

    def __init__(self, pipeline: type[Pipeline]) -> None:
        self.pipeline = pipeline

    def load_device(self, file: str) -> SimpleNamespace:
        assert Path(file).is_file()
        motion = self.pipeline.motion
        return SimpleNamespace(
            set_real_time=lambda on: None if motion is None else setattr(motion, "real_time", on),
            set_status_changed_callback=lambda changed: (
                None if motion is None else setattr(motion, "then", lambda: changed("stopped"))
            ),
            query_sensors=lambda: sensors(motion),
        )


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> type[Pipeline]:
    """A pyrealsense2 whose pipelines are this test's."""

    class TestPipeline(Pipeline):
        pass

    installed(
        monkeypatch,
        pipeline=TestPipeline,
        config=Config,
        pipeline_wrapper=lambda pipeline: pipeline,
        context=lambda: Context(TestPipeline),
        playback_status=SimpleNamespace(stopped="stopped"),
    )
    return TestPipeline


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "walk.bag"
    path.write_bytes(b"#ROSBAG V2.0\n")
    return path


@pytest.fixture
def poses(tmp_path: Path) -> Path:
    """From 0.05 s before the second image to 0.05 s after the fifth, every 0.1 s."""
    path = tmp_path / "track.txt"
    times = [0.05 + 0.1 * i for i in range(5)]
    lines = (stamped_line(FIRST + t, look_at([t, 0, 0], [9, 0, 0])) for t in times)
    path.write_text("\n".join(lines))
    return path


def test_a_recording_with_colour_gives_it_aligned_to_depth(library: type[Pipeline], recording: Path) -> None:
    assert open_dataset(f"realsense:{recording}").read(0).color is None
    library.colored = True
    source = open_dataset(f"realsense:{recording}")
    for i in (1, 4, 2):
        frame = source.read(i)
        assert frame.color is not None
        assert (frame.color == 10 + i).all()
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


def test_what_is_no_recording_is_named(library: type[Pipeline], tmp_path: Path) -> None:
    refused(f"realsense:{tmp_path}/nowhere.bag", "nowhere.bag: no such file")
    path = tmp_path / "other.bag"
    path.write_bytes(b"no bag")
    refused(f"realsense:{path}", "other.bag: cannot be played: Failed to resolve")
    refused(f"realsense:{path}?pose=x", "unknown parameter 'pose'")
    refused(f"realsense:{path}", "depth_scale", depth_scale=1000.0)


def test_an_empty_recording_is_named(library: type[Pipeline], recording: Path) -> None:
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


def test_without_a_file_poses_are_tracked(library: type[Pipeline], recording: Path) -> None:
    for name in ("realsense:", "realsense:?poses=track", f"realsense:{recording}"):
        source = open_dataset(name)
        assert source.tracked
        assert source.read(0).T_world_camera.shape == (4, 4)
    assert len(open_dataset(f"realsense:{recording}?poses=still", track=True)) == COUNT


def test_a_camera_may_stand_still(library: type[Pipeline], recording: Path) -> None:
    for name in ("realsense:?poses=still", f"realsense:{recording}?poses=still"):
        source = open_dataset(name)
        assert not source.tracked
        np.testing.assert_array_equal(source.read(0).T_world_camera, source.read(1).T_world_camera)


def test_the_gyroscope_of_a_recording_is_read_whole(library: type[Pipeline], recording: Path) -> None:
    library.motion = MotionSensor(FIRST - 1.0, stamp(COUNT) + 20.0)
    source = open_dataset(f"realsense:{recording}")
    assert not library.motion.real_time
    assert library.motion.closed
    for i in (0, 4, 2):
        gyro, up = source.read(i).gyro, source.read(i).T_world_camera[:3, :3] @ UP
        assert gyro is not None
        R = gyro.turn(stamp(i), stamp(i + 1))
        assert R is not None
        np.testing.assert_allclose(R, cv2.Rodrigues(RATE * 0.1)[0], atol=1e-9)
        np.testing.assert_allclose(up, [0, 0, 1], atol=1e-9)
        assert source.read(i).acceleration is not None
    for query in ("imu=none", "poses=still"):
        assert open_dataset(f"realsense:{recording}?{query}").read(0).gyro is None
    library.motion = None
    plain = open_dataset(f"realsense:{recording}")
    assert plain.read(0).gyro is None
    assert not any("imu" in note for note in plain.notes)


def test_poses_that_cannot_be_read_are_named(library: type[Pipeline], tmp_path: Path) -> None:
    refused(f"realsense:?poses={tmp_path}/nowhere.txt", "nowhere.txt")


@pytest.mark.usefixtures("one_backend")
def test_a_recording_without_poses_is_mapped(
    library: type[Pipeline], recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class CarriedCamera(library):  # type: ignore[misc, valid-type]
        """Plays a walk through the built-in room."""

        def start(self, config: SimpleNamespace) -> SimpleNamespace:
            profile = super().start(config)
            self.left = list(range(tracked_room.COUNT))
            return profile

        def wait_for_frames(self, timeout_ms: int) -> SimpleNamespace:
            frames = super().wait_for_frames(timeout_ms)
            depth_m = tracked_room.frames()[frames.number].depth_m
            frames.get_depth_frame().get_data = lambda: np.rint(depth_m / 0.0005).astype(np.uint16)
            return frames

    class CarriedConfig(Config):
        def profile(self) -> SimpleNamespace:
            profile, camera = super().profile(), tracked_room.frames()[0].camera
            intrinsics = profile.get_stream("depth").as_video_stream_profile().get_intrinsics()
            intrinsics.__dict__.update(width=camera.width, height=camera.height, fx=camera.fx, fy=camera.fy)
            intrinsics.__dict__.update(ppx=camera.cx, ppy=camera.cy)
            return profile

    monkeypatch.setattr(sys.modules["pyrealsense2"], "pipeline", CarriedCamera)
    monkeypatch.setattr(sys.modules["pyrealsense2"], "config", CarriedConfig)
    result = map_sequence(open_dataset(f"realsense:{recording}"), tracked_room.CONFIG)
    assert result.track is not None
    found = result.track.poses(result.map)
    assert list(found) == list(range(tracked_room.COUNT))
    start = inverse(found[0])
    assert tracked_room.errors({i: start @ T for i, T in found.items()})[:, 1].max() < 0.08
