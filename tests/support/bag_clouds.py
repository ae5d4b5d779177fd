"""Writes bags with the point clouds of a lidar on a robot that drives and turns."""

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
        fields.append(
            bag.message("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=KINDS[kind], count=1)
        )
        offset += int(kind[1])
    dtype = np.dtype(
        {
            "names": list(formats),
            "formats": [kind for kind, _ in formats.values()],
            "offsets": [place for _, place in formats.values()],
            "itemsize": offset + 3,
        }
    )
    rows = np.zeros((height, width), dtype)
    for name, values in columns.items():
        rows[name] = values
    data = np.pad(rows.view(np.uint8).reshape(height, -1), ((0, 0), (0, 5)))
    bag.send(
        topic,
        "sensor_msgs/msg/PointCloud2",
        at,
        header=bag.header(at, frame),
        height=height,
        width=width,
        fields=fields,
        is_bigendian=big,
        point_step=dtype.itemsize,
        row_step=data.shape[1],
        data=data.reshape(-1),
        is_dense=False,
    )


def drive(bag: Bag) -> None:
    """Odometry at 20 Hz from 0.9 s on, and where the lidar sits."""
    for i in range(12):
        stamp = 0.9 + 0.05 * i
        bag.odometry("/odom", stamp, "odom", BODY, pose(stamp))
    bag.tf("/tf_static", 0.0, BODY, LIDAR, T_BODY_LIDAR)


def stamp(scan: int) -> float:
    return 1.0 + 0.1 * scan


def write(folder: Path, kind: Kind = "mcap", **options: Any) -> Path:
    def scans(bag: Bag) -> None:
        for scan in range(SCANS):
            send(bag, stamp(scan), points(scan), **options)

    return write_bag(folder, scans, drive, kind=kind)
