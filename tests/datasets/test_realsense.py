"""A RealSense camera, played by a stand-in for its library; and what is said where that is not installed."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from realsense_library import (
    PLACE_M,
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
from taichi_mrf.datasets.base import start_pose
from taichi_mrf.datasets.realsense.device import MISSES
from taichi_mrf.errors import DatasetError, FrameError
from taichi_mrf.sensor.motion import GRAVITY


class Pipeline:
    """A camera of 4 x 3 pixels that sends what is in ``images``: depth in steps, or None for nothing."""

    images: tuple[np.ndarray | None, ...] = ()
    problem: str | None = None
    color: np.ndarray | None = None  # of each image's pixels; None: the camera has no colour sensor
    motion: MotionSensor | None = None

    def __init__(self) -> None:
        self.left = list(self.images)
        self.stopped = False

    def start(self, config: SimpleNamespace) -> SimpleNamespace:
        if self.problem:
            raise RuntimeError(self.problem)
        if "color" in config.streams and self.color is None:
            raise RuntimeError("Couldn't resolve requests")
        width, height = config.streams["depth"][:2]
        return profile_of(width, height, query_sensors=lambda: sensors(self.motion))

    def wait_for_frames(self, timeout_ms: int) -> SimpleNamespace:
        steps = self.left.pop(0) if self.left else None
        if steps is None:
            raise RuntimeError(f"Frame didn't arrive within {timeout_ms}")
        image = depth_image(steps, 2.5, 0)
        return SimpleNamespace(get_depth_frame=lambda: image, colors=self.color)

    def stop(self) -> None:
        self.stopped = True


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> type[Pipeline]:
    """A pyrealsense2 whose cameras are Pipelines of this test."""

    class Config:
        def __init__(self) -> None:
            self.streams: dict[str, tuple[object, ...]] = {}

        def enable_stream(self, kind: str, *asked: object) -> None:
            self.streams[kind] = asked

    class TestPipeline(Pipeline):
        pass

    installed(monkeypatch, pipeline=TestPipeline, config=Config)
    return TestPipeline


def test_images_come_in_metres_with_the_cameras_own_intrinsics(library: type[Pipeline]) -> None:
    library.images = (STEPS, STEPS)
    source = open_dataset("realsense:width=4&height=3")
    assert source.endless
    assert (source.camera.fx, source.camera.fy, source.camera.cx, source.camera.cy) == (4.0, 5.0, 1.5, 1.0)
    frame = source.read(7)
    np.testing.assert_allclose(frame.depth_m, STEPS * 0.0005, rtol=1e-6)
    assert frame.depth_m.dtype == np.float32
    assert (frame.name, frame.stamp) == ("realsense-000007", 2.5)
    np.testing.assert_allclose(frame.T_world_camera[:3, 2], [1, 0, 0], atol=1e-12)
    assert any("?poses=still" in note for note in source.notes)


def test_colours_come_aligned_to_depth_where_the_camera_has_them(library: type[Pipeline]) -> None:
    library.images = (STEPS, STEPS)
    alone = open_dataset("realsense:width=4&height=3")
    assert alone.read(0).color is None
    assert any("depth alone: Couldn't resolve requests" in note for note in alone.notes)
    library.color = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)
    frame = open_dataset("realsense:width=4&height=3").read(0)
    np.testing.assert_array_equal(frame.color, library.color)
    np.testing.assert_allclose(frame.depth_m, STEPS * 0.0005, rtol=1e-6)
    assert open_dataset("realsense:width=4&height=3", color=False).read(0).color is None


def test_a_missed_image_is_a_broken_frame_and_many_are_the_end(library: type[Pipeline]) -> None:
    library.images = (None, STEPS, *[None] * MISSES)
    source = open_dataset("realsense:width=4&height=3")
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
        open_dataset("realsense:width=4&height=3").read(0)


def test_what_the_library_says_is_passed_on(library: type[Pipeline]) -> None:
    library.problem = "No device connected"
    refused("realsense:", "realsense: cannot be started: No device connected")


def test_a_wrong_option_is_named(library: type[Pipeline]) -> None:
    refused("realsense:heigth=3", "heigth")


def test_the_camera_is_given_back_with_its_source(library: type[Pipeline]) -> None:
    source = open_dataset("realsense:width=4&height=3")
    pipeline = source.pipeline
    del source
    assert pipeline.stopped


def test_the_gyroscope_turns_with_the_camera_and_the_first_image_is_level(library: type[Pipeline]) -> None:
    library.images = (STEPS, STEPS)
    library.motion = MotionSensor(2.0, 3.0)
    source = open_dataset("realsense:width=4&height=3")
    assert library.motion.opened == [("gyro", 200), ("accel", 250)]
    first, second = source.read(0), source.read(1)
    assert second.gyro is not None
    R = second.gyro.turn(2.2, 2.5)
    assert R is not None
    np.testing.assert_allclose(R, cv2.Rodrigues(RATE * 0.3)[0], atol=1e-9)
    np.testing.assert_allclose(first.T_world_camera[:3, :3] @ UP, [0, 0, 1], atol=1e-9)
    np.testing.assert_array_equal(second.T_world_camera, first.T_world_camera)
    assert second.acceleration is not None
    np.testing.assert_allclose(second.acceleration.accelerations_m_s2[7], GRAVITY * UP, atol=1e-9)
    np.testing.assert_array_equal(second.acceleration.position_m, PLACE_M)
    assert any("imu: it measures turns" in note for note in source.notes)
    del source
    assert library.motion.stopped
    assert library.motion.closed


def test_a_camera_whose_imu_cannot_help_is_tracked_without(library: type[Pipeline]) -> None:
    library.images = (STEPS,)
    without = open_dataset("realsense:width=4&height=3")
    assert without.read(0).gyro is None
    assert not any("imu" in note for note in without.notes)
    library.motion = MotionSensor(2.0, 3.0, shake=2.0)
    shaken = open_dataset("realsense:width=4&height=3").read(0)
    assert shaken.gyro is not None
    np.testing.assert_array_equal(shaken.T_world_camera, start_pose())
    library.motion = MotionSensor(2.0, 3.0, clock="another")
    assert open_dataset("realsense:width=4&height=3").read(0).gyro is None
    library.motion = MotionSensor(2.0, 3.0)
    library.motion.problem = "Device is busy"
    busy = open_dataset("realsense:width=4&height=3")
    assert busy.read(0).gyro is None
    assert "imu: it is not used: Device is busy" in busy.notes


def test_an_imu_may_be_left_alone(library: type[Pipeline]) -> None:
    library.images = (STEPS,)
    library.motion = MotionSensor(2.0, 3.0)
    for query in ("imu=none", "poses=still"):
        assert open_dataset(f"realsense:width=4&height=3&{query}").read(0).gyro is None
    assert library.motion.opened == []
    refused("realsense:imu=yes", "imu may be none, not 'yes'")
