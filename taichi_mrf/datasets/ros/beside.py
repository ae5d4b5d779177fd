"""Streams of a bag beside depth: colour images, the confidence of depth, and an IMU.

Colour images are registered to depth, or of a camera of their own whose place tf gives. Confidence are the
grades of a RealSense L515: realsense-ros publishes them as mono8, ``confidence/image_rect_raw`` beside
``depth/image_rect_raw``: 4 bits for each pixel of depth. librealsense puts them into the upper half of a
byte, 0, 16, ... to 240; 0 to 15 are read too. The gyroscope of an IMU tells how the camera turns, and its
accelerometer which way is up at the beginning.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.color_camera import ColorCamera, without_black
from taichi_mrf.datasets.confidence import L515
from taichi_mrf.datasets.formats.tum_rgbd import associate
from taichi_mrf.datasets.ros import messages
from taichi_mrf.datasets.ros.sensor import BagSensor, camera_of
from taichi_mrf.datasets.ros.sources import Entry, TopicSource
from taichi_mrf.datasets.ros.topics import DepthTopic, choose, described, image_topics, topics_of
from taichi_mrf.errors import DatasetError, naming
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.motion import AccelerationSamples, GyroSamples, upwards_at

PART = "confidence"
"""The part of a topic's name where that of depth has ``depth``."""

_BITS = 4


@dataclass(frozen=True)
class Beside:
    """The images of one topic: ``entries`` has the one that belongs to each depth image, or None. ``decode``
    brings a message to the pixels of a depth image (H, W) of a camera."""

    reader: TopicSource
    topic: str
    entries: Sequence[Entry | None]
    decode: Callable[[Any, NDArray[np.float32], PinholeCamera], NDArray[Any]]

    def read(self, index: int, depth_m: NDArray[np.float32], camera: PinholeCamera) -> NDArray[Any] | None:
        """Colours or sigmas of a depth image's pixels, None if it has none. Raises DatasetError, which names
        file and topic."""
        entry = self.entries[index]
        return None if entry is None else self.of(self.reader.read(self.topic, entry), depth_m, camera)

    def of(self, message: Any, depth_m: NDArray[np.float32], camera: PinholeCamera) -> NDArray[Any]:
        """Colours or sigmas from a message of the topic."""
        with naming(f"{self.reader.path}: topic {self.topic}"):
            return self.decode(message, depth_m, camera)


def find_confidence(
    sensor: BagSensor,
    wanted: str,
    depth: DepthTopic,
    camera: PinholeCamera,
    stamps: Sequence[float],
    gap: float | None,
) -> tuple[Beside | None, list[str]]:
    """The confidence of depth images of some stamps, and notes for the user: which topic is used, how many
    depth images have none, and why none is used although there is one. ``wanted`` is the topic, if the user
    named it. Raises DatasetError if that is none of the depth image's confidence."""
    reader = sensor.reader
    beside = [name for name in topics_of(reader, *messages.IMAGES) if is_beside(name, depth.name)]
    if wanted:
        name = choose(reader, "confidence", wanted, beside, "topics of confidence")
        problem = _misfit(reader, name, camera)
        if problem:
            raise DatasetError(f"{reader.path}: topic {name}: {problem}")
    else:
        problems = {name: _misfit(reader, name, camera) for name in beside}
        fitting = [name for name, problem in problems.items() if not problem]
        if len(fitting) > 1:
            return None, [f"confidence: choose one with ?confidence={' or ?confidence='.join(fitting)}"]
        if not fitting:
            return None, [f"confidence: {name} is not used: {problem}" for name, problem in problems.items()]
        name = fitting[0]
    if len(sensor.frames) > 1:
        return None, [f"confidence: {name} is not used: depth is of several sensors"]
    entries, alone = paired(sensor, name, stamps, gap)
    return Beside(reader, name, entries, _sigma_m), [f"confidence: {name}, as a sigma for each pixel{alone}"]


def is_beside(name: str, depth: str) -> bool:
    """True if a topic's name is that of one of depth up to ``confidence`` in the place of ``depth``."""
    parts, of_depth = name.split("/"), depth.split("/")
    if PART not in parts or "depth" not in of_depth:
        return False
    return parts[: parts.index(PART)] == of_depth[: of_depth.index("depth")]


def _misfit(reader: TopicSource, name: str, camera: PinholeCamera) -> str | None:
    """Reason why a topic's images cannot be the confidence of a camera's, None if they can. Raises
    DatasetError if it holds no images."""
    described(reader, name)
    try:
        height, width = messages.grey_image(reader.first(name)).shape
    except DatasetError as error:
        return str(error)
    if (height, width) == camera.shape:
        return None
    return f"its images have {width} x {height} pixels, those of depth {camera.width} x {camera.height}"


