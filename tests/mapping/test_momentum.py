"""Tracking with an accelerometer: its predictions against closed forms, and a camera that is swung about."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from tracked_room import CONFIG

from taichi_mrf.alignment.se3 import moved, twist
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.datasets.synthetic.room import RoomOptions, SyntheticRoom
from taichi_mrf.datasets.synthetic.room_furniture import ROOM_IN_WORLD
from taichi_mrf.errors import LostFrameError
from taichi_mrf.geometry.poses import Pose, inverse, look_at, tangent_norms
from taichi_mrf.mapping.momentum import Momentum
from taichi_mrf.mapping.tracking import Tracker
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.motion import GRAVITY, AccelerationSamples, GyroSamples

IMU_HZ, FRAMES_HZ, COUNT = 200.0, 3.0, 14
AT_M = np.array([0.05, -0.1, 0.15])
"""Of the IMU in the camera frame."""

UP = np.array([0.0, 0.0, GRAVITY])
NONE = np.zeros(3)


def thrown(stamp_s: float) -> Pose:
    """A camera that turns evenly while the IMU beside it is accelerated evenly."""
    T = moved(look_at([0, 0, 0], [1, 0, 0]), [0, 0, 0, *(stamp_s * np.array([0.3, -0.8, 0.5]))])
    imu = np.array([0.5, -1.0, 0.2]) * stamp_s + np.array([-2.0, 1.5, 0.7]) * stamp_s**2 / 2
    T[:3, 3] = imu - T[:3, :3] @ AT_M
    return T


def swung(stamp_s: float) -> Pose:
    """From side to side by up to 2 m/s and 10 m/s^2 after the first second, looking about."""
    w, begun = 5.0, np.clip(stamp_s / 1.2, 0, 1)
    wide = begun**3 * (10 - 15 * begun + 6 * begun**2)
    side, ahead = 0.4 * np.sin(w * stamp_s + 0.4), 0.15 * np.sin(0.5 * w * stamp_s)
    eye = np.array([0.2 + wide * ahead, -0.3 + wide * side, 1.5]) + ROOM_IN_WORLD
    yaw = 0.4 * np.sin(1.1 * stamp_s)
    return look_at(eye, eye + np.array([-np.cos(yaw), -np.sin(yaw), -0.2]))


@cache
def measured(pose_at: object, seconds: float, noise: float = 0.0) -> tuple[GyroSamples, AccelerationSamples]:
    """Readings of an IMU at AT_M: by differences of poses (noise in m/s^2, and 0.05 of bias)."""
    stamps, h, random = np.arange(-0.01, seconds, 1 / IMU_HZ), 1e-3, np.random.default_rng(0)

    def place(s: float) -> np.ndarray:
        T = pose_at(s)  # type: ignore[operator]
        return np.asarray(T[:3, :3] @ AT_M + T[:3, 3])

    rates, felt = [], []
    for s in stamps:
        T = pose_at(s)  # type: ignore[operator]
        rates.append(twist(inverse(pose_at(s - h)) @ pose_at(s + h))[3:] / (2 * h))  # type: ignore[operator]
        felt.append(T[:3, :3].T @ ((place(s + h) - 2 * place(s) + place(s - h)) / h**2 + UP))
    spoilt = np.array(felt)
    if noise:
        spoilt += random.normal(np.array([0.03, -0.03, 0.026]), noise, spoilt.shape)
    return GyroSamples(stamps, np.array(rates)), AccelerationSamples(stamps, spoilt, AT_M)


def frame_at(pose_at: object, stamp_s: float) -> Frame:
    gyro, acceleration = measured(pose_at, 3.0)
    T, camera = pose_at(stamp_s), RoomOptions(width=8, height=8).camera()  # type: ignore[operator]
    depth_m = np.zeros((8, 8), np.float32)
    return Frame(depth_m, T, camera, stamp_s, "now", gyro=gyro, acceleration=acceleration)


def test_an_even_acceleration_gives_the_exact_place_also_of_a_camera_beside_the_imu() -> None:
    momentum, before, last = Momentum(), (0.1, thrown(0.1)), (0.4, thrown(0.4))
    momentum.gravity_m_s2 = UP
    T = momentum.ahead(frame_at(thrown, 0.9), before, last, NONE)
    assert T is not None
    # Samples stand for a turning axis between them; the rest is exact.
    np.testing.assert_allclose(T, thrown(0.9), atol=1e-4)


def test_gravity_is_learnt_from_the_places_that_are_found() -> None:
    momentum, off, proven = Momentum(), [], []
    for k in range(14, 28):
        before, last, now = (0.1 * (k + n) for n in (-2, -1, 0))
        frame = frame_at(swung, now)
        T = momentum.ahead(frame, (before, swung(before)), (last, swung(last)), NONE)
        assert T is not None
        off.append(tangent_norms(T, swung(now))[1])
        momentum.note(frame, swung(now))
        proven.append(momentum.proven)
    assert momentum.gravity_m_s2 is not None
    assert off[0] > 0.05  # the mean of what was measured at first
    np.testing.assert_array_equal(proven, np.array(off) < 0.05)
    momentum.note(replace(frame), swung(now))
    assert not momentum.proven  # a frame that it was not asked for
    assert max(off[-4:]) < 0.2 * off[0]
    assert np.linalg.norm(momentum.gravity_m_s2 - UP) < 0.2


def test_what_is_missing_or_too_long_ago_gives_no_guess() -> None:
    momentum, frame = Momentum(), frame_at(swung, 0.6)
    before, last = (0.2, swung(0.2)), (0.4, swung(0.4))
    assert momentum.ahead(frame, before, last, NONE) is not None
    for without in (
        replace(frame, gyro=None),
        replace(frame, acceleration=None),
        replace(frame, stamp=float("nan")),
        replace(frame, stamp=1.45),
        replace(frame, stamp=3.5),
    ):
        assert momentum.ahead(without, before, last, NONE) is None
    assert momentum.ahead(frame, (-0.5, swung(-0.5)), last, NONE) is None


@dataclass
class Swung(SyntheticRoom):
    def pose_at(self, index: int) -> Pose:
        return swung(index / FRAMES_HZ)


@cache
def frames() -> list[Frame]:
    options = RoomOptions(frames=COUNT, width=160, height=120)
    room = Swung("swung", options.camera(), options=options, color=False)
    gyro, acceleration = measured(swung, COUNT / FRAMES_HZ, noise=0.02)
    stamped = (replace(room.read(i), stamp=i / FRAMES_HZ) for i in range(COUNT))
    return [replace(frame, gyro=gyro, acceleration=acceleration) for frame in stamped]


def largest_error_m(with_acceleration: bool) -> float:
    """Of the frames that are found, infinite if one is lost."""
    m = MRFMap.from_config(CONFIG, frames()[0].camera)
    tracker, off = Tracker(m, PoseConfig()), []
    for frame in frames():
        known = frame if with_acceleration else replace(frame, acceleration=None)
        try:
            found, _ = tracker.follow(known)
        except LostFrameError:
            return float("inf")
        off.append(tangent_norms(frame.T_world_camera, found.T_world_camera)[1])
        tracker.took(m.add_keyframe(found.depth_m, found.T_world_camera, found.camera))
    return max(off)


@pytest.mark.usefixtures("one_backend")
def test_a_camera_that_is_swung_about_is_followed_with_an_accelerometer_only() -> None:
    assert largest_error_m(with_acceleration=True) < 0.04
    assert largest_error_m(with_acceleration=False) > 0.2
