"""IMUs of bags: turns and the first image's level in the camera's frame, and topics that cannot be used."""

import cv2
import numpy as np
import pytest
from inputs_bags import FRAME, Bag, Kind, Make, images, stamp
from refusals import refused

from taichi_mrf.alignment.se3 import moved
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.base import start_pose
from taichi_mrf.sensor.motion import GRAVITY, upwards

TOPIC, BODY = "/imu/data", "imu_link"
T_camera_imu = moved(np.eye(4), [0.02, 0.0, 0.01, 1.2, -0.9, 0.4])
RATE = np.array([0.3, -0.8, 0.5])
"""Radians a second in the camera frame."""

TILT = moved(np.eye(4), [0, 0, 0, 0.2, 0.0, 0.3])[:3, :3]
UP = TILT.T @ [0.0, -1.0, 0.0]


def imu(
    bag: Bag,
    topic: str = TOPIC,
    tf: bool = True,
    covariance: float = 0.0,
    shake: float = 0.0,
) -> None:
    if tf:
        bag.tf("/tf_static", 0.0, FRAME, BODY, T_camera_imu)
    to_imu, random = T_camera_imu[:3, :3].T, np.random.default_rng(0)
    unknown = np.zeros(9)
    unknown[0] = covariance
    for k in range(160):
        at = 0.8 + k / 200
        force = to_imu @ (GRAVITY * UP) + random.normal(0, shake + 1e-6, 3)
        bag.send(
            topic, "sensor_msgs/msg/Imu", at, header=bag.header(at, BODY),
            orientation=bag.quaternion([0.0, 0.0, 0.0, 1.0]), orientation_covariance=np.zeros(9),
            angular_velocity=bag.vector(to_imu @ RATE), angular_velocity_covariance=unknown,
            linear_acceleration=bag.vector(force), linear_acceleration_covariance=np.zeros(9),
        )  # fmt: skip


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_turns_come_in_the_cameras_frame_and_the_first_image_is_level(make: Make, kind: Kind) -> None:
    dataset = open_dataset(f"{make(images, imu, kind=kind)}?poses=track")
    first, second = dataset.read(0), dataset.read(1)
    R = second.gyro.turn(first.stamp, second.stamp)
    np.testing.assert_allclose(R, cv2.Rodrigues(RATE * (stamp(1) - stamp(0)))[0], atol=1e-6)
    np.testing.assert_allclose(first.T_world_camera[:3, :3] @ UP, [0, 0, 1], atol=1e-5)
    np.testing.assert_allclose(second.acceleration.accelerations_m_s2[7], GRAVITY * UP, atol=1e-4)
    np.testing.assert_array_equal(second.acceleration.position_m, T_camera_imu[:3, 3])
    assert any(f"{TOPIC} measures turns; the first image is level" in note for note in dataset.notes)


def test_what_shakes_does_not_say_which_way_is_up(make: Make) -> None:
    dataset = open_dataset(f"{make(images, lambda bag: imu(bag, shake=2.0))}?poses=track")
    np.testing.assert_array_equal(dataset.read(0).T_world_camera, start_pose())
    assert any("which way is up it does not say" in note for note in dataset.notes)
    assert upwards(np.tile([0.0, 0.0, 12.0], (20, 1))) is None
    assert upwards(np.tile([0.0, 0.0, GRAVITY], (5, 1))) is None
    np.testing.assert_allclose(upwards(np.tile([0.0, -GRAVITY, 0.0], (20, 1))), [0, -1, 0])


def test_topics_that_cannot_be_used_are_named(make: Make) -> None:
    dataset = open_dataset(f"{make(images, lambda bag: imu(bag, tf=False))}?poses=track")
    assert dataset.read(0).gyro is None
    assert any(f"no fixed transform from {BODY!r} to {FRAME!r}" in note for note in dataset.notes)
    both = make(images, imu, lambda bag: imu(bag, topic="/other"), kind="mcap")
    dataset = open_dataset(f"{both}?poses=track")
    assert any("choose one with ?imu=" in note for note in dataset.notes)
    assert open_dataset(f"{both}?poses=track&imu=/other").read(0).gyro is not None
    assert open_dataset(f"{both}?poses=track&imu=none").notes == []


def test_accelerations_alone_are_no_turns(make: Make) -> None:
    path = make(images, lambda bag: imu(bag, covariance=-1.0))
    assert open_dataset(f"{path}?poses=track").read(0).gyro is None
    refused(f"{path}?poses=track&imu={TOPIC}", f"topic {TOPIC} has no angular rates")


@pytest.mark.parametrize("up", [(0, -1, 0), (0.1, -0.9, 0.3), (0.0, 0.0, -1.0), (0.05, 0.02, 1.0), (1, 0, 0)])
def test_a_start_pose_is_level_and_looks_along_x(up: tuple) -> None:
    unit = np.array(up) / np.linalg.norm(up)
    R = start_pose(unit)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0
    np.testing.assert_allclose(R @ unit, [0, 0, 1], atol=1e-12)
    ahead = R @ [0, 0, 1]
    assert ahead[1] == pytest.approx(0, abs=0.06)
    if up == (0, -1, 0):
        np.testing.assert_allclose(start_pose(unit), start_pose(), atol=1e-12)
