"""The confidence of depth in a bag, as a sigma for each pixel: the grades of a RealSense L515.

realsense-ros publishes them as mono8, ``confidence/image_rect_raw`` beside ``depth/image_rect_raw``: 4 bits
for each pixel of depth. librealsense puts them into the upper half of a byte, 0, 16, ... to 240; 0 to 15 are
read too.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.confidence import L515
from taichi_mrf.datasets.ros import messages
from taichi_mrf.datasets.ros.color import paired
from taichi_mrf.datasets.ros.reader import Entry, RosReader
from taichi_mrf.datasets.ros.sensor import BagSensor
from taichi_mrf.datasets.ros.topics import DepthTopic, choose, described
from taichi_mrf.errors import DatasetError, naming
from taichi_mrf.sensor.camera import PinholeCamera

PART = "confidence"
"""The part of a topic's name where that of depth has ``depth``."""

_BITS = 4


@dataclass(frozen=True)
class BagConfidence:
    """The images of one topic: ``entries`` has the one that belongs to each depth image, or None."""

    reader: RosReader
    topic: str
    entries: Sequence[Entry | None]

    def read(
        self, index: int, depth_m: NDArray[np.float32], camera: PinholeCamera
    ) -> NDArray[np.float32] | None:
        """The sigma of a depth image's pixels, (H, W) metres, None if it has no confidence. Raises
        DatasetError, which names file and topic."""
        entry = self.entries[index]
        if entry is None:
            return None
        message = self.reader.read(self.topic, entry)
        with naming(f"{self.reader.path}: topic {self.topic}"):
            return L515.sigma_m(_grades(messages.grey_image(message)), depth_m, camera)


def find_confidence(
    reader: RosReader,
    wanted: str,
    depth: DepthTopic,
    camera: PinholeCamera,
    stamps: Sequence[float],
    gap: float | None,
    sensor: BagSensor,
) -> tuple[BagConfidence | None, list[str]]:
    """The confidence of depth images of some stamps, and notes for the user: which topic is used, how many
    depth images have none, and why none is used although there is one. ``wanted`` is the topic, if the user
    named it. Raises DatasetError if that is none of the depth image's confidence."""
    images = (messages.IMAGE, messages.COMPRESSED_IMAGE)
    names = [topic.name for topic in reader.topics.values() if topic.type in images and topic.messages]
    beside = [name for name in names if _beside(name, depth.name)]
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
    return BagConfidence(reader, name, entries), [f"confidence: {name}, as a sigma for each pixel{alone}"]


def _beside(name: str, depth: str) -> bool:
    """True if a topic's name is that of depth up to ``confidence`` in the place of ``depth``."""
    parts, of_depth = name.split("/"), depth.split("/")
    if PART not in parts or "depth" not in of_depth:
        return False
    return parts[: parts.index(PART)] == of_depth[: of_depth.index("depth")]


def _misfit(reader: RosReader, name: str, camera: PinholeCamera) -> str | None:
    """Why a topic's images cannot be the confidence of a camera's, None if they can. Raises DatasetError if
    it holds no images."""
    described(reader, name)
    try:
        height, width = messages.grey_image(reader.first(name)).shape
    except DatasetError as error:
        return str(error)
    if (height, width) == camera.shape:
        return None
    return f"its images have {width} x {height} pixels, those of depth {camera.width} x {camera.height}"


def _grades(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Grades from 0 to 15. Raises DatasetError if the image holds anything else."""
    if image.max(initial=0) < 1 << _BITS:
        return image
    if (image % (1 << _BITS)).any():
        raise DatasetError(
            f"has values up to {image.max()}, which are no grades of 4 bits (0 to 15, or 0, 16, ... to 240)"
        )
    return np.right_shift(image, _BITS, dtype=np.uint8)
