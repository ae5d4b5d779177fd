"""A stand-in for Intel's RealSense library: cameras and recordings that play the same images, and a motion
sensor, a gyroscope and an accelerometer that are turned against the depth camera."""

import sys
from collections.abc import Callable
from pathlib import Path
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


COUNT = 6
FIRST = 1000.0
"""Seconds of the first image; they come at 10 Hz."""


def stamp(i: int) -> float:
    return FIRST + 0.1 * i


def colors(i: int) -> np.ndarray:
    return np.arange(i, i + 36, dtype=np.uint8).reshape(3, 4, 3)


class Pipeline:
    """Plays ``images`` of depth in steps, or None for one that does not come, with a gap for the ``lost``.

    A recording in real time loses the first image on every second start.
    """

    images: tuple[np.ndarray | None, ...] = tuple(STEPS + 10 * i for i in range(COUNT))
    lost: tuple[int, ...] = ()
    colored = False
    problem: str | None = None
    motion: "MotionSensor | None" = None
    asked: dict[str, tuple[object, ...]]
    starts = 0
    stopped = 0

    def start(self, config: "Config") -> SimpleNamespace:
        if self.problem:
            raise RuntimeError(self.problem)
        if config.file is not None and not Path(config.file).read_bytes().startswith(b"#ROSBAG"):
            raise RuntimeError("Failed to resolve request.\n Request to enable_device_from_file was invalid")
        if "color" in config.streams and not self.colored:
            raise RuntimeError("Couldn't resolve requests")
        type(self).starts += 1
        type(self).asked = config.streams
        self.left = [i for i in range(len(self.images)) if i not in self.lost]
        if config.playback is not None and config.playback.real_time and self.starts % 2 == 0:
            self.left.pop(0)
        return config.profile([] if config.file else sensors(self.motion))

    def wait_for_frames(self, timeout_ms: int) -> SimpleNamespace:
        i = self.left.pop(0) if self.left else None
        if i is None or self.images[i] is None:
            raise RuntimeError(f"Frame didn't arrive within {timeout_ms}")
        image = depth_image(self.images[i], stamp(i), 100 + i)
        return SimpleNamespace(get_depth_frame=lambda: image, number=i, colors=colors(i))

    def stop(self) -> None:
        type(self).stopped += 1


class Config:
    def __init__(self) -> None:
        self.file: str | None = None
        self.playback: SimpleNamespace | None = None
        self.streams: dict[str, tuple[object, ...]] = {}

    def enable_device_from_file(self, file: str, repeat_playback: bool) -> None:
        assert not repeat_playback
        self.file, self.playback = file, SimpleNamespace(real_time=True)

    def enable_stream(self, kind: str, *asked: object) -> None:
        self.streams[kind] = asked

    def resolve(self, wrapped: object) -> SimpleNamespace:
        return self.profile([])

    def profile(self, sensors: list[object]) -> SimpleNamespace:
        """First answer of a pipeline: images of 4 x 3 pixels, whatever is asked for."""
        intrinsics = SimpleNamespace(width=4, height=3, fx=4.0, fy=5.0, ppx=1.5, ppy=1.0)
        video = SimpleNamespace(get_intrinsics=lambda: intrinsics)
        depth = SimpleNamespace(get_depth_scale=lambda: 0.0005)
        player = SimpleNamespace(set_real_time=lambda on: setattr(self.playback, "real_time", on))
        device = SimpleNamespace(
            first_depth_sensor=lambda: depth, as_playback=lambda: player, query_sensors=lambda: sensors
        )
        stream = SimpleNamespace(as_video_stream_profile=lambda: video)
        return SimpleNamespace(get_stream=lambda kind: stream, get_device=lambda: device)


class Context:
    """Loads a recording with the sensors of a kind of pipeline; the motion sensor ends it."""

    def __init__(self, pipeline: type[Pipeline]) -> None:
        self.motion = pipeline.motion

    def load_device(self, file: str) -> SimpleNamespace:
        assert Path(file).is_file()
        motion = self.motion or SimpleNamespace()
        return SimpleNamespace(
            set_real_time=lambda on: setattr(motion, "real_time", on),
            set_status_changed_callback=lambda changed: setattr(motion, "then", lambda: changed("stopped")),
            query_sensors=lambda: sensors(self.motion),
        )


def installed(monkeypatch: pytest.MonkeyPatch) -> type[Pipeline]:
    """A pyrealsense2 whose pipelines are of the returned class, a new one."""

    class TestPipeline(Pipeline):
        pass

    module = ModuleType("pyrealsense2")
    module.__dict__.update(
        stream=SimpleNamespace(depth="depth", color="color", gyro="gyro", accel="accel"),
        format=SimpleNamespace(z16="z16", rgb8="rgb8"),
        align=Align,
        pipeline=TestPipeline,
        config=Config,
        pipeline_wrapper=lambda pipeline: pipeline,
        context=lambda: Context(TestPipeline),
        playback_status=SimpleNamespace(stopped="stopped"),
    )
    monkeypatch.setitem(sys.modules, "pyrealsense2", module)
    return TestPipeline


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
