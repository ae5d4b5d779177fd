"""Corrections of rosbags: files that it refuses and should not, or takes and should not.

It refuses a whole file for one channel of another encoding, or one message definition that it cannot parse.
Here such topics are set aside, with the reason.

It unpacks the compressed parts of a bag, chunks, single messages and whole files, to whatever it holds, which
for a file of 65 kB may be gigabytes. Its readers look the unpackers of chunks up in tables, and take those of
messages and files from a module; :func:`bound_unpacking` puts bounded ones in their places.
"""

import bz2
import importlib
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Protocol

from taichi_mrf.datasets.ros.names import METADATA
from taichi_mrf.errors import DatasetError, said
from taichi_mrf.system.files import is_file, read_text

_LEAST_BOUND, _LARGEST_RATIO = 1 << 26, 1000
"""Chunks are a few megabytes, and one large image at most; images of a single value pack a thousandfold."""

_LEAST_FILE, _LARGEST_FILE_RATIO = 1 << 28, 100
"""A whole file, which is unpacked to the disk. Recordings pack three to twenty times."""


class _Unpacker(Protocol):
    @property
    def eof(self) -> bool: ...

    def decompress(self, data: bytes, max_length: int = -1) -> bytes: ...


def bound_unpacking() -> None:
    """Let rosbags unpack no more than a bound; to do so again changes nothing."""
    unpackers: dict[str, Callable[[], _Unpacker]] = {
        "bz2": bz2.BZ2Decompressor,
        "lz4": importlib.import_module("lz4.frame").LZ4FrameDecompressor,
        "zstd": _zstd().ZstdDecompressor,
    }
    ros1 = importlib.import_module("rosbags.rosbag1.reader").decompressors
    mcap = importlib.import_module("rosbags.rosbag2.storage_mcap").DECOMPRESSORS
    for table in (ros1, mcap):
        for name in set(table) & set(unpackers):
            table[name] = _bounded(unpackers[name], "chunk")
    vars(importlib.import_module("rosbags.rosbag2.reader"))["zstd"] = _BoundedZstd()


class _BoundedZstd:
    """The two functions of the module ``zstd`` with which rosbags reads ROS 2 bags: ``decompress`` for a
    message, ``open`` for a file."""

    def __init__(self) -> None:
        self.decompress = _bounded(_zstd().ZstdDecompressor, "message")

    def open(self, packed: BinaryIO, mode: str) -> "_BoundedFile":
        return _BoundedFile(_zstd().open(packed, mode), os.fstat(packed.fileno()).st_size)


class _BoundedFile:
    """A file that is unpacked while it is read, up to a bound."""

    def __init__(self, stream: BinaryIO, packed_bytes: int) -> None:
        self._stream, self._packed_bytes = stream, packed_bytes
        self._left = max(_LEAST_FILE, _LARGEST_FILE_RATIO * packed_bytes)

    def __enter__(self) -> "_BoundedFile":
        return self

    def __exit__(self, *error: object) -> None:
        self._stream.close()

    def read(self, size: int) -> bytes:
        found = self._stream.read(size)
        self._left -= len(found)
        if self._left < 0:
            raise ValueError(f"a file of {self._packed_bytes:,} bytes unpacks to more than it may")
        return found


def _bounded(make: Callable[[], _Unpacker], what: str) -> Callable[..., bytes]:
    def unpack(packed: bytes, claimed: int | None = None) -> bytes:
        """``claimed`` is the size that MCAP's reader expects; that of ROS 1 passes none."""
        most = max(_LEAST_BOUND, _LARGEST_RATIO * len(packed))
        unpacker = make()
        found = unpacker.decompress(packed, most + 1 if claimed is None else min(most, claimed) + 1)
        if len(found) > most or (claimed is not None and (claimed > most or len(found) > claimed)):
            raise ValueError(f"a {what} of {len(packed):,} bytes claims to unpack to more than it may")
        if not unpacker.eof:
            raise ValueError(f"a packed {what} is cut short")
        return found

    return unpack


def _zstd() -> Any:
    try:
        return importlib.import_module("compression.zstd")  # from Python 3.14 on
    except ImportError:
        return importlib.import_module("backports.zstd")


ROS1 = "ros1"
_ENCODINGS = ("cdr", ROS1, "")
_IDL_RULE = "=" * 80 + "\n"


