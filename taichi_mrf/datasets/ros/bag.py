"""ROS 1 bags, ROS 2 bags and MCAP files: ``walk.bag?depth=/camera/depth/image_raw&pose=/odom&frame=map``.

The fields of :class:`BagOptions` are the options; without any, the only depth topic and the only source of
poses are used. On opening, the stamp of each depth message is read; images are decoded
when their frame is read. A pose is interpolated between its neighbours in time, and an image that has none
near enough is left out and counted. ``poses=track`` finds all poses from the images while mapping.
Reading needs the extra ``ros``.
"""

import weakref
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from taichi_mrf.datasets.base import Dataset, Format
from taichi_mrf.datasets.options import TRACK, ReadOptions, parse_options
from taichi_mrf.datasets.ros import messages
from taichi_mrf.datasets.ros.color import BagColors, find_colors
from taichi_mrf.datasets.ros.poses import BagPoses, PoseChoice, find_poses
from taichi_mrf.datasets.ros.reader import METADATA, SUFFIXES, Entry, RosReader, is_bag
from taichi_mrf.datasets.ros.topics import DepthTopic, choose, depth_topics, described
from taichi_mrf.datasets.timed_poses import INTERPOLATION_GAP
from taichi_mrf.errors import DatasetError, FrameError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame

REALSENSE = "/device_0/sensor_"
"""The beginning of topics in the files of Intel's library, whose messages differ from those of ROS."""


@dataclass(frozen=True)
class BagOptions(PoseChoice):
    """The options after the name of a bag."""

    depth: str = ""
    """The topic of depth images."""

    info: str = ""
    """The topic of their CameraInfo."""

    color: str = ""
    """The topic of colour images, by default the only one."""


@dataclass
class RosBag(Dataset):
    """The depth images of one topic, each with its pose; ``entries`` says where in the bag they are."""

    camera: PinholeCamera
    reader: RosReader = field(kw_only=True)
    topic: str = field(kw_only=True)
    entries: Sequence[Entry] = field(kw_only=True)
    poses: Sequence[Pose] = field(kw_only=True)
    names: Sequence[str] = field(kw_only=True)
    depth_scale: float | None = None
    colors: BagColors | None = None

    @property
    def frame_names(self) -> Sequence[str]:
        """The number that each image has in its topic, from 0."""
        return self.names

    def read(self, index: int) -> Frame:
        """Decode one image.

        Raises FrameError, which names frame, file and topic, if it is damaged, of another encoding, or of
        another size than the camera's. Raises IndexError outside 0 to len - 1.
        """
        if not 0 <= index < len(self.entries):
            raise IndexError(f"{self.name} has {len(self.entries)} frames, there is no frame {index}")
        name, where = self.names[index], f"{self.reader.path}: topic {self.topic}"
        try:
            message = self.reader.read(self.topic, self.entries[index])
        except DatasetError as error:
            raise FrameError(f"frame {name}: {error}") from error
        try:
            depth_m = messages.depth_image(message, self.depth_scale)
        except DatasetError as error:
            raise FrameError(f"frame {name}: {where}: {error}") from error
        if depth_m.shape != self.camera.shape:
            raise FrameError(
                f"frame {name}: {where}: the image has {depth_m.shape[1]} x {depth_m.shape[0]} pixels, "
                f"the camera {self.camera.width} x {self.camera.height}"
            )
        color = None
        if self.colors is not None:
            try:
                color = self.colors.read(index, depth_m, self.camera)
            except DatasetError as error:
                raise FrameError(f"frame {name}: {error}") from error
        return Frame(depth_m, self.poses[index], self.camera, self.entries[index].stamp, name, color)


def open_bag(path: Path, query: str, options: ReadOptions) -> RosBag:
    """Open a bag with the options after the question mark of its name.

    Raises DatasetError, whose text names the file and where it applies the topic, for a bag that cannot be
    read, missing or ambiguous topics, an unknown camera, and if no image has a
    pose.
    """
    chosen = parse_options(BagOptions, query, str(path))
    if options.track:
        chosen = replace(chosen, poses=TRACK)
    reader = RosReader(path)
    try:
        if any(name.startswith(REALSENSE) for name in reader.topics):
            raise DatasetError(
                f"{path}: is a recording of Intel's RealSense library, without poses: "
                f"realsense:{path}?poses=FILE plays it, with poses from lines of stamp tx ty tz qx qy qz qw, "
                "or ?poses=track"
            )
        bag = _open(reader, chosen, options)
    except DatasetError:
        reader.close()
        raise
    weakref.finalize(bag, reader.close)
    return bag


