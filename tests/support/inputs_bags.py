"""Writes ROS 1 bags, ROS 2 bags and MCAP files with rosbags, for the tests of their reader."""

import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from datasets_recordings import CAMERA, quaternion_of
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from taichi_mrf.alignment.se3 import moved
from taichi_mrf.calibration.chessboard import camera_matrix
from taichi_mrf.datasets.base import Dataset
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.motion import GRAVITY

Kind = Literal["ros1", "sqlite", "mcap"]
Make = Callable[..., Path]
"""Writes a bag of parts, as the fixture ``make`` does; returns its path."""

EYE = np.eye(4)
START = 1_600_000_000.0
"""Seconds of the first stamps."""


def nanoseconds(stamp: float) -> int:
    """A stamp in seconds after START, in nanoseconds."""
    return round((START + stamp) * 1e9)


@cache
def types_of(kind: Kind) -> Typestore:
    """The types of messages of all bags of a kind: the library compiles code for each type of each store."""
    if kind != "ros1":
        return get_typestore(Stores.ROS2_HUMBLE)
    types = get_typestore(Stores.ROS1_NOETIC)  # which has no tf2
    text = "geometry_msgs/TransformStamped[] transforms"
    types.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
    return types


class Bag:
    """A bag in the making. Stamps are seconds after START; messages are recorded ``latency`` later, in ROS 1
    from the node ``node``."""

    latency = 0.05
    node = ""

    def __init__(self, kind: Kind, writer: Any) -> None:
        self.kind, self.writer, self.types = kind, writer, types_of(kind)
        self.connections: dict[str, Any] = {}

    def send(self, topic: str, name: str, stamp: float, frame: str | None = None, **fields: Any) -> None:
        """Record a message of a type such as sensor_msgs/msg/Image, with a header if it has a frame."""
        if frame is not None:
            fields["header"] = self.header(stamp, frame)
        self.record(topic, name, stamp, self.message(name, **fields))

    def record(self, topic: str, name: str, stamp: float, message: Any) -> None:
        key = topic + self.node
        if key not in self.connections:
            node = {"callerid": self.node} if self.node else {}
            self.connections[key] = self.writer.add_connection(topic, name, typestore=self.types, **node)
        serialize = self.types.serialize_ros1 if self.kind == "ros1" else self.types.serialize_cdr
        self.writer.write(self.connections[key], nanoseconds(stamp + self.latency), serialize(message, name))

    def message(self, name: str, /, **given: Any) -> Any:
        """A message of a type: dictionaries stand for messages in it, and fields that are left out are 0."""
        fields = {field: self._zero(kind) for field, kind in self.types.fielddefs[name][1]} | given
        for field, (node, kind) in self.types.fielddefs[name][1]:
            if node == Nodetype.NAME and isinstance(fields[field], dict):
                fields[field] = self.message(kind, **fields[field])
        return self.types.types[name](**fields)

    def _zero(self, kind: Any) -> Any:
        match kind:
            case (Nodetype.NAME, _):
                return {}
            case (Nodetype.BASE, (name, _)):
                return "" if name == "string" else 0
            case (_, (_, length)):
                return np.zeros(length)

    def header(self, stamp: float, frame: str) -> Any:
        seconds, rest = divmod(nanoseconds(stamp), 10**9)
        return self.message("std_msgs/msg/Header", stamp={"sec": seconds, "nanosec": rest}, frame_id=frame)

    def image(
        self, topic: str, stamp: float, frame: str, image: NDArray, encoding: str, big: bool = False
    ) -> None:
        """An Image whose rows are padded by four bytes."""
        height, width = image.shape[:2]
        data = image.astype(image.dtype.newbyteorder(">" if big else "<")).view(np.uint8).reshape(height, -1)
        padded = np.pad(data, ((0, 0), (0, 4)))
        self.send(
            topic, "sensor_msgs/msg/Image", stamp, frame, height=height, width=width, encoding=encoding,
            is_bigendian=int(big), step=padded.shape[1], data=padded.reshape(-1),
        )  # fmt: skip

    def compressed(self, topic: str, stamp: float, frame: str, image: NDArray, words: str) -> None:
        """A CompressedImage of a file; ``words`` is its format. Three channels are RGB."""
        suffix = ".jpg" if "jpeg" in words else ".png"
        data = cv2.imencode(suffix, image[..., ::-1] if image.ndim == 3 else image)[1].reshape(-1)
        self.send(topic, "sensor_msgs/msg/CompressedImage", stamp, frame, format=words, data=data)

    def compressed_depth(
        self, topic: str, stamp: float, frame: str, image: NDArray, kind: str = "16UC1",
        packing: str = "compressedDepth png",
    ) -> None:  # fmt: skip
        """A CompressedImage as image_transport's compressedDepth plugin writes it; 32FC1 from metres."""
        scale, offset = 0.0, 0.0
        if kind == "32FC1":  # depth_quantization 100, depth_max 10 m: the plugin's own defaults
            scale, offset = 100.0 * 101.0, 1 - 100.0 * 101.0 / 10.0
            with np.errstate(divide="ignore"):
                image = np.where(image > 0, np.rint(scale / image + offset), 0).astype(np.uint16)
        packed = rvl(image) if "rvl" in packing else cv2.imencode(".png", image)[1].tobytes()
        data = np.frombuffer(struct.pack("<iff", 0, scale, offset) + packed, np.uint8)
        words = f"{kind}; {packing}"
        self.send(topic, "sensor_msgs/msg/CompressedImage", stamp, frame, format=words, data=data)

    def camera_info(
        self, topic: str, frame: str, camera: PinholeCamera, distortion: tuple[float, ...] = (),
        model: str = "plumb_bob", projection: PinholeCamera | None = None, stamp: float = 0.0,
        binning: tuple[int, int] = (0, 0), part: tuple[int, int, int, int] = (0, 0, 0, 0),
    ) -> None:  # fmt: skip
        """A CameraInfo; ``projection`` is that of the rectified images, ``part`` the region of interest as x,
        y, width and height."""
        roi = dict(zip(("x_offset", "y_offset", "width", "height"), part, strict=True))
        P = np.column_stack([camera_matrix(projection or camera), np.zeros(3)])
        arrays = {"d": distortion or [0.0] * 5, "k": camera_matrix(camera), "r": np.eye(3), "p": P}
        self.send(
            topic, "sensor_msgs/msg/CameraInfo", stamp, frame, roi=roi, height=camera.height,
            width=camera.width, distortion_model=model, binning_x=binning[0], binning_y=binning[1],
            **{name.upper() if self.kind == "ros1" else name: np.ravel(v) for name, v in arrays.items()},
        )  # fmt: skip

    def odometry(self, topic: str, stamp: float, frame: str, child: str, T: Pose) -> None:
        pose = {"pose": pose_of(T)}
        self.send(topic, "nav_msgs/msg/Odometry", stamp, frame, child_frame_id=child, pose=pose)

    def pose_stamped(self, topic: str, stamp: float, frame: str, T: Pose) -> None:
        self.send(topic, "geometry_msgs/msg/PoseStamped", stamp, frame, pose=pose_of(T))

    def path(self, topic: str, stamp: float, frame: str, poses: Mapping[float, Pose]) -> None:
        """All poses of a body so far, by their stamps."""
        name = "geometry_msgs/msg/PoseStamped"
        each = [self.message(name, header=self.header(s, frame), pose=pose_of(T)) for s, T in poses.items()]
        self.send(topic, "nav_msgs/msg/Path", stamp, frame, poses=each)

    def tf(self, topic: str, stamp: float, parent: str, child: str, T: Pose) -> None:
        """A transform; of a matrix of zeros, with a quaternion of zeros."""
        name, header = "geometry_msgs/msg/TransformStamped", self.header(stamp, parent)
        turn = quaternion_of(T[:3, :3]) if T[:3, :3].any() else np.zeros(4)
        transform = {"translation": axes("xyz", T[:3, 3]), "rotation": axes("xyzw", turn)}
        each = self.message(name, header=header, child_frame_id=child, transform=transform)
        self.send(topic, "tf2_msgs/msg/TFMessage", stamp, transforms=[each])


