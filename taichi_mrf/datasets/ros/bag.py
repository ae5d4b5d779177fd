"""ROS 1 bags, ROS 2 bags and MCAP files: ``walk.bag?depth=/camera/depth/image_raw&pose=/odom&frame=map``.

The fields of :class:`.SensorChoice` are the options; without any, the only depth topic and the only source of
poses are used; the point clouds of a lidar, where there are no depth images or ``points`` names them
(lidar.py). On opening, the stamp of each message is read; images are decoded when their frame is read. A pose
is interpolated between its neighbours in time, and an image that has none near enough is left out and
counted. ``poses=track`` finds all poses from the images while mapping. Reading needs the extra ``ros``.

A summary lists the contents of a bag for a user who wants to map it: topics, frames, and the options that
choose them.
"""

import weakref
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset, Table, start_pose
from taichi_mrf.datasets.confidence import L515
from taichi_mrf.datasets.conventions import Conventions
from taichi_mrf.datasets.depth_scale import check_metres, gather
from taichi_mrf.datasets.derived import pose_of
from taichi_mrf.datasets.images import note_of_largest
from taichi_mrf.datasets.options import TRACK, ReadOptions, parse_options
from taichi_mrf.datasets.ros import messages
from taichi_mrf.datasets.ros.beside import Beside, find_colors, find_confidence, find_imu
from taichi_mrf.datasets.ros.lidar import LidarBag, find_clouds, maps_clouds, posed_through
from taichi_mrf.datasets.ros.poses import BagPoses, pose_candidates
from taichi_mrf.datasets.ros.reader import BagRow, RosReader
from taichi_mrf.datasets.ros.sensor import (
    BagCameras,
    DepthCamera,
    SensorChoice,
    find_depth_camera,
    posed_by,
    track_of,
)
from taichi_mrf.datasets.ros.sources import Entry, Topic, TopicSource
from taichi_mrf.datasets.ros.tf import Transforms, TransformTree, read_transforms, tree_of
from taichi_mrf.datasets.ros.topics import cloud_topics, depth_topics, message_frame
from taichi_mrf.datasets.timed_poses import TimedPoses, largest_gap
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.motion import AccelerationSamples, GyroSamples, upwards_at
from taichi_mrf.sensor.ray_table import RayTable

REALSENSE = "/device_0/sensor_"
"""The beginning of topics in the files of Intel's library, whose messages differ from those of ROS."""

_AGREE = 0.03
"""Neighbouring images whose depths differ by less, as a share of them, agree."""

_LOOKED_AT = 4
"""Images whose numbers are looked at when a bag is opened."""


