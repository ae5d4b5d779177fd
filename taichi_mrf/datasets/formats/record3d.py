"""Recordings of the app Record3D: an iPhone's or iPad's lidar, with ARKit's poses and confidence.

A ``.r3d``, which is a zip, or a folder with what is in it, read without trust:

- ``metadata``: JSON. ``K`` are the 9 numbers of the colour camera's matrix, column by column; ``w`` and ``h``
  the size that it is for; ``dw`` and ``dh`` the size of depth, which old files lack; ``poses`` qx qy qz qw tx
  ty tz of each frame, with x right, y up and z backwards. ``fps``, ``frameTimestamps`` (seconds) and
  ``perFrameIntrinsicCoeffs`` (fx fy cx cy of each frame) may be missing
- ``rgbd/N.depth``: float32 metres; ``rgbd/N.conf``: 8 bits, ARKit's levels 0 (low), 1 and 2 (high);
  both packed with LZFSE or as they are. ``rgbd/N.jpg``: the colour image, to which depth is registered

An LZFSE stream is a row of blocks, each of which says how many bytes it holds; they are added up before
anything is unpacked. Unpacking needs the extra ``record3d``. Level 2 leaves the sigma, level 1 doubles it,
and pixels of level 0 are no measurements.
"""

import math
import struct
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import NumberedRow, Table, start_pose
from taichi_mrf.datasets.color_camera import ColorCamera
from taichi_mrf.datasets.confidence import ARKIT
from taichi_mrf.datasets.images import decode_color
from taichi_mrf.datasets.intrinsics import json_values
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.datasets.trajectories import pose_from_quaternion
from taichi_mrf.errors import ConfigError, DatasetError, naming, said
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.system.files import is_file, is_folder, open_regular, read_bytes
from taichi_mrf.system.libraries import library
from taichi_mrf.system.packed import TEXT, ZipMembers

MISSING = "the file is missing"
_LZFSE, _END = b"bvx", b"bvx$"
_LEAST_HEADER = 32
"""Bytes of an LZFSE block's header without its table of frequencies."""


class Files:
    """The files of a recording by their names in it, such as ``rgbd/0.depth``: in a .r3d or in a folder."""

    def __init__(self, path: Path) -> None:
        """Raises DatasetError, which names the file, if it is neither a folder nor a zip."""
        self.path, self.zipped = path, not is_folder(path)
        if not self.zipped:
            inside = [path, *(child for child in path.iterdir() if is_folder(child))]
            files = (file for folder in inside for file in folder.iterdir() if is_file(file))
            self.names = frozenset(file.relative_to(path).as_posix() for file in files)
            return
        stream = open_regular(path, DatasetError)
        try:
            self._zip = ZipMembers(path, stream, DatasetError)
        except Exception as error:  # zipfile raises many kinds of errors
            stream.close()
            raise DatasetError(f"{path}: not a recording of Record3D: {said(error)}") from error
        self.names = frozenset(self._zip.members)
        weakref.finalize(self, stream.close)

    def where(self, name: str) -> str:
        """Name of a file in errors."""
        return f"{self.path}: {name}" if self.zipped else str(self.path / name)

    def read(self, name: str, most_bytes: int, weight: int = 1) -> bytes:
        """A file's content. Raises DatasetError, which names the file, if it is missing, damaged or larger
        than ``most_bytes``, or unpacks to too much; ``weight`` is what each byte counts for then."""
        if not self.zipped:
            return read_bytes(self.path / name, DatasetError, MISSING, most_bytes)
        if name not in self.names:
            raise DatasetError(f"{self.where(name)}: {MISSING}")
        size = self._zip.members[name].file_size
        if size > most_bytes:
            problem = f"claims {size:,} bytes; at most {most_bytes:,} are expected"
            raise DatasetError(f"{self.where(name)}: {problem}")
        return self._zip.read(name, weight)


def is_packed(data: bytes) -> bool:
    """True if the content of a file of depth or confidence is an LZFSE stream."""
    return data.startswith(_LZFSE)


