"""``foxglove:ws://robot:8765?depth=/camera/depth/image_raw&pose=/odom&frame=map``: depth images, or
``?points=/points`` point clouds, from a robot that runs, whose ``foxglove_bridge`` sends its topics; or
``zenoh:tcp/robot:7447`` from one whose ROS 2 runs over Zenoh.

Topics, cameras and poses are chosen as in a bag (ros/sensor.py), from what is heard in the first seconds, and
by the same options. How messages become frames is in stream.py.
"""

import time
import weakref
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.confidence import L515
from taichi_mrf.datasets.depth_scale import check_metres
from taichi_mrf.datasets.entries import FOXGLOVE, ZENOH
from taichi_mrf.datasets.lidar.scans import DENSER_POSES, reach_of
from taichi_mrf.datasets.options import TRACK, ReadOptions, parse_options
from taichi_mrf.datasets.ros import messages
from taichi_mrf.datasets.ros.bag import BagSummary, by_axes, summary_of
from taichi_mrf.datasets.ros.beside import (
    COLOR_GAP,
    Beside,
    find_colors,
    find_confidence,
    find_imu,
    is_beside,
)
from taichi_mrf.datasets.ros.lidar import Clouds, find_clouds, maps_clouds
from taichi_mrf.datasets.ros.poses import BagPoses
from taichi_mrf.datasets.ros.sensor import BagSensor, SensorChoice, find_depth_camera
from taichi_mrf.datasets.ros.sources import Topic
from taichi_mrf.datasets.timed_poses import largest_gap
from taichi_mrf.datasets.wires.client import Client
from taichi_mrf.datasets.wires.foxglove import FoxgloveClient
from taichi_mrf.datasets.wires.heard import NEEDED, HeardTopics
from taichi_mrf.datasets.wires.rmw_zenoh import ZenohClient
from taichi_mrf.datasets.wires.stream import CameraRobot, LidarRobot, Robot
from taichi_mrf.errors import DatasetError
from taichi_mrf.sensor.frame import Frame

LISTEN_S = 2.0
"""Seconds in which what tells the frames and poses is heard, also map -> odom of a localiser at 1 Hz."""

DECIDE_S = 3.0
"""So much longer it is tried to find out what is mapped."""

_LOOKED_AT = 4
"""Images whose numbers are looked at when a robot is opened."""

ENDLESS = "the stream never ends: --keep-live N bounds the memory, --keyframes.* selects fewer keyframes"


@dataclass(frozen=True)
class ZenohChoice(SensorChoice):
    """Choice of topics on a robot whose ROS 2 runs over Zenoh."""

    domain: int = 0
    """The robot's ROS_DOMAIN_ID."""


def _opened(wire: str, text: str, options: ReadOptions) -> Dataset:
    """Connect to a robot: ``ADDRESS?option=value&...``; over Zenoh the address may be missing. Raises
    DatasetError, naming the address, if it cannot be reached, and as a bag if it is not clear what to map."""
    heard, chosen = _connected(f"{wire}{text}")
    if options.track:
        chosen = replace(chosen, poses=TRACK)
    try:
        robot = _open(heard, chosen, options)
    except BaseException:
        heard.client.close()
        raise
    weakref.finalize(robot, heard.client.close)
    return robot


open_foxglove, open_zenoh = partial(_opened, FOXGLOVE), partial(_opened, ZENOH)


def summarise(source: str) -> BagSummary:
    """Summary of a robot's messages, from a few seconds of listening. Raises DatasetError."""
    heard, _ = _connected(source)
    try:
        _listen(heard, _needed(heard, SensorChoice(), color=True))
        return summary_of(heard)
    finally:
        heard.client.close()


def _connected(source: str) -> tuple[HeardTopics, SensorChoice]:
    """A robot's topics, and what its options choose."""
    name, _, query = source.partition("?")
    address = name.partition(":")[2]
    choice = parse_options(ZenohChoice if name.startswith(ZENOH) else SensorChoice, query, name)
    client: Client
    if isinstance(choice, ZenohChoice):
        client = ZenohClient(address, choice.domain)
    else:
        client = FoxgloveClient(address)
    try:
        return HeardTopics(client), choice
    except BaseException:
        client.close()
        raise


def _needed(heard: HeardTopics, chosen: SensorChoice, color: bool) -> list[str]:
    """The topics that tell what is mapped; of images and clouds, if the user has named one, that and what may
    belong to it."""
    wanted = chosen.points or chosen.depth
    types = (*NEEDED, messages.IMU) if chosen.poses == TRACK else NEEDED

    def may_belong(topic: Topic) -> bool:
        if topic.name.strip("/") == wanted.strip("/"):
            return True
        if chosen.points or topic.type not in messages.IMAGES:
            return False
        others = {name.strip("/") for name in (chosen.color, chosen.confidence) if name}
        beside = not chosen.confidence and is_beside(topic.name, f"/{wanted.strip('/')}")
        return topic.name.strip("/") in others or beside or (color and not chosen.color)

    return [
        topic.name
        for topic in heard.topics.values()
        if topic.type in types and (topic.type not in messages.OF_SENSORS or not wanted or may_belong(topic))
    ]


def _listen(heard: HeardTopics, topics: Collection[str]) -> None:
    heard.client.subscribe(topics)
    end = time.monotonic() + LISTEN_S
    while time.monotonic() < end:
        time.sleep(0.01)
        heard.hear()


