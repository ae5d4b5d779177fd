"""RVL, a code for depth images without loss (A. Wilson, "Fast Lossless Depth Image Compression", ISS 2017):
runs of zeros and of other pixels, whose differences from each other are numbers of three bits a nibble."""

import struct

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.images import MOST_PIXELS
from taichi_mrf.errors import DatasetError


def decode_rvl(data: bytes) -> NDArray[np.uint16]:
    """The image (H, W) behind two integers, width and height, as ROS's compressedDepth and RTAB-Map write
    it. Raises DatasetError if it is damaged."""
    if len(data) < 8:
        raise DatasetError("RVL data are cut short")
    width, height = struct.unpack_from("<II", data)
    if not 0 < width * height <= MOST_PIXELS:
        raise DatasetError(f"{width} x {height} pixels; at most {MOST_PIXELS:,} are read")
    numbers = _numbers(np.frombuffer(data, "<u4", (len(data) - 8) // 4, 8))
    runs, place, at, counts = [], 0, 0, numbers.tolist()
    while place < width * height:
        if at + 2 > len(counts) or min(counts[at : at + 2]) < 0:
            raise DatasetError("RVL data are cut short")
        zeros, others = counts[at : at + 2]
        place += zeros
        runs.append((place, at + 2, others))
        place, at = place + others, at + 2 + others
    if place > width * height or at > len(counts):
        raise DatasetError("RVL data do not fit the image's size")
    pixels, coded, count = (np.array(column, np.int64) for column in zip(*runs, strict=True))
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    steps = numbers[np.repeat(coded, count) + within]
    image = np.zeros(width * height, np.uint16)
    values = np.cumsum((steps >> 1) ^ -(steps & 1))
    if values.min(initial=0) < 0 or values.max(initial=0) > np.iinfo(np.uint16).max:
        raise DatasetError("RVL data are damaged: a depth is out of range")
    image[np.repeat(pixels, count) + within] = values.astype(np.uint16)
    return image.reshape(height, width)


def _numbers(words: NDArray[np.uint32]) -> NDArray[np.int64]:
    """The numbers in words of eight nibbles, the first in the upper bits: three bits each, the lowest first,
    below a bit that tells that more follow."""
    nibbles = ((words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32)) & 15).ravel().astype(np.int64)
    last = np.flatnonzero(nibbles < 8)
    first = np.concatenate([[0], last[:-1] + 1]) if len(last) else last
    if len(last) and (last - first).max() > 10:
        raise DatasetError("RVL data are damaged")
    nibbles = nibbles[: last[-1] + 1] if len(last) else nibbles[:0]
    place = np.arange(len(nibbles)) - np.repeat(first, last - first + 1)
    return np.add.reduceat((nibbles & 7) << (3 * place), first) if len(last) else nibbles
