"""``foxglove:ws://robot:8765?depth=/camera/depth/image_raw&pose=/odom&frame=map``: depth images from a robot
that runs, whose ``foxglove_bridge`` sends its topics.

Topics, cameras and poses are chosen as in a bag (ros/sensor.py), from what is heard in the first seconds, and
by the same options. The pose of an image is interpolated as soon as the next pose has come. Of the images
whose poses are known the newest is the next frame: where mapping is slower than the camera, older ones are
skipped.
"""

import time
import weakref
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from taichi_mrf.datasets.base import Dataset, EndlessNames
from taichi_mrf.datasets.options import TRACK, ReadOptions, parse_options
from taichi_mrf.datasets.ros import messages
from taichi_mrf.datasets.ros.bag import BagSummary, summary_of
from taichi_mrf.datasets.ros.sensor import DepthCamera, DepthChoice, find_depth_camera
from taichi_mrf.datasets.ros.sources import NANOSECONDS, Entry
from taichi_mrf.datasets.timed_poses import largest_gap
from taichi_mrf.datasets.wires.foxglove import FoxgloveClient, wait_until
from taichi_mrf.datasets.wires.heard import DEPTH_NEEDS, Heard, HeardTopics
from taichi_mrf.errors import DatasetError, FrameError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.frame import Frame

LISTEN_S = 2.0
"""Seconds in which what tells the frames and poses is heard, also map -> odom of a localiser at 1 Hz."""

DECIDE_S = 3.0
"""So much longer it is tried to find out what is mapped."""

LATE_S = 1.0
"""Poses come at most so much later than the largest gap allows; an image that has none by then gets none."""

SILENCE_S = 10.0
"""A robot that sends no image that can be mapped for so long has ended, for who waits for one."""

ENDLESS = "a robot never ends: --keep-live N bounds the memory, --keyframes.* selects fewer keyframes"


@dataclass
class Robot(Dataset):
    """The depth images of a robot that runs. ``skipped`` counts those that were older than the newest,
    ``dropped`` those without a pose."""

    heard: HeardTopics = field(kw_only=True)
    mapped: DepthCamera = field(kw_only=True)
    depth_scale: float | None = None
    gap: float = 0.0
    skipped: int = 0

    def __post_init__(self) -> None:
        self._came = 0
        self._unposed: deque[tuple[int, Entry, Any]] = deque()
        self._next: tuple[int, Entry, Any, Pose] | None = None
        self._now_ns = 0
        depth = self.heard.topics[self.mapped.depth.name]
        for entry in self.mapped.sensor.entries:
            self._take([(depth, entry, self.heard.read(depth.name, entry))])
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
        skipped, dropped = self.skipped + self.heard.client.dropped, self.dropped
        counted = [f"{skipped} skipped, as mapping is slower"] if skipped else []
        counted += [f"{dropped} left out: no poses within {self.gap:g} s on both sides"] if dropped else []
        counted += [self.heard.problem] if self.heard.problem else []
        return f"the next image of {self._came}" + (f" ({'; '.join(counted)})" if counted else "")

    def read(self, index: int) -> Frame:
        """The newest image with a pose, whatever the index. Raises DatasetError if none comes for SILENCE_S
        seconds, FrameError for one that cannot be decoded."""
        if not wait_until(lambda: not self.awaiting(), SILENCE_S):
            why = f"nothing to map for {SILENCE_S:g} s: waiting for {self.awaiting()}"
            raise DatasetError(f"{self.heard.path}: {why}")
        assert self._next is not None
        number, entry, message, T_world_camera = self._next
        self._next = None
        where = f"{self.heard.path}: topic {self.mapped.depth.name}"
        try:
            depth_m, camera = self.mapped.cameras.measured(message, entry, self.depth_scale, where)
        except DatasetError as error:
            raise FrameError(f"frame {number:06d}: {error}") from error
        return Frame(depth_m, T_world_camera, camera, entry.stamp, f"{number:06d}")

    def _take(self, heard: Sequence[Heard]) -> None:
        """Take what has come: images wait for their poses."""
        for topic, entry, message in heard:
            self._now_ns = max(self._now_ns, entry.recorded_ns)
            if topic.name == self.mapped.depth.name:
                self._unposed.append((self._came, entry, message))
                self._came += 1
            else:
                for poses in self.mapped.poses.values():
                    poses.hear(topic, entry, message)
        while self._unposed and self._is_decided(self._unposed[0][1]):
            number, entry, message = self._unposed.popleft()
            pose = self.mapped.poses[entry.frame].at(entry.stamp, self.gap)
            if pose is None:
                self.dropped += 1
                continue
            self.skipped += self._next is not None
            self._next = number, entry, message, pose

    def _is_decided(self, entry: Entry) -> bool:
        """True if the poses around an image have come, or will not come any more."""
        poses = self.mapped.poses.get(entry.frame)
        if poses is None or entry.stamp <= poses.until:
            return True
        return self._now_ns - entry.recorded_ns > (self.gap + LATE_S) * NANOSECONDS


