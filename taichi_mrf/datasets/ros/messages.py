"""Decoding the messages of depth cameras and trackers: images to metres, poses.

ROS calls depth images by their encodings: 16UC1 (and mono16, as RealSense writes it) are millimetres, 32FC1
metres (REP 118). A CompressedImage of the transport ``compressedDepth`` is a PNG or RVL behind 12 bytes: an
integer and two floats, with which a 32FC1 image's inverse depths were made whole numbers.
"""

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.images import (
    PNG_SIGNATURE,
    decode_16_bit,
    decode_color,
    decode_rvl,
    measured,
    share_of_largest,
    without_filling,
)
from taichi_mrf.datasets.trajectories import pose_from_quaternion
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose

IMAGE = "sensor_msgs/msg/Image"
IMAGES = (IMAGE, "sensor_msgs/msg/CompressedImage")
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
OF_SENSORS = (*IMAGES, POINT_CLOUD)
IMU = "sensor_msgs/msg/Imu"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORM_STAMPED = "geometry_msgs/msg/TransformStamped"
PATH = "nav_msgs/msg/Path"
"""All poses of a body so far."""

POSES = (ODOMETRY, POSE_STAMPED, POSE_WITH_COVARIANCE, TRANSFORM_STAMPED)
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

SIGNED = "16SC1"
MILLIMETRES = ("16UC1", "mono16", SIGNED)
METRES = "32FC1"
PNG = "png"
"""The format of a CompressedImage that is a plain 16-bit PNG file: millimetres."""

ENCODINGS = f"{MILLIMETRES[0]} (millimetres), {METRES} (metres), or compressedDepth of the two as PNG or RVL"
STEPS_PER_METRE = 1000.0

GREY = ("mono8", "8UC1")
"""Encodings of grey images of 8 bits."""

_COLOR_CHANNELS = {"rgb8": [0, 1, 2], "rgba8": [0, 1, 2], "bgr8": [2, 1, 0], "bgra8": [2, 1, 0]}
"""Places of red, green and blue in the pixels of an encoding."""

_COMPRESSED_COLOR = ("jpeg", "jpg", "png", "rgb8;", "bgr8;")
"""Beginnings of the formats of CompressedImages in colour."""

_HEADER_BYTES = 12
_RVL = "rvl"
_PACKINGS = ("compressedDepth", "compressed", "png", _RVL)
"""The words of a CompressedImage's format behind the encoding of its pixels."""


def encoding(message: Any) -> str:
    """The encoding of an Image or a CompressedImage, such as ``16UC1; compressedDepth``."""
    return str(message.format if hasattr(message, "format") else message.encoding)


def check_depth(encoding: str) -> None:
    """Raises DatasetError, which does not name the topic, if an image of this encoding is not depth."""
    kind, _, packing = map(str.strip, encoding.partition(";"))
    if kind not in (*MILLIMETRES, METRES, PNG):
        raise DatasetError(f"encoding {encoding!r} is not depth; supported are {ENCODINGS}")
    if packing.startswith(("jpeg", "jpg")):
        raise DatasetError(f"encoding {encoding!r} is not depth: JPEG keeps only 8 bits, with losses")
    if not set(packing.split()) <= {*_PACKINGS, *MILLIMETRES, METRES}:
        raise DatasetError(
            f"encoding {encoding!r} is depth in an unsupported packing; supported are {ENCODINGS}"
        )


def may_be_depth(encoding: str) -> bool:
    """True if an image of this encoding can be read as depth."""
    try:
        check_depth(encoding)
    except DatasetError:
        return False
    return True


def is_depth(encoding: str, topic: str) -> bool:
    """True if images of this encoding on a topic are depth. mono16 and plain PNG count if the topic's name
    contains depth, because infrared images are so too."""
    kind = encoding.partition(";")[0].strip()
    if not may_be_depth(encoding):
        return False
    return kind in (MILLIMETRES[0], SIGNED, METRES) or "depth" in topic.lower()


def depth_image(message: Any, depth_scale: float | None) -> NDArray[np.float32]:
    """Axial depth in metres, (H, W) float32, of an Image or a CompressedImage; 0 means no measurement.
    ``depth_scale`` (steps per metre) takes the place of the encoding's own. Raises DatasetError, which does
    not name the topic, for a wrong encoding and for data that do not fit it."""
    values, steps = _compressed(message) if hasattr(message, "format") else _raw(message)
    values = measured(values) if values.dtype.kind in "ui" else values
    depth_m = values.astype(np.float32) / np.float32(depth_scale or steps)
    return without_filling(depth_m)


def share_without(message: Any) -> float:
    """The share of the pixels of an Image that have the largest whole number, which is no measurement."""
    raw = None if hasattr(message, "format") else _raw(message)[0]
    return 0.0 if raw is None else share_of_largest(raw)


