"""The size that an image file claims, read from its header before a decoder takes memory for it.

The formats listed here are the only ones that are decoded: what a decoder allocates for any other cannot be
bounded beforehand.
"""

import re
import struct
from collections.abc import Callable

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
KNOWN = "PNG, JPEG, TIFF, WebP, BMP, PGM, PPM"

Size = tuple[int, int]


def claimed_size(data: bytes) -> Size | None:
    """(width, height) in pixels by the header of an encoded image.

    None for a damaged header and for other formats than those of KNOWN.
    """
    read = next((read for signature, read in _READERS if re.match(signature, data, re.DOTALL)), None)
    try:
        size = None if read is None else read(data)
    except (struct.error, IndexError):  # the header is cut short
        return None
    return size if size is not None and min(size) > 0 else None


def _png(data: bytes) -> Size | None:
    width, height = struct.unpack_from(">II", data, 16)
    return (width, height) if data[12:16] == b"IHDR" else None


def _jpeg(data: bytes) -> Size | None:
    position = 2
    while data[position] == 0xFF:
        if data[position + 1] == 0xFF:  # fill bytes may precede a marker
            position += 1
            continue
        if data[position + 1] in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, position + 5)
            return width, height
        position += 2 + struct.unpack_from(">H", data, position + 2)[0]
    return None


def _bmp(data: bytes) -> Size | None:
    if struct.unpack_from("<I", data, 14)[0] == 12:  # the header of OS/2
        width, height = struct.unpack_from("<HH", data, 18)
    else:
        width, height = struct.unpack_from("<ii", data, 18)
    return width, abs(height)  # negative: rows from the top


def _pnm(data: bytes) -> Size | None:
    found = re.match(rb"P[1-6](?:\s+|#[^\n]*\n)+(\d{1,9})(?:\s+|#[^\n]*\n)+(\d{1,9})\s", data)
    return (int(found[1]), int(found[2])) if found else None


def _webp(data: bytes) -> Size | None:
    kind = data[12:16]
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8X" and not data[20] & _WEBP_ANIMATION:
        return tuple(1 + int.from_bytes(data[i : i + 3], "little") for i in (24, 27))  # type: ignore[return-value]
    return None


def _tiff(data: bytes) -> Size | None:
    """The size of the first image, which is the one that is decoded; of a tile of it if that is larger."""
    order = "<" if data[:2] == b"II" else ">"
    (begin,) = struct.unpack_from(f"{order}I", data, 4)
    (count,) = struct.unpack_from(f"{order}H", data, begin)
    values = {}
    for entry in range(begin + 2, begin + 2 + 12 * count, 12):
        tag, kind, items = struct.unpack_from(f"{order}HHI", data, entry)
        if tag in _TIFF_SIZES:
            if tag in values or items != 1 or kind not in _TIFF_KINDS:
                return None
            (values[tag],) = struct.unpack_from(f"{order}{_TIFF_KINDS[kind]}", data, entry + 8)
    width, height, tile_width, tile_height = (values.get(tag, 0) for tag in _TIFF_SIZES)
    if tile_width * tile_height > max(width * height, _LARGEST_TILE):
        return tile_width, tile_height
    return width, height


_READERS: tuple[tuple[bytes, Callable[[bytes], Size | None]], ...] = (
    (re.escape(PNG_SIGNATURE), _png),
    (rb"\xff\xd8", _jpeg),
    (rb"BM", _bmp),
    (rb"P[1-6]", _pnm),
    (rb"RIFF....WEBP", _webp),
    (rb"II\*\0|MM\0\*", _tiff),
)
"""What files of each format begin with, and the reader of their headers."""

_JPEG_FRAMES = {0xC0, 0xC1, 0xC2, 0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF}
"""Markers of a JPEG's segments that begin with its size."""

_WEBP_ANIMATION = 2

_TIFF_SIZES = (256, 257, 322, 323)
"""ImageWidth, ImageLength, TileWidth, TileLength."""

_TIFF_KINDS = {3: "H", 4: "I"}
_LARGEST_TILE = 1 << 20
"""Pixels of a tile that is larger than its image; small images have tiles of 256 x 256."""
