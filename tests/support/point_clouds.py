"""Writes point clouds and recordings of lidar scans, for the tests of their readers."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from datasets_recordings import quaternion_of, row_of
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose, inverse, look_at

Points = NDArray[np.floating]


@dataclass
class Walk:
    """Scans of a lidar that moves: ``clouds`` in its own frame, (N, 3) float32 each, and T_world_lidar."""

    count: int = 3
    points: int = 40
    clouds: list[Points] = field(init=False)
    poses: list[Pose] = field(init=False)

    def __post_init__(self) -> None:
        random = np.random.default_rng(7)
        self.clouds = [random.uniform(-4, 4, (self.points, 3)).astype(np.float32) for _ in range(self.count)]
        self.poses = [look_at([0.3 * i, 0.1, 1.0], [3.0, 0.2 * i, 1.2]) for i in range(self.count)]


def in_order(points: Points) -> Points:
    """Points (..., 3) as (N, 3), in an order that does not depend on theirs."""
    flat = np.asarray(points, np.float64).reshape(-1, 3)
    return flat[np.lexsort(flat.T)]


def lzf(data: bytes) -> bytes:
    """Pack bytes as libLZF does: runs of up to 32, and repeats of three bytes and more of the 8192 before."""
    out, begin, at = bytearray(), 0, 0
    while at <= len(data):
        first = data.rfind(data[at : at + 3], max(0, at - 8192), at + 2) if at + 3 <= len(data) else -1
        if first < 0 and at < len(data):
            at += 1
            continue
        for run in (data[i : min(i + 32, at)] for i in range(begin, at, 32)):
            out += bytes([len(run) - 1]) + run
        if at == len(data):
            break
        length = 3
        while length < 264 and at + length < len(data) and data[first + length] == data[at + length]:
            length += 1
        distance, coded = at - first - 1, length - 2
        out += bytes(
            [min(coded, 7) << 5 | distance >> 8, *([coded - 7] if coded >= 7 else []), distance & 255]
        )
        begin = at = at + length
    return bytes(out)


def write_pcd(
    path: Path, points: Points, encoding: str = "binary", T_world_sensor: Pose | None = None
) -> Path:
    """A PCD with an intensity between y and z, and padding, as PCL has them."""
    viewpoint = "0 0 0 1 0 0 0"
    if T_world_sensor is not None:
        x, y, z, w = quaternion_of(T_world_sensor[:3, :3])
        viewpoint = " ".join(f"{v:.9g}" for v in (*T_world_sensor[:3, 3], w, x, y, z))
    head = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y intensity _ z\nSIZE 4 4 2 1 4\nTYPE F F U U F\n"
        "COUNT 1 1 1 3 1\n"
        f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT {viewpoint}\nPOINTS {len(points)}\nDATA {encoding}\n"
    ).encode()
    dtype = np.dtype([("x", "<f4"), ("y", "<f4"), ("intensity", "<u2"), ("_", "u1", (3,)), ("z", "<f4")])
    rows = np.zeros(len(points), dtype)
    rows["x"], rows["y"], rows["z"] = np.asarray(points, np.float32).T
    rows["intensity"] = 7
    if encoding == "ascii":
        body = "".join(f"{r['x']:.9g} {r['y']:.9g} 7 0 0 0 {r['z']:.9g}\n" for r in rows).encode()
    elif encoding == "binary":
        body = rows.tobytes()
    else:
        columns = b"".join(rows[name].tobytes() for name in dtype.names or ())
        packed = lzf(columns)
        body = struct.pack("<II", len(packed), len(columns)) + packed
    path.write_bytes(head + body)
    return path


def write_ply(path: Path, points: Points, encoding: str = "binary_little_endian", faces: int = 0) -> Path:
    """A PLY whose vertices have a ring before their coordinates."""
    head = (
        f"ply\nformat {encoding} 1.0\ncomment made by hand\nelement vertex {len(points)}\n"
        "property uchar ring\nproperty double x\nproperty double y\nproperty float z\n"
        f"element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    order = ">" if "big" in encoding else "<"
    rows = np.zeros(
        len(points), np.dtype([("ring", "u1"), ("x", f"{order}f8"), ("y", f"{order}f8"), ("z", f"{order}f4")])
    )
    rows["x"], rows["y"], rows["z"] = np.asarray(points, np.float64).T
    text = "".join(f"0 {r['x']:.9g} {r['y']:.9g} {r['z']:.9g}\n" for r in rows).encode()
    path.write_bytes(head + (text if encoding == "ascii" else rows.tobytes()))
    return path


def write_scans(folder: Path, walk: Walk, numbers: Sequence[int] = (0, 3, 12)) -> Path:
    """scan-NNN.npz in steps of 2 mm, and poses.npz."""
    folder.mkdir(exist_ok=True)
    for number, cloud in zip(numbers, walk.clouds, strict=True):
        np.savez(folder / f"scan-{number:03d}.npz", xyz_2mm=np.rint(cloud / 0.002).astype(np.int16))
    poses = {
        "scan": np.array(numbers),
        "T_world_lidar": np.array(walk.poses),
        "stamp_s": 5.0 + np.arange(len(numbers)),
    }
    np.savez(folder / "poses.npz", **poses)
    return folder


def write_velodyne(folder: Path, walk: Walk, T_camera_lidar: Pose, times: bool = True) -> Path:
    """A sequence of KITTI's odometry: its poses are those of the left camera, relative to the first."""
    (folder / "velodyne").mkdir(parents=True)
    for number, cloud in enumerate(walk.clouds):
        rows = np.column_stack([cloud, np.full(len(cloud), 0.5)]).astype("<f4")
        (folder / "velodyne" / f"{number:06d}.bin").write_bytes(rows.tobytes())
    T_cameras = [pose @ inverse(T_camera_lidar) for pose in walk.poses]
    (folder / "poses.txt").write_text("\n".join(row_of((inverse(T_cameras[0]) @ T)[:3]) for T in T_cameras))
    (folder / "calib.txt").write_text(f"P0: 7 0 6 0 0 7 1 0 0 0 1 0\nTr: {row_of(T_camera_lidar[:3])}\n")
    if times:
        (folder / "times.txt").write_text("".join(f"{0.25 * i:e}\n" for i in range(walk.count)))
    return folder