def axes(names: str, values: Iterable[float]) -> dict[str, float]:
    """The fields of a vector or of a quaternion."""
    return dict(zip(names, values, strict=True))


def pose_of(T: Pose) -> dict[str, dict[str, float]]:
    """The fields of a Pose."""
    return {"position": axes("xyz", T[:3, 3]), "orientation": axes("xyzw", quaternion_of(T[:3, :3]))}


def rvl(image: NDArray[np.uint16]) -> bytes:
    """An image in RVL, number by number, as its authors' code writes it."""
    nibbles: list[int] = []

    def write(value: int) -> None:
        while True:
            value, low = value >> 3, value & 7
            nibbles.append(low | 8 * bool(value))
            if not value:
                return

    pixels, at, previous = image.ravel().tolist(), 0, 0
    while at < len(pixels):
        for is_zero in (True, False):
            count = next((k for k, p in enumerate(pixels[at:]) if (p == 0) != is_zero), len(pixels) - at)
            write(count)
            for pixel in () if is_zero else pixels[at : at + count]:
                step, previous = pixel - previous, pixel
                write(2 * step if step >= 0 else -2 * step - 1)
            at += count
    nibbles += [0] * (-len(nibbles) % 8)
    words = [int("".join(f"{n:x}" for n in nibbles[i : i + 8]), 16) for i in range(0, len(nibbles), 8)]
    return struct.pack(f"<II{len(words)}I", image.shape[1], image.shape[0], *words)


