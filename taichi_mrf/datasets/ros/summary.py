"""The contents of a bag for a user who wants to map it: topics, frames, and the options that choose them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from taichi_mrf.datasets.ros.bag import REALSENSE
from taichi_mrf.datasets.ros.poses import pose_candidates
from taichi_mrf.datasets.ros.reader import RosReader, Topic
from taichi_mrf.datasets.ros.tf import Transforms, TransformTree, read_transforms, tree_of
from taichi_mrf.datasets.ros.topics import DepthTopic, cloud_topics, depth_topics, message_frame
from taichi_mrf.datasets.timed_poses import TimedPoses
from taichi_mrf.errors import DatasetError


@dataclass(frozen=True)
class BagSummary:
    """The contents of a bag.

    ``remarks`` describe topics, by name, beyond their type. ``transforms`` are the tree's edges
    in words. ``sources`` are what to call the bag so that it can be mapped, with ``flags`` to add; the first
    needs the least to be filled in.
    """

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
    """Look into a bag. Raises DatasetError, whose text names the file, if it cannot be read."""
    reader = RosReader(path)
    try:
        topics = list(reader.topics.values())
        if any(topic.name.startswith(REALSENSE) for topic in topics):
            return BagSummary(topics, {}, reader.duration, [], [f"realsense:{path}?poses=FILE"], "")
        depth, sent = depth_topics(reader), read_transforms(reader)
        remarks = {each.name: f"depth, {each.encoding}, frame {each.frame or 'unnamed'}" for each in depth}
        clouds = {name: message_frame(reader, name) for name in cloud_topics(reader)}
        remarks |= {name: f"points, frame {frame or 'unnamed'}" for name, frame in clouds.items()}
        frames = clouds | {each.name: each.frame for each in depth} or {"": ""}
        trees = {name: _tree(sent, name, frame) for name, frame in frames.items()}
        return BagSummary(
            topics,
            remarks,
            reader.duration,
            list(dict.fromkeys(words for tree in trees.values() for words in _transforms(tree))),
            [*_sources(reader, trees, depth), *_cloud_sources(reader, trees, clouds, bool(depth))],
            "" if all(each.info for each in depth) else " --camera fx,fy,cx,cy",
        )
    finally:
        reader.close()


def _tree(sent: dict[str, Transforms], topic: str, frame: str) -> TransformTree:
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


def _cloud_sources(
    reader: RosReader, trees: Mapping[str, TransformTree], clouds: dict[str, str], has_depth: bool
) -> list[str]:
    """The same for each pair of a topic of point clouds and a source of poses."""
    sources = []
    for name, frame in clouds.items():
        points = [f"points={name}"] if has_depth or len(clouds) > 1 else []
        sources += [
            f"{reader.path}?{'&'.join(options)}" if options else str(reader.path)
            for options in ([*points, *pose] for pose in _pose_options(reader, trees[name], frame))
        ]
    return sources


def _pose_options(reader: RosReader, tree: TransformTree, frame: str) -> list[list[str]]:
    """For each source of poses the options that choose it."""
    try:
        poses = [f"pose={name}" for name in pose_candidates(reader, tree, frame)]
    except DatasetError:  # frames that form a cycle
        poses = []
    return [[]] if len(poses) == 1 else [[pose] for pose in poses or ["poses=FILE"]]


def _sources(reader: RosReader, trees: Mapping[str, TransformTree], depth: Sequence[DepthTopic]) -> list[str]:
    """A source name for each pair of a depth topic and a source of poses, with the options that are
    ambiguous."""
    sources = []
    for topic in depth:
        for pose in _pose_options(reader, trees[topic.name], topic.frame):
            options = [f"depth={topic.name}"] if len(depth) > 1 else []
            options += [f"info={topic.info[0]}"] if len(topic.info) > 1 else []
            options += pose
            sources.append(f"{reader.path}?{'&'.join(options)}" if options else str(reader.path))
    return sources
