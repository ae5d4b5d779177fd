"""``foxglove:ws://robot:8765?depth=/camera/depth/image_raw&pose=/odom&frame=map``: depth images from a robot
that runs, whose ``foxglove_bridge`` sends its topics.

Topics, cameras and poses are chosen as in a bag (ros/sensor.py), from what is heard in the first seconds, and
by the same options. The pose of an image is interpolated as soon as the next pose has come. Of the images
whose poses are known the newest is the next frame: where mapping is slower than the camera, older ones are
skipped.
"""

import math
import time
import weakref
from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from taichi_mrf.datasets.base import Arrivals, Dataset, EndlessNames
from taichi_mrf.datasets.lidar.scans import LidarRecording, reach_of
from taichi_mrf.datasets.options import TRACK, ReadOptions, parse_options
from taichi_mrf.datasets.ros import messages
from taichi_mrf.datasets.ros.bag import BagSummary, summary_of
from taichi_mrf.datasets.ros.lidar import Clouds, find_clouds, maps_clouds
from taichi_mrf.datasets.ros.poses import BagPoses
from taichi_mrf.datasets.ros.sensor import BagSensor, DepthCamera, SensorChoice, find_depth_camera
from taichi_mrf.datasets.ros.sources import Entry
from taichi_mrf.datasets.timed_poses import largest_gap
from taichi_mrf.datasets.trajectories import RESTART_S
from taichi_mrf.datasets.wires.foxglove import MOST_IMAGES, FoxgloveClient, wait_until
from taichi_mrf.datasets.wires.heard import NEEDED, Heard, HeardTopics
from taichi_mrf.errors import DatasetError, FrameError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.frame import Frame

LISTEN_S = 2.0
"""Seconds in which what tells the frames and poses is heard, also map -> odom of a localiser at 1 Hz."""

DECIDE_S = 3.0
"""So much longer it is tried to find out what is mapped."""

LATE_S = 1.0
"""Poses come at most so much later than the largest gap allows; an image that has none by then gets none."""

CLOCKS_S = 5.0
"""Stamps that are further from when they arrive are of another clock, not late."""

CLOCK = "/clock"
"""The topic of simulated time."""

SILENCE_S = 10.0
"""A robot that sends no image that can be mapped for so long has ended, for who waits for one."""

ENDLESS = "a robot never ends: --keep-live N bounds the memory, --keyframes.* selects fewer keyframes"


class Posed(NamedTuple):
    """A message of the sensor: its number, what was heard, how much later than stamped it counts, as the
    clock has started again, and T_world_camera, (4, 4), None while it waits for that."""

    number: int
    heard: Heard
    later_s: float
    pose: Pose | None = None


