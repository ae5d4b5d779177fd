"""The frames of a sensor of a robot that runs: images or clouds that wait for their poses.

Of those that are whole the newest is the next frame: where mapping is slower than the sensor, older ones are
skipped. Nothing waits without bound. Where the robot's time jumps back, what was heard before is dropped.
"""

import math
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any, NamedTuple

from taichi_mrf.datasets.base import Arrivals, Dataset, EndlessNames, start_pose
from taichi_mrf.datasets.lidar.scans import LidarRecording
from taichi_mrf.datasets.ros.beside import COLOR_GAP, BagImu, Beside, imu_row
from taichi_mrf.datasets.ros.lidar import Clouds
from taichi_mrf.datasets.ros.poses import BagPoses
from taichi_mrf.datasets.ros.sensor import BagSensor, DepthCamera
from taichi_mrf.datasets.ros.sources import Entry
from taichi_mrf.datasets.trajectories import RESTART_S
from taichi_mrf.datasets.wires.client import MOST_IMAGES, wait_until
from taichi_mrf.datasets.wires.heard import Heard, HeardTopics
from taichi_mrf.errors import DatasetError, FrameError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.motion import MOST_SAMPLES, upwards_at

LATE_S = 1.0
"""Poses come at most so much later than the largest gap allows, by the robot's stamps and by this machine's
clock; an image that has none by then gets none."""

CLOCKS_S = 5.0
"""Stamps that are further from when they arrive are of another clock, not late."""

CLOCK = "/clock"
"""The topic of simulated time."""

SILENCE_S = 10.0
"""A robot that sends no image that can be mapped for so long has ended, for who waits for one."""


class Posed(NamedTuple):
    """A message of the sensor: its number, what was heard, up to when poses are needed for it, how much later
    than stamped it counts, as the clock has started again, T_world_camera, (4, 4), None while it waits for
    that, and the images of other topics that belong to it, by these."""

    number: int
    heard: Heard
    until_s: float
    later_s: float
    pose: Pose | None = None
    beside: Mapping[str, Any] = {}