def _sigma_m(message: Any, depth_m: NDArray[np.float32], camera: PinholeCamera) -> NDArray[np.float32]:
    """The sigma of a depth image's pixels, (H, W) metres, by a message with their grades."""
    return L515.sigma_m(_grades(messages.grey_image(message)), depth_m, camera)


def _grades(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Grades from 0 to 15. Raises DatasetError if the image holds anything else."""
    if image.max(initial=0) < 1 << _BITS:
        return image
    if (image % (1 << _BITS)).any():
        raise DatasetError(
            f"has values up to {image.max()}, which are not 4-bit grades (0 to 15, or 0, 16, ... to 240)"
        )
    return np.right_shift(image, _BITS, dtype=np.uint8)


NONE = "none"
"""The value of the option ``imu`` for a camera that is tracked without."""

ImuRow = tuple[float, ...]
"""A measurement of an IMU in its own frame: stamp in seconds, angular rates, accelerations (7 numbers)."""


@dataclass(frozen=True)
class BagImu:
    """The IMU of a topic, mounted at ``T_optical_imu`` (4, 4); ``rows`` are what it measured."""

    topic: str
    T_optical_imu: Pose
    rows: Sequence[ImuRow]

    def samples(
        self, rows: Iterable[ImuRow], later_s: float = 0.0
    ) -> tuple[GyroSamples, AccelerationSamples | None]:
        """The rates and accelerations of the camera by some rows, whose stamps count ``later_s`` later."""
        table = np.array(list(rows)).reshape(-1, 7)
        stamps, first = np.unique(table[:, 0] + later_s, return_index=True)
        R_optical_imu = self.T_optical_imu[:3, :3]
        rates, forces = (table[first, i : i + 3] @ R_optical_imu.T for i in (1, 4))
        valid, known = (np.isfinite(each).all(axis=1) for each in (rates, forces))
        felt = AccelerationSamples(stamps[known], forces[known], self.T_optical_imu[:3, 3])
        return GyroSamples(stamps[valid], rates[valid]), felt if known.any() else None


def imu_row(entry: Entry, message: Any) -> ImuRow:
    """The measurement in an IMU message; accelerations are nan if it has none."""
    rate, force = message.angular_velocity, message.linear_acceleration
    felt = (force.x, force.y, force.z) if _measures(message, "linear_acceleration") else (np.nan,) * 3
    return (entry.stamp, rate.x, rate.y, rate.z, *felt)


def find_imu(sensor: BagSensor, wanted: str, first_s: float) -> tuple[BagImu | None, list[str]]:
    """The IMU beside a camera whose images begin at ``first_s``, and notes for the user: which topic is used,
    or why none is although there are some. ``wanted`` is the topic, if the user named it. Raises DatasetError
    if that has no angular rates."""
    if wanted == NONE:
        return None, []
    reader = sensor.reader
    found = topics_of(reader, messages.IMU)
    topics = [name for name in found if _measures(reader.first(name), "angular_velocity")]
    if not wanted and len(topics) != 1:
        return None, [f"imu: choose one with ?imu={' or ?imu='.join(topics)}"] if topics else []
    name = choose(reader, "imu", wanted, topics, "topics of an IMU's angular rates")
    if name not in topics:
        raise DatasetError(f"{reader.path}: topic {name} has no angular rates ({messages.IMU})")
    found_rows = {entry: imu_row(entry, message) for entry, message in reader.messages(name)}
    frame = next((entry.frame for entry in found_rows if entry.frame), "")
    optical = sensor.frame
    T_optical_imu = np.eye(4) if frame == optical != "" else sensor.tree().mounted(optical, frame)
    if T_optical_imu is None:
        return None, [f"imu: {name} is not used: tf has no fixed transform from {frame!r} to {optical!r}"]
    imu = BagImu(name, T_optical_imu, [found_rows[entry] for entry in sensor.run.of(list(found_rows))])
    up = upwards_at(imu.samples(imu.rows)[1], first_s)
    level = "the first image is level by it" if up is not None else "it does not say which way is up"
    return imu, [f"imu: {name} measures turns; {level}"]


def _measures(message: Any | None, what: str) -> bool:
    """True if a message has angular rates or accelerations: their first covariance is -1 if it has none."""
    return message is not None and getattr(message, f"{what}_covariance")[0] != -1


COLOR_GAP = 0.035
"""Default of the largest time in seconds between a depth image and its colour image: a frame at 30 Hz."""


def _colors(
    of: ColorCamera | None,
    distortion: tuple[float, ...],
    message: Any,
    depth_m: NDArray[np.float32],
    depth_camera: PinholeCamera,
) -> NDArray[np.uint8]:
    """The colours (H, W, 3) of a depth image's pixels. The camera ``of`` them, whose OpenCV coefficients are
    the ``distortion``, is None if they are registered to depth. Raises DatasetError for another size."""
    color = messages.color_image(message)
    own = depth_camera if of is None else of.camera
    if color.shape[:2] != own.shape:
        raise DatasetError(
            f"the image has {color.shape[1]} x {color.shape[0]} pixels, its camera {own.width} x {own.height}"
        )
    if of is None:
        return without_black(color)
    if any(distortion):
        K = np.array([[own.fx, 0, own.cx], [0, own.fy, own.cy], [0, 0, 1.0]])
        color = cv2.undistort(color, K, np.array(distortion)).astype(np.uint8)
    return of.registered(color, depth_m, depth_camera)


def find_colors(
    sensor: BagSensor,
    wanted: str,
    depth: DepthTopic,
    camera: PinholeCamera,
    stamps: Sequence[float],
    gap: float | None,
) -> tuple[Beside | None, list[str]]:
    """The colours for depth images of some stamps, and notes for the user: which images are used, how many
    depth images have none, and why none are used although there are some. ``wanted`` is the topic, if the
    user named it. Raises DatasetError if that is no colour topic."""
    reader = sensor.reader
    topics = {topic.name: topic for topic in image_topics(reader) if messages.is_color(topic.encoding)}
    if not wanted and len(topics) != 1:
        return None, [f"color: choose one with ?color={' or ?color='.join(topics)}"] if topics else []
    name = choose(reader, "color", wanted, list(topics), "topics of colour images")
    topic = topics.get(name) or described(reader, name)
    if not messages.is_color(topic.encoding):
        raise DatasetError(f"{reader.path}: topic {name}: encoding {topic.encoding!r} is not colour")
    if len(sensor.frames) > 1:
        return None, [f"color: {name} is not used: depth is of several sensors"]
    found = _own_camera(sensor, topic, depth, camera)
    if isinstance(found, str):
        return None, [f"color: {name} is not used: {found}"]
    entries, alone = paired(sensor, name, stamps, gap)
    how = "registered to depth" if found[0] is None else "brought to the depth camera's pixels"
    return Beside(reader, name, entries, partial(_colors, *found)), [f"color: {name}, {how}{alone}"]


def paired(
    sensor: BagSensor, topic: str, stamps: Sequence[float], gap: float | None
) -> tuple[list[Entry | None], str]:
    """The images of a topic that belong to depth images of some stamps, and how many have none, in words."""
    entries = sensor.run.of([entry for entry, _ in sensor.reader.messages(topic)])
    partners = associate(stamps, [entry.stamp for entry in entries], COLOR_GAP if gap is None else gap)
    found = [None if partner is None else entries[partner] for partner in partners]
    alone = found.count(None)
    return found, f"; {alone} of {len(found)} images have none" if alone else ""


def _own_camera(
    sensor: BagSensor, topic: DepthTopic, depth: DepthTopic, camera: PinholeCamera
) -> tuple[ColorCamera | None, tuple[float, ...]] | str:
    """The camera of a topic of colour images beside the depth camera, None if the images are registered to
    depth, and its distortion; or why it is not known."""
    reader = sensor.reader
    try:
        height, width = shape = messages.color_image(reader.first(topic.name)).shape[:2]
    except DatasetError as error:
        return str(error)
    same = topic.frame in (depth.frame, sensor.frame)
    if same and topic.frame:
        if shape == camera.shape:
            return None, ()
        return f"its images have the depth camera's frame and another size, {width} x {height}"
    infos = [reader.first(name) for name in topic.info]
    own_infos = [info for info in infos if info and messages.frame_name(info.header.frame_id) == topic.frame]
    if not own_infos:
        return "its CameraInfo is not known"
    try:
        stated, distortion = camera_of(own_infos[0], topic.rectified)
    except DatasetError as error:
        return f"its CameraInfo {error}"
    own = stated.of(shape)
    if own is None:
        return f"its images have {width} x {height} pixels, its CameraInfo has another view"
    if same:
        return (None, ()) if own == camera else "neither it nor depth names a frame"
    T_color_depth = sensor.tree().mounted(topic.frame, sensor.frame)
    if T_color_depth is None:
        return f"tf has no fixed transform from {sensor.frame!r} to {topic.frame!r}"
    return ColorCamera(own, T_color_depth), distortion
