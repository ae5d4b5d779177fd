"""The messages of a bag's sensor that are mapped, and their poses."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.datasets.ros.messages import header_ns
from taichi_mrf.datasets.ros.poses import BagPoses, PoseChoice, find_poses
from taichi_mrf.datasets.ros.reader import Entry, RosReader
from taichi_mrf.datasets.ros.runs import BagRun, run_of
from taichi_mrf.datasets.ros.tf import TransformTree, read_transforms, tree_of
from taichi_mrf.datasets.timed_poses import largest_gap, within_gap
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose


@dataclass(frozen=True)
class BagSensor:
    """The messages of a topic, ``what``, that are of one run, by their stamps. ``frame`` is the sensor's, by
    the user's word or the first message; ``tree`` reads its tree of frames."""

    reader: RosReader
    topic: str
    what: str
    frame: str
    entries: Sequence[Entry]
    run: BagRun
    tree: Callable[[], TransformTree]
    notes: Sequence[str]

    @property
    def frames(self) -> Counter[str]:
        """The frames of the messages, with their numbers: several are those of several sensors."""
        return Counter(entry.frame for entry in self.entries)


def find_sensor(reader: RosReader, topic: str, what: str, choice: PoseChoice) -> BagSensor:
    """The messages of a topic that are read. Raises DatasetError, naming file and topic, if there is none, or
    no run that the user wants, or if they are of several frames and of none that the user named."""
    recorded = [entry for entry, _ in reader.messages(topic)]
    if not recorded:  # in a damaged file, whose index counts some
        raise DatasetError(f"{reader.path}: topic {topic} contains no message")
    frames = Counter(entry.frame for entry in recorded)
    notes = []
    if choice.optical and len(frames) > 1:
        if choice.optical not in frames:
            raise DatasetError(f"{_several(reader, topic, what, frames)}: ?optical= names none of these")
        recorded = [entry for entry in recorded if entry.frame == choice.optical]
        notes.append(f"of {topic} the {len(recorded)} {what} of {choice.optical} are read")
    if len(recorded) > 2 and 2 * len({(entry.frame, entry.stamp) for entry in recorded}) < len(recorded):
        recorded = [replace(entry, stamp=entry.recorded_ns / 1e9) for entry in recorded]
        notes.append(f"the stamps of {topic} stand still: the times of recording are taken")
    elif recorded[0].stamp == recorded[0].recorded_ns / 1e9 and _is_unstamped(reader.first(topic)):
        notes.append(f"the stamps of {topic} are 0: the times of recording are taken, which are later")
    run, entries, said = run_of(reader, topic, recorded, choice.run, what)
    frame = choice.optical or entries[0].frame
    return BagSensor(
        reader,
        topic,
        what,
        frame,
        sorted(entries, key=lambda entry: entry.stamp),
        run,
        cache(lambda: _tree(reader, topic, frame, choice.tf, run)),
        notes + said,
    )


def _is_unstamped(message: Any) -> bool:
    return header_ns(message.header) == 0


def _tree(reader: RosReader, topic: str, frame: str, tf: str, run: BagRun) -> TransformTree:
    try:
        return tree_of(read_transforms(reader), topic, frame, tf, run)
    except DatasetError as error:
        raise DatasetError(f"{reader.path}: {str(error).removeprefix(f'{reader.path}: ')}") from error


def poses_of(sensor: BagSensor, choice: PoseChoice) -> dict[str, BagPoses]:
    """The poses of a topic's messages by their frames. Raises DatasetError, as find_poses, and if several
    sensors share the topic and one of them has none."""
    frames, found = sensor.frames, {}
    for frame in frames:
        try:
            if len(frames) > 1 and choice.poses:
                raise DatasetError(f"?poses={choice.poses} is for one sensor")
            found[frame] = find_poses(sensor.reader, frame, choice, sensor.tree, sensor.run)
            if len(frames) > 1 and found[frame].registered:
                raise DatasetError(f"the data of {frame} are in the frame of the poses")
        except DatasetError as error:
            said = str(error).removeprefix(f"{sensor.reader.path}: ")
            if len(frames) == 1:
                raise DatasetError(f"{sensor.reader.path}: {said}") from error
            several = _several(sensor.reader, sensor.topic, sensor.what, frames)
            raise DatasetError(f"{several}: ?optical=FRAME reads those of one; {frame}: {said}") from error
    return found


def _several(reader: RosReader, topic: str, what: str, frames: Mapping[str, int]) -> str:
    words = ", ".join(f"{frame or 'unnamed'} ({count})" for frame, count in frames.items())
    return f"{reader.path}: topic {topic} has {what} of several frames, {words}, as of several sensors"


Posed = list[tuple[int, Entry, Pose]]
"""Messages with their numbers in the run and their poses."""


def posed_by(
    sensor: BagSensor, found: Mapping[str, BagPoses], options: ReadOptions
) -> tuple[Posed, list[str]]:
    """The messages that have a pose, and notes. Raises DatasetError if none has."""
    gap, entries = largest_gap(options), sensor.entries
    posed, dropped = within_gap(
        [entry.stamp for entry in entries],
        [found[entry.frame].at(entry.stamp, gap) for entry in entries],
        gap,
        f"{sensor.what} of {sensor.topic}",
        str(sensor.reader.path),
        "; ".join(dict.fromkeys(each.source for each in found.values())),
        next((each.stamps for each in found.values() if len(each.stamps)), ()),
    )
    notes = [*sensor.notes, *dict.fromkeys(note for each in found.values() for note in each.notes), *dropped]
    return [(i, entries[i], pose) for i, pose in posed], notes