@dataclass
class Robot(Dataset):
    """The messages of one sensor of a robot that runs. ``skipped`` counts those that were older than the
    newest, ``dropped`` those without a pose, ``jumps`` how often the robot's time jumped back."""

    heard: HeardTopics = field(kw_only=True)
    sensor: BagSensor = field(kw_only=True)
    poses: dict[str, BagPoses] = field(kw_only=True)
    gap: float = 0.0
    skipped: int = 0
    jumps: int = 0

    def __post_init__(self) -> None:
        self._came = 0
        self._waiting: deque[Posed] = deque()
        self._next: Posed | None = None
        self._newest_s = self._newest_stamp = self._read_s = -math.inf
        self._latest: tuple[float, float] | None = None  # the sensor's last stamp, and when it arrived
        self._later_s = self._off_s = 0.0
        self._news: dict[str, str] = {}  # said once of each subject
        moving = [each for poses in self.poses.values() for each in poses.moving]
        self._moving = list({id(each): each for each in moving}.values())
        kept = {(e.entry.recorded_ns, e.entry.ordinal): e for e in self.heard.kept(self.sensor.topic)}
        entries = self.sensor.entries  # whose stamps are mended
        self._take([kept[e.recorded_ns, e.ordinal]._replace(entry=e) for e in entries])
        self.heard.forget()

    @abstractmethod
    def load(self, posed: Posed, stamp: float, name: str) -> Frame:
        """The frame of a message, with a stamp and a name. Raises DatasetError, naming source and topic."""

    def until(self, entry: Entry, message: Any) -> float:
        """The time in seconds up to which poses are needed for a message."""
        return entry.stamp

    def is_posed(self, heard: Heard, pose: Pose) -> bool | None:
        """False if poses are not known for all of a message that has one at its stamp."""
        return None

    def complete(self, posed: Posed) -> tuple[Posed, bool]:
        """A message with what belongs to it on other topics so far, and whether that has come."""
        return posed, True

    def take_other(self, heard: Heard) -> None:
        """Take a message of another topic."""

    def forget_after(self, stamp: float) -> None:
        """Drop what was heard on other topics after a time: the clock has started again."""

    @property
    def endless(self) -> bool:
        return True

    @property
    def frame_names(self) -> Sequence[str]:
        return EndlessNames()

    def awaiting(self) -> str:
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
        image, self._next = self._next, None
        self._compare_clocks(image.heard.entry.stamp, image.heard.arrived_s)
        name = f"{image.number:06d}"
        try:
            return self.load(image, image.heard.entry.stamp + image.later_s, name)
        except DatasetError as error:
            raise FrameError(f"frame {name}: {error}") from error

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
            self._newest_stamp = max(self._newest_stamp, each.entry.stamp)
            if each.topic.name == self.sensor.topic:
                self._take_image(each)
                continue
            self.take_other(each)
            restarts = [edge.restarts for edge in self._moving]
            for poses in self.poses.values():
                poses.hear(each.topic, each.entry, each.message)
            for edge, before in zip(self._moving, restarts, strict=True):
                if edge.restarts > before:
                    self._begin_again(float(edge.stamps[-1]), each.arrived_s)
        while self._waiting:
            image = self._whole(self._waiting[0])
            if image is None:
                return
            self._waiting.popleft()
            entry = image.heard.entry
            known = self.poses.get(entry.frame)
            pose = None if known is None or image.until_s > known.until else known.at(entry.stamp, self.gap)
            if pose is None or self.is_posed(image.heard, pose) is False:
                self.dropped += 1
                continue
            self.skipped += self._next is not None
            self._next = image._replace(pose=pose)

    def _take_image(self, heard: Heard) -> None:
        stamp = heard.entry.stamp
        self._begin_again(stamp, heard.arrived_s)
        self._latest = max(stamp, self._latest[0] if self._latest else stamp), heard.arrived_s
        until_s = self.until(heard.entry, heard.message)
        self._waiting.append(Posed(self._came, heard, until_s, self._later_s))
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
        self.forget_after(end)
        kept = [image for image in self._waiting if image.heard.entry.stamp <= end]
        self.dropped += len(self._waiting) - len(kept)
        self._waiting = deque(kept)
        self._later_s += latest + max(0.0, arrived_s - at_s) - stamp
        self._latest, self._newest_stamp = (stamp, arrived_s), stamp
        self.jumps += 1
        by = _in_words(latest - stamp)
        self._news.setdefault(
            "jump",
            f"the robot's time has jumped back by {by}, as when a bag is replayed or a simulation "
            "restarts: earlier poses are dropped, and mapping goes on",
        )

    def _whole(self, image: Posed) -> Posed | None:
        """An image with what belongs to it, once that and the poses around it have come, or will not come any
        more; None before."""
        poses, (image, is_whole) = self.poses.get(image.heard.entry.frame), self.complete(image)
        if is_whole and (poses is None or image.until_s <= poses.until):
            return image
        # While the robot or the connection pauses, its stamps do, too: what comes after that is not late.
        late_s = min(self._newest_stamp - image.until_s, self._newest_s - image.heard.arrived_s)
        return image if late_s > self.gap + LATE_S else None


