"""Depth images as RTAB-Map packs them.

- PNGs of 16-bit millimetres, and PNGs whose four 8-bit channels are the bytes of float32 metres
- RVL (A. Wilson, "Fast Lossless Depth Image Compression", ISS 2017)
- inverse depth in 16 bits, as a PNG or as RVL

RVL is a row of whole numbers in nibbles, those of a little-endian 32-bit word from the highest on. A nibble
has three bits of its number, the lowest first, and one that says whether more follow. The numbers are, in
turn, how many pixels are 0, how many are not, and for each of these its difference from the last one that was
not 0, with the sign in the lowest bit.
"""

import struct

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.image_header import PNG_SIGNATURE, claimed_size
from taichi_mrf.datasets.images import MOST_PIXELS, decode_16_bit, decode_unchanged, measured
from taichi_mrf.errors import DatasetError

RVL, INVERSE = b"DEPTHRVL", b"DEPTHINV"
_HEADER = 16
_PNG_KIND = 25
"""The place of a PNG's type of colour: 6 is red, green, blue and opacity."""

_MOST_NIBBLES = 11
"""Of a whole number of 32 bits."""


def depth_size(data: bytes) -> tuple[int, int] | None:
    """(width, height) of a packed depth image, None for an unknown format or a damaged header."""
    if data.startswith(INVERSE):
        data = data[_HEADER:]
    if data.startswith(RVL) and len(data) >= _HEADER:
        width, height = struct.unpack_from("<2I", data, len(RVL))
        return width, height
    return claimed_size(data)


def decode_depth(data: bytes, where: str, steps_per_metre: float) -> NDArray[np.float32]:
    """Axial depth in metres, (H, W) float32, 0 for no measurement. ``steps_per_metre`` is for images of whole
    numbers. Raises DatasetError, whose text begins with ``where``, for a damaged image."""
    if data.startswith(INVERSE) and len(data) >= _HEADER:
        a, b = struct.unpack_from("<2f", data, len(INVERSE))
        steps = _whole(data[_HEADER:], where).astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            metres = np.where(steps > 0, np.float32(a) / (steps - np.float32(b)), np.float32(0))
    elif data.startswith(PNG_SIGNATURE) and data[_PNG_KIND : _PNG_KIND + 1] == b"\6":
        metres = np.ascontiguousarray(decode_unchanged(data, where)).view("<f4")[..., 0]
    else:
        metres = _whole(data, where).astype(np.float32) / np.float32(steps_per_metre)
    return np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(0)).astype(np.float32)


def _whole(data: bytes, where: str) -> NDArray[np.uint16]:
    """The whole numbers of an image, (H, W)."""
    if not data.startswith(RVL):
        return decode_16_bit(data, where)
    size = depth_size(data)
    if size is None or size[0] * size[1] > MOST_PIXELS:
        raise DatasetError(f"{where}: the image is damaged (its header)")
    values = _whole_numbers(data[_HEADER:])
    pixels = np.zeros(size[0] * size[1], np.int64)
    deltas, places, pixel, read = [], [], 0, 0
    while pixel < len(pixels):
        zeros, others = values[read : read + 2] if read + 2 <= len(values) else (len(pixels), 0)
        pixel, read = pixel + int(zeros), read + 2
        if pixel + others > len(pixels) or read + others > len(values) or zeros + others == 0:
            raise DatasetError(f"{where}: the image is cut short or damaged")
        deltas.append(values[read : read + others])
        places.append(np.arange(pixel, pixel + others))
        pixel, read = pixel + int(others), read + int(others)
    if deltas:
        zigzag = np.concatenate(deltas)
        pixels[np.concatenate(places)] = np.cumsum((zigzag >> 1) ^ -(zigzag & 1))
    if pixels.min(initial=0) < 0 or pixels.max(initial=0) > np.iinfo(np.uint16).max:
        raise DatasetError(f"{where}: the image is damaged (a depth out of range)")
    return measured(pixels.astype(np.uint16)).reshape(size[1], size[0])


def _whole_numbers(data: bytes) -> NDArray[np.int64]:
    """The numbers in a stream of nibbles."""
    words = np.frombuffer(data[: len(data) // 4 * 4], "<u4")
    nibbles = ((words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32)) & 0xF).reshape(-1).astype(np.int64)
    ends = np.flatnonzero(nibbles < 8)
    begins = np.concatenate([[0], ends[:-1] + 1]).astype(np.int64)
    number = np.zeros(len(ends), np.int64)
    lengths = np.minimum(ends + 1 - begins, _MOST_NIBBLES) if len(ends) else ends
    for place in range(int(lengths.max(initial=0))):
        has = lengths > place
        number[has] |= (nibbles[begins[has] + place] & 7) << (3 * place)
    return number
