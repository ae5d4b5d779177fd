"""The poses of a bag as they were known at each time of the recording, with what was corrected by then.

- A topic of ``nav_msgs/Path`` has all poses of a body so far in each message. The last message counts.
- ``tf``: the transform between the root and the first frame below it that moves (map and odom) is the one
  that a SLAM system corrects. The pose of a camera at time s, as known at time t, is T_map_odom(t)
  T_odom_camera(s), as tf2 looks up a transform between two times. Each change of T_map_odom moves all
  earlier poses by the same.
- A topic of single poses does not change.
"""

import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from taichi_mrf.datasets.options import parse_options
from taichi_mrf.datasets.pose_sources.base import ChangedPoses, FrameKey
from taichi_mrf.datasets.ros import messages
from taichi_mrf.datasets.ros.poses import PoseChoice, body_of, find_poses, must_connect, pose_candidates
from taichi_mrf.datasets.ros.reader import RosReader
from taichi_mrf.datasets.ros.runs import BagRun
from taichi_mrf.datasets.ros.sensor import BagSensor, find_sensor
from taichi_mrf.datasets.ros.sources import NANOSECONDS, Entry
from taichi_mrf.datasets.ros.tf import TransformTree, read_transforms, tree_of
from taichi_mrf.datasets.ros.topics import (
    FROM_TF,
    choose,
    cloud_topics,
    depth_topics,
    message_frame,
    topics_of,
)
from taichi_mrf.datasets.timed_poses import INTERPOLATION_GAP, TimedPoses
from taichi_mrf.errors import DatasetError, KeyframeError, naming
from taichi_mrf.geometry.poses import as_pose

CORRECTED = 1e-6
"""A transform that differs by more than this in a number (metres, radians) was corrected, not sent again."""

LEAST_STEP_S = 0.02
"""Poses from tf are given no denser than this (seconds), and interpolated in between."""


@dataclass
class PoseHistory:
    """Poses that change at the times ``since`` (seconds, ascending); ``version`` gives those from one of
    these times on, by its number."""

    name: str
    since: Sequence[float]
    version: Callable[[int], ChangedPoses]
    problem: str | None = None
    _shown: int = field(default=-1, init=False)

    def poll(self, stamp_s: float) -> ChangedPoses | None:
        """The poses that were known at a time in seconds, None if they are those of the last call."""
        number = int(np.searchsorted(self.since, stamp_s, side="right")) - 1
        if number in (-1, self._shown):
            return None
        self._shown = number
        return self.version(number)


def open_history(path: Path, query: str) -> PoseHistory:
    """The poses that a bag tells, chosen by options after the question mark: ``pose``, ``body``, ``optical``,
    ``frame``, ``tf`` and ``run``, as for a bag that is mapped. Raises DatasetError, naming file and topic."""
    choice = parse_options(PoseChoice, query, str(path))
    if choice.poses:
        raise DatasetError(f"{path}: ?poses= does not work with --poses; ?pose= names a topic, or tf")
    reader = RosReader(path)
    try:
        history = _open(reader, choice)
    except DatasetError:
        reader.close()
        raise
    weakref.finalize(history, reader.close)
    return history


def _open(reader: RosReader, choice: PoseChoice) -> PoseHistory:
    sensor = _sensor(reader, choice)
    optical = sensor.frame if sensor else choice.optical
    run = sensor.run if sensor else BagRun()
    tree = sensor.tree() if sensor else tree_of(read_transforms(reader), "", optical, choice.tf)
    tree = tree.towards(choice.frame, choice.body)
    paths = topics_of(reader, messages.PATH)
    wanted = choice.pose
    if not wanted and len(paths) != 1:
        others = pose_candidates(reader, tree, optical) if optical else []
        wanted = choose(reader, "pose", "", list(dict.fromkeys([*paths, *others])), "topics of poses")
    name = wanted or paths[0]
    if name == FROM_TF:
        return _from_tree(reader, tree, optical, choice)
    name = choose(reader, "pose", name, paths, "topics of poses")
    if reader.topics[name].type == messages.PATH:
        return _from_paths(reader, name, tree, optical, choice, run)
    return _from_poses(reader, name, optical, choice, tree, run)


def _sensor(reader: RosReader, choice: PoseChoice) -> BagSensor | None:
    """The sensor of the bag's only topic of depth images or clouds, or of all such topics if they are of one
    frame; None if there are several or none."""
    topics = {topic.name: topic.frame for topic in depth_topics(reader)}
    topics |= {name: message_frame(reader, name) for name in cloud_topics(reader)}
    if len(set(topics.values())) != 1:
        return None
    return find_sensor(reader, next(iter(topics)), "messages", choice)