def las_head(number: int, packed: bool = False, /, **changes: int) -> bytes:
    """The bytes of a LAS or LAZ file of points of 28 bytes, which are zeros; of LAZ with one empty chunk.
    ``changes`` replace what the header, or ``chunks`` and ``chunk_points``, say."""
    values = {"header": 227, "begin": 227, "records": 0, "kind": 1, "point_bytes": 28, "count": number}
    values |= {"begin": 227 + 54 + 46, "records": 1, "kind": 0x81} if packed else {}
    values |= {name: value for name, value in changes.items() if name in values}
    head = b"LASF" + bytes(20) + bytes([1, 2]) + bytes(68)
    head += struct.pack("<HIIBHI", *values.values())
    head += bytes(227 - len(head))
    if not packed:
        return head + bytes(number * 28)
    packing = struct.pack("<2x16sHH32x", b"laszip encoded", 22204, 46)
    packing += struct.pack("<12xI30x", changes.get("chunk_points", 50_000))
    begin = len(head) + len(packing)
    table = changes.get("table", begin + 8 + 100)
    chunks = struct.pack("<II", 0, changes.get("chunks", 1))
    return head + packing + struct.pack("<q", table) + bytes(100) + chunks + bytes(20)


class LasFile:
    """A stand-in for an open file of laspy's and for its points."""

    def __init__(self, points_m: Points, times: NDArray[np.float64] | None = None) -> None:
        names = ["X", "Y", "Z", *([] if times is None else ["gps_time"])]
        self.point_format = SimpleNamespace(id=0 if times is None else 1, dimension_names=names)
        self.xyz, self.gps_time = points_m, times

    def __enter__(self) -> "LasFile":
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def read(self) -> "LasFile":
        return self


class RoomWalk(Walk):
    """Scans of a lidar that drives through a room of 6 x 5 x 2.6 m with a pillar, and turns."""

    def __post_init__(self) -> None:
        low, high = np.array([-3.0, -2.5, 0.0]), np.array([3.0, 2.5, 2.6])
        pillar = np.array([0.6, -0.4, -1.0]), np.array([1.4, 0.4, 4.0])
        elevation, azimuth = np.radians(np.arange(-33.0, 34, 6))[:, None], np.radians(np.arange(0.0, 360, 4))
        level = np.cos(elevation)
        rays = [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation) + 0 * azimuth]
        d = np.stack(rays, axis=-1).reshape(-1, 3) + 1e-9
        self.poses, self.clouds = [], []
        for share in np.linspace(0, 1, self.count):
            T = np.eye(4)
            yaw = 0.5 * np.sin(3 * share)
            T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
            T[:3, 3] = [-2.3 + 2.4 * share, 1.6 * np.cos(2.5 * share), 0.9]
            turned = d @ T[:3, :3].T
            walls = np.where(turned > 0, (high - T[:3, 3]) / turned, (low - T[:3, 3]) / turned).min(axis=1)
            a, b = ((face - T[:3, 3]) / turned for face in pillar)
            near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            range_m = np.where((near < far) & (near > 0), np.minimum(near, walls), walls)
            self.clouds.append((d * range_m[:, None]).astype(np.float32))
            self.poses.append(T)

    def in_world(self) -> list[Points]:
        """The clouds in the world's frame."""
        return [cloud @ T[:3, :3].T + T[:3, 3] for cloud, T in zip(self.clouds, self.poses, strict=True)]
