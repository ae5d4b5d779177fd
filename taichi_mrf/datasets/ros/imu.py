"""The IMU of a bag: how the camera turns, by its gyroscope, and which way is up at the beginning."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.ros import messages
from taichi_mrf.datasets.ros.reader import RosReader
from taichi_mrf.datasets.ros.sensor import BagSensor
from taichi_mrf.datasets.ros.topics import choose
from taichi_mrf.errors import DatasetError
from taichi_mrf.sensor.motion import AccelerationSamples, GyroSamples, upwards_at

NONE = "none"
"""The value of the option ``imu`` for a camera that is tracked without."""


@dataclass(frozen=True)
class BagImu:
    """The angular rates and accelerations of the camera, and upwards in its frame, (3,), at the first image;
    None for what is not known. ``notes`` are for the user: which topic is used, or why none is although there
    are some."""

    gyro: GyroSamples | None = None
    acceleration: AccelerationSamples | None = None
    up: NDArray[np.float64] | None = None
    notes: list[str] = field(default_factory=list)


def find_imu(reader: RosReader, wanted: str, sensor: BagSensor, first_s: float) -> BagImu:
    """The IMU beside a camera whose images begin at ``first_s``. ``wanted`` is the topic, if the user
    named it. Raises DatasetError if that has no angular rates."""
    if wanted == NONE:
        return BagImu()
    topics = [
        t.name for t in reader.topics.values() if t.type == messages.IMU and _turns(reader.first(t.name))
    ]
    if not wanted and len(topics) != 1:
        return BagImu(notes=[f"imu: choose one with ?imu={' or ?imu='.join(topics)}"] if topics else [])
    name = choose(reader, "imu", wanted, topics, "topics of an IMU's angular rates")
    if name not in topics:
        raise DatasetError(f"{reader.path}: topic {name} has no angular rates ({messages.IMU})")
    entries, rates, accelerations, frame, optical = [], [], [], "", sensor.frame
    for entry, message in reader.messages(name):
        rate, force = message.angular_velocity, message.linear_acceleration
        entries.append(entry)
        rates.append((rate.x, rate.y, rate.z))
        accelerations.append((force.x, force.y, force.z) if _accelerates(message) else (np.nan,) * 3)
        frame = frame or entry.frame
    T_optical_imu = np.eye(4) if frame == optical != "" else sensor.tree().mounted(optical, frame)
    if T_optical_imu is None:
        why = f"tf has no fixed transform from {frame!r} to {optical!r}"
        return BagImu(notes=[f"imu: {name} is not used: {why}"])
    to_optical = T_optical_imu[:3, :3].T
    part = list(sensor.run.part([entry.stamp for entry in entries], [entry.place for entry in entries]))
    times, first = np.unique([entries[i].stamp for i in part], return_index=True)
    rates_imu = np.array(rates)[part][first]
    valid = np.isfinite(rates_imu).all(axis=1)
    measured = np.array(accelerations)[part][first] @ to_optical
    felt = np.isfinite(measured).all(axis=1)
    acceleration = AccelerationSamples(times[felt], measured[felt], T_optical_imu[:3, 3])
    up = upwards_at(acceleration, first_s)
    level = "the first image is level by it" if up is not None else "which way is up it does not say"
    gyro = GyroSamples(times[valid], rates_imu[valid] @ to_optical)
    return BagImu(gyro, acceleration if felt.any() else None, up, [f"imu: {name} measures turns; {level}"])


def _turns(message: Any | None) -> bool:
    """True if a message has angular rates: the first covariance is -1 if it has none."""
    return message is not None and message.angular_velocity_covariance[0] != -1


def _accelerates(message: Any) -> bool:
    """The same for accelerations."""
    return bool(message.linear_acceleration_covariance[0] != -1)