@contextmanager
def writing(path: Path, kind: Kind) -> Iterator[Bag]:
    """A new bag: a .bag file for ros1, else the folder of a ROS 2 bag."""
    if kind == "ros1":
        writer: Any = Writer1(path)
        writer.set_compression(Writer1.CompressionFormat.LZ4)
        writer.chunk_threshold = 1 << 14
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
    with writer:
        yield Bag(kind, writer)


def write_bag(folder: Path, *parts: Callable[[Bag], object], kind: Kind = "ros1", name: str = "walk") -> Path:
    """A bag of parts; returns its path. A second one of the same name has a number behind it."""
    suffix = ".bag" if kind == "ros1" else ""
    path = folder / (name + suffix)
    if path.exists():
        path = folder / f"{name}{len(list(folder.iterdir()))}{suffix}"
    with writing(path, kind) as bag:
        for part in parts:
            part(bag)
    return path


COUNT = 5
FRAME = "camera_depth_optical_frame"
BODY = "base_link"
TOPIC, INFO = "/camera/depth/image_raw", "/camera/depth/camera_info"
T_body_camera = look_at([0.1, 0.2, 0.3], [1.0, 0.0, 0.0])


def steps(i: int) -> np.ndarray:
    image = np.random.default_rng(i).integers(400, 9000, (12, 16)).astype(np.uint16)
    image[0, 0] = 0
    return image


def metres(i: int) -> np.ndarray:
    return steps(i).astype(np.float32) / 1000


T_LINK_CAMERA = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
EYES = [look_at([0.15 * i - 0.8, 0.3, 0.1], [0.15 * i + 0.2, 1.1, -0.1]) for i in range(COUNT)]


def seen(i: int) -> np.ndarray:
    """Millimetres of the walls of a box, 5 x 4 x 3 m, from inside."""
    ways = CAMERA.rays() @ EYES[i][:3, :3].T
    walls = (np.sign(ways) * [2.5, 2.0, 1.5] - EYES[i][:3, 3]) / ways
    return np.rint(walls.min(axis=-1) * 1000).astype(np.uint16)


def world_body(i: float) -> Pose:
    return look_at([0.1 * i, 0.2, 0.0], [3.0, 0.1 * i, 0.2])


def stamp(i: float) -> float:
    return 1.0 + 0.1 * i


def images(
    bag: Bag, topic: str = TOPIC, info: bool = True, frame: str = FRAME,
    image: Callable[[int], NDArray] = steps, encoding: str = "16UC1", late: float = 0.0,
    numbers: Sequence[int] = range(COUNT),
) -> None:  # fmt: skip
    """Images, with the CameraInfo that goes with their topic."""
    if info:
        bag.camera_info(topic.rpartition("/")[0] + "/camera_info", frame, CAMERA)
    for i in numbers:
        bag.image(topic, stamp(i) + late, frame, image(i), encoding)


def odometry(
    bag: Bag, topic: str = "/odom", child: str = BODY, T: Pose = EYE, late: float = 0.0,
    numbers: Sequence[float] = range(COUNT),
) -> None:  # fmt: skip
    """The path of a body that starts at T, as Odometry."""
    for i in numbers:
        bag.odometry(topic, stamp(i) + late, "odom", child, T @ world_body(i))


