"""A ROS 1 bag, a ROS 2 bag or an MCAP file as topics and messages, read with the library ``rosbags``.

It needs no ROS, and comes with the extra ``ros``. Its errors become DatasetError here; the rest of the
package sees topics by name and messages as objects with their fields.

rosbags gives messages by their time of recording. Where that is a simulation's, which starts again, the
messages of two runs would come mixed; their places in the file keep them apart.

It refuses a whole file for one channel of another encoding, or one message definition that it cannot parse.
Here such topics are set aside, with the reason. It unpacks the compressed parts of a bag, chunks, single
messages and whole files, to whatever it holds, which for a file of 65 kB may be gigabytes. Its readers look
the unpackers of chunks up in tables, and take those of messages and files from a module;
:func:`bound_unpacking` puts bounded ones in their places.
"""

import bz2
import functools
import importlib
import os
import re
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from taichi_mrf.datasets.base import Row
from taichi_mrf.datasets.ros.decoding import CDR, LANGUAGES, ROS1, Decoder, ros2_name
from taichi_mrf.datasets.ros.names import METADATA, parts_of
from taichi_mrf.datasets.ros.sources import NANOSECONDS, Channel, Entry, Place, Topic, TopicSource, entry_of
from taichi_mrf.errors import DatasetError, said
from taichi_mrf.system.bounded import BoundedFile, stored_only
from taichi_mrf.system.files import check_regular, is_file, is_folder, read_text
from taichi_mrf.system.libraries import library
from taichi_mrf.system.packed import LARGEST_RATIO, UnpackedBytes

_LEAST_BOUND = 1 << 26
"""Chunks are a few megabytes, and one large image at most."""


def bound_unpacking() -> None:
    """Let rosbags unpack no more than a bound; to do so again changes nothing."""
    unpackers: dict[str, Callable[[], Any]] = {
        "bz2": bz2.BZ2Decompressor,
        "lz4": importlib.import_module("lz4.frame").LZ4FrameDecompressor,
        "zstd": _zstd().ZstdDecompressor,
    }
    ros1 = importlib.import_module("rosbags.rosbag1.reader")
    mcap = importlib.import_module("rosbags.rosbag2.storage_mcap")
    ros1.Reader.open = _sum_first(ros1.Reader.open, _held_to_sizes)
    mcap.McapReader._open = _sum_first(
        mcap.McapReader._open, lambda reader: [chunk.uncompressed_size for chunk in reader.chunks]
    )
    for table in (ros1.decompressors, mcap.DECOMPRESSORS):
        for name in set(table) & set(unpackers):
            table[name] = _bounded(unpackers[name], "chunk")
    vars(importlib.import_module("rosbags.rosbag2.reader"))["zstd"] = SimpleNamespace(
        decompress=_bounded(_zstd().ZstdDecompressor, "message"),
        open=lambda packed, mode: BoundedFile(_zstd().open(packed, mode), os.fstat(packed.fileno()).st_size),
    )
    sqlite = importlib.import_module("rosbags.rosbag2.storage_sqlite3").Sqlite3Reader
    sqlite._open = stored_only(getattr(sqlite._open, "__wrapped__", sqlite._open))


def _bounded(make: Callable[[], Any], what: str) -> Callable[..., bytes]:
    def unpack(packed: bytes, claimed: int | None = None) -> bytes:
        """``claimed`` is the size of a chunk by its header; a message has none."""
        most = max(_LEAST_BOUND, LARGEST_RATIO * len(packed))
        unpacker = make()
        found = unpacker.decompress(packed, most + 1 if claimed is None else min(most, claimed) + 1)
        if len(found) > most or (claimed is not None and (claimed > most or len(found) > claimed)):
            raise ValueError(f"a {what} of {len(packed):,} bytes claims to unpack to more than it may")
        if not unpacker.eof:
            raise ValueError(f"a packed {what} is cut short")
        return found

    return unpack