def _open(reader: RosReader, chosen: BagOptions, options: ReadOptions) -> RosBag:
    depth = _depth_topic(reader, chosen.depth)
    camera, distortion = _camera(reader, depth, chosen.info, options)
    found = find_poses(reader, depth, chosen)
    gap = INTERPOLATION_GAP if options.max_time_gap is None else options.max_time_gap
    entries = sorted((entry for entry, _ in reader.messages(depth.name)), key=lambda entry: entry.stamp)
    posed = [
        (i, entry, pose)
        for i, entry in enumerate(entries)
        if (pose := found.at(entry.stamp, gap)) is not None
    ]
    if not posed:
        raise DatasetError(_without_poses(reader, depth, entries, found, gap))
    notes = list(found.notes)
    dropped = len(entries) - len(posed)
    if dropped:
        notes.append(
            f"{dropped} of {len(entries)} images of {depth.name} dropped: "
            f"no poses within {gap:g} s on both sides"
        )
    colors = None
    if options.color:
        stamps = [entry.stamp for _, entry, _ in posed]
        colors, said = find_colors(reader, chosen.color, depth, camera, stamps, options.max_time_gap)
        notes += said
    return RosBag(
        name=reader.path.stem,
        camera=camera,
        notes=notes,
        dropped=dropped,
        distortion=distortion,
        reader=reader,
        topic=depth.name,
        entries=[entry for _, entry, _ in posed],
        poses=[pose for _, _, pose in posed],
        names=[f"{i:06d}" for i, _, _ in posed],
        depth_scale=options.depth_scale,
        tracked=chosen.poses == TRACK,
        colors=colors,
    )


def _depth_topic(reader: RosReader, wanted: str) -> DepthTopic:
    topics = {topic.name: topic for topic in depth_topics(reader)}
    name = choose(reader, "depth", wanted, list(topics), f"topics of depth images ({messages.ENCODINGS})")
    topic = topics.get(name) or described(reader, name)
    try:
        messages.check_depth(topic.encoding)
    except DatasetError as error:
        raise DatasetError(f"{reader.path}: topic {name}: {error}") from error
    return topic


def _camera(
    reader: RosReader, depth: DepthTopic, wanted: str, options: ReadOptions
) -> tuple[PinholeCamera, tuple[float, ...]]:
    """The camera of a topic's images and the distortion in its CameraInfo."""
    if options.camera is not None:
        return options.camera, ()
    if options.intrinsics is not None:
        return PinholeCamera(*_size(reader, depth), *options.intrinsics), ()
    if not (wanted or depth.info):
        raise DatasetError(f"{reader.path}: contains no CameraInfo; pass --camera fx,fy,cx,cy")
    name = choose(reader, "info", wanted, depth.info, f"topics of the CameraInfo of {depth.name}")
    message = reader.first(name)
    if message is None or reader.topics[name].type != messages.CAMERA_INFO:
        raise DatasetError(f"{reader.path}: topic {name} contains no {messages.CAMERA_INFO}")
    try:
        return messages.camera_of(message, depth.rectified)
    except DatasetError as error:
        raise DatasetError(f"{reader.path}: topic {name}: {error}") from error


def _size(reader: RosReader, depth: DepthTopic) -> tuple[int, int]:
    """(width, height) of a topic's first image."""
    try:
        height, width = messages.depth_image(reader.first(depth.name), None).shape
    except DatasetError as error:
        raise DatasetError(f"{reader.path}: topic {depth.name}: {error}") from error
    return width, height


def _without_poses(
    reader: RosReader, depth: DepthTopic, entries: Sequence[Entry], found: BagPoses, gap: float
) -> str:
    return (
        f"{reader.path}: none of {len(entries)} images of {depth.name} ({entries[0].stamp:.3f} to "
        f"{entries[-1].stamp:.3f} s) has poses within {gap:g} s on both sides ({found.source})"
    )


FORMAT = Format(
    name="ROS bag",
    looks_for=f"{', '.join(SUFFIXES)} or the folder of a ROS 2 bag with {METADATA}",
    recognises=is_bag,
    open=lambda path, options: open_bag(path, "", options),
    open_with_query=open_bag,
)
