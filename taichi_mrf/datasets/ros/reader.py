"""A ROS 1 bag, a ROS 2 bag or an MCAP file as topics and messages, read with the library ``rosbags``.

It needs no ROS, and comes with the extra ``ros``. Its errors become
DatasetError here; the rest of the package sees topics by name and messages as objects with their fields.

rosbags gives messages by their time of recording. Where that is a simulation's, which starts again, the
messages of two runs would come mixed; their places in the file keep them apart.
"""

import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from taichi_mrf.datasets.base import Row
from taichi_mrf.datasets.ros.messages import frame_name, header_ns
from taichi_mrf.datasets.ros.names import METADATA, parts_of
from taichi_mrf.datasets.ros.tolerance import ROS1, bound_unpacking, files_of, msgtype_of, open_tolerantly
from taichi_mrf.errors import DatasetError, said
from taichi_mrf.system.files import check_regular, is_folder
from taichi_mrf.system.libraries import library

Place = tuple[int, int]
"""The time of recording of a message in nanoseconds, and a number that grows along the recording."""


def places_of(readers: Sequence[Any], topic: str, msgtype: str) -> list[Place]:
    """The places of a topic's messages in the order in which rosbags gives them."""
    found: list[tuple[int, int, int]] = []
    for part, reader in enumerate(readers):
        storage = getattr(reader, "storage", reader)
        for file, each in enumerate(getattr(storage, "storages", [storage])):
            ids = [c.id for c in each.connections if (c.topic, c.msgtype) == (topic, msgtype)]
            before = max(part, file) << 128
            found += [(file, time, before + place) for time, place in _places(each, ids)]
    return [place for _, *place in sorted(found)]  # type: ignore[misc]


def _places(file: Any, ids: Sequence[int]) -> Iterator[Place]:
    """Of a ROS 1 bag by its index, of SQLite by the rows' numbers, of MCAP by the indices of its chunks."""
    if hasattr(file, "indexes"):
        yield from (
            (each.time, (each.chunk_pos << 48) + each.offset) for key in ids for each in file.indexes[key]
        )
    elif hasattr(file, "dbconn"):
        marks = ",".join("?" * len(ids))
        rows = "SELECT timestamp, id FROM messages WHERE topic_id IN"
        yield from file.dbconn.cursor().execute(f"{rows} ({marks})", tuple(ids))
    else:
        for chunk in file.chunks:
            for key in set(ids) & set(chunk.message_index_offsets):
                file.bio.seek(chunk.message_index_offsets[key] + 9)
                _, size = struct.unpack("<HI", file.bio.read(6))
                for time, offset in struct.iter_unpack("<QQ", file.bio.read(size)):
                    yield time, (chunk.chunk_start_offset << 48) + offset


LONGEST_PAUSE_S = 5.0
"""Between the files of a recording that was split while it ran."""

_NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: its message type as ROS 2 writes it, such as sensor_msgs/msg/Image, and why if its
    messages cannot be read."""

    name: str
    type: str
    messages: int


@dataclass(frozen=True)
class Entry:
    """Place of a message: recorded at ``recorded_ns``, the ``ordinal``-th of its topic (from 0) then."""

    recorded_ns: int
    ordinal: int
    stamp: float
    """The header's stamp in seconds, or the time of recording where there is no header or its stamp is 0."""

    frame: str = ""
    """The frame in the header."""

    publisher: str = ""
    """The node that sent it, which only ROS 1 records."""

    place: int = 0
    """Grows in the order of recording: its time, or the place in the file if that time starts again."""


@dataclass(frozen=True)
class BagRow(Row):
    """A frame of a bag, and where its message is."""

    entry: Entry


