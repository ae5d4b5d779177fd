"""Writes bags with the point clouds of a lidar on a robot that drives and turns."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from inputs_bags import BODY, Bag, Kind, write_bag
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.spherical import SphericalCamera

LIDAR = "os_lidar"
SCANS = 3
CAMERA = SphericalCamera(np.linspace(0.3, -0.3, 4), np.pi - 2 * np.pi * np.arange(24) / 24)
LOST = np.random.default_rng(5).random(CAMERA.shape) < 0.25
T_BODY_LIDAR = np.array([[1.0, 0, 0, 0.2], [0, 1, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]])
KINDS = {"f4": 7, "f8": 8, "u4": 6, "u2": 4, "u1": 2}


def pose(stamp: float) -> Pose:
    """T_odom_body: it drives along x and turns."""
    T, turn = np.eye(4), 0.5 * stamp
    T[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    T[0, 3] = stamp
    return T


def points(scan: int) -> NDArray[np.float64]:
    """(H, W, 3), NaN where nothing came back."""
    ranges = np.random.default_rng(scan).uniform(2.0, 8.0, CAMERA.shape)
    return np.where(LOST[..., None], np.nan, CAMERA.rays() * ranges[..., None])


def send(
    bag: Bag, at: float, xyz: NDArray, topic: str = "/points", big: bool = False, frame: str = LIDAR,
    **more: NDArray,
) -> None:  # fmt: skip
    """A PointCloud2 of points (H, W, 3) and other fields (H, W), with padding behind each point and row."""
    height, width = xyz.shape[:2]
    columns = {axis: xyz[..., i].astype(np.float32) for i, axis in enumerate("xyz")} | more
    order, offset, fields = ">" if big else "<", 4, []
    formats: dict[str, tuple[str, int]] = {}
    for name, values in columns.items():
        kind = values.dtype.str[1:]
        formats[name] = order + kind, offset
        field = {"name": name, "offset": offset, "datatype": KINDS[kind], "count": 1}
        fields.append(bag.message("sensor_msgs/msg/PointField", **field))
        offset += int(kind[1])
    kinds, places = zip(*formats.values(), strict=True)
    dtype = np.dtype({"names": [*formats], "formats": kinds, "offsets": places, "itemsize": offset + 3})
    rows = np.zeros((height, width), dtype)
    for name, values in columns.items():
        rows[name] = values
    data = np.pad(rows.view(np.uint8).reshape(height, -1), ((0, 0), (0, 5)))
    bag.send(
        topic, "sensor_msgs/msg/PointCloud2", at, frame, height=height, width=width, fields=fields,
        is_bigendian=big, point_step=dtype.itemsize, row_step=data.shape[1], data=data.reshape(-1),
    )  # fmt: skip


def drive(bag: Bag) -> None:
    """Odometry at 20 Hz from 0.9 s on, and where the lidar sits."""
    for i in range(12):
        stamp = 0.9 + 0.05 * i
        bag.odometry("/odom", stamp, "odom", BODY, pose(stamp))
    bag.tf("/tf_static", 0.0, BODY, LIDAR, T_BODY_LIDAR)


def sweeps(
    bag: Bag, first_s: float, last_s: float, posed: Sequence[float], at: Sequence[float] = (2.0, 3.0, 4.0),
    path: Callable[[float], Pose] = pose,
) -> None:  # fmt: skip
    """Clouds ``at`` these stamps, whose columns are measured from ``first_s`` after it to ``last_s``, with
    odometry of a body on a ``path`` at the times ``posed``."""
    seconds = np.tile(np.linspace(first_s, last_s, CAMERA.width, dtype=np.float32), (CAMERA.height, 1))
    for i, each in enumerate(at):
        send(bag, each, points(i), time=seconds)
    for each in posed:
        bag.odometry("/odom", each, "odom", BODY, path(each))
    bag.tf("/tf_static", 0.0, BODY, LIDAR, T_BODY_LIDAR)


POSED = np.arange(30, 94) / 20
"""Poses at 20 Hz from 1.5 s to 4.65 s, around all clouds."""

SWEEPS_WITHOUT_POSES: dict[str, tuple[float, float, NDArray[np.float64], list[str]]] = {
    "poses end at the last stamp": (0.0, 0.08, POSED[POSED <= 4.0], ["000000", "000001"]),
    "poses begin after the first point": (-0.08, 0.0, POSED[POSED >= 2.0], ["000001", "000002"]),
    "a hole in mid-sweep": (
        -0.3, 0.45, POSED[(POSED < 3.07) | (POSED > 3.38)], ["000000", "000002"]
    ),
    "a hole of just over 0.2 s in mid-sweep": (
        -0.3, 0.45, POSED[(POSED < 3.12) | (POSED > 3.33)], ["000000", "000002"]
    ),
}  # fmt: skip
"""When the first and last column are measured, the times of poses, and the clouds with poses through it."""


def stamp(scan: int) -> float:
    return 1.0 + 0.1 * scan


def write(folder: Path, kind: Kind = "mcap", **options: Any) -> Path:
    def scans(bag: Bag) -> None:
        for scan in range(SCANS):
            send(bag, stamp(scan), points(scan), **options)

    return write_bag(folder, scans, drive, kind=kind)
