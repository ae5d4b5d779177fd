"""The order in which the messages of a bag were written.

rosbags gives messages by their time of recording. Where that is a simulation's, which starts again, the
messages of two runs would come mixed; their places in the file keep them apart.
"""

import struct
from collections.abc import Iterator, Sequence
from typing import Any

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