def open_tolerantly(paths: Sequence[Path]) -> tuple[Any, list[tuple[Any, str]]]:
    """An open AnyReader with the connections that can be read, and the others, each with the reason. Raises
    errors of many kinds for a damaged file."""
    highlevel, typesys = (
        importlib.import_module("rosbags.highlevel"),
        importlib.import_module("rosbags.typesys"),
    )
    _tolerate_schemas()
    reader = highlevel.AnyReader(paths)
    unread: list[tuple[Any, str]] = []
    # Before ROS Iron, bags hold no definitions of their messages; those read here never changed.
    known = typesys.get_typestore(typesys.Stores.LATEST).fielddefs if reader.is2 else {}

    def open_types() -> None:
        for each in reader.readers:
            reader.stack.enter_context(each)
        types: dict[str, Any] = {}
        store = typesys.get_typestore(typesys.Stores.EMPTY)
        found = []
        for each in (each for part in reader.readers for each in part.connections):
            try:
                if getattr(each.ext, "serialization_format", "") not in _ENCODINGS:
                    raise ValueError(f"its messages are {each.ext.serialization_format}")
                each = each._replace(msgtype=msgtype_of(each))
                types |= _defined(each, known, typesys)
                found.append(each)
            except Exception as error:  # the library raises many kinds of errors
                unread.append((each, said(error)))
        store.register(types)
        for each in found:
            if each.digest and each.msgdef.data and _digest(store, each.msgtype, reader.is2) != each.digest:
                unread.append((each, "its messages were written with another definition"))
            else:
                reader.connections.append(each)
        reader.typestore = store

    reader._open = open_types
    reader.open()
    return reader, unread


def msgtype_of(connection: Any) -> str:
    """The type of a connection's messages as ROS 2 writes it; in an MCAP file converted from ROS 1 it is
    written in another way."""
    package, _, name = connection.msgtype.partition("/")
    is_ros1 = getattr(connection.ext, "serialization_format", "") == ROS1 and "/" not in name
    return f"{package}/msg/{name}" if is_ros1 else connection.msgtype


def files_of(folder: Path) -> list[Path]:
    """The files of a ROS 2 bag, if its metadata list topics of other encodings, for which rosbags refuses the
    folder; none otherwise."""
    text = read_text(folder / METADATA, DatasetError) if is_file(folder / METADATA) else ""
    is_packed = re.search(r"compression_mode: *['\"]?(file|message)", text, re.IGNORECASE)
    if is_packed or set(re.findall(r"serialization_format: *['\"]?(\w+)", text)) <= {"cdr"}:
        return []
    return sorted(file for file in folder.iterdir() if file.suffix in (".mcap", ".db3"))


def _digest(store: Any, msgtype: str, is2: bool) -> str:
    """The number by which a definition is known again, "" for one that names types which are not defined."""
    try:
        return str(store.hash_rihs01(msgtype) if is2 else store.generate_msgdef(msgtype)[1])
    except Exception:
        return ""


def _defined(connection: Any, known: dict[str, Any], typesys: Any) -> dict[str, Any]:
    """The types of a connection's messages, by its definition or those that are known."""
    text, kind = connection.msgdef.data, connection.msgdef.format.name
    if kind == "NONE":
        return known
    try:
        if kind == "MSG":
            return dict(typesys.get_types_from_msg(text, connection.msgtype))
        if not text.startswith(f"{_IDL_RULE}IDL: "):
            return dict(typesys.get_types_from_idl(text))
        parts = [part.split("\n", 1)[1] for part in text.split(_IDL_RULE)[1:]]
        return {name: each for part in parts for name, each in typesys.get_types_from_idl(part).items()}
    except Exception:
        if connection.msgtype in known:
            return known
        raise


def _tolerate_schemas() -> None:
    """Let rosbags read past MCAP's schemas that are not of ROS; to do so again changes nothing."""
    mcap = importlib.import_module("rosbags.rosbag2.storage_mcap")
    formats = importlib.import_module("rosbags.interfaces")
    of_ros = {"ros2msg": "MSG", "ros1msg": "MSG", "ros2idl": "IDL", "omgidl": "IDL"}

    def get_msgdef(schema: Any) -> Any:
        kind = formats.MessageDefinitionFormat[of_ros.get(schema.encoding if schema else "", "NONE")]
        return formats.MessageDefinition(kind, schema.data if kind.name != "NONE" else "")

    def read_string(file: Any) -> str:
        is_profile = file.tell() == 0  # the first field of the first record; rosbags wants "ros2" there
        text = str(mcap.read_bytes(file).decode(errors="replace"))
        return "ros2" if is_profile else text

    vars(mcap).update(get_msgdef=get_msgdef, read_string=read_string)