def unpacker() -> Any:
    """The library that unpacks LZFSE. Raises DatasetError, which says what to install."""
    return library("lzfse", "depth that Record3D has packed needs", "record3d", DatasetError)


def held_bytes(data: bytes) -> int:
    """Unpacked size, in bytes, of a file of depth or confidence. Raises DatasetError, which names no file,
    for an LZFSE stream that is damaged."""
    if not is_packed(data):
        return len(data)
    place = total = 0
    try:
        while data[place : place + 4] != _END:
            kind, held = struct.unpack_from("<4sI", data, place)
            total += held
            place += _block_bytes(kind, held, data, place)
    except struct.error:
        raise DatasetError("is cut short") from None
    return total


def unpacked(data: bytes, expected_bytes: int) -> bytes:
    """The content of a file of depth or confidence. Raises DatasetError, which names no file, if it is
    damaged or holds another number of bytes than expected, and what to install if it is packed and the
    library is missing."""
    held = held_bytes(data)
    if held != expected_bytes:
        raise DatasetError(f"holds {held:,} bytes, expected {expected_bytes:,}")
    if not is_packed(data):
        return data
    lzfse = unpacker()
    try:
        content: bytes = lzfse.decompress(data)
    except Exception as error:
        raise DatasetError("is damaged: it cannot be unpacked") from error
    if len(content) != expected_bytes:
        raise DatasetError(f"unpacks to {len(content):,} bytes, expected {expected_bytes:,}")
    return content


def _block_bytes(kind: bytes, held: int, data: bytes, place: int) -> int:
    """The size of a block of an LZFSE stream with its header."""
    if kind == b"bvx-":  # as it is
        return 8 + held
    if kind == b"bvxn":  # LZVN
        return 12 + int(struct.unpack_from("<I", data, place + 8)[0])
    if kind == b"bvx2":  # the sizes of literals and matches are fields of 20 bits
        literals, matches, header = struct.unpack_from("<QQI", data, place + 8)
        if header >= _LEAST_HEADER:
            return int(header + (literals >> 20 & 0xFFFFF) + (matches >> 40 & 0xFFFFF))
    raise DatasetError(f"holds an unknown block, {kind!r}: it is damaged")


MOST_PIXELS = 1 << 24
"""Of a depth image; those of phones have 49,152 or 307,200."""

FRAMES_PER_SECOND = 30.0
"""Assumed where nothing tells."""

_LEAST_RATE, _LARGEST_RATE = 1e-3, 1e6

_NO_POSE = np.array([0.0, 0, 0, 1, 0, 0, 0])


@dataclass(frozen=True)
class Metadata:
    """Content of the metadata. ``where`` is what errors call them, ``depth_shape`` (height, width), None if
    it is missing; ``poses`` is (N, 7), ``intrinsics`` (N, 4), both with no row if they are missing."""

    where: str
    values: Mapping[str, Any]
    color_camera: PinholeCamera
    depth_shape: tuple[int, int] | None
    poses: NDArray[np.float64]
    intrinsics: NDArray[np.float64]

    @property
    def has_poses(self) -> bool:
        """True if any frame has a pose other than the origin, which all have without tracking."""
        return len(self.poses) == 1 or not bool(np.all(self.poses == _NO_POSE))

    def cameras(self, numbers: Sequence[int]) -> list[PinholeCamera] | None:
        """The colour camera of each of these frames, None if one is that of all. Raises DatasetError."""
        if len(self.intrinsics) == 0:
            return None
        name, size = "perFrameIntrinsicCoeffs", (self.color_camera.width, self.color_camera.height)
        if len(self.intrinsics) <= max(numbers):
            raise DatasetError(
                f"{self.where}: {name} has {len(self.intrinsics)} entries, none for frame {max(numbers)}"
            )
        # Zeros stand for intrinsics that are not known.
        known = np.flatnonzero(self.intrinsics.any(axis=1))
        if len(known) == 0:
            return None
        rows = known[np.maximum(np.searchsorted(known, numbers, "right") - 1, 0)]
        with naming(f"{self.where}: {name}", ConfigError):
            return [PinholeCamera(*size, *map(float, self.intrinsics[row])) for row in rows]

    def stamps(self, numbers: Sequence[int]) -> tuple[list[float], list[str]]:
        """Time of each of these frames, in seconds, and notes. Raises DatasetError."""
        times, rate = self.values.get("frameTimestamps"), self.values.get("fps")
        if times:
            try:
                stamps = [float(times[number]) for number in numbers]
            except (ValueError, TypeError, IndexError, KeyError, OverflowError):
                stamps = []
            if len(stamps) < len(numbers) or not all(map(math.isfinite, stamps)):
                raise DatasetError(f"{self.where}: frameTimestamps must be a number for each frame")
            return stamps, []
        if isinstance(rate, int | float) and _LEAST_RATE <= rate <= _LARGEST_RATE:
            return [number / rate for number in numbers], []
        note = f"no stamps in {self.where}: assumed {FRAMES_PER_SECOND:g} frames a second"
        return [number / FRAMES_PER_SECOND for number in numbers], [note]


