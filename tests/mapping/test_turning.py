"""Tracking with a gyroscope: fast turns that constant motion does not foresee."""

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
from taichi_mrf.mapping.tracking import Tracker
from taichi_mrf.mapping.turning import GyroTurns, turned
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.motion import GyroSamples

FRAMES_HZ, GYRO_HZ = 5.0, 200.0
COUNT = 12
BIAS_RAD_S = np.array([0.02, -0.015, 0.01])
NOISE_RAD_S = 0.005


def pose_at(stamp_s: float) -> Pose:
    """Who stands in the room and looks left and right, by up to 30 degrees in a fifth of a second."""
    yaw = 0.7 * np.sin(2 * np.pi * stamp_s / 1.7)
    eye = np.array([1.2, -0.2 + 0.1 * np.sin(stamp_s), 1.5]) + ROOM_IN_WORLD
    return look_at(eye, eye + np.array([-np.cos(yaw), -np.sin(yaw), -0.2]))


@dataclass
class Looking(SyntheticRoom):
    def pose_at(self, index: int) -> Pose:
        return pose_at(index / FRAMES_HZ)


@cache
def gyro() -> GyroSamples:
    stamps = np.arange(-0.01, COUNT / FRAMES_HZ, 1 / GYRO_HZ)
    half = 0.5 / GYRO_HZ
    rates = [twist(inverse(pose_at(s - half)) @ pose_at(s + half))[3:] * GYRO_HZ for s in stamps]
    noise = np.random.default_rng(0).normal(0, NOISE_RAD_S, (len(stamps), 3))
    return GyroSamples(stamps, np.array(rates) + BIAS_RAD_S + noise)


@cache
def frames() -> list[Frame]:
    options = RoomOptions(frames=COUNT, width=160, height=120)
    room = Looking("looking", options.camera(), options=options, color=False)
    return [replace(room.read(i), stamp=i / FRAMES_HZ) for i in range(COUNT)]


def tracked(with_gyro: bool) -> tuple[list[float], int, Tracker]:
    """How far each frame that is found is off in metres and radians together, and how many are lost."""
    m = MRFMap.from_config(CONFIG, frames()[0].camera)
    tracker = Tracker(m, PoseConfig())
    off, lost = [], 0
    for frame in frames():
        try:
            found, _ = tracker.follow(replace(frame, gyro=gyro() if with_gyro else None))
        except LostFrameError:
            lost += 1
            continue
        off.append(sum(tangent_norms(frame.T_world_camera, found.T_world_camera)))
        tracker.took(m.add_keyframe(found.depth_m, found.T_world_camera, found.camera))
    return off, lost, tracker


@pytest.mark.usefixtures("one_backend")
def test_fast_turns_are_followed_with_a_gyroscope_and_lost_without() -> None:
    turns = [
        tangent_norms(a.T_world_camera, b.T_world_camera)[0]
        for a, b in zip(frames(), frames()[1:], strict=False)
    ]
    assert np.degrees(max(turns)) > 28
    off, lost, tracker = tracked(with_gyro=True)
    assert lost == 0
    assert max(off) < 0.05
    np.testing.assert_allclose(tracker._turns.bias_rad_s, BIAS_RAD_S, atol=0.01)
    alone, lost = tracked(with_gyro=False)[:2]
    assert lost > 0 or max(alone) > 0.3


def test_the_bias_is_learnt_from_frames_and_outliers_are_left_out() -> None:
    turns, T = GyroTurns(), pose_at(0.0)
    frame = Frame(
        np.zeros((2, 2), np.float32), T, RoomOptions(width=8, height=8).camera(), 0.2, "now", gyro=gyro()
    )
    turns.note(frame, 0.0, T, pose_at(0.2))
    np.testing.assert_allclose(turns.bias_rad_s, BIAS_RAD_S, atol=0.004)
    turns.note(frame, 0.0, T, moved(pose_at(0.2), [0, 0, 0, 0.3, 0, 0]))
    np.testing.assert_allclose(turns.bias_rad_s, BIAS_RAD_S, atol=0.004)
    assert turns.since(replace(frame, gyro=None), 0.0) is None
    assert turns.since(frame, float("nan")) is None
    assert turns.since(frame, -1.0) is None


def test_guesses_have_the_turn_and_keep_their_place() -> None:
    T, R = pose_at(0.3), moved(np.eye(4), [0, 0, 0, 0.1, 0.2, -0.3])[:3, :3]
    ahead = moved(T, [0.1, 0.0, 0.2, 0.0, 0.4, 0.0])
    first, second = turned([T, ahead], T, R)
    np.testing.assert_array_equal([first[:3, 3], second[:3, 3]], [T[:3, 3], ahead[:3, 3]])
    np.testing.assert_allclose([first[:3, :3], second[:3, :3]], [T[:3, :3] @ R] * 2)
    assert turned([T, ahead], T, None) == [T, ahead]
