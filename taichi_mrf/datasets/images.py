"""Image files to arrays: depth images with all their checks, colour images, and the same back to disk.

The size that a file claims is read from its header before a decoder takes memory for it. The formats in
_READERS are the only ones that are decoded: what a decoder allocates for any other cannot be bounded
beforehand.

RVL is a code for depth images without loss (A. Wilson, "Fast Lossless Depth Image Compression", ISS 2017):
runs of zeros and of other pixels, whose differences from each other are numbers of three bits a nibble.
"""

import re
import struct
import zlib
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.turned import turn_hint
from taichi_mrf.errors import DatasetError, said
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.files import read_bytes
from taichi_mrf.system.npz_file import read_npy
from taichi_mrf.system.packed import DEFLATE_RATIO

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
KNOWN = "PNG, JPEG, TIFF, WebP, BMP, PGM, PPM"

Size = tuple[int, int]


def claimed_size(data: bytes) -> Size | None:
    """(width, height) in pixels by the header of an encoded image. None for a damaged header and for other
    formats than those of KNOWN."""
    read = next((read for signature, read in _READERS if re.match(signature, data, re.DOTALL)), None)
    try:
        size = None if read is None else read(data)
    except (struct.error, IndexError):  # the header is cut short
        return None
    return size if size is not None and min(size) > 0 else None


_HEADER = 1 << 12


def stated_size(path: Path) -> Size | None:
    """(width, height) by the first bytes of a file; None if they do not tell, or it cannot be read."""
    try:
        with path.open("rb") as file:
            return claimed_size(file.read(_HEADER))
    except OSError:
        return None


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
"""First bytes of the files of each format, and the reader of their headers."""

_JPEG_FRAMES = {0xC0, 0xC1, 0xC2, 0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF}
"""Markers of a JPEG's segments that begin with its size."""

_WEBP_ANIMATION = 2

_TIFF_SIZES = (256, 257, 322, 323)
"""ImageWidth, ImageLength, TileWidth, TileLength."""

_TIFF_KINDS = {3: "H", 4: "I"}
_LARGEST_TILE = 1 << 20
"""Pixels of a tile that is larger than its image; small images have tiles of 256 x 256."""

ARRAY = ".npy"
DEPTH_SUFFIXES = (".png", ".tif", ".tiff")
"""Of depth images that folders may hold."""

_MANY = 0.03
"""Share of pixels with the largest value of which a note is made."""

Kind = TypeVar("Kind", bound=np.integer)

MOST_PIXELS = 1 << 27
"""Far more than a camera has; a packed image of a few megabytes may claim a hundred times as many."""


def read_depth(
    path: Path, steps_per_metre: float, camera: PinholeCamera | None = None
) -> NDArray[np.float32]:
    """Axial depth in metres, (H, W) float32, from a grey image of 16 bits or of floats, or from NumPy's array
    of any numbers (.npy), 0 for none. Raises DatasetError, which names the file, for an image that is
    missing, damaged, of another kind, or of another size than the camera's."""
    steps = _values(path, camera)
    if path.suffix == ARRAY and steps.dtype.kind in "ui":
        steps = measured(steps)
    elif not (steps.ndim == 2 and steps.dtype.kind == "f"):
        return np.take(_metres_of_16_bit(steps_per_metre), _of_16_bit(steps, str(path)), mode="clip")
    return without_filling(steps.astype(np.float32) / np.float32(steps_per_metre))


@lru_cache(maxsize=4)
def _metres_of_16_bit(steps_per_metre: float) -> NDArray[np.float32]:
    """The depth of each number of 16 bits, to look up: to find it takes four times as long."""
    return without_filling(np.arange(1 << 16, dtype=np.float32) / np.float32(steps_per_metre))


def holds_depth(path: Path) -> bool:
    """True if a file is an image that may be one of depth: grey of 16 bits or of floats."""
    try:
        steps = _decode(_image_file(path), str(path), cv2.IMREAD_UNCHANGED)
    except DatasetError:
        return False
    return steps.ndim == 2 and (steps.dtype == np.uint16 or steps.dtype.kind == "f")