def _open(heard: HeardTopics, chosen: SensorChoice, options: ReadOptions) -> Robot:
    _listen(heard, _needed(heard, chosen, options.color))
    robot = _decided(heard, chosen, options)
    kept = [robot.sensor.topic]
    kept += robot.topics if isinstance(robot, CameraRobot) else []
    if not chosen.poses:
        kept += [t.name for t in heard.topics.values() if t.type in (*messages.TF, *messages.POSES)]
    heard.client.subscribe(kept)
    return robot


def _parts(
    heard: HeardTopics, sensor: BagSensor, poses: dict[str, BagPoses], options: ReadOptions
) -> dict[str, Any]:
    """The parts of a robot that are the same for all sensors."""
    notes = [*sensor.notes, *(note for each in poses.values() for note in each.notes)]
    return {
        "name": str(heard.path),
        "notes": [ENDLESS, *dict.fromkeys(notes)],
        "heard": heard,
        "sensor": sensor,
        "poses": poses,
        "gap": largest_gap(options),
    }


def _with_camera(heard: HeardTopics, chosen: SensorChoice, options: ReadOptions) -> Robot:
    mapped = find_depth_camera(heard, chosen, options)
    depth, sensor, cameras, poses = mapped
    tracked, colors, imu = chosen.poses == TRACK, None, None
    if options.depth_scale is None:
        depths = []
        for entry in sensor.entries[:_LOOKED_AT]:
            with suppress(DatasetError):  # reported when its frame is read
                depths.append(messages.depth_image(heard.read(depth.name, entry), None))
        check_metres(depths, f"{heard.path}: topic {depth.name}")
    poses, said = by_axes(heard, mapped, chosen, options)
    stamps = [entry.stamp for entry in sensor.entries]
    of_depth = (depth, cameras.first, stamps, options.max_time_gap)
    if options.color:
        colors, words = find_colors(sensor, chosen.color, *of_depth)
        said += _without_counts(words, colors)
    confidences, words = find_confidence(sensor, chosen.confidence, *of_depth)
    said += _without_counts(words, confidences)
    if tracked:
        imu, words = find_imu(sensor, chosen.imu, stamps[-1])
        said += words
    parts = _parts(heard, sensor, poses, options)
    parts["notes"] += [*said, *cameras.notes]
    return CameraRobot(
        camera=cameras.first,
        distortion=cameras.distortion,
        tracked=tracked,
        confidence=L515 if confidences else None,
        mapped=mapped,
        depth_scale=options.depth_scale,
        colors=colors,
        confidences=confidences,
        beside_gap=COLOR_GAP if options.max_time_gap is None else options.max_time_gap,
        imu=imu,
        **parts,
    )


def _without_counts(notes: list[str], beside: Beside | None) -> list[str]:
    """Notes of images that are used without how many of those that were heard so far have none."""
    return [each.partition(";")[0] if beside else each for each in notes]


def _with_lidar(heard: HeardTopics, chosen: SensorChoice, options: ReadOptions) -> Robot:
    sensor, poses, clouds = find_clouds(heard, chosen, options)
    parts = _parts(heard, sensor, poses, options)
    gap = parts["gap"]
    if clouds.at is not None and any(each.are_apart(2 * gap) for each in poses.values()):
        why = f"most poses are more than {2 * gap:g} s apart; {DENSER_POSES}"
        parts["notes"].append(f"{clouds.topic}: times of points do not undo the lidar's motion: {why}")
        clouds = replace(clouds, at=None)
    first = _first_cloud(heard, sensor, poses, clouds, gap)
    parts["notes"].append(clouds.in_words(first.camera))
    return LidarRobot(
        camera=first.camera,
        reach_m=reach_of(first.depth_m),
        tracked=chosen.poses == TRACK,
        clouds=clouds,
        **parts,
    )


def _first_cloud(
    heard: HeardTopics, sensor: BagSensor, poses: dict[str, BagPoses], clouds: Clouds, gap: float
) -> Frame:
    """The first cloud that can be read, if possible one with a pose: it tells rays and reach. Raises
    DatasetError if there is none."""
    problem: DatasetError | None = None
    posed = [(entry, poses[entry.frame].at(entry.stamp, gap)) for entry in sensor.entries]
    for entry, pose in sorted(posed, key=lambda each: each[1] is None):
        try:
            message = heard.read(sensor.topic, entry)
            return clouds.frame(entry, message, np.eye(4) if pose is None else pose, entry.stamp, "")
        except DatasetError as error:
            problem = problem or error
    raise DatasetError(f"{heard.path}: no cloud can be read: {problem}") from problem


def _decided(heard: HeardTopics, chosen: SensorChoice, options: ReadOptions) -> Robot:
    """The robot, as soon as enough has been heard to tell what is mapped. Raises DatasetError."""
    end = time.monotonic() + DECIDE_S
    while True:
        try:
            find = _with_lidar if maps_clouds(heard, chosen) else _with_camera
            return find(heard, chosen, options)
        except DatasetError as error:
            if time.monotonic() > end:
                needed = _needed(heard, chosen, options.color)
                silent = [name for name in needed if not heard.topics[name].messages]
                said = f"; nothing came on {', '.join(silent)} in {heard.duration:.0f} s" if silent else ""
                said += f"; {heard.problem}" if heard.problem else ""
                raise DatasetError(f"{error}{said}") from error
        time.sleep(0.1)
        heard.hear()