class RosReader:
    """An open bag. ``topics`` are those by name, ``duration`` the seconds from the first message to the last;
    messages are objects with the fields of their type."""

    def __init__(self, path: Path) -> None:
        """Open a .bag, .mcap or .db3 file, the folder of a ROS 2 bag, or one with the files of a recording
        that was split.

        Raises DatasetError, whose text names the file, if it is cut short, damaged or of a kind that is not
        known, if files do not follow each other in time, and if rosbags is not installed.
        """
        self.path, self.parts = path, parts_of(path)
        for file in path.iterdir() if is_folder(path) else [path]:
            if not is_folder(file):
                check_regular(file, DatasetError)
        _library("rosbags.highlevel")
        try:
            bound_unpacking()
            self._reader, unread = open_tolerantly(self.parts or files_of(path) or [path])
            self._connections: dict[str, list[Any]] = {}
            for connection in self._reader.connections:
                self._connections.setdefault(connection.topic, []).append(connection)
            topics = {
                name: Topic(name, each[0].msgtype, sum(connection.msgcount for connection in each))
                for name, each in self._connections.items()
            }
            for each, why in unread:
                topics.setdefault(each.topic, Topic(each.topic, f"{each.msgtype} ({why})", each.msgcount))
            self.topics = dict(sorted(topics.items()))
            self.duration = max(0, self._reader.duration) / _NANOSECONDS if self.topics else 0.0
        except Exception as error:  # the library raises many kinds of errors
            raise DatasetError(f"{path}: {_unreadable(said(error))}") from error
        self._open, self.by_file = True, False
        times = [(each.start_time, each.end_time) for each in self._reader.readers]
        for (_, ended), (began, _), part in zip(times, times[1:], self.parts[1:], strict=False):
            if abs(began - ended) > LONGEST_PAUSE_S * _NANOSECONDS:
                self.close()
                raise DatasetError(
                    f"{path}: contains several recordings ({part.name} begins {(began - ended) / 1e9:.1f} s "
                    "after the end of the one before); pass one of: "
                    f"{', '.join(each.name for each in self.parts)}"
                )

    def close(self) -> None:
        """Close the file."""
        if self._open:
            self._open = False
            self._reader.close()

    def messages(self, topic: str) -> Iterator[tuple[Entry, Any]]:
        """All messages of a topic in the order of recording. Raises DatasetError, naming file and topic."""
        previous, ordinal = None, 0
        places = self.places(topic) if self.by_file else []
        for number, (recorded_ns, message, publisher) in enumerate(self._read(topic, None, None)):
            ordinal = ordinal + 1 if recorded_ns == previous else 0
            previous = recorded_ns
            stamp, frame = _header(message, recorded_ns)
            place = places[number][1] if number < len(places) else recorded_ns
            yield Entry(recorded_ns, ordinal, stamp, frame, publisher, place), message

    def places(self, topic: str) -> list[Place]:
        """The places in the file of a topic's messages, in the order of ``messages``; none if its index is
        damaged."""
        try:
            return places_of(self._reader.readers, topic, self.topics[topic].type)
        except Exception:  # as on opening
            return []

    def first(self, topic: str) -> Any | None:
        """The first message of a topic, None if there is none."""
        return next((message for _, message in self.messages(topic)), None)

    def read(self, topic: str, entry: Entry) -> Any:
        """One message again. Raises DatasetError, which names file and topic."""
        found = self._read(topic, entry.recorded_ns, entry.recorded_ns + 1)
        for ordinal, (_, message, _) in enumerate(found):
            if ordinal == entry.ordinal:
                return message
        raise DatasetError(f"{self.path}: topic {topic}: a message is missing")

    def _read(self, topic: str, start: int | None, stop: int | None) -> Iterator[tuple[int, Any, str]]:
        try:
            found = self._reader.messages(self._connections[topic], start=start, stop=stop)
            for connection, recorded_ns, data in found:
                msgtype = msgtype_of(connection)
                if msgtype != self.topics[topic].type:  # in a damaged file
                    raise ValueError(f"contains a {msgtype}")
                publisher = getattr(connection.ext, "callerid", None) or ""
                is_ros1 = getattr(connection.ext, "serialization_format", "") == ROS1
                store = self._reader.typestore
                message = (
                    store.deserialize_ros1(data, msgtype)
                    if is_ros1
                    else self._reader.deserialize(data, msgtype)
                )
                yield recorded_ns, message, publisher
        except Exception as error:  # as on opening
            raise DatasetError(f"{self.path}: topic {topic}: cannot be read: {said(error)}") from error


def _unreadable(problem: str) -> str:
    """Why rosbags cannot open a file, and the remedy."""
    missing = re.search(r"files are missing: \[(.*)\]", problem)
    if missing:
        names = ", ".join(Path(each.strip("' ")).name for each in missing[1].split(","))
        return (
            f"its {METADATA} names files that are not there, {names}: add them; without it the files "
            "that are there are read"
        )
    if "magic is invalid" in problem and "end magic" not in problem:
        return "is no bag, whatever its name; a pointer of git-lfs, or a download that failed, looks so"
    if "empty" in problem:
        return "is an empty file"
    return (
        f"cannot be read as a bag, it is damaged or cut short: {problem}; 'rosbag reindex', 'ros2 bag "
        "reindex' or 'mcap recover' may mend a recording that was not closed"
    )


def _library(name: str) -> Any:
    return library(name, "bags need", "ros", DatasetError)


def _header(message: Any, recorded_ns: int) -> tuple[float, str]:
    """Stamp and frame of a message."""
    header = getattr(message, "header", None)
    if header is None:
        return recorded_ns / _NANOSECONDS, ""
    return (header_ns(header) or recorded_ns) / _NANOSECONDS, frame_name(header.frame_id)
