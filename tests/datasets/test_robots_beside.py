"""What robots that run send beside depth, used as in the bag of it: colours, confidence, and an IMU."""

from collections.abc import Callable
from functools import partial
from typing import Any

import cv2
import inputs_bags
import numpy as np
import pytest
from datasets_recordings import CAMERA
from heard import SECONDS, assert_same_frame, came, one_by_one
from inputs_bags import (
    CONFIDENCE,
    COUNT,
    FRAME,
    IMU,
    RATE,
    UP,
    Bag,
    T_camera_imu,
    confidence,
    images,
    imu,
    mounted,
    odometry,
    plain,
    stamp,
)

from taichi_mrf.config.schema import Config
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.base import start_pose
from taichi_mrf.datasets.recorded_noise import with_recorded_noise
from taichi_mrf.datasets.wires import stream
from taichi_mrf.datasets.wires.client import wait_until
from taichi_mrf.geometry.poses import look_at
from taichi_mrf.sensor.camera import PinholeCamera

Part = Callable[[Bag], object]
Begin = Callable[..., Any]

BETWEEN = np.arange(-0.5, COUNT + 1).tolist()
"""Poses half a step before and after each image."""

COLOR, OWN_FRAME = "/camera/color/image_raw", "camera_color_optical_frame"
OWN = PinholeCamera(32, 20, 30.0, 31.0, 15.0, 9.5)
T_depth_color = look_at([0.02, 0.0, 0.0], [0.02, 0.01, 1.0])


def picture(i: int, camera: PinholeCamera = CAMERA) -> np.ndarray:
    return np.random.default_rng(100 + i).integers(1, 256, (*camera.shape, 3)).astype(np.uint8)


def of_another_camera(bag: Bag) -> None:
    bag.camera_info("/camera/color/camera_info", OWN_FRAME, OWN)
    mounted(bag, FRAME, OWN_FRAME, T_depth_color)
    images(bag, COLOR, False, OWN_FRAME, lambda i: picture(i, OWN), "rgb8", late=0.01)


def compressed_colors(bag: Bag) -> None:
    for i in range(COUNT):
        bag.compressed(COLOR, stamp(i) - 0.01, FRAME, picture(i), "png")
    bag.compressed(COLOR, stamp(COUNT), FRAME, picture(7), "png")


COLORS: dict[str, Part] = {
    "registered": partial(images, topic=COLOR, info=False, image=picture, encoding="rgb8", late=0.01),
    "of another camera": of_another_camera,
    "compressed, and earlier than depth": compressed_colors,
}


@pytest.mark.parametrize("kind", COLORS)
def test_colours_are_those_of_the_bag_bit_for_bit(begin: Begin, kind: str) -> None:
    parts = (images, mounted, partial(odometry, numbers=BETWEEN), COLORS[kind])
    sender, live, bag = begin(*parts, first=5 + 2 * (kind == "of another camera"), color=True)
    recorded = open_dataset(bag)
    assert {note for note in live.notes if note.startswith("color")} == {
        note for note in recorded.notes if note.startswith("color")
    }
    found = one_by_one(sender, live)
    assert len(found) == len(recorded) == COUNT
    for ours, theirs in zip(found, recorded, strict=True):
        assert theirs.color is not None
        assert_same_frame(ours, theirs)


def confidence_of_one(bag: Bag) -> None:
    bag.image(CONFIDENCE, stamp(0), FRAME, inputs_bags.grades(0), "mono8")


def test_depth_has_what_is_near_it_where_other_topics_fall_silent(
    begin: Begin, monkeypatch: pytest.MonkeyPatch
) -> None:
    early = partial(images, topic=COLOR, info=False, image=picture, encoding="rgb8", late=-0.01)
    sender, live, _ = begin(plain, early, confidence_of_one, color=True)
    assert wait_until(lambda: came(live) == COUNT, SECONDS)
    first = live.read(0)
    np.testing.assert_array_equal(first.color, picture(0))
    assert first.sigma_m is not None
    assert live.awaiting()  # images that belong to the newest may yet come
    monkeypatch.setattr(stream, "LATE_S", 0.1)

    def is_there() -> bool:
        sender.send_again("/tf_static")
        return not live.awaiting()

    assert wait_until(is_there, SECONDS)
    frame = live.read(0)
    assert frame.name == f"{COUNT - 1:06d}"
    assert frame.sigma_m is None
    np.testing.assert_array_equal(frame.color, picture(COUNT - 1))


