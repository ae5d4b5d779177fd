"""Choosing among the contents of a bag: depth topics, cameras and pose topics.

A single candidate is taken. Of several the user must choose one, and the error lists them as the options
that choose them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from taichi_mrf.datasets.ros import messages
from taichi_mrf.datasets.ros.sources import TopicSource
from taichi_mrf.errors import DatasetError, naming

LASER_SCAN = "sensor_msgs/msg/LaserScan"
FROM_TF = "tf"
"""The value of the option ``pose`` for poses from the tree of frames."""


@dataclass(frozen=True)
class DepthTopic:
    """A topic of depth images: encoding, their camera's frame, and the CameraInfo topics that may be its."""

    name: str
    encoding: str
    frame: str
    info: tuple[str, ...]

    @property
    def rectified(self) -> bool:
        """True if its images are those of an ideal camera: REP 104 calls such topics image_rect..."""
        return any(part.startswith("image_rect") for part in self.name.split("/"))


def image_topics(reader: TopicSource) -> list[DepthTopic]:
    """The topics of images as their first messages show them."""
    return [described(reader, name) for name in topics_of(reader, *messages.IMAGES)]


def topics_of(reader: TopicSource, *types: str) -> list[str]:
    """The topics with messages of some types."""
    return [topic.name for topic in reader.topics.values() if topic.type in types and topic.messages]


def depth_topics(reader: TopicSource) -> list[DepthTopic]:
    """The topics whose first message is a depth image (messages.is_depth)."""
    return [topic for topic in image_topics(reader) if messages.is_depth(topic.encoding, topic.name)]


def packed_otherwise(reader: TopicSource) -> list[str]:
    """The topics of depth images that are packed in a way that is not read."""
    depth = (messages.MILLIMETRES[0], messages.METRES)
    return [t.name for t in image_topics(reader) if t.encoding.partition(";")[0].strip() in depth]


def no_depth(reader: TopicSource) -> str:
    """Content of a bag without topics of depth images, and which of it might be read."""
    images = {topic.name: topic.encoding for topic in image_topics(reader)}
    held = [f"{t.name} ({images.get(t.name) or t.type.rpartition('/')[2]})" for t in reader.topics.values()]
    text = f"contains no topics of depth images ({messages.ENCODINGS}), nor of point clouds (PointCloud2)"
    text += f"; its topics: {', '.join(held) or 'none'}"
    maybe = [name for name, encoding in images.items() if messages.may_be_depth(encoding)]
    if maybe:
        text += f". {' or '.join(f'?depth={name}' for name in maybe)} reads those images as depth"
    if any(topic.type == LASER_SCAN for topic in reader.topics.values()):
        text += ". LaserScans are not read from bags; taichi-mrf laser reads CARMEN logs and .npz"
    if any(topic.type.endswith("/CustomMsg") for topic in reader.topics.values()):
        text += (
            ". CustomMsg is the Livox driver's own message: record with its xfer_format 0, which is "
            "PointCloud2, or convert the bag (livox_to_pointcloud2)"
        )
    return text


def cloud_topics(reader: TopicSource) -> list[str]:
    """The topics of point clouds."""
    return topics_of(reader, messages.POINT_CLOUD)


def message_frame(reader: TopicSource, topic: str) -> str:
    """The coordinate frame of a topic's first message, empty if there is none."""
    message = reader.first(topic)
    return "" if message is None else messages.frame_name(message.header.frame_id)


def described(reader: TopicSource, name: str) -> DepthTopic:
    """A topic of images as its first message shows it. Raises DatasetError, which names file and topic, if it
    has other messages or none."""
    topic = reader.topics[name]
    if topic.type not in messages.IMAGES:
        raise DatasetError(f"{reader.path}: topic {name} is of type {topic.type}, not {messages.IMAGE}")
    message = reader.first(name)
    if message is None:
        raise DatasetError(f"{reader.path}: topic {name} contains no message")
    frame = messages.frame_name(message.header.frame_id)
    return DepthTopic(name, messages.encoding(message), frame, _camera_topics(reader, name, frame))


def _camera_topics(reader: TopicSource, depth: str, frame: str) -> tuple[str, ...]:
    """The CameraInfo topics of a depth topic: of those in its images' ``frame``, or of all if none is, those
    that share the longest beginning of their names with it. One is left in most bags, since drivers put
    camera_info beside the image."""
    every = topics_of(reader, messages.CAMERA_INFO)
    names = [name for name in every if frame and message_frame(reader, name) == frame] or every
    shared = {name: _shared_parts(name, depth) for name in names}
    most = max(shared.values(), default=0)
    return tuple(name for name in names if shared[name] == most)


def _shared_parts(a: str, b: str) -> int:
    pairs = zip(a.strip("/").split("/"), b.strip("/").split("/"), strict=False)
    return next((i for i, (x, y) in enumerate(pairs) if x != y), min(a.count("/"), b.count("/")))


def choose(reader: TopicSource, option: str, wanted: str, candidates: Sequence[str], what: str) -> str:
    """The topic that the user named, or the only candidate. Raises DatasetError, which names the file and
    lists the candidates, if the bag has no topic of that name, if there are several candidates and none was
    named, or no candidate."""
    path = reader.path
    if wanted:
        name = wanted if wanted in reader.topics else f"/{wanted}"
        if name in candidates or name in reader.topics:
            return name
        known = ", ".join(candidates) or "none"
        raise DatasetError(f"{path}: there is no topic {wanted}; {what}: {known}")
    if len(candidates) == 1:
        return candidates[0]
    if not candidates:
        topics = (
            ", ".join(f"{t.name} ({t.type.rpartition('/')[2]})" for t in reader.topics.values()) or "none"
        )
        raise DatasetError(f"{path}: contains no {what}; its topics: {topics}")
    choices = ", ".join(f"{option}={name}" for name in candidates)
    raise DatasetError(f"{path}: contains several {what}: choose one with ?{choices.replace(', ', ' or ?')}")


def choose_depth(reader: TopicSource, wanted: str) -> DepthTopic:
    """The topic of depth images that the user named, or the only one. Raises DatasetError, as choose, and if
    its images are no depth that can be read."""
    topics = {topic.name: topic for topic in depth_topics(reader)}
    unread = [] if topics else packed_otherwise(reader)
    if not (topics or unread or wanted):
        raise DatasetError(f"{reader.path}: {no_depth(reader)}")
    what = f"topics of depth images ({messages.ENCODINGS})"
    name = choose(reader, "depth", wanted, [*topics, *unread], what)
    topic = topics.get(name) or described(reader, name)
    with naming(f"{reader.path}: topic {name}"):
        messages.check_depth(topic.encoding)
    return topic
