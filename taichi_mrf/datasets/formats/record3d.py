"""Recordings of the app Record3D: an iPhone's or iPad's lidar, with ARKit's poses and confidence.

A ``.r3d``, which is a zip, or a folder with what is in it:

- ``metadata``: cameras, stamps, and poses with x right, y up and z backwards (record3d_metadata.py)
- ``rgbd/N.depth``: float32 metres; ``rgbd/N.conf``: 8 bits, ARKit's levels 0 (low), 1 and 2 (high);
  both packed with LZFSE or as they are. ``rgbd/N.jpg``: the colour image, to which depth is registered

Level 2 leaves the sigma, level 1 doubles it, and pixels of level 0 are no measurements.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Row, Table, start_pose
from taichi_mrf.datasets.color_camera import ColorCamera
from taichi_mrf.datasets.confidence import ARKIT
from taichi_mrf.datasets.formats.record3d_files import (
    Files,
    held_bytes,
    is_packed,
    open_files,
    unpacked,
    unpacker,
)
from taichi_mrf.datasets.formats.record3d_metadata import MOST_PIXELS, Metadata, read_metadata
from taichi_mrf.datasets.images import decode_color
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.datasets.trajectories import pose_from_quaternion
from taichi_mrf.errors import DatasetError, naming
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.system.files import is_file

METADATA, IMAGES = "metadata", "rgbd"
_MOST_METADATA, _MOST_IMAGE = 1 << 27, 1 << 26
_MOST_DIGITS = 9
_ARKIT_AXES = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Record3DFrame(Row):
    """A frame and its number."""

    number: int


@dataclass
class Record3D(Table[Record3DFrame]):
    """The frames of a recording. ``cameras`` are those of their colour images, where
    each has its own; None if one holds for all, as the caller's does."""

    camera: PinholeCamera
    files: Files = field(kw_only=True)
    metadata: Metadata = field(kw_only=True)
    cameras: Sequence[PinholeCamera] | None = field(kw_only=True)
    steps_per_metre: float = 1.0
    color: bool = True

    def load(self, index: int, row: Record3DFrame, T_world_camera: Pose) -> Frame:
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
    files = open_files(path)
    numbers = sorted(number for name in files.names if (number := _number_of(name)) is not None)
    if not numbers:
        raise DatasetError(f"{path}: contains no {IMAGES}/N.depth")
    metadata = read_metadata(files.where(METADATA), files.read(METADATA, _MOST_METADATA))
    if not (metadata.has_poses or options.track):
        raise DatasetError(
            f"{metadata.where}: contains no poses, as recordings of the front camera do not; --track-poses "
            "finds them from the images"
        )
    count = len(metadata.poses)
    posed = [number for number in numbers if number < count] if metadata.has_poses else numbers
    if not posed:
        raise DatasetError(f"{metadata.where}: has {count} poses, for none of its {len(numbers)} frames")
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


def _row(metadata: Metadata, number: int, stamp: float) -> Record3DFrame:
    pose = partial(_pose, metadata.poses[number]) if metadata.has_poses else start_pose()
    return Record3DFrame(f"{number:06d}", stamp, pose, f"{metadata.where}: pose {number}", number)


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
    """What a packed file may have, if it unpacks to ``size`` bytes."""
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
