"""A stand-in for the motion sensor of Intel's RealSense library: a gyroscope and an accelerometer that are
turned against the depth camera, and send their samples as soon as they are started."""

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np

from taichi_mrf.alignment.se3 import moved
from taichi_mrf.sensor.acceleration import GRAVITY

R_DEPTH_IMU = moved(np.eye(4), [0, 0, 0, 1.2, -0.9, 0.4])[:3, :3]
RATE = np.array([0.3, -0.8, 0.5])
"""Radians a second in the depth camera's frame."""

UP = np.array([0.3, -0.9, 0.2]) / np.linalg.norm([0.3, -0.9, 0.2])
"""Upwards in the depth camera's frame."""

PLACE_M = (0.01, -0.02, 0.03)
"""Of the IMU in the depth camera's frame."""

CLOCK = "global time"


class MotionSensor:
    """Sends samples from ``begin_s`` to ``end_s``. With ``problem`` it cannot be opened; ``shake`` is added
    to accelerations (m/s^2)."""

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