@pytest.mark.parametrize("query", ["", "?depth=camera/depth/image_raw", f"?confidence={CONFIDENCE}"])
def test_confidence_is_that_of_the_bag_bit_for_bit(begin: Begin, query: str) -> None:
    parts = (images, mounted, partial(odometry, numbers=BETWEEN), confidence)
    sender, live, bag = begin(*parts, query=query, first=6)
    recorded = open_dataset(bag, color=False)
    assert with_recorded_noise(Config(), live).sensor == with_recorded_noise(Config(), recorded).sensor
    assert live.stated == recorded.stated
    assert f"confidence: {CONFIDENCE}, as a sigma for each pixel" in live.notes
    found = one_by_one(sender, live)
    assert len(found) == COUNT
    for ours, theirs in zip(found, recorded, strict=True):
        assert theirs.sigma_m is not None
        assert_same_frame(ours, theirs)


def test_colours_are_found_beside_depth_that_is_named(begin: Begin) -> None:
    parts = (images, mounted, partial(odometry, numbers=BETWEEN), COLORS["registered"])
    _, live, _ = begin(*parts, query="?depth=/camera/depth/image_raw", first=6, color=True)
    assert f"color: {COLOR}, registered to depth" in live.notes


def check_turn(frame: Any, begin_s: float, end_s: float) -> None:
    R = frame.gyro.turn(begin_s, end_s)
    np.testing.assert_allclose(R, cv2.Rodrigues(RATE * (end_s - begin_s))[0], atol=1e-6)


def test_turns_and_the_level_start_are_those_of_the_bag(begin: Begin) -> None:
    late = partial(imu, latency=0.2)
    sender, live, bag = begin(images, late, query="?poses=track", first=60, listen_to=IMU)
    recorded = open_dataset(f"{bag}?poses=track")
    found = one_by_one(sender, live)
    assert [frame.name for frame in found] == list(recorded.frame_names)
    assert any(f"imu: {IMU} measures turns" in note for note in live.notes)
    for before, ours, theirs in zip(found, found[1:], list(recorded)[1:], strict=False):
        span = before.stamp, ours.stamp
        np.testing.assert_array_equal(ours.gyro.turn(*span), theirs.gyro.turn(*span))
        check_turn(ours, *span)
        np.testing.assert_allclose(ours.T_world_camera[:3, :3] @ UP, [0, 0, 1], atol=1e-5)
        np.testing.assert_array_equal(ours.acceleration.position_m, T_camera_imu[:3, 3])
        same = np.isin(theirs.acceleration.stamps_s, ours.acceleration.stamps_s)
        np.testing.assert_array_equal(
            ours.acceleration.accelerations_m_s2, theirs.acceleration.accelerations_m_s2[same]
        )


def test_an_imu_may_be_left_alone_or_unfit(begin: Begin) -> None:
    sender, live, _ = begin(images, imu, query="?poses=track&imu=none")
    assert live.read(0).gyro is None
    assert wait_until(lambda: IMU not in sender.listener.topics, SECONDS)
    _, live, _ = begin(images, partial(imu, tf=False), query="?poses=track", listen_to=IMU)
    assert any("imu: /imu/data is not used: tf has no fixed transform" in note for note in live.notes)
    np.testing.assert_array_equal(live.read(0).T_world_camera, start_pose())
    sender, live, _ = begin(plain, imu)
    assert live.read(0).gyro is None
    assert IMU not in sender.listener.topics


def test_where_time_jumps_back_measurements_of_before_are_dropped(begin: Begin) -> None:
    parts = (partial(images, numbers=range(20)), partial(imu, seconds=2.4))
    sender, live, _ = begin(*parts, query="?poses=track", listen_to=IMU)
    assert wait_until(lambda: came(live) == 20, SECONDS)
    first = live.read(0)
    check_turn(first, first.stamp - 1.0, first.stamp)
    sender.send()
    assert wait_until(lambda: came(live) == 40 and not live.awaiting(), SECONDS)
    frame = live.read(1)
    check_turn(frame, frame.stamp - 0.2, frame.stamp)
    assert first.stamp < frame.gyro.stamps_s[0] < frame.stamp
