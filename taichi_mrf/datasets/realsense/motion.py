"""The IMU of a RealSense (D435i, D455, L515): turns and the level start, in the depth camera's frame.

The motion module is a sensor of its own beside the depth camera. A pipeline that streams depth as well would
hand out only the latest sample with each image, so that the sensor is started by itself, with a callback.
An accelerometer at rest measures upwards, as what holds it does. Sources: Intel's notes on the D435i
(librealsense, doc/d435i.md), and rs2_extrinsics in its header rs_sensor.h, with rotations by columns.
"""

import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.sensor.motion import AT_REST_S, MOST_SAMPLES, AccelerationSamples, GyroSamples, upwards_at

LEAST_HZ = 100
"""Of the rates that the camera offers the lowest from here on is taken, else the highest."""

WAIT_S = 1.0
"""The longest wait for accelerations around a camera's first image, and for a recording's next samples."""

USED = "imu: it measures turns, and is level at the first image if it rests; ?imu=none tracks without"


class MotionModule:
    """The motion sensor of a device of the library ``rs``, started. ``depth`` is the profile of the depth
    stream, of which it finds the frame. It keeps the last ``kept`` samples, all if None."""

    def __init__(self, rs: Any, device: Any, depth: Any, kept: int | None = MOST_SAMPLES) -> None:
        """Raises LookupError if the device has no gyroscope, RuntimeError as the library does."""
        self._rs = rs
        self._came = threading.Condition()
        self._sensor, profiles = _sensor_of(rs, device)
        self._T_depth_imu, self._samples = {}, {}
        for kind, profile in profiles.items():
            extrinsics, T_depth_imu = profile.get_extrinsics_to(depth), np.eye(4)
            T_depth_imu[:3, :3] = np.array(extrinsics.rotation, float).reshape(3, 3).T
            T_depth_imu[:3, 3] = extrinsics.translation
            self._T_depth_imu[kind] = T_depth_imu
            self._samples[kind] = deque[tuple[float, Any, tuple[float, float, float]]](maxlen=kept)
        self._sensor.open(list(profiles.values()))
        try:
            self._sensor.start(self._take)
        except RuntimeError:
            self._sensor.close()
            raise

    def gyro(self, clock: Any) -> GyroSamples | None:
        """The angular rates so far, by this clock (the library's timestamp domain of an image)."""
        stamps, rates = self._by(self._rs.stream.gyro, clock)
        return GyroSamples(stamps, rates) if len(stamps) else None

    def acceleration(self, clock: Any) -> AccelerationSamples | None:
        """The accelerations so far, by this clock."""
        accel = self._rs.stream.accel
        if accel not in self._samples:
            return None
        stamps, accelerations = self._by(accel, clock)
        samples = AccelerationSamples(stamps, accelerations, self._T_depth_imu[accel][:3, 3])
        return samples if len(stamps) else None

    def up(self, first_s: float, clock: Any, wait_s: float = WAIT_S) -> NDArray[np.float64] | None:
        """Upwards in the depth camera's frame, (3,), at the first image; None if it moved, or is not known.
        Waits for the samples after that image."""
        samples = self._samples.get(self._rs.stream.accel)
        if samples is None:
            return None
        with self._came:
            self._came.wait_for(lambda: samples and samples[-1][0] >= first_s + AT_REST_S, wait_s)
        return upwards_at(self.acceleration(clock), first_s)

    def wait(self, ended: threading.Event) -> None:
        """Wait until it has ended, or no further sample comes."""
        count = -1
        while not ended.wait(WAIT_S) and count != (now := sum(map(len, self._samples.values()))):
            count = now

    def stop(self) -> None:
        """Stop the sensor, and leave it to others."""
        self._sensor.stop()
        self._sensor.close()

    def _take(self, frame: Any) -> None:
        """Keep a sample; called on the library's threads."""
        motion, kind = frame.as_motion_frame(), frame.get_profile().stream_type()
        value = motion.get_motion_data()
        stamp_s, clock = motion.get_timestamp() / 1000.0, motion.get_frame_timestamp_domain()
        with self._came:
            self._samples[kind].append((stamp_s, clock, (value.x, value.y, value.z)))
            self._came.notify_all()

    def _by(self, kind: Any, clock: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Stamps (N,), ascending, and values (N, 3) in the depth camera's frame of one kind of sample."""
        with self._came:
            taken = [(stamp_s, *value) for stamp_s, by, value in self._samples[kind] if by == clock]
        table = np.array(taken, float).reshape(-1, 4)
        table = table[np.isfinite(table).all(axis=1)]
        stamps, first = np.unique(table[:, 0], return_index=True)
        return stamps, table[first, 1:] @ self._T_depth_imu[kind][:3, :3].T


def motion_or_note(
    open_motion: Callable[..., MotionModule], *of: Any
) -> tuple[MotionModule | None, list[str]]:
    """The IMU that ``open_motion`` opens, if there is one that can be used; and what the user should know."""
    try:
        return open_motion(*of), [USED]
    except LookupError:
        return None, []
    except RuntimeError as error:
        return None, [f"imu: it is not used: {' '.join(str(error).split())}"]


def recorded_motion(rs: Any, path: Path) -> MotionModule:
    """Measurements of the IMU while a recording with depth was made, stopped. Raises as MotionModule does."""
    context = rs.context()
    device = context.load_device(str(path))
    device.set_real_time(False)
    ended = threading.Event()

    def changed(status: Any) -> None:
        if status == rs.playback_status.stopped:
            ended.set()

    device.set_status_changed_callback(changed)
    profiles = (profile for sensor in device.query_sensors() for profile in sensor.get_stream_profiles())
    depth = next(profile for profile in profiles if profile.stream_type() == rs.stream.depth)
    module = MotionModule(rs, device, depth, kept=None)
    module.wait(ended)
    module.stop()
    return module


def _sensor_of(rs: Any, device: Any) -> tuple[Any, dict[Any, Any]]:
    """The sensor with the gyroscope, and its profiles of angular rates and, if it has any, accelerations."""
    for sensor in device.query_sensors():
        chosen = {}
        for kind in (rs.stream.gyro, rs.stream.accel):
            offered = [each for each in sensor.get_stream_profiles() if each.stream_type() == kind]
            if offered:
                chosen[kind] = min(offered, key=lambda p: (p.fps() < LEAST_HZ, abs(p.fps() - LEAST_HZ)))
        if rs.stream.gyro in chosen:
            return sensor, chosen
    raise LookupError("the camera has no gyroscope")