def _sum_first(opens: Callable[[Any], None], sizes: Callable[[Any], Iterable[int]]) -> Callable[[Any], None]:
    """A function that opens a reader and sums up what its chunks claim to unpack to, before one is: MCAP's
    reader holds all at once that overlap in time, and an index may list one chunk a thousand times."""
    opens = getattr(opens, "__wrapped__", opens)

    @functools.wraps(opens)
    def open_bounded(reader: Any) -> None:
        opens(reader)
        with ExitStack() as unless_bounded:
            unless_bounded.callback(reader.close)
            UnpackedBytes(reader.bio.seek(0, os.SEEK_END)).count("", sum(sizes(reader)))
            unless_bounded.pop_all()

    return open_bounded


def _held_to_sizes(reader: Any) -> Iterator[int]:
    """The sizes of a ROS 1 bag's chunks by headers that rosbags passes over; the unpackers keep to them."""
    ros1 = importlib.import_module("rosbags.rosbag1.reader")
    for place, chunk in reader.chunks.items():
        reader.bio.seek(place)
        size = ros1.Header.read(reader.bio).get_uint32("size")
        if chunk.decompressor is not ros1.decompressors["none"]:
            unpack = functools.partial(chunk.decompressor, claimed=size)
            reader.chunks[place] = chunk._replace(decompressor=unpack)
        yield size


def _zstd() -> Any:
    try:
        return importlib.import_module("compression.zstd")  # from Python 3.14 on
    except ImportError:
        return importlib.import_module("backports.zstd")


def open_tolerantly(paths: Sequence[Path]) -> tuple[Any, Decoder, list[tuple[Any, str]]]:
    """An open AnyReader with the connections that can be read, what decodes their messages, and the other
    connections, each with the reason. Raises errors of many kinds for a damaged file."""
    _tolerate_schemas()
    reader, decoder = importlib.import_module("rosbags.highlevel").AnyReader(paths), Decoder()
    unread: list[tuple[Any, str]] = []

    def open_types() -> None:
        for each in reader.readers:
            reader.stack.enter_context(each)
        connections = [each for part in reader.readers for each in part.connections]
        connections = [each._replace(msgtype=msgtype_of(each)) for each in connections]
        problems = decoder.learn([_channel_of(each, reader.is2) for each in connections])
        for each, problem in zip(connections, problems, strict=True):
            if problem:
                unread.append((each, problem))
            elif each.digest and each.msgdef.data and _digest(decoder, each, reader.is2) != each.digest:
                unread.append((each, "its messages were written with another definition"))
            else:
                reader.connections.append(each)
        reader.typestore = decoder.store

    reader._open = open_types
    reader.open()
    return reader, decoder, unread


def _encoding_of(connection: Any, is2: bool) -> str:
    return getattr(connection.ext, "serialization_format", "") or (CDR if is2 else ROS1)


def _channel_of(connection: Any, is2: bool) -> Channel:
    text, language = connection.msgdef.data, connection.msgdef.format.name
    return Channel(connection.topic, connection.msgtype, _encoding_of(connection, is2), language, text)


def msgtype_of(connection: Any) -> str:
    """The type of a connection's messages as ROS 2 writes it, also in an MCAP file converted from ROS 1."""
    is_ros1 = getattr(connection.ext, "serialization_format", "") == ROS1
    return ros2_name(connection.msgtype) if is_ros1 else connection.msgtype


def files_of(folder: Path) -> list[Path]:
    """The files of a ROS 2 bag, if its metadata list topics of other encodings, for which rosbags refuses the
    folder; none otherwise."""
    text = read_text(folder / METADATA, DatasetError) if is_file(folder / METADATA) else ""
    is_packed = re.search(r"compression_mode: *['\"]?(file|message)", text, re.IGNORECASE)
    if is_packed or set(re.findall(r"serialization_format: *['\"]?(\w+)", text)) <= {"cdr"}:
        return []
    return sorted(file for file in folder.iterdir() if file.suffix in (".mcap", ".db3"))


def _digest(decoder: Decoder, connection: Any, is2: bool) -> str:
    """The number by which a definition is known again, "" for one that names types which are not defined."""
    store, msgtype = decoder.store, connection.msgtype
    try:
        return str(store.hash_rihs01(msgtype) if is2 else store.generate_msgdef(msgtype)[1])
    except Exception:
        return ""


