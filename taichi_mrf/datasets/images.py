"""Image files to arrays: depth images with all their checks, colour images, and the same back to disk."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import DatasetError

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def read_depth(path: Path, steps_per_metre: float, sentinel: int | None = None) -> NDArray[np.float32]:
    """Axial depth in metres, (H, W) float32, from a 16-bit grey image; 0 means no measurement.

    ``sentinel`` is a second value that means no measurement. Raises DatasetError, whose text names
    the file, for one that is missing, damaged, or no 16-bit grey image.
    """
    image = decode_16_bit(_bytes(path), str(path))
    depth_m = image.astype(np.float32) / np.float32(steps_per_metre)
    if sentinel is not None:
        depth_m[image == sentinel] = 0.0
    return depth_m


def read_color(path: Path) -> NDArray[np.uint8]:
    """An (H, W, 3) uint8 RGB image. Raises DatasetError, whose text names the file."""
    return cv2.cvtColor(_decode(_bytes(path), str(path), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of an image file. Raises DatasetError, whose text names the file."""
    height, width = _decode(_bytes(path), str(path), cv2.IMREAD_UNCHANGED).shape[:2]
    return width, height


def decode_16_bit(data: bytes, where: str) -> NDArray[np.uint16]:
    """The grey values, (H, W) uint16, of an encoded image. Raises DatasetError, whose text begins with
    ``where``, if it is damaged or no 16-bit grey image."""
    image = _decode(data, where, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype != np.uint16:
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise DatasetError(
            f"{where}: not a depth image: expected 16-bit grey, "
            f"found {8 * image.dtype.itemsize}-bit with {channels} channel{'s' if channels > 1 else ''}"
        )
    return image


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise DatasetError(f"{path}: the image is missing") from None
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror}") from error


def _decode(data: bytes, where: str, flags: int) -> NDArray:
    problem = _png_damage(data) if data.startswith(PNG_SIGNATURE) else None
    if problem:
        raise DatasetError(f"{where}: {problem}")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except cv2.error:
        image = None
    if image is None:
        raise DatasetError(f"{where}: not a readable image{'' if data else ' (the file is empty)'}")
    return image


def _png_damage(data: bytes) -> str | None:
    """What is wrong with the chunks of a PNG, if anything.

    Checked here since libpng writes to stderr past every logger, and since some builds of OpenCV hand
    out the upper part of a cut image with zeros below, which would pass for missing depth.
    """
    position = len(PNG_SIGNATURE)
    while position + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        end = position + 12 + length
        if end > len(data):
            break
        (checksum,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(memoryview(data)[position + 4 : end - 4]) != checksum:
            return "the image is damaged (wrong checksum)"
        if kind == b"IEND":
            return None
        position = end
    return "the image is cut short"
