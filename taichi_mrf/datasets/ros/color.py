"""The colour images of a bag: registered to depth, or of a camera of their own whose place tf gives."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.color_camera import ColorCamera, without_black
from taichi_mrf.datasets.formats.tum_rgbd import associate
from taichi_mrf.datasets.ros import messages
from taichi_mrf.datasets.ros.cameras import camera_of
from taichi_mrf.datasets.ros.messages import frame_name
from taichi_mrf.datasets.ros.reader import Entry, RosReader
from taichi_mrf.datasets.ros.sensor import BagSensor
from taichi_mrf.datasets.ros.topics import DepthTopic, choose, described, image_topics
from taichi_mrf.errors import DatasetError, naming
from taichi_mrf.sensor.camera import PinholeCamera

COLOR_GAP = 0.035
"""Default of the largest time in seconds between a depth image and its colour image: a frame at 30 Hz."""


@dataclass(frozen=True)
class BagColors:
    """The colour images of one topic: ``entries`` has the one that belongs to each depth image, or None.
    ``camera`` took them unless they are registered to depth; ``distortion`` are its OpenCV coefficients."""

    reader: RosReader
    topic: str
    entries: Sequence[Entry | None]
    camera: ColorCamera | None
    distortion: tuple[float, ...]

    def read(
        self, index: int, depth_m: NDArray[np.float32], depth_camera: PinholeCamera
    ) -> NDArray[np.uint8] | None:
        """The colours (H, W, 3) of a depth image's pixels, None if it has none. Raises DatasetError, which
        names file and topic."""
        entry = self.entries[index]
        if entry is None:
            return None
        message = self.reader.read(self.topic, entry)
        with naming(f"{self.reader.path}: topic {self.topic}"):
            color = messages.color_image(message)
        own = depth_camera if self.camera is None else self.camera.camera
        if color.shape[:2] != own.shape:
            raise DatasetError(
                f"{self.reader.path}: topic {self.topic}: the image has {color.shape[1]} x {color.shape[0]} "
                f"pixels, its camera {own.width} x {own.height}"
            )
        if self.camera is None:
            return without_black(color)
        if any(self.distortion):
            K = np.array([[own.fx, 0, own.cx], [0, own.fy, own.cy], [0, 0, 1.0]])
            color = cv2.undistort(color, K, np.array(self.distortion)).astype(np.uint8)
        return self.camera.registered(color, depth_m, depth_camera)


def find_colors(
    reader: RosReader,
    wanted: str,
    depth: DepthTopic,
    camera: PinholeCamera,
    stamps: Sequence[float],
    gap: float | None,
    sensor: BagSensor,
) -> tuple[BagColors | None, list[str]]:
    """The colours for depth images of some stamps, and notes for the user: which images are used, how many
    depth images have none, and why none are used although there are some. ``wanted`` is the topic, if the
    user named it. Raises DatasetError if that is no colour topic."""
    topics = {topic.name: topic for topic in _color_topics(reader)}
    if not wanted and len(topics) != 1:
        return None, [f"color: choose one with ?color={' or ?color='.join(topics)}"] if topics else []
    name = choose(reader, "color", wanted, list(topics), "topics of colour images")
    topic = topics.get(name) or described(reader, name)
    if not messages.is_color(topic.encoding):
        raise DatasetError(f"{reader.path}: topic {name}: encoding {topic.encoding!r} is not colour")
    if len(sensor.frames) > 1:
        return None, [f"color: {name} is not used: depth is of several sensors"]
    found = _own_camera(reader, topic, depth, camera, sensor)
    if isinstance(found, str):
        return None, [f"color: {name} is not used: {found}"]
    own, distortion = found
    entries, alone = paired(sensor, name, stamps, gap)
    how = "registered to depth" if own is None else "brought to the depth camera's pixels"
    return BagColors(reader, name, entries, own, distortion), [f"color: {name}, {how}{alone}"]


def paired(
    sensor: BagSensor, topic: str, stamps: Sequence[float], gap: float | None
) -> tuple[list[Entry | None], str]:
    """The images of a topic that belong to depth images of some stamps, and how many have none, in words."""
    entries = sensor.run.of([entry for entry, _ in sensor.reader.messages(topic)])
    partners = associate(stamps, [entry.stamp for entry in entries], COLOR_GAP if gap is None else gap)
    found = [None if partner is None else entries[partner] for partner in partners]
    alone = found.count(None)
    return found, f"; {alone} of {len(found)} images have none" if alone else ""


def _color_topics(reader: RosReader) -> list[DepthTopic]:
    return [topic for topic in image_topics(reader) if messages.is_color(topic.encoding)]


def _own_camera(
    reader: RosReader, topic: DepthTopic, depth: DepthTopic, camera: PinholeCamera, sensor: BagSensor
) -> tuple[ColorCamera | None, tuple[float, ...]] | str:
    """The camera of a topic of colour images beside the depth camera, None if the images are registered to
    depth, and its distortion; or why it is not known."""
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
    own_infos = [info for info in infos if info and frame_name(info.header.frame_id) == topic.frame]
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