def _tolerate_schemas() -> None:
    """Let rosbags read past MCAP's schemas that are not of ROS; to do so again changes nothing."""
    mcap = importlib.import_module("rosbags.rosbag2.storage_mcap")
    formats = importlib.import_module("rosbags.interfaces")

    def get_msgdef(schema: Any) -> Any:
        kind = formats.MessageDefinitionFormat[LANGUAGES.get(schema.encoding if schema else "", "NONE")]
        return formats.MessageDefinition(kind, schema.data if kind.name != "NONE" else "")

    def read_string(file: Any) -> str:
        is_profile = file.tell() == 0  # the first field of the first record; rosbags wants "ros2" there
        text = str(mcap.read_bytes(file).decode(errors="replace"))
        return "ros2" if is_profile else text

    vars(mcap).update(get_msgdef=get_msgdef, read_string=read_string)


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


@dataclass(frozen=True)
class BagRow(Row):
    """A frame of a bag, and where its message is."""

    entry: Entry


class RosReader(TopicSource):
    """An open bag."""

    path: Path

    def __init__(self, path: Path) -> None:
        """Open a .bag, .mcap or .db3 file, the folder of a ROS 2 bag, or one with the files of a recording
        that was split. Raises DatasetError, which names the file, if it is cut short, damaged or of a kind
        that is not known, if files do not follow each other in time, and if rosbags is not installed."""
        self.path, self.parts = path, parts_of(path)
        for file in path.iterdir() if is_folder(path) else [path]:
            if not is_folder(file):
                check_regular(file, DatasetError)
        library("rosbags.highlevel", "bags need", "ros", DatasetError)
        try:
            bound_unpacking()
            self._reader, self._decoder, unread = open_tolerantly(self.parts or files_of(path) or [path])
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
            self.duration = max(0, self._reader.duration) / NANOSECONDS if self.topics else 0.0
        except Exception as error:  # the library raises many kinds of errors
            raise DatasetError(f"{path}: {_unreadable(said(error))}") from error
        self._open, self.by_file = True, False
        times = [(each.start_time, each.end_time) for each in self._reader.readers]
        for (_, ended), (began, _), part in zip(times, times[1:], self.parts[1:], strict=False):
            if abs(began - ended) > LONGEST_PAUSE_S * NANOSECONDS:
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
        previous, ordinal = None, 0
        places = self.places(topic) if self.by_file else []
        for number, (recorded_ns, message, publisher) in enumerate(self._read(topic, None, None)):
            ordinal = ordinal + 1 if recorded_ns == previous else 0
            previous = recorded_ns
            place = places[number][1] if number < len(places) else recorded_ns
            yield entry_of(message, recorded_ns, ordinal, publisher, place), message

    def places(self, topic: str) -> list[Place]:
        try:
            return places_of(self._reader.readers, topic, self.topics[topic].type)
        except Exception:  # as on opening
            return []

    def read(self, topic: str, entry: Entry) -> Any:
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
                encoding = _encoding_of(connection, self._reader.is2)
                message = self._decoder.decode(msgtype, encoding, data)
                yield recorded_ns, message, publisher
        except Exception as error:  # as on opening
            raise DatasetError(f"{self.path}: topic {topic}: cannot be read: {said(error)}") from error


def _unreadable(problem: str) -> str:
    """Reason why rosbags cannot open a file, and the remedy."""
    missing = re.search(r"files are missing: \[(.*)\]", problem)
    if missing:
        names = ", ".join(Path(each.strip("' ")).name for each in missing[1].split(","))
        return (
            f"its {METADATA} names files that are not there, {names}: add them; without it the files "
            "that are there are read"
        )
    if "magic is invalid" in problem and "end magic" not in problem:
        return "is not a bag, despite its name; maybe a git-lfs pointer, or a failed download"
    if "empty" in problem:
        return "is an empty file"
    if "too much for a file" in problem:
        return f"{problem}; if you trust it, unpack it by 'rosbag decompress' or 'mcap decompress'"
    return (
        f"cannot be read as a bag, it is damaged or cut short: {problem}; 'rosbag reindex', 'ros2 bag "
        "reindex' or 'mcap recover' may repair a recording that was not closed"
    )