def read_metadata(where: str, data: bytes) -> Metadata:
    """The metadata in a file. Raises DatasetError, which begins with ``where`` and names the entry."""
    values = json_values(data, where)
    if not isinstance(values, dict):
        raise DatasetError(f"{where}: expected an object with K, w, h and poses")
    shape = None
    if "dw" in values or "dh" in values:
        shape = _whole(where, values, "dh"), _whole(where, values, "dw")
        if shape[0] * shape[1] > MOST_PIXELS:
            raise DatasetError(
                f"{where}: {shape[1]} x {shape[0]} pixels of depth; at most {MOST_PIXELS:,} are read"
            )
    return Metadata(
        where,
        values,
        _color_camera(where, values),
        shape,
        _table(where, values, "poses", 7),
        _table(where, values, "perFrameIntrinsicCoeffs", 4),
    )


def _color_camera(where: str, values: Mapping[str, Any]) -> PinholeCamera:
    width, height = _whole(where, values, "w"), _whole(where, values, "h")
    K = _numbers(values.get("K"))
    if K.shape != (9,) or not np.isfinite(K).all():
        raise DatasetError(f"{where}: K is not a list of 9 numbers")
    with naming(f"{where}: K", ConfigError):
        return PinholeCamera.from_matrix(width, height, K.reshape(3, 3).T)


def _table(where: str, values: Mapping[str, Any], name: str, columns: int) -> NDArray[np.float64]:
    """A list of lists of as many numbers, (N, columns), without a row if it is missing."""
    found = values.get(name)
    table = _numbers(found) if found else np.empty((0, columns))
    if table.ndim != 2 or table.shape[1] != columns:
        raise DatasetError(f"{where}: {name} is not a list of {columns} numbers for each frame")
    return table


def _numbers(found: Any) -> NDArray[np.float64]:
    """Numbers of JSON as an array, of no dimension if they are anything else."""
    try:
        return np.array(found, np.float64)
    except (ValueError, TypeError, OverflowError):
        return np.array(np.nan)


def _whole(where: str, values: Mapping[str, Any], name: str) -> int:
    """A number of pixels."""
    found = values.get(name)
    if isinstance(found, float) and found.is_integer():
        found = int(found)
    if not isinstance(found, int) or isinstance(found, bool) or not 0 < found <= MOST_PIXELS:
        raise DatasetError(f"{where}: {name} is {str(found)[:40]}, not a number of pixels")
    return found