@dataclass
class Robot(Dataset):
    """The messages of one sensor of a robot that runs. ``load`` makes a frame of one, whose stamp and name it
    is given, and asks for poses up to a time, ``until``. ``skipped`` counts those that were older than the
    newest, ``dropped`` those without a pose, ``jumps`` how often the robot's time jumped back."""

    heard: HeardTopics = field(kw_only=True)
    sensor: BagSensor = field(kw_only=True)
    poses: dict[str, BagPoses] = field(kw_only=True)
    load: Callable[[Entry, Any, Pose, float, str], Frame] = field(kw_only=True)
    until: Callable[[Entry, Any], float] = lambda entry, message: entry.stamp
    gap: float = 0.0
    skipped: int = 0
    jumps: int = 0

    def __post_init__(self) -> None:
        self._came = 0
        self._waiting: deque[Posed] = deque()
        self._next: Posed | None = None
        self._newest_s = self._read_s = -math.inf
        self._latest: tuple[float, float] | None = None  # the sensor's last stamp, and when it arrived
        self._later_s = self._off_s = 0.0
        self._news: dict[str, str] = {}  # said once of each subject
        moving = [each for poses in self.poses.values() for each in poses.moving]
        self._moving = list({id(each): each for each in moving}.values())
        kept = {(e.entry.recorded_ns, e.entry.ordinal): e for e in self.heard.kept(self.sensor.topic)}
        entries = self.sensor.entries  # whose stamps are mended
        self._take([kept[e.recorded_ns, e.ordinal]._replace(entry=e) for e in entries])
        self.heard.forget()

    @property
    def endless(self) -> bool:
        """A robot never ends."""
        return True

    @property
    def frame_names(self) -> Sequence[str]:
        """The numbers of messages."""
        return EndlessNames()

    def awaiting(self) -> str:
        """Why there is no frame."""
        self._take(self.heard.hear())
        if self._next is not None:
            return ""
        if self.heard.client.problem:
            return f"the robot: {self.heard.client.problem}"
        skipped = self.skipped + self.heard.client.dropped[self.sensor.topic]
        counted = [f"{skipped} skipped, as mapping is slower"] if skipped else []
        counted += [f"{self.dropped} left out: no poses within {self.gap:g} s on both sides"] * (
            self.dropped > 0
        )
        counted += [f"time has jumped back {self.jumps} times"] if self.jumps > 1 else []
        counted += [self.heard.problem] if self.heard.problem else []
        one = self.sensor.what.removesuffix("s")
        return f"the next {one} of {self._came}" + (f" ({'; '.join(counted)})" if counted else "")

    def arrivals(self) -> Arrivals:
        """The rate of the sensor; the age is that by stamps, or where the clocks differ, since it came."""
        age_s = time.monotonic() - self._read_s + (self._off_s if abs(self._off_s) <= CLOCKS_S else 0.0)
        rate_hz = self.heard.client.rate_hz(self.sensor.topic)
        return Arrivals(rate_hz, None if math.isinf(age_s) else max(0.0, age_s), tuple(self._news.values()))

    def read(self, index: int) -> Frame:
        """The newest image with a pose, whatever the index. Raises DatasetError if none comes for SILENCE_S
        seconds, FrameError for one that cannot be decoded."""
        if not wait_until(lambda: not self.awaiting(), SILENCE_S):
            why = f"nothing to map for {SILENCE_S:g} s: waiting for {self.awaiting()}"
            raise DatasetError(f"{self.heard.path}: {why}")
        assert self._next is not None
        (number, (_, entry, message, arrived_s), later_s, pose), self._next = self._next, None
        assert pose is not None
        self._compare_clocks(entry.stamp, arrived_s)
        try:
            return self.load(entry, message, pose, entry.stamp + later_s, f"{number:06d}")
        except DatasetError as error:
            raise FrameError(f"frame {number:06d}: {error}") from error

    def _compare_clocks(self, stamp: float, arrived_s: float) -> None:
        """Note when an image arrived, and how far its stamp is from that; say it if it is no delay."""
        self._read_s = arrived_s
        self._off_s = time.time() - (time.monotonic() - arrived_s) - stamp
        if abs(self._off_s) <= CLOCKS_S:
            return
        why = "a clock is wrong, time is simulated, or a bag is played"
        if CLOCK in self.heard.client.channels:
            why = f"time is simulated or a bag's, by {CLOCK}"
        side = "before" if self._off_s > 0 else "after"
        off = f"{_in_words(abs(self._off_s))} {side} this machine's clock"
        said = f"the stamps of {self.sensor.topic} are {off}: {why}; ages are counted from arrival"
        self._news.setdefault("clocks", said)

    def _take(self, heard: Sequence[Heard]) -> None:
        """Take what has come: images wait for their poses."""
        for each in heard:
            self._newest_s = max(self._newest_s, each.arrived_s)
            if each.topic.name == self.sensor.topic:
                self._take_image(each)
                continue
            restarts = [edge.restarts for edge in self._moving]
            for poses in self.poses.values():
                poses.hear(each.topic, each.entry, each.message)
            for edge, before in zip(self._moving, restarts, strict=True):
                if edge.restarts > before:
                    self._begin_again(float(edge.stamps[-1]), each.arrived_s)
        while self._waiting and self._is_decided(self._waiting[0]):
            image = self._waiting.popleft()
            entry = image.heard.entry
            pose = self.poses[entry.frame].at(entry.stamp, self.gap) if entry.frame in self.poses else None
            if pose is None:
                self.dropped += 1
                continue
            self.skipped += self._next is not None
            self._next = image._replace(pose=pose)

    def _take_image(self, heard: Heard) -> None:
        stamp = heard.entry.stamp
        self._begin_again(stamp, heard.arrived_s)
        self._latest = max(stamp, self._latest[0] if self._latest else stamp), heard.arrived_s
        self._waiting.append(Posed(self._came, heard, self._later_s))
        self._came += 1
        if len(self._waiting) > MOST_IMAGES:
            self._waiting.popleft()
            self.dropped += 1

    def _begin_again(self, stamp: float, arrived_s: float) -> None:
        """If the robot's time has jumped back, to a ``stamp``, drop the poses and images of before. The map's
        time goes on by as much as has passed here."""
        if self._latest is None or stamp >= self._latest[0] - RESTART_S:
            return
        (latest, at_s), end = self._latest, stamp + RESTART_S
        for edge in self._moving:
            edge.forget_after(end)
        kept = [image for image in self._waiting if image.heard.entry.stamp <= end]
        self.dropped += len(self._waiting) - len(kept)
        self._waiting = deque(kept)
        self._later_s += latest + max(0.0, arrived_s - at_s) - stamp
        self._latest = stamp, arrived_s
        self.jumps += 1
        by = _in_words(latest - stamp)
        self._news.setdefault(
            "jump",
            f"the robot's time has jumped back by {by}, as of a bag that is played again or a simulation "
            "that starts again: the poses of before are dropped, and mapping goes on",
        )

    def _is_decided(self, image: Posed) -> bool:
        """True if the poses around an image have come, or will not come any more."""
        _, entry, message, arrived_s = image.heard
        poses = self.poses.get(entry.frame)
        if poses is None or self.until(entry, message) <= poses.until:
            return True
        return self._newest_s - arrived_s > self.gap + LATE_S