def _from_paths(
    reader: RosReader, topic: str, tree: TransformTree, optical: str, choice: PoseChoice, run: BagRun
) -> PoseHistory:
    """Each message of a Path is a version."""
    if choice.body:
        must_connect(reader, tree, choice.body, optical)
    with naming(f"{reader.path}: topic {topic}"):
        body, _ = body_of(tree, optical, choice.body, topic, message_frame(reader, topic))
    entries: Sequence[Entry] = [entry for entry, message in reader.messages(topic) if message.poses]
    if not entries:
        raise DatasetError(f"{reader.path}: topic {topic}: no message contains a pose")
    entries = sorted(run.of(entries), key=lambda entry: entry.stamp)

    def version(number: int) -> ChangedPoses:
        found: dict[FrameKey, ArrayLike] = {}
        for each in reader.read(topic, entries[number]).poses:
            stamp = messages.header_ns(each.header) / NANOSECONDS
            T_body_optical = tree.lookup(body, optical, stamp, INTERPOLATION_GAP)
            if T_body_optical is None:
                continue
            with naming(f"{reader.path}: topic {topic}: the pose at {stamp:.3f} s", KeyframeError):
                found[stamp] = as_pose(messages.pose_of(each)) @ T_body_optical
        return found

    return PoseHistory(f"{reader.path}: {topic}", [entry.stamp for entry in entries], version)


def _from_tree(reader: RosReader, tree: TransformTree, optical: str, choice: PoseChoice) -> PoseHistory:
    """Each correction of the uppermost transform that moves is a version."""
    if not optical:
        raise DatasetError(f"{reader.path}: ?pose=tf needs the camera's frame: add &optical=FRAME")
    if not choice.frame:
        tree.check(optical)
    fixed = choice.frame or tree.ancestors(optical)[-1]
    must_connect(reader, tree, fixed, optical)
    moving = [
        (frame, edge)
        for frame in reversed(tree.ancestors(optical)[:-1])
        if isinstance(edge := tree.edges[frame][1], TimedPoses)
    ]
    if len(moving) < 2:
        raise DatasetError(
            f"{reader.path}: tf corrects nothing between {fixed} and {optical}: fewer than two transforms "
            "move there; ?pose= names a topic"
        )
    (odom, correction), (_, fastest) = moving[0], moving[-1]
    T_fixed_map = tree.lookup(fixed, tree.edges[odom][0], 0.0, np.inf)
    if T_fixed_map is None:
        raise DatasetError(f"{reader.path}: tf: {fixed} moves with what is corrected; choose another ?frame=")
    changes = np.abs(np.diff(correction.poses, axis=0)).max(axis=(1, 2), initial=0.0) > CORRECTED
    firsts = [0, *(np.flatnonzero(changes) + 1).tolist()]
    T_odom_optical = {
        stamp: T
        for stamp in _thinned(fastest.stamps)
        if (T := tree.lookup(odom, optical, stamp, INTERPOLATION_GAP)) is not None
    }

    def version(number: int) -> ChangedPoses:
        T_fixed_odom = T_fixed_map @ correction.poses[firsts[number]]
        return {stamp: T_fixed_odom @ T for stamp, T in T_odom_optical.items()}

    since = [float(correction.stamps[first]) for first in firsts]
    return PoseHistory(f"{reader.path}: tf from {fixed} to {optical}", since, version)


def _from_poses(
    reader: RosReader, topic: str, optical: str, choice: PoseChoice, tree: TransformTree, run: BagRun
) -> PoseHistory:
    """A topic of single poses is one version."""
    found = find_poses(reader, optical, choice, lambda: tree, run)
    stamps = [entry.stamp for entry in run.of([entry for entry, _ in reader.messages(topic)])]

    def version(number: int) -> ChangedPoses:
        poses = {stamp: found.at(stamp, INTERPOLATION_GAP) for stamp in stamps}
        return {stamp: T for stamp, T in poses.items() if T is not None}

    return PoseHistory(f"{reader.path}: {topic}", [float("-inf")], version)


def _thinned(stamps: np.ndarray) -> list[float]:
    """The stamps without those that are nearer than LEAST_STEP_S to the last one that stays."""
    kept: list[float] = []
    for stamp in stamps.tolist():
        if not kept or stamp - kept[-1] >= LEAST_STEP_S:
            kept.append(stamp)
    return kept