METADATA, IMAGES = "metadata", "rgbd"
_MOST_METADATA, _MOST_IMAGE = 1 << 27, 1 << 26
_MOST_DIGITS = 9
_ARKIT_AXES = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass
class Record3D(Table[NumberedRow]):
    """The frames of a recording. ``cameras`` are those of their colour images, where
    each has its own; None if one holds for all, as the caller's does."""

    camera: PinholeCamera
    files: Files = field(kw_only=True)
    metadata: Metadata = field(kw_only=True)
    cameras: Sequence[PinholeCamera] | None = field(kw_only=True)
    steps_per_metre: float = 1.0
    color: bool = True

    def load(self, index: int, row: NumberedRow, T_world_camera: Pose) -> Frame:
        """Read depth, confidence and colour, which must have the sizes that they should."""
        number, own = row.number, None if self.cameras is None else self.cameras[index]
        camera = self.camera if own is None else _of_depth(own, self.camera.shape)
        color = sigma_m = None
        depth_m = self._depth(_file(number, "depth"))
        if _file(number, "conf") in self.files.names:
            sigma_m = self._sigma(_file(number, "conf"), depth_m, camera)
        if self.color and _file(number, "jpg") in self.files.names:
            color = self._color(_file(number, "jpg"), own or self.metadata.color_camera, depth_m, camera)
        return Frame(depth_m, T_world_camera, camera, row.stamp, row.name, color, sigma_m)

    def _depth(self, file: str) -> NDArray[np.float32]:
        depth_m = (self._array(file, np.dtype("<f4")) / self.steps_per_metre).astype(np.float32)
        with np.errstate(invalid="ignore"):
            depth_m[~np.isfinite(depth_m) | (depth_m < 0)] = 0.0
        return depth_m

    def _array(self, file: str, dtype: np.dtype) -> NDArray[Any]:
        """The pixels (H, W) in a file of depth or confidence."""
        size = self.camera.width * self.camera.height * dtype.itemsize
        data = self.files.read(file, _packed_bound(size))
        with naming(f"{self.files.where(file)}"):
            return np.frombuffer(unpacked(data, size), dtype).reshape(self.camera.shape)

    def _sigma(self, file: str, depth_m: NDArray[np.float32], camera: PinholeCamera) -> NDArray[np.float32]:
        levels = self._array(file, np.dtype(np.uint8))
        with naming(f"{self.files.where(file)}"):
            return ARKIT.sigma_m(levels, depth_m, camera)

    def _color(
        self, file: str, own: PinholeCamera, depth_m: NDArray[np.float32], camera: PinholeCamera
    ) -> NDArray[np.uint8]:
        """The colours of the depth image's pixels; the image may be larger than the metadata say."""
        where = self.files.where(file)
        image = decode_color(self.files.read(file, _MOST_IMAGE), where)
        scaled = own.scaled(image.shape[1] / own.width)
        if image.shape[:2] != scaled.shape:
            raise DatasetError(
                f"{where}: has {image.shape[1]} x {image.shape[0]} pixels, which are not the proportions of "
                f"the {own.width} x {own.height} in {METADATA}"
            )
        return ColorCamera(scaled, np.eye(4)).registered(image, depth_m, camera)


def open_recording(path: Path, options: ReadOptions) -> Record3D:
    """List the frames in the order of their numbers. Raises DatasetError, which names the file and the entry
    of its metadata, also for a recording without poses, unless they are to be tracked."""
    files = Files(path)
    numbers = sorted(number for name in files.names if (number := _number_of(name)) is not None)
    if not numbers:
        raise DatasetError(f"{path}: contains no {IMAGES}/N.depth")
    metadata = read_metadata(files.where(METADATA), files.read(METADATA, _MOST_METADATA, TEXT))
    if not (metadata.has_poses or options.track):
        raise DatasetError(
            f"{metadata.where}: contains no poses, as recordings of the front camera do not; --track-poses "
            "finds them from the images"
        )
    count = len(metadata.poses)
    posed = [number for number in numbers if number < count] if metadata.has_poses else numbers
    if not posed:
        raise DatasetError(f"{metadata.where}: has {count} poses, but none for its {len(numbers)} frames")
    dropped = len(numbers) - len(posed)
    notes = (
        [f"{dropped} of {len(numbers)} images dropped: {METADATA} has no pose for them"] if dropped else []
    )
    _check_unpacker(files, posed[0])
    stamps, assumed = metadata.stamps(posed)
    overridden = options.camera is not None or options.intrinsics is not None
    return Record3D(
        path.stem if is_file(path) else path.name,
        _camera(files, posed[0], metadata, options),
        notes + assumed,
        dropped,
        files=files,
        metadata=metadata,
        confidence=ARKIT if any(_file(number, "conf") in files.names for number in posed) else None,
        rows=[_row(metadata, number, stamp) for number, stamp in zip(posed, stamps, strict=True)],
        cameras=None if overridden else metadata.cameras(posed),
        steps_per_metre=options.depth_scale or 1.0,
        color=options.color,
    )