@dataclass
class LidarRobot(Robot, LidarRecording):
    """The point clouds of a robot that runs."""


def _in_words(seconds: float) -> str:
    """A time in the unit that suits it."""
    for unit, length in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.1f} s"


def _depth_frame(
    mapped: DepthCamera, depth_scale: float | None, where: str,
    entry: Entry, message: Any, pose: Pose, stamp: float, name: str,
) -> Frame:  # fmt: skip
    """The frame of an image of depth."""
    depth_m, camera = mapped.cameras.measured(message, entry, depth_scale, where)
    return Frame(depth_m, pose, camera, stamp, name)


def open_foxglove(text: str, options: ReadOptions) -> Dataset:
    """Connect to a robot: ``ADDRESS?option=value&...``. Raises DatasetError, which names the address, if it
    cannot be reached, and as a bag does if it is not clear what to map."""
    address, _, query = text.partition("?")
    chosen = parse_options(SensorChoice, query, f"foxglove:{address}")
    if options.track:
        chosen = replace(chosen, poses=TRACK)
    heard = _connected(address)
    try:
        robot = _open(heard, chosen, options)
    except BaseException:
        heard.client.close()
        raise
    weakref.finalize(robot, heard.client.close)
    return robot


def summarise(address: str) -> BagSummary:
    """What a robot sends, from a few seconds of listening. Raises DatasetError."""
    heard = _connected(address)
    try:
        _listen(heard, _needed(heard, SensorChoice()))
        return summary_of(heard)
    finally:
        heard.client.close()


def _connected(address: str) -> HeardTopics:
    client = FoxgloveClient(address)
    try:
        return HeardTopics(f"foxglove:{client.address}", client)
    except BaseException:
        client.close()
        raise


def _needed(heard: HeardTopics, chosen: SensorChoice) -> list[str]:
    """The topics that tell what is mapped; of images and clouds one only, if the user has named it."""
    wanted = chosen.points or chosen.depth
    named = wanted if wanted in heard.topics else f"/{wanted}"
    return [
        topic.name
        for topic in heard.topics.values()
        if topic.type in NEEDED
        and (topic.type not in messages.OF_SENSORS or not wanted or topic.name == named)
    ]


def _listen(heard: HeardTopics, topics: Collection[str]) -> None:
    heard.ask_for(topics)
    end = time.monotonic() + LISTEN_S
    while time.monotonic() < end:
        time.sleep(0.01)
        heard.hear()


def _open(heard: HeardTopics, chosen: SensorChoice, options: ReadOptions) -> Robot:
    _listen(heard, _needed(heard, chosen))
    robot = _decided(heard, chosen, options)
    kept = [robot.sensor.topic]
    if chosen.poses != TRACK and not chosen.poses:
        kept += [t.name for t in heard.topics.values() if t.type in (*messages.TF, *messages.POSES)]
    heard.ask_for(kept)
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
    parts = _parts(heard, mapped.sensor, mapped.poses, options)
    parts["notes"] += mapped.cameras.notes
    where = f"{heard.path}: topic {mapped.depth.name}"
    return Robot(
        camera=mapped.cameras.first,
        distortion=mapped.cameras.distortion,
        tracked=chosen.poses == TRACK,
        load=partial(_depth_frame, mapped, options.depth_scale, where),
        **parts,
    )


def _with_lidar(heard: HeardTopics, chosen: SensorChoice, options: ReadOptions) -> Robot:
    sensor, poses, clouds = find_clouds(heard, chosen, options)
    parts = _parts(heard, sensor, poses, options)
    first = _first_cloud(heard, sensor, poses, clouds, parts["gap"])
    parts["notes"] += [clouds.in_words(first.camera)]
    return LidarRobot(
        camera=first.camera,
        reach_m=reach_of(first.depth_m),
        tracked=chosen.poses == TRACK,
        load=clouds.frame,
        until=clouds.until,
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
                silent = [name for name in _needed(heard, chosen) if not heard.topics[name].messages]
                said = f"; nothing came on {', '.join(silent)} in {heard.duration:.0f} s" if silent else ""
                raise DatasetError(f"{error}{said}") from error
        time.sleep(0.1)
        heard.hear()
