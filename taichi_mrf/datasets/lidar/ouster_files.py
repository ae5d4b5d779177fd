"""Check that an Ouster recording is whole: ouster-sdk trusts what is in it, and wrong sizes end the process.

An OSF is a row of blocks: a header, chunks of messages, and metadata. Each is its size in 4 bytes, a
FlatBuffer of that size whose name stands behind its first 4 bytes, and the CRC-32 of both. A PCAP is a row of
packets, each behind its time and two sizes: of what was captured, and of what was sent.
"""

import struct
import zlib
from pathlib import Path
from typing import BinaryIO

from taichi_mrf.errors import DatasetError
from taichi_mrf.system.files import open_regular

OSF = ".osf"
HEADER, METADATA = b"OSF$", b"OSF#"
_PIECE = 1 << 20
_PCAP_ORDERS = {0xA1B2C3D4: "<", 0xD4C3B2A1: ">", 0xA1B23C4D: "<", 0x4D3CB2A1: ">"}
"""Byte orders by the first number of a PCAP, read as little-endian; the last two stamp nanoseconds."""

_PCAP_HEADER, _PACKET_HEADER = 24, 16


def check_recording(path: Path) -> None:
    """Read a file once, and raise DatasetError, which names it, if it is cut short, damaged, or an .osf that
    is none. Of a .pcap only the sizes of packets can be checked, and of one in another layout, nothing."""
    with open_regular(path, DatasetError) as file:
        try:
            length = file.seek(0, 2)
            file.seek(0)
            if length == 0:
                raise DatasetError(f"{path}: is empty")
            if path.suffix.lower() == OSF:
                _check_osf(path, file, length)
            else:
                _check_pcap(path, file, length)
        except OSError as error:
            raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from error


def _check_osf(path: Path, file: BinaryIO, length: int) -> None:
    place, name = 0, b""
    while place < length:
        place, name = _check_block(path, file, place, length)
    if name != METADATA:
        raise DatasetError(f"{path}: is cut short: its metadata are missing")


def _check_block(path: Path, file: BinaryIO, place: int, length: int) -> tuple[int, bytes]:
    """The end of a block, and its name."""
    head = file.read(12)
    if place == 0 and head[8:] != HEADER:
        raise DatasetError(f"{path}: is no OSF file")
    if len(head) < 12:
        raise DatasetError(f"{path}: is cut short at byte {length:,}")
    left = struct.unpack_from("<I", head)[0] - 8
    if left < 0 or file.tell() + left + 4 > length:
        raise DatasetError(
            f"{path}: is cut short or damaged: {left + 8:,} bytes at byte {place:,} do not fit"
        )
    checksum = zlib.crc32(head)
    while left > 0:
        piece = file.read(min(left, _PIECE))
        if not piece:
            raise DatasetError(f"{path}: is cut short while it is read")
        checksum, left = zlib.crc32(piece, checksum), left - len(piece)
    if file.read(4) != struct.pack("<I", checksum):
        raise DatasetError(f"{path}: is damaged: the checksum of the block at byte {place:,} is wrong")
    return file.tell(), head[8:]


def _check_pcap(path: Path, file: BinaryIO, length: int) -> None:
    head = file.read(_PCAP_HEADER)
    order = _PCAP_ORDERS.get(int.from_bytes(head[:4], "little"))
    if order is None:
        return
    place, number = _PCAP_HEADER, 0
    while place < length:
        file.seek(place)
        header = file.read(_PACKET_HEADER)
        captured, sent = (
            struct.unpack_from(f"{order}II", header, 8) if len(header) == _PACKET_HEADER else (0, 0)
        )
        place += _PACKET_HEADER + captured
        if place > length:
            raise DatasetError(f"{path}: is cut short in packet {number}")
        if captured < sent:
            raise DatasetError(f"{path}: packet {number} holds {captured:,} of its {sent:,} bytes")
        number += 1