def open_foxglove(text: str, options: ReadOptions) -> Dataset:
    """Connect to a robot: ``ADDRESS?option=value&...``. Raises DatasetError, which names the address, if it
    cannot be reached, and as a bag does if it is not clear what to map."""
    address, _, query = text.partition("?")
    chosen = parse_options(DepthChoice, query, f"foxglove:{address}")
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
        _listen(heard, _needed(heard, DepthChoice()))
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


def _needed(heard: HeardTopics, chosen: DepthChoice) -> list[str]:
    """The topics that tell what is mapped; images of one topic only, if the user has named it."""
    named = chosen.depth if chosen.depth in heard.topics else f"/{chosen.depth}"
    images = [topic.name for topic in heard.topics.values() if topic.type in messages.IMAGES]
    others = [topic.name for topic in heard.topics.values() if topic.type in DEPTH_NEEDS]
    return [name for name in others if name not in images or not chosen.depth or name == named]


def _listen(heard: HeardTopics, topics: Collection[str]) -> None:
    heard.ask_for(topics)
    end = time.monotonic() + LISTEN_S
    while time.monotonic() < end:
        time.sleep(0.01)
        heard.hear()


def _open(heard: HeardTopics, chosen: DepthChoice, options: ReadOptions) -> Robot:
    _listen(heard, _needed(heard, chosen))
    mapped = _decided(heard, chosen, options)
    kept = [mapped.depth.name]
    if chosen.poses != TRACK and not chosen.poses:
        kept += [t.name for t in heard.topics.values() if t.type in (*messages.TF, *messages.POSES)]
    heard.ask_for(kept)
    notes = [*mapped.sensor.notes, *(note for each in mapped.poses.values() for note in each.notes)]
    return Robot(
        name=str(heard.path),
        camera=mapped.cameras.first,
        notes=[ENDLESS, *dict.fromkeys(notes), *mapped.cameras.notes],
        distortion=mapped.cameras.distortion,
        tracked=chosen.poses == TRACK,
        heard=heard,
        mapped=mapped,
        depth_scale=options.depth_scale,
        gap=largest_gap(options),
    )


def _decided(heard: HeardTopics, chosen: DepthChoice, options: ReadOptions) -> DepthCamera:
    """What is mapped, as soon as enough has been heard to tell. Raises DatasetError."""
    end = time.monotonic() + DECIDE_S
    while True:
        try:
            return find_depth_camera(heard, chosen, options)
        except DatasetError as error:
            if time.monotonic() > end:
                silent = [name for name in _needed(heard, chosen) if not heard.topics[name].messages]
                said = f"; nothing came on {', '.join(silent)} in {heard.duration:.0f} s" if silent else ""
                raise DatasetError(f"{error}{said}") from error
        time.sleep(0.1)
        heard.hear()