def moving_tf(
    bag: Bag, parent: str = "odom", T: Pose = EYE, child: str = BODY, topic: str = "/tf", late: float = 0.0,
    numbers: Sequence[float] = range(COUNT),
) -> None:  # fmt: skip
    """The path of a body that starts at T, as transforms."""
    for i in numbers:
        bag.tf(topic, stamp(i) + late, parent, child, T @ world_body(i))


def stamped_poses(bag: Bag, topic: str, frame: str = "map", T_body_own: Pose = EYE) -> None:
    """The path of something on the body, as PoseStamped, which names no body."""
    for i in range(COUNT):
        bag.pose_stamped(topic, stamp(i), frame, world_body(i) @ T_body_own)


def mounted(
    bag: Bag, parent: str = BODY, child: str = FRAME, T: Pose = T_body_camera, topic: str = "/tf_static"
) -> None:
    """A transform that is fixed: where the camera is on the body."""
    bag.tf(topic, 0.0, parent, child, T)


def plain(bag: Bag) -> None:
    images(bag)
    odometry(bag)
    mounted(bag)


BETWEEN = np.arange(-0.5, COUNT).tolist()
"""Poses half a step before and after each image."""

WAYS: dict[str, Callable[[Bag], object]] = {
    "odometry": partial(odometry, numbers=BETWEEN),
    "tf": partial(moving_tf, numbers=BETWEEN),
}
IMAGES: dict[str, Callable[[Bag], object]] = {
    "16UC1": images,
    "32FC1": partial(images, image=metres, encoding="32FC1"),
}

CONFIDENCE = "/camera/confidence/image_rect_raw"


def grades(i: int) -> np.ndarray:
    image = np.random.default_rng(200 + i).integers(0, 16, CAMERA.shape).astype(np.uint8)
    image[0, :3] = 0, 1, 15
    return image


def confidence(
    bag: Bag, topic: str = CONFIDENCE, shift: int = 4, encoding: str = "mono8", skip: int | None = None
) -> None:
    """Images of grades of 4 bits."""
    for i in range(COUNT):
        if i != skip:
            bag.image(topic, stamp(i) + 0.01, FRAME, grades(i) << shift, encoding)


IMU, LINK = "/imu/data", "imu_link"
T_camera_imu = moved(np.eye(4), [0.02, 0.0, 0.01, 1.2, -0.9, 0.4])
RATE = np.array([0.3, -0.8, 0.5])
"""Radians a second in the camera frame."""

TILT = moved(np.eye(4), [0, 0, 0, 0.2, 0.0, 0.3])[:3, :3]
UP = TILT.T @ [0.0, -1.0, 0.0]


def imu(
    bag: Bag, topic: str = IMU, tf: bool = True, covariance: float = 0.0, shake: float = 0.0,
    seconds: float = 0.8, latency: float = 0.05,
) -> None:  # fmt: skip
    """An IMU beside a camera that turns at RATE and does not move, from 0.8 s on at 200 Hz."""
    bag.latency = latency
    if tf:
        bag.tf("/tf_static", 0.0, FRAME, LINK, T_camera_imu)
    to_imu, random = T_camera_imu[:3, :3].T, np.random.default_rng(0)
    unknown = np.zeros(9)
    unknown[0] = covariance
    for k in range(round(200 * seconds)):
        at = 0.8 + k / 200
        force = to_imu @ (GRAVITY * UP) + random.normal(0, shake + 1e-6, 3)
        bag.send(
            topic, "sensor_msgs/msg/Imu", at, LINK, orientation={"w": 1.0},
            angular_velocity=axes("xyz", to_imu @ RATE), angular_velocity_covariance=unknown,
            linear_acceleration=axes("xyz", force),
        )  # fmt: skip
    bag.latency = Bag.latency


def check_poses(
    dataset: Dataset, T_fixed: Pose = EYE, mount: Pose = T_body_camera, count: int = COUNT, atol: float = 1e-9
) -> None:
    """Its frames are at the body's poses, seen from a fixed frame, and mounted so."""
    assert len(dataset) == count
    for i, frame in enumerate(dataset):
        np.testing.assert_allclose(frame.T_world_camera, T_fixed @ world_body(i) @ mount, atol=atol)


def data_file(path: Path) -> Path:
    """The file of a bag that holds its messages."""
    return path if path.is_file() else next(path.glob("*.[dm][bc]*"))
