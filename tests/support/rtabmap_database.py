"""Writes databases with RTAB-Map's tables, as its published schema and serialisation have them."""

import sqlite3
import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import inputs_bags
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera

SCHEMA = """
CREATE TABLE Node (id INTEGER NOT NULL, map_id INTEGER NOT NULL, weight INTEGER, stamp FLOAT, pose BLOB,
    ground_truth_pose BLOB, velocity BLOB, label TEXT, gps BLOB, env_sensors BLOB, time_enter DATE,
    PRIMARY KEY (id));
CREATE TABLE Data (id INTEGER NOT NULL, image BLOB, depth BLOB, depth_confidence BLOB, calibration BLOB,
    scan BLOB, scan_info BLOB, user_data BLOB, time_enter DATE, PRIMARY KEY (id));
CREATE TABLE Link (from_id INTEGER NOT NULL, to_id INTEGER NOT NULL, type INTEGER NOT NULL,
    information_matrix BLOB NOT NULL, transform BLOB, user_data BLOB);
CREATE TABLE Admin (version TEXT, preview_image BLOB, opt_cloud BLOB, opt_ids BLOB, opt_poses BLOB,
    opt_last_localization BLOB, time_enter DATE);
"""

OPTICAL = np.array([[0.0, 0, 1, 0.1], [-1, 0, 0, 0.02], [0, -1, 0, 0.3], [0, 0, 0, 1]])
"""The camera on the robot, which looks along x: z forward, x right, y down."""


def transform(T: Pose | None) -> bytes:
    """12 floats, row by row; zeros for none."""
    rows = np.zeros((3, 4)) if T is None else T[:3]
    return struct.pack("<12f", *rows.reshape(-1))


def packed(values: NDArray) -> bytes:
    """A row of int32 (OpenCV's type 4) or float32 (5), packed."""
    kind = 4 if values.dtype == np.int32 else 5
    return zlib.compress(values.tobytes()) + struct.pack("<3i", 1, values.size, kind)


def calibration(
    camera: PinholeCamera,
    T_body_camera: Pose = OPTICAL,
    lens: Sequence[float] = (),
    kind: int = 0,
    rectified: bool = False,
) -> bytes:
    """As from version 0.18 on."""
    K = [camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1]
    P = [camera.fx, 0, camera.cx, 0, 0, camera.fy, camera.cy, 0, 0, 0, 1, 0] if rectified else []
    header = (0, 21, 4, kind, camera.width, camera.height, len(K), len(lens), 0, len(P), 12)
    return (
        struct.pack("<11i", *header)
        + struct.pack(f"<{9 + len(lens) + len(P)}d", *K, *lens, *P)
        + transform(T_body_camera)
    )


def plain_calibration(camera: PinholeCamera, T_body_camera: Pose = OPTICAL) -> bytes:
    """As before version 0.18."""
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
    return struct.pack("<6f", *numbers) + transform(T_body_camera)


def encoded(image: NDArray, ending: str = ".png") -> bytes:
    """An image file; float32 as four channels of bytes, three channels are RGB."""
    if image.dtype == np.float32:
        image = np.ascontiguousarray(image).view(np.uint8).reshape(*image.shape, 4)
    elif image.ndim == 3:
        image = image[..., ::-1]
    ok, data = cv2.imencode(ending, image)
    assert ok
    return data.tobytes()


def rvl(image: NDArray[np.uint16]) -> bytes:
    """RVL as the database holds it."""
    return b"DEPTHRVL" + inputs_bags.rvl(image)


class Database:
    """A database in the making."""

    def __init__(self, path: Path, version: str = "0.21.4") -> None:
        self.connection = sqlite3.connect(path)
        self.connection.executescript(SCHEMA)
        self.connection.execute("INSERT INTO Admin(version) VALUES(?)", (version,))

    def add(
        self,
        id: int,
        stamp: float,
        T_odom_body: Pose | None,
        depth: bytes | None,
        camera: bytes | None,
        color: bytes | None = None,
        session: int = 0,
    ) -> None:
        node = (id, session, 0, stamp, transform(T_odom_body))
        self.connection.execute("INSERT INTO Node(id, map_id, weight, stamp, pose) VALUES(?,?,?,?,?)", node)
        data = (id, color, depth, camera)
        self.connection.execute("INSERT INTO Data(id, image, depth, calibration) VALUES(?,?,?,?)", data)
        self.connection.commit()

    def optimise(self, poses: Mapping[int, Pose]) -> None:
        """Store the poses of an optimisation."""
        ids = packed(np.array(list(poses), np.int32))
        rows = np.concatenate([T[:3].reshape(-1) for T in poses.values()]).astype(np.float32)
        self.connection.execute("UPDATE Admin SET opt_ids = ?, opt_poses = ?", (ids, packed(rows)))
        self.connection.commit()

    def link(self, first: int, second: int, kind: int, T: Pose, information: NDArray) -> None:
        values = (first, second, kind, information.astype("<f8").tobytes(), transform(T))
        self.connection.execute(
            "INSERT INTO Link(from_id, to_id, type, information_matrix, transform) VALUES(?,?,?,?,?)", values
        )
        self.connection.commit()
