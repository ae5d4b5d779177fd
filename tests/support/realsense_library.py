"""A stand-in for Intel's RealSense library: what cameras and their recordings have in common, and a motion
sensor, a gyroscope and an accelerometer that are turned against the depth camera."""

import sys
from collections.abc import Callable
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from taichi_mrf.alignment.se3 import moved
from taichi_mrf.sensor.motion import GRAVITY

R_DEPTH_IMU = moved(np.eye(4), [0, 0, 0, 1.2, -0.9, 0.4])[:3, :3]
RATE = np.array([0.3, -0.8, 0.5])
"""Radians a second in the depth camera's frame."""

UP = np.array([0.3, -0.9, 0.2]) / np.linalg.norm([0.3, -0.9, 0.2])
"""Upwards in the depth camera's frame."""

PLACE_M = (0.01, -0.02, 0.03)
"""Of the IMU in the depth camera's frame."""

CLOCK = "global time"


STEPS = np.arange(12, dtype=np.uint16).reshape(3, 4) * 1000
"""The depth image of a camera of 4 x 3 pixels, in steps of half a millimetre."""


def installed(monkeypatch: pytest.MonkeyPatch, **names: object) -> None:
    """A pyrealsense2 with these names and the ones that tell kinds apart."""
    module = ModuleType("pyrealsense2")
    streams = SimpleNamespace(depth="depth", color="color", gyro="gyro", accel="accel")
    formats = SimpleNamespace(z16="z16", rgb8="rgb8")
    module.__dict__.update(stream=streams, format=formats, align=Align, **names)
    monkeypatch.setitem(sys.modules, "pyrealsense2", module)


def profile_of(width: int = 4, height: int = 3, **of_device: object) -> SimpleNamespace:
    """What a pipeline gives as it starts."""
    intrinsics = SimpleNamespace(width=width, height=height, fx=4.0, fy=5.0, ppx=1.5, ppy=1.0)
    video = SimpleNamespace(get_intrinsics=lambda: intrinsics)
    sensor = SimpleNamespace(get_depth_scale=lambda: 0.0005)
    return SimpleNamespace(
        get_stream=lambda kind: SimpleNamespace(as_video_stream_profile=lambda: video),
        get_device=lambda: SimpleNamespace(first_depth_sensor=lambda: sensor, **of_device),
    )


def depth_image(steps: np.ndarray, stamp_s: float, number: int) -> SimpleNamespace:
    return SimpleNamespace(
        get_data=lambda: steps,
        get_timestamp=lambda: 1000.0 * stamp_s,
        get_frame_number=lambda: number,
        get_frame_timestamp_domain=lambda: CLOCK,
    )


class Align:
    """Gives each image the colours that come with its frames."""

    def __init__(self, to: str) -> None:
        assert to == "depth"

    def process(self, frames: SimpleNamespace) -> SimpleNamespace:
        color = SimpleNamespace(get_data=lambda: frames.colors)
        return SimpleNamespace(get_depth_frame=frames.get_depth_frame, get_color_frame=lambda: color)


def sensors(motion: "MotionSensor | None") -> list[object]:
    """Of a device: depth, and motion if it has it."""
    depth = SimpleNamespace(get_stream_profiles=lambda: [SimpleNamespace(stream_type=lambda: "depth")])
    return [depth] if motion is None else [depth, motion]


class MotionSensor:
    """Sends samples from ``begin_s`` to ``end_s`` as soon as it is started. With ``problem`` it cannot be
    opened; ``shake`` is added to accelerations (m/s^2)."""

    def __init__(self, begin_s: float, end_s: float, clock: str = CLOCK, shake: float = 0.0) -> None:
        self.begin_s, self.end_s, self.clock, self.shake = begin_s, end_s, clock, shake
        self.problem: str | None = None
        self.opened: list[tuple[str, int]] = []
        self.stopped = self.closed = False
        self.real_time = True
        self.then: Callable[[], None] = lambda: None

    def get_stream_profiles(self) -> list[SimpleNamespace]:
        rotation = R_DEPTH_IMU.T.ravel().tolist()  # by columns
        extrinsics = SimpleNamespace(rotation=rotation, translation=list(PLACE_M))
        return [
            SimpleNamespace(
                stream_type=lambda kind=kind: kind,
                fps=lambda hz=hz: hz,
                get_extrinsics_to=lambda to: extrinsics,
            )
            for kind, hz in (("gyro", 400), ("gyro", 200), ("accel", 63), ("accel", 250))
        ]

    def open(self, profiles: list[SimpleNamespace]) -> None:
        if self.problem:
            raise RuntimeError(self.problem)
        self.opened = [(each.stream_type(), each.fps()) for each in profiles]

    def start(self, take: Callable[[SimpleNamespace], None]) -> None:
        random = np.random.default_rng(0)
        for kind, hz in self.opened:
            for stamp_s in np.arange(self.begin_s, self.end_s, 1 / hz):
                force = GRAVITY * UP + self.shake * random.normal(size=3)
                value = R_DEPTH_IMU.T @ (RATE if kind == "gyro" else force)
                take(self._frame(kind, float(stamp_s), value))
        self.then()

    def stop(self) -> None:
        self.stopped = True

    def close(self) -> None:
        self.closed = True

    def _frame(self, kind: str, stamp_s: float, value: np.ndarray) -> SimpleNamespace:
        x, y, z = value
        motion = SimpleNamespace(
            get_motion_data=lambda: SimpleNamespace(x=x, y=y, z=z),
            get_timestamp=lambda: 1000.0 * stamp_s,
            get_frame_timestamp_domain=lambda: self.clock,
        )
        profile = SimpleNamespace(stream_type=lambda: kind)
        return SimpleNamespace(as_motion_frame=lambda: motion, get_profile=lambda: profile)