def _row(metadata: Metadata, number: int, stamp: float) -> NumberedRow:
    pose = partial(_pose, metadata.poses[number]) if metadata.has_poses else start_pose()
    return NumberedRow(f"{number:06d}", stamp, pose, f"{metadata.where}: pose {number}", number)


def _pose(values: NDArray[np.float64]) -> Pose:
    return as_pose(pose_from_quaternion(np.append(values[4:], values[:4])) @ _ARKIT_AXES)


def _check_unpacker(files: Files, first: int) -> None:
    """Raise DatasetError, which says what to install, if depth is packed and nothing unpacks it here."""
    try:
        data = files.read(_file(first, "depth"), _packed_bound(4 * MOST_PIXELS))
    except DatasetError:  # which reading the frame reports
        return
    if is_packed(data):
        unpacker()


def _camera(files: Files, first: int, metadata: Metadata, options: ReadOptions) -> PinholeCamera:
    """The depth camera, that of the first frame if each has its own."""
    shape = metadata.depth_shape or _depth_shape(files, first, metadata)
    if options.camera is not None:
        if options.camera.shape != shape:
            raise DatasetError(
                f"{metadata.where}: the depth images have {shape[1]} x {shape[0]} pixels, the camera "
                f"{options.camera.width} x {options.camera.height}"
            )
        return options.camera
    own = metadata.cameras([first])
    with naming(metadata.where):
        return _of_depth(metadata.color_camera if own is None else own[0], shape)


def _file(number: int, kind: str) -> str:
    return f"{IMAGES}/{number}.{kind}"


def _number_of(name: str) -> int | None:
    """The number of a frame, by the name of its depth image."""
    stem = name.removeprefix(f"{IMAGES}/").removesuffix(".depth")
    is_number = stem.isdecimal() and len(stem) <= _MOST_DIGITS
    return int(stem) if is_number and name == _file(int(stem), "depth") else None


def _packed_bound(size: int) -> int:
    """Largest size of a packed file that unpacks to ``size`` bytes."""
    return 2 * size + 4096


def _depth_shape(files: Files, first: int, metadata: Metadata) -> tuple[int, int]:
    """(height, width) of depth images that the metadata do not tell: they have the proportions of colour."""
    name, color = _file(first, "depth"), metadata.color_camera
    with naming(f"{files.where(name)}"):
        pixels = held_bytes(files.read(name, _packed_bound(4 * MOST_PIXELS))) // 4
    width = max(1, round(math.sqrt(pixels * color.width / color.height)))
    height = pixels // width
    if not 0 < width * height == pixels <= MOST_PIXELS:
        raise DatasetError(f"{metadata.where}: dw and dh are missing, and {name} has {pixels} pixels")
    return height, width


def _of_depth(camera: PinholeCamera, shape: tuple[int, int]) -> PinholeCamera:
    """The depth camera, from that of the colour images, which it shares its view with. Raises DatasetError,
    which names no file, if the two have other proportions."""
    scaled = camera.scaled(shape[1] / camera.width)
    if scaled.shape != shape:
        raise DatasetError(
            f"depth of {shape[1]} x {shape[0]} pixels has other proportions than colour of "
            f"{camera.width} x {camera.height}"
        )
    return scaled
