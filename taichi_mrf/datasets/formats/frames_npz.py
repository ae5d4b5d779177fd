"""Frames in NumPy's npz: one file, or a folder of files that are taken in the order of their names.

``depth_m`` (N, H, W) float is axial depth in metres, 0 or NaN where there is none, or uint16 with
``depth_scale``, its steps per metre; ``T_world_camera`` is (N, 4, 4) or (N, 3, 4); ``K`` (3, 3), or ``fx``,
``fy``, ``cx``, ``cy``, and with a first axis of N each frame's own, where zeros stand for those of the frame
before. ``stamp`` (N,) in seconds and ``color`` (N, H, W, 3) uint8 RGB may be left out, and so may poses with
``ReadOptions.track``. Without the N, a file is one frame.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Row, Table, start_pose
from taichi_mrf.datasets.depth_scale import check_metres
from taichi_mrf.datasets.images import measured, note_of_largest, share_of_largest, without_filling
from taichi_mrf.datasets.intrinsics import of_this_size, own_cameras
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.errors import ConfigError, DatasetError
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.system.files import is_folder
from taichi_mrf.system.npz_file import NpzFile, open_npz

DEPTH, POSE, MATRIX, STAMP, COLOR, SCALE = "depth_m", "T_world_camera", "K", "stamp", "color", "depth_scale"
WANTED = "a readable npz file"


@dataclass(frozen=True)
class Part:
    """One file's frames: their poses (N, 4, 4), stamps (N,), cameras, and the depth's steps per metre."""

    path: Path
    poses: NDArray[np.float64]
    stamps: NDArray[np.float64]
    cameras: Sequence[PinholeCamera]
    steps_per_metre: float


@dataclass(frozen=True)
class NpzFrame(Row):
    """The ``number``-th frame, from 0, of a file."""

    part: Part
    number: int


@dataclass
class FramesNpz(Table[NpzFrame]):
    """The frames of one or more files, with cameras of their ``own`` unless the caller's holds for all. The
    images of the file that was read last are kept in memory. The caller may have given the depth's scale."""

    color: bool = True
    own: bool = False
    scale_given: bool = False
    _loaded: tuple[Path, NDArray, NDArray | None] | None = field(default=None, repr=False)

    def check_scale(self, pose: Callable[[int], Pose] | None) -> list[str]:
        """A note of whole numbers that are no measurements; the unit is known."""
        try:
            depth, _ = self._images(self.rows[0].part)
        except DatasetError:  # reported when a frame is read
            return []
        first = self.rows[0].part
        if depth.dtype.kind == "f" and first.steps_per_metre == 1 and not self.scale_given:
            check_metres(list(depth[:: max(1, len(depth) // 4)]), f"{first.path}: {DEPTH}")
        return note_of_largest([share_of_largest(image) for image in depth[:: max(1, len(depth) // 4)]])

    def load(self, index: int, row: NpzFrame, T_world_camera: Pose) -> Frame:
        (depth, color), part, i = self._images(row.part), row.part, row.number
        values = measured(depth[i]) if depth.dtype.kind == "u" else depth[i]
        depth_m = values.astype(np.float32) / np.float32(part.steps_per_metre)
        depth_m = without_filling(depth_m)
        image = None if color is None else color[i]
        camera = part.cameras[i] if self.own else self.camera
        return Frame(depth_m, T_world_camera, camera, row.stamp, row.name, image)

    def _images(self, part: Part) -> tuple[NDArray, NDArray | None]:
        if self._loaded is None or self._loaded[0] != part.path:
            with open_npz(part.path, DatasetError, WANTED) as file:
                count = len(part.poses)
                depth = _numbers(file, part.path, DEPTH)
                camera = part.cameras[0] if self.own else self.camera
                if depth.shape[-2:] != camera.shape:
                    raise DatasetError(
                        f"{part.path}: {DEPTH} is {depth.shape}, the camera has "
                        f"{camera.width} x {camera.height} pixels"
                    )
                depth = depth.reshape(count, *camera.shape)
                color = None
                if self.color and COLOR in file:
                    color = file[COLOR].reshape(count, *camera.shape, 3)
            self._loaded = part.path, depth, color
        return self._loaded[1], self._loaded[2]


def open_npz_frames(path: Path, options: ReadOptions) -> FramesNpz:
    """Open one file, or all files of a folder as one sequence. Raises DatasetError, which names the file and
    the field."""
    paths = sorted(path.glob("*.npz")) if is_folder(path) else [path]
    name = path.name if is_folder(path) else path.stem
    parts: list[Part] = []
    for each in paths:
        parts.append(_read_part(each, options, first=sum(len(part.poses) for part in parts)))
    own = options.camera is None and options.intrinsics is None
    every = [row for part in parts for row in _rows(part)]
    rows = [row for row in every if np.isfinite(row.part.poses[row.number]).all()] or every
    lost, given = len(every) - len(rows), options.depth_scale is not None
    notes = [f"{lost} of {len(every)} images dropped: tracking was lost ({POSE})"] if lost else []
    return FramesNpz(
        name, parts[0].cameras[0], notes, lost, rows=rows, color=options.color, own=own, scale_given=given
    )


def _rows(part: Part) -> Iterator[NpzFrame]:
    """The frames of a file, named as the file is, with their numbers if it holds several."""
    for i, pose in enumerate(part.poses):
        name = f"{part.path.stem}-{i:06d}" if len(part.poses) > 1 else part.path.stem
        where = f"{part.path}: {POSE}"
        yield NpzFrame(name, float(part.stamps[i]), partial(as_pose, pose), where, part, i)


def _read_part(path: Path, options: ReadOptions, first: int) -> Part:
    """One file, whose first frame is number ``first`` of the sequence. Without stamps, frames are a second
    apart."""
    with open_npz(path, DatasetError, WANTED) as file:
        shape, dtype = file.header(DEPTH)
        if len(shape) not in (2, 3) or dtype.kind not in "fu":
            raise DatasetError(f"{path}: {DEPTH} is {dtype} {shape}; expected (N, H, W) of floats or uint16")
        height, width = shape[-2:]
        count = shape[0] if len(shape) == 3 else 1
        unposed = options.track and POSE not in file
        poses = np.tile(start_pose(), (count, 1, 1)) if unposed else _numbers(file, path, POSE)
        if poses.size != count * math.prod(poses.shape[-2:]) or poses.shape[-2:] not in ((4, 4), (3, 4)):
            raise DatasetError(f"{path}: {POSE} is {poses.shape}; expected ({count}, 4, 4)")
        stamps = _numbers(file, path, STAMP).reshape(-1) if STAMP in file else first + np.arange(count)
        if stamps.shape != (count,):
            raise DatasetError(f"{path}: {STAMP} is {stamps.shape}; expected ({count},)")
        if not np.isfinite(stamps).all():
            first = int(np.flatnonzero(~np.isfinite(stamps))[0])
            raise DatasetError(
                f"{path}: {STAMP} of frame {first} is {stamps[first]:g}; stamps must be finite"
            )
        if COLOR in file:
            found, kind = file.header(COLOR)
            if found != (*shape, 3) or kind != np.uint8:
                raise DatasetError(f"{path}: {COLOR} is {kind} {found}; expected uint8 {(*shape, 3)}")
        return Part(
            path,
            poses.reshape(count, *poses.shape[-2:]).astype(np.float64),
            stamps.astype(np.float64),
            _cameras(path, file, count, (width, height), options),
            _steps_per_metre(path, file, dtype, options),
        )


def _cameras(
    path: Path, file: NpzFile, count: int, size: tuple[int, int], options: ReadOptions
) -> Sequence[PinholeCamera]:
    """The camera of each frame, for images of ``size`` (width, height)."""
    if options.camera is not None:
        return [options.camera] * count
    if options.intrinsics is not None:
        return [PinholeCamera(*size, *options.intrinsics)] * count
    if MATRIX in file:
        matrices = _numbers(file, path, MATRIX)
        if matrices.shape not in ((3, 3), (count, 3, 3)):
            raise DatasetError(f"{path}: {MATRIX} is {matrices.shape}; expected (3, 3), or ({count}, 3, 3)")
    else:
        names = ("fx", "fy", "cx", "cy")
        missing = [name for name in names if name not in file]
        if missing:
            raise DatasetError(
                f"{path}: needs {MATRIX} (3, 3), or fx, fy, cx, cy; {', '.join(missing)} missing"
            )
        numbers = [_numbers(file, path, name).reshape(-1) for name in names]
        for name, values in zip(names, numbers, strict=True):
            if len(values) not in (1, count):
                raise DatasetError(f"{path}: {name} has {len(values)} numbers; expected one, or {count}")
        fx, fy, cx, cy = np.broadcast_arrays(*numbers)
        matrices = np.zeros((len(fx), 3, 3))
        matrices[:, [0, 1, 0, 1, 2], [0, 1, 2, 2, 2]] = np.stack([fx, fy, cx, cy, np.ones(len(fx))], axis=1)
    matrices = matrices.reshape(-1, 3, 3)
    known: list[PinholeCamera | None] = []
    for index, K in enumerate(matrices):
        try:
            known.append(of_this_size(PinholeCamera.from_matrix(*size, K)) if K[:2].any() else None)
        except ConfigError as error:
            of = f" of frame {index}" if len(matrices) > 1 else ""
            raise DatasetError(f"{path}: {MATRIX}{of}: {error}") from error
    found = [camera for camera in own_cameras(known, options) if camera is not None]
    if not found:
        raise DatasetError(f"{path}: its intrinsics are all zero; --camera fx,fy,cx,cy sets them")
    return found * max(1, count // len(found))


def _steps_per_metre(path: Path, file: NpzFile, dtype: np.dtype, options: ReadOptions) -> float:
    if options.depth_scale is not None:
        return options.depth_scale
    if SCALE in file:
        found = _numbers(file, path, SCALE)
        if found.size != 1:
            raise DatasetError(f"{path}: {SCALE} is {found.shape}; expected one number")
        scale = float(found.reshape(-1)[0])
        if not 0 < scale < float("inf"):
            raise DatasetError(f"{path}: {SCALE} must be a positive number of steps per metre, not {scale:g}")
        return scale
    if dtype.kind == "u":
        raise DatasetError(f"{path}: {DEPTH} is {dtype} and needs {SCALE}, its steps per metre")
    return 1.0


def _numbers(file: NpzFile, path: Path, name: str) -> NDArray:
    """An array of integers or floating-point numbers."""
    found = file[name]
    if found.dtype.kind not in "fiu":
        raise DatasetError(f"{path}: {name} is {found.dtype}, not numbers")
    return found