def _raw(message: Any) -> tuple[NDArray, float]:
    """The values of an Image, (H, W), and how many of their steps are a metre."""
    kinds = dict.fromkeys(MILLIMETRES, ("u2", STEPS_PER_METRE))
    kinds |= {METRES: ("f4", 1.0), SIGNED: ("i2", STEPS_PER_METRE)}
    if message.encoding not in kinds:
        raise DatasetError(f"encoding {message.encoding!r} is not depth; supported are {ENCODINGS}")
    kind, steps = kinds[message.encoding]
    dtype = np.dtype(f"{'>' if message.is_bigendian else '<'}{kind}")
    return _rows(message, dtype.itemsize).view(dtype), steps


def _rows(message: Any, pixel_bytes: int) -> NDArray[np.uint8]:
    """The bytes of an Image, (H, W * pixel_bytes), without what pads its rows. Raises DatasetError if they
    are too few."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.asarray(message.data, np.uint8)
    if step < width * pixel_bytes or len(data) < height * step:
        raise DatasetError(
            f"{len(data)} bytes are too few for {width} x {height} pixels of {message.encoding}"
        )
    rows = data[: height * step].reshape(height, step)[:, : width * pixel_bytes]
    return np.ascontiguousarray(rows)


def _compressed(message: Any) -> tuple[NDArray, float]:
    """The values of a CompressedImage, (H, W), and how many of their steps are a metre."""
    data = bytes(message.data)
    check_depth(message.format)
    kind, _, packing = map(str.strip, message.format.partition(";"))
    if _RVL in packing.split():
        start = _HEADER_BYTES
        steps = measured(decode_rvl(data[start:]))
    else:
        start = data.find(PNG_SIGNATURE, 0, _HEADER_BYTES + len(PNG_SIGNATURE))
        if start not in (0, _HEADER_BYTES):
            raise DatasetError(f"format {message.format!r} is not depth as PNG; supported are {ENCODINGS}")
        steps = decode_16_bit(data[start:], message.format)
    if kind != METRES:
        return steps, STEPS_PER_METRE
    if start == 0:
        raise DatasetError(f"format {message.format!r} lacks the header with the scale of its inverse depths")
    _, scale, offset = struct.unpack_from("<iff", data)
    inverse = steps.astype(np.float32) - np.float32(offset)
    depth_m = np.zeros(steps.shape, np.float32)
    np.divide(np.float32(scale), inverse, out=depth_m, where=(steps > 0) & (inverse > 0))
    return depth_m, 1.0


def is_color(encoding: str) -> bool:
    """True if an image of this encoding is a colour image."""
    compressed = encoding.startswith(_COMPRESSED_COLOR) or "; jpeg compressed" in encoding
    return encoding in _COLOR_CHANNELS or (compressed and "compressedDepth" not in encoding)


def color_image(message: Any) -> NDArray[np.uint8]:
    """An (H, W, 3) RGB image of an Image or a CompressedImage. Raises DatasetError, which does not name the
    topic, for data that do not fit its encoding."""
    if hasattr(message, "format"):
        return decode_color(bytes(message.data), message.format)
    if message.encoding not in _COLOR_CHANNELS:
        raise DatasetError(f"encoding {message.encoding!r} is not colour")
    order = _COLOR_CHANNELS[message.encoding]
    pixel_bytes = 4 if "a" in message.encoding else 3
    pixels = _rows(message, pixel_bytes).reshape(int(message.height), int(message.width), pixel_bytes)
    return np.ascontiguousarray(pixels[..., order])


def grey_image(message: Any) -> NDArray[np.uint8]:
    """The (H, W) grey values of an Image of 8 bits. Raises DatasetError, which does not name the topic, for
    another encoding and for data that do not fit it."""
    if encoding(message) not in GREY:
        raise DatasetError(f"encoding {encoding(message)!r} is not grey of 8 bits ({' or '.join(GREY)})")
    return _rows(message, 1)


def pose_of(message: Any) -> Pose:
    """T_parent_child, (4, 4), of a message of a type of POSES. Raises KeyframeError if it is no pose."""
    if hasattr(message, "transform"):
        return _pose(message.transform.translation, message.transform.rotation)
    pose = message.pose
    while hasattr(pose, "pose"):  # inside a PoseWithCovariance
        pose = pose.pose
    return _pose(pose.position, pose.orientation)


def _pose(position: Any, orientation: Any) -> Pose:
    q = orientation
    return pose_from_quaternion(
        np.array([position.x, position.y, position.z, q.x, q.y, q.z, q.w], np.float64)
    )


def frame_name(text: str) -> str:
    """A frame's name without the slash that old recordings put before it."""
    return text.lstrip("/")


def header_ns(header: Any) -> int:
    """The stamp of a std_msgs/Header in nanoseconds."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