def look_at_depth(path: Path, camera: PinholeCamera) -> tuple[bool, float]:
    """True for a depth image of floats, and the share of its pixels that have the largest whole number;
    (False, 0) for one that cannot be read."""
    try:
        steps = _values(path, camera)
    except DatasetError:  # reported when its frame is read
        return False, 0.0
    return steps.dtype.kind == "f", share_of_largest(steps)


def share_of_largest(steps: NDArray) -> float:
    """The share of pixels that have the largest value of whole numbers."""
    is_whole = steps.ndim == 2 and steps.dtype.kind in "ui" and steps.itemsize == 2
    return float((steps == np.iinfo(steps.dtype).max).mean()) if is_whole else 0.0


def note_of_largest(shares: Sequence[float]) -> list[str]:
    """A note, if a good part of the pixels of the frames that were looked at have the largest value."""
    share = float(np.mean(shares)) if len(shares) else 0.0
    said = f"{share:.0%} of the pixels of {len(shares)} frames looked at have the largest possible number"
    return [f"depth: {said}, which is not a measurement"] if share > _MANY else []


def measured(steps: NDArray[Kind]) -> NDArray[Kind]:
    """Depth in whole steps with 0 where there is no measurement: in no format is the largest value of the
    type one. Cameras and drivers write it for what is too far, too near or unknown."""
    return np.where(steps == np.iinfo(steps.dtype).max, steps.dtype.type(0), steps)


_NOT_SEEN_M = 1e7
"""No camera's depth is as large, in whatever unit: renderers write 1e10 where there is no surface."""

_LARGEST_MM_M = 65.535
"""The largest number of 16 bits, once millimetres have become metres."""