@dataclass
class CameraRobot(Robot):
    """The depth images of a robot that runs. ``colors`` and ``confidences`` say how images of their topics
    become the colours and sigmas of those that are at most ``beside_gap`` seconds apart; ``imu`` tells how
    a tracked camera moves."""

    mapped: DepthCamera = field(kw_only=True)
    depth_scale: float | None = None
    colors: Beside | None = None
    confidences: Beside | None = None
    beside_gap: float = COLOR_GAP
    imu: BagImu | None = None

    def __post_init__(self) -> None:
        self._beside = {
            each.topic: deque(self.heard.kept(each.topic), MOST_IMAGES)
            for each in (self.colors, self.confidences)
            if each is not None
        }
        self._measured = deque(self.imu.rows if self.imu else (), MOST_SAMPLES)
        super().__post_init__()

    @property
    def topics(self) -> list[str]:
        """The topics that are heard besides that of depth and those of poses."""
        found = [self.mapped.cameras.topic, *self._beside, self.imu.topic if self.imu else ""]
        return [name for name in found if name]

    def load(self, posed: Posed, stamp: float, name: str) -> Frame:
        """Decode an image, its colours and its sigmas; a tracked camera that rests is level by its IMU."""
        entry, message, T_world_camera = posed.heard.entry, posed.heard.message, posed.pose
        assert T_world_camera is not None
        gyro = acceleration = None
        where = f"{self.heard.path}: topic {self.sensor.topic}"
        depth_m, camera = self.mapped.cameras.measured(message, entry, self.depth_scale, where)
        color, sigma_m = (
            each.of(posed.beside[each.topic], depth_m, camera)
            if each and each.topic in posed.beside
            else None
            for each in (self.colors, self.confidences)
        )
        if self.imu is not None:
            gyro, acceleration = self.imu.samples(self._measured, posed.later_s)
            T_world_camera = start_pose(upwards_at(acceleration, stamp))
        parts = (T_world_camera, camera, stamp, name, color, sigma_m)
        return Frame(depth_m, *parts, gyro=gyro, acceleration=acceleration)

    def complete(self, posed: Posed) -> tuple[Posed, bool]:
        """With the images of other topics that are nearest in time; an IMU has measured until then."""
        stamp, beside = posed.heard.entry.stamp, {}
        is_whole = self.imu is None or (bool(self._measured) and self._measured[-1][0] >= stamp)
        for topic, heard in self._beside.items():
            is_whole &= any(each.entry.stamp >= stamp for each in heard)
            apart, nearest = min(
                ((abs(each.entry.stamp - stamp), each.message) for each in heard),
                key=itemgetter(0),
                default=(math.inf, None),
            )
            if apart <= self.beside_gap:
                beside[topic] = nearest
        return posed._replace(beside=beside), is_whole

    def take_other(self, heard: Heard) -> None:
        """Take images beside depth, what an IMU measured, and a CameraInfo, which may have changed."""
        if heard.topic.name in self._beside:
            self._beside[heard.topic.name].append(heard)
        elif self.imu is not None and heard.topic.name == self.imu.topic:
            if self._measured and heard.entry.stamp < self._measured[-1][0] - RESTART_S:
                self._measured.clear()
            self._measured.append(imu_row(heard.entry, heard.message))
        elif heard.topic.name == self.mapped.cameras.topic:
            since, said = self.mapped.cameras.hear(heard.entry, heard.message)
            first = [each.number for each in self._waiting if each.heard.entry.stamp >= since] or [self._came]
            if said:
                told = f"the camera changes, according to its CameraInfo: from frame {first[0]:06d} on {said}"
                self._news.setdefault("camera", f"{told}; later changes are taken, too")

    def forget_after(self, stamp: float) -> None:
        """Drop images of other topics, and times of cameras."""
        for topic, heard in self._beside.items():
            self._beside[topic] = deque([e for e in heard if e.entry.stamp <= stamp], MOST_IMAGES)
        self.mapped.cameras.begin_again()


@dataclass
class LidarRobot(Robot, LidarRecording):
    """The point clouds of a robot that runs."""

    clouds: Clouds = field(kw_only=True)

    def load(self, posed: Posed, stamp: float, name: str) -> Frame:
        assert posed.pose is not None
        return self.clouds.frame(posed.heard.entry, posed.heard.message, posed.pose, stamp, name)

    def until(self, entry: Entry, message: Any) -> float:
        """Time of its last point."""
        return self.clouds.until(entry, message)

    def is_posed(self, heard: Heard, pose: Pose) -> bool | None:
        """False if poses are missing between its first point and its last."""
        return self.clouds.is_posed(heard.entry, heard.message, pose)


def _in_words(seconds: float) -> str:
    """A time in the unit that suits it."""
    for unit, length in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.1f} s"