@dataclass
class RosBag(Table[BagRow]):
    """The depth images of one topic, each with its pose. ``cameras`` took them; ``camera`` is the first."""

    camera: PinholeCamera
    reader: RosReader = field(kw_only=True)
    topic: str = field(kw_only=True)
    cameras: BagCameras = field(kw_only=True)
    depth_scale: float | None = None
    colors: Beside | None = None
    confidences: Beside | None = None
    gyro: GyroSamples | None = None
    acceleration: AccelerationSamples | None = None

    def check_scale(self, pose: Callable[[int], Pose] | None) -> list[str]:
        """A note of whole numbers that are no measurements. Raises DatasetError if floats are no metres."""
        shares, depths = [], []
        for row in self.rows[:: -(-len(self.rows) // _LOOKED_AT)]:
            with suppress(DatasetError):  # reported when its frame is read
                message = self.reader.read(self.topic, row.entry)
                shares.append(messages.share_without(message))
                depths.append(messages.depth_image(message, None))
        if self.depth_scale is None:
            check_metres(depths, f"{self.reader.path}: topic {self.topic}")
        return note_of_largest(shares)

    def load(self, index: int, row: BagRow, T_world_camera: Pose) -> Frame:
        """Decode one image, which must have its camera's size."""
        message = self.reader.read(self.topic, row.entry)
        where = f"{self.reader.path}: topic {self.topic}"
        depth_m, camera = self.cameras.measured(message, row.entry, self.depth_scale, where)
        color = sigma_m = None
        if self.colors is not None:
            color = self.colors.read(index, depth_m, camera)
        if self.confidences is not None:
            sigma_m = self.confidences.read(index, depth_m, camera)
        parts = (T_world_camera, camera, row.stamp, row.name, color, sigma_m)
        return Frame(depth_m, *parts, gyro=self.gyro, acceleration=self.acceleration)


def by_axes(
    reader: TopicSource, mapped: DepthCamera, chosen: SensorChoice, options: ReadOptions
) -> tuple[dict[str, BagPoses], list[str]]:
    """The poses of a camera's axes. If nothing says whether poses are of these or of a body's, x ahead and z
    up, and neighbouring images agree clearly better so, they are turned, with a note: names such as
    camera_link are used for both."""
    depth, sensor, cameras, poses = mapped
    doubtful = any(each.assumed or "optical" not in frame.lower() for frame, each in poses.items())
    stated = chosen.poses == TRACK or chosen.optical or chosen.body or options.conventions.of_poses
    if stated or not doubtful:
        return poses, []
    gap, turned = largest_gap(options), {frame: _turned(each) for frame, each in poses.items()}
    known = [entry for entry in sensor.entries if poses[entry.frame].at(entry.stamp, gap) is not None]

    def metres(index: int) -> NDArray[np.float32]:
        return messages.depth_image(reader.read(depth.name, known[index]), options.depth_scale)

    def placed(of: Mapping[str, BagPoses], index: int) -> Any:
        return of[known[index].frame].at(known[index].stamp, gap)

    found = [
        gather(len(known), partial(placed, each), metres, cameras.first, (1.0,)).disagreement
        for each in (poses, turned)
    ]
    if not all(found) or found[1][1.0] >= min(_AGREE, 0.5 * found[0][1.0]):
        return poses, []
    note = (
        f"poses of {depth.frame or 'the camera'} are taken for those of a body, x ahead and z up: "
        f"neighbouring images differ by {found[1][1.0]:.1%} that way, by {found[0][1.0]:.1%} as they are; "
        "?body=FRAME or ?optical=FRAME takes them as they are"
    )
    return turned, [note]


def _turned(poses: BagPoses) -> BagPoses:
    """Poses of a body's axes, x ahead and z up, as those of the camera's."""

    def at(stamp: float, gap: float) -> Pose | None:
        T = poses.at(stamp, gap)
        return None if T is None else pose_of(T, Conventions(axes="ros"))

    return replace(poses, at=at)


def open_bag(path: Path, query: str, options: ReadOptions) -> Dataset:
    """Open a bag with the options after the question mark of its name. Raises DatasetError, which names the
    file and where it applies the topic, for a bag that cannot be read, missing or ambiguous topics, an
    unknown camera, and if no image has a pose."""
    chosen = parse_options(SensorChoice, query, str(path))
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
    if reader.parts:
        first, last = reader.parts[0].name, reader.parts[-1].name
        bag.notes.append(f"{first} to {last}: {len(reader.parts)} files are read as one recording")
    weakref.finalize(bag, reader.close)
    return bag


def _open(reader: RosReader, chosen: SensorChoice, options: ReadOptions) -> Dataset:
    if maps_clouds(reader, chosen):
        return _open_lidar(reader, chosen, options)
    depth, sensor, cameras, _ = mapped = find_depth_camera(reader, chosen, options)
    found, by_turned = by_axes(reader, mapped, chosen, options)
    posed, notes = posed_by(sensor, found, options)
    dropped = len(sensor.entries) - len(posed)
    stamps, colors = [entry.stamp for _, entry, _ in posed], None
    parts = (depth, cameras.first, stamps, options.max_time_gap)
    if options.color:
        colors, said = find_colors(sensor, chosen.color, *parts)
        notes += said
    confidence, said = find_confidence(sensor, chosen.confidence, *parts)
    notes += said + cameras.notes
    tracked, gyro, acceleration = chosen.poses == TRACK, None, None
    if tracked:
        imu, said = find_imu(sensor, chosen.imu, stamps[0])
        notes += said
        if imu is not None:
            gyro, acceleration = imu.samples(imu.rows)
            T_start = start_pose(upwards_at(acceleration, stamps[0]))
            posed = [(i, entry, T_start) for i, entry, _ in posed]
    return RosBag(
        name=reader.path.stem,
        camera=cameras.first,
        cameras=cameras,
        notes=notes + by_turned,
        dropped=dropped,
        distortion=cameras.distortion,
        reader=reader,
        topic=depth.name,
        rows=_rows(reader, posed),
        track=None if chosen.poses == TRACK else track_of(found, options),
        depth_scale=options.depth_scale,
        tracked=tracked,
        colors=colors,
        confidence=None if confidence is None else L515,
        confidences=confidence,
        gyro=gyro,
        acceleration=acceleration,
    )


def _open_lidar(reader: RosReader, chosen: SensorChoice, options: ReadOptions) -> LidarBag:
    sensor, found, clouds = find_clouds(reader, chosen, options)
    tracked = chosen.poses == TRACK
    posed, notes = posed_by(sensor, found, options)
    posed, dropped, rigid = posed_through(sensor, found, clouds, posed, options)
    if rigid:
        clouds = replace(clouds, at=None)
    elif not chosen.deskew and not tracked:
        rigid = "leave out deskew=false"
    bag = LidarBag(
        name=reader.path.stem,
        camera=RayTable([[1.0, 0.0, 0.0]]),
        notes=notes + dropped,
        dropped=len(sensor.entries) - len(posed),
        reader=reader,
        clouds=clouds,
        rigid=rigid,
        rows=_rows(reader, posed),
        track=None if tracked or clouds.registered else track_of(found, options),
        tracked=tracked,
    )
    bag.look_at_first()
    return bag


def _rows(reader: RosReader, posed: Sequence[tuple[int, Entry, Pose]]) -> list[BagRow]:
    """Frames are named by the number of their message in its topic, or in the run that is read, from 0."""
    return [BagRow(f"{i:06d}", entry.stamp, pose, f"{reader.path}", entry) for i, entry, pose in posed]


@dataclass(frozen=True)
class BagSummary:
    """The contents of a bag. ``remarks`` describe topics, by name, beyond their type. ``transforms`` are the
    tree's edges in words. ``sources`` are what to call the bag so that it can be mapped, with ``flags`` to
    add; the first needs the least to be filled in."""

    topics: Sequence[Topic]
    remarks: dict[str, str]
    duration: float
    transforms: Sequence[str]
    sources: Sequence[str]
    flags: str

    def rate(self, topic: Topic) -> float | None:
        """Messages of a topic in a second, None if there are too few."""
        return (topic.messages - 1) / self.duration if topic.messages > 1 and self.duration > 0 else None


def summarise(path: Path) -> BagSummary:
    """Look into a bag. Raises DatasetError, which names the file, if it cannot be read."""
    reader = RosReader(path)
    try:
        return summary_of(reader)
    finally:
        reader.close()


def summary_of(reader: TopicSource) -> BagSummary:
    """The contents of topics, and how to name them. Raises DatasetError, which names the source."""
    topics = list(reader.topics.values())
    if any(topic.name.startswith(REALSENSE) for topic in topics):
        return BagSummary(topics, {}, reader.duration, [], [f"realsense:{reader.path}?poses=FILE"], "")
    depth, sent = depth_topics(reader), read_transforms(reader)
    remarks = {each.name: f"depth, {each.encoding}, frame {each.frame or 'unnamed'}" for each in depth}
    clouds = {name: message_frame(reader, name) for name in cloud_topics(reader)}
    remarks |= {name: f"points, frame {frame or 'unnamed'}" for name, frame in clouds.items()}
    frames = clouds | {each.name: each.frame for each in depth} or {"": ""}
    trees = {name: _tree_or_none(sent, name, frame) for name, frame in frames.items()}
    chosen = {each.name: [f"depth={each.name}"] * (len(depth) > 1) for each in depth}
    for each in depth:
        chosen[each.name] += [f"info={each.info[0]}"] if len(each.info) > 1 else []
    chosen |= {name: [f"points={name}"] * (bool(depth) or len(clouds) > 1) for name in clouds}
    return BagSummary(
        topics,
        remarks,
        reader.duration,
        list(dict.fromkeys(words for tree in trees.values() for words in _transforms(tree))),
        [each for name, of in chosen.items() for each in _sources(reader, trees[name], frames[name], of)],
        "" if all(each.info for each in depth) else " --camera fx,fy,cx,cy",
    )


def _tree_or_none(sent: dict[str, Transforms], topic: str, frame: str) -> TransformTree:
    """The tree of a topic, without frames if the user must choose among several."""
    try:
        return tree_of(sent, topic, frame)
    except DatasetError:
        return TransformTree({})


def _transforms(tree: TransformTree) -> list[str]:
    words = []
    for child, (parent, edge) in sorted(tree.edges.items()):
        moving = f"moving, {len(edge)} times" if isinstance(edge, TimedPoses) else "fixed"
        words.append(f"{parent} -> {child} ({moving})")
    return words + [dispute.problem for dispute in tree.disputed.values()]


def _pose_options(reader: TopicSource, tree: TransformTree, frame: str) -> list[list[str]]:
    """For each source of poses the options that choose it."""
    try:
        poses = [f"pose={name}" for name in pose_candidates(reader, tree, frame)]
    except DatasetError:  # frames that form a cycle
        poses = []
    unknown = tree.misses(frame) or (not frame and tree.frames and poses)
    sensor = ["optical=FRAME"] if unknown else []
    if not poses:
        return [sensor or ["poses=FILE"]]
    return [[]] if len(poses) == 1 and not sensor else [[pose, *sensor] for pose in poses]


def _sources(reader: TopicSource, tree: TransformTree, frame: str, chosen: list[str]) -> list[str]:
    """The source's name with the options that have to be ``chosen`` for a topic, for each source of poses."""
    found = [[*chosen, *pose] for pose in _pose_options(reader, tree, frame)]
    mark = "&" if isinstance(reader.path, str) and "?" in reader.path else "?"  # a robot's domain
    return [f"{reader.path}{mark}{'&'.join(options)}" if options else str(reader.path) for options in found]