def without_filling(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth (H, W) with 0 where it is no number, negative, or what is written for no measurement."""
    none = ~(np.isfinite(depth) & (depth > 0) & (depth < _NOT_SEEN_M))
    none |= np.abs(depth - np.float32(_LARGEST_MM_M)) < 1e-5
    depth[none] = 0.0
    return depth


def read_color(path: Path, camera: PinholeCamera | None = None) -> NDArray[np.uint8]:
    """An (H, W, 3) uint8 RGB image. Raises DatasetError, which names the file, also for one of another size
    than the camera's."""
    return decode_color(_image_file(path), str(path), camera)


def read_grey(path: Path) -> NDArray[np.uint8]:
    """An (H, W) uint8 grey image. Raises DatasetError, which names the file."""
    return _decode(_image_file(path), str(path), cv2.IMREAD_GRAYSCALE)


def read_levels(path: Path, channels: int, camera: PinholeCamera) -> NDArray[np.uint8]:
    """The numbers of an image's pixels, (H, W) uint8, of several channels (H, W, channels) with red first.
    Raises DatasetError, which names the file, for an image that is missing, damaged, of another kind, or of
    another size than the camera's."""
    image = _decode(_image_file(path), str(path), cv2.IMREAD_UNCHANGED, camera)
    if image.dtype != np.uint8 or image.size != channels * image.shape[0] * image.shape[1]:
        wanted = _kind(np.empty((1, 1, channels), np.uint8))
        raise DatasetError(f"{path}: expected {wanted}, numbers and no palette; found {_kind(image)}")
    return image if channels == 1 else image[..., [2, 1, 0, 3][:channels]]


def _kind(image: NDArray) -> str:
    """An image's bits and channels in words."""
    channels = 1 if image.ndim == 2 else image.shape[2]
    return f"{8 * image.dtype.itemsize}-bit with {channels} channel{'s' if channels > 1 else ''}"


def first_size(paths: Iterable[Path]) -> tuple[int, int] | None:
    """(width, height) of the first image that can be read; a broken one is reported with its frame."""
    for path in paths:
        with suppress(DatasetError):
            height, width = _values(path).shape[:2]
            return width, height
    return None


def decode_16_bit(data: bytes, where: str, camera: PinholeCamera | None = None) -> NDArray[np.uint16]:
    """Depth in steps, (H, W) uint16, of an encoded image, 0 where there is no measurement. Raises
    DatasetError, which begins with ``where``, if it is damaged, no 16-bit grey image, or of another size than
    the camera's."""
    return _of_16_bit(_decode(data, where, cv2.IMREAD_UNCHANGED, camera), where)


def _of_16_bit(image: NDArray, where: str) -> NDArray[np.uint16]:
    if image.ndim != 2 or image.dtype != np.uint16:
        raise DatasetError(
            f"{where}: not a depth image: expected 16-bit grey, found {_kind(image)}"
            + (
                "; a colour or 8-bit picture of depth has lost the measurements, except a simulator's, "
                "whose colours are bytes of one number (CARLA: 1000 m * (R + 256 G + 65536 B) / (2^24 - 1)): "
                "compute depth, and write it as 16-bit millimetres"
                if image.itemsize == 1 and image.ndim == 3
                else "; an 8-bit picture of depth has lost the measurements"
                if image.itemsize == 1
                else ""
            )
        )
    return measured(image)


def decode_unchanged(data: bytes, where: str) -> NDArray:
    """The values of an encoded image with all its channels, as OpenCV orders them. Raises DatasetError, which
    begins with ``where``, if it is damaged."""
    return _decode(data, where, cv2.IMREAD_UNCHANGED)


def decode_color(data: bytes, where: str, camera: PinholeCamera | None = None) -> NDArray[np.uint8]:
    """An (H, W, 3) uint8 RGB image from an encoded one. Raises DatasetError, which begins with ``where``, if
    it is damaged, or of another size than the camera's."""
    return cv2.cvtColor(_decode(data, where, cv2.IMREAD_COLOR, camera), cv2.COLOR_BGR2RGB)


def _values(path: Path, camera: PinholeCamera | None = None) -> NDArray:
    """The values of an image's file, which may be an array of one number a pixel. Raises DatasetError."""
    if path.suffix != ARRAY:
        return _decode(_image_file(path), str(path), cv2.IMREAD_UNCHANGED, camera)
    try:
        array = read_npy(path)
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: not a readable array: {said(error)}") from error
    image = array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array
    if image.ndim != 2 or image.dtype.kind not in "fui" or not image.size:
        raise DatasetError(
            f"{path}: no depth image: expected numbers (H, W), found {array.dtype} {array.shape}"
        )
    _check_size(str(path), image.shape[1], image.shape[0], camera)
    return image


def _image_file(path: Path) -> bytes:
    return read_bytes(path, DatasetError, "the image is missing")


def _decode(data: bytes, where: str, flags: int, camera: PinholeCamera | None = None) -> NDArray:
    is_png, claimed = data.startswith(PNG_SIGNATURE), claimed_size(data)
    if claimed is not None:  # before any of it is unpacked
        _check_size(where, *claimed, camera)
    kept: list[bytes] = []
    problem = _png_damage(data, kept) if is_png else None
    if problem:
        raise DatasetError(f"{where}: {problem}")
    if claimed is None:
        what = f"no {KNOWN}, or its header is damaged" if data else "the file is empty"
        raise DatasetError(f"{where}: not a readable image ({what})")
    try:
        image = cv2.imdecode(np.frombuffer(b"".join(kept) or data, np.uint8), flags)
    except (cv2.error, MemoryError):
        image = None
    if image is None:
        raise DatasetError(f"{where}: not a readable image")
    _check_size(where, image.shape[1], image.shape[0], camera)
    return image


def _check_size(where: str, width: int, height: int, camera: PinholeCamera | None) -> None:
    if camera is not None and (height, width) != camera.shape:
        raise DatasetError(
            f"{where}: the image has {width} x {height} pixels, the camera {camera.width} x {camera.height}"
            + turn_hint(camera, (width, height))
            + at_size(camera, width, height)
        )
    if width * height > MOST_PIXELS:
        raise DatasetError(f"{where}: {width} x {height} pixels; at most {MOST_PIXELS:,} are read")


def as_numbers(camera: PinholeCamera) -> str:
    """A camera as --camera takes it."""
    return f"{camera.fx:g},{camera.fy:g},{camera.cx:g},{camera.cy:g}"


def at_size(camera: PinholeCamera, width: int, height: int) -> str:
    """The intrinsics of a camera whose images were scaled to another size, in words; empty if the two have
    other proportions."""
    scaled = camera.scaled(width / camera.width)
    return (
        f"; scaled to this size it is --camera {as_numbers(scaled)}"
        if scaled.shape == (height, width)
        else ""
    )


def _png_damage(data: bytes, kept: list[bytes]) -> str | None:
    """The damage of a PNG's chunks, or None. They are put into ``kept``, all but texts and colour profiles,
    which libpng unpacks however large they are. Checked here since libpng writes to stderr past every logger,
    and since some builds of OpenCV hand out the upper part of a cut image with zeros below, which would pass
    for missing depth. Memory that the header claims is not taken before it is known to be filled."""
    position, packed = len(PNG_SIGNATURE), []
    kept.append(PNG_SIGNATURE)
    while position + _CHUNK_BYTES <= len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        end = position + _CHUNK_BYTES + length
        if end > len(data):
            break
        (checksum,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(memoryview(data)[position + 4 : end - 4]) != checksum:
            return "the image is damaged (wrong checksum)"
        if (kind == b"IHDR") != (position == len(PNG_SIGNATURE)) or (kind == b"IHDR" and length != 13):
            return "the image is damaged (its header is not where it should be)"
        if kind == b"IDAT":
            packed.append(data[position + 8 : end - 4])
        if kind not in _TEXTS:
            kept.append(data[position:end])
        if kind == b"IEND":
            return _png_content_damage(data, b"".join(packed))
        position = end
    return "the image is cut short"


def _png_content_damage(data: bytes, packed: bytes) -> str | None:
    """The damage of a PNG's pixels when its chunks are whole, or None."""
    width, height, depth, color, method, row_filter, interlaced = struct.unpack_from(">IIBBBBB", data, 16)
    samples = _SAMPLES.get(color)
    if samples is None or depth not in (1, 2, 4, 8, 16) or method or row_filter or not width * height:
        return (
            f"the image is damaged (a header of {width} x {height} pixels of the kind {color}, {depth} bit)"
        )
    wanted = height * (1 + (width * samples * depth + 7) // 8)
    if interlaced:  # written row by row by every depth camera; the passes of others OpenCV checks
        return None if wanted <= DEFLATE_RATIO * (len(packed) + 1) else "the image is cut short"
    unpacker, held, pending = zlib.decompressobj(), 0, packed
    try:
        while pending and not unpacker.eof and held <= wanted:
            held += len(unpacker.decompress(pending, _PIECE))
            pending = unpacker.unconsumed_tail
    except zlib.error:
        return "the image is damaged (its pixels cannot be unpacked)"
    if held != wanted:
        than = "cut short: its pixels are fewer" if held < wanted else "damaged: its pixels are more"
        return f"the image is {than} than {width} x {height}"
    return None


_CHUNK_BYTES = 12
_TEXTS = (b"tEXt", b"zTXt", b"iTXt", b"iCCP")
_PIECE = 1 << 20
_SAMPLES = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""Samples of a pixel by a PNG's type of colour."""


def decode_rvl(data: bytes) -> NDArray[np.uint16]:
    """The image (H, W) behind two integers, width and height, as ROS's compressedDepth and RTAB-Map write
    it. Raises DatasetError if it is damaged."""
    if len(data) < 8:
        raise DatasetError("RVL data are cut short")
    width, height = struct.unpack_from("<II", data)
    if not 0 < width * height <= MOST_PIXELS:
        raise DatasetError(f"{width} x {height} pixels; at most {MOST_PIXELS:,} are read")
    numbers = _rvl_numbers(np.frombuffer(data, "<u4", (len(data) - 8) // 4, 8))
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


def _rvl_numbers(words: NDArray[np.uint32]) -> NDArray[np.int64]:
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
