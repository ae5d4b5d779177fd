"""Nerfstudio's layout, in which Polycam, Record3D and others export depth: transforms.json and its images.

``frames`` has for each image ``transform_matrix``, T_world_camera with x right, y up and z backwards, and
``depth_file_path``, depth along the axis, an image of 16 bits or floats or an array (``.npy``), which may
have fewer pixels than the colour image ``file_path``. ``w``, ``h``, ``fl_x``, ``fl_y``, ``cx``, ``cy`` (or
``camera_angle_x``) and the lens (``k1``, ``k2``, ``p1``, ``p2``, ``k3``) are those of the colour image; a
frame's own replace those of the file. ``depth_unit_scale_factor`` are the metres of a step; where it is
missing, floats are metres and whole numbers millimetres. Poses stay where ``applied_transform`` has moved
them; if it or ``applied_scale`` has scaled them, that is undone.
"""

import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.derived import T_AXES_OPTICAL
from taichi_mrf.datasets.images import first_size
from taichi_mrf.datasets.intrinsics import json_values, own_cameras
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.datasets.recording import RecordedFrame, beside, first_file, natural, recording
from taichi_mrf.datasets.turned import of_image_size, turn_hint
from taichi_mrf.errors import ConfigError, DatasetError, KeyframeError, naming
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.files import read_text

NAME = "nerfstudio"
TRANSFORMS = "transforms.json"
STEPS_PER_METRE = 1000.0
"""Nerfstudio's own default."""

_MOST_BYTES = 1 << 27
_LENS = ("k1", "k2", "p1", "p2", "k3")
_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL")
_RIGID = 1e-3

Entry = Mapping[str, Any]


def recognises(folder: Path) -> bool:
    """True if transforms.json names depth images."""
    try:
        return '"depth_file_path"' in read_text(folder / TRANSFORMS, DatasetError, most_bytes=_MOST_BYTES)
    except DatasetError:
        return False


def open_folder(folder: Path, options: ReadOptions) -> Dataset:
    """List the frames that have a depth image, in the order of the images' names. Raises DatasetError, which
    names the frame and the entry."""
    path = folder / TRANSFORMS
    values = _read(path)
    frames = [(f"{path}: frames[{n}]", frame) for n, frame in enumerate(values["frames"])]
    with_depth = [(where, frame) for where, frame in frames if frame.get("depth_file_path")]
    files = [_file(folder, where, frame["depth_file_path"]) for where, frame in with_depth]
    order = sorted(range(len(files)), key=lambda place: natural(files[place]))
    color_cameras = [_camera(where, {**values, **frame}) for where, frame in with_depth]
    lenses = {
        tuple(_number(where, name, {**values, **frame}.get(name, 0.0)) for name in _LENS)
        for where, frame in with_depth
    }
    if len(lenses) > 1:
        raise DatasetError(f"{path}: its frames have different lenses ({', '.join(_LENS)}); one is read")
    size, turned = first_size(files[place] for place in order), options.conventions.turned
    cameras = own_cameras([_of_depth(path, camera, size, turned) for camera in color_cameras], options)
    scales = _applied_scales(path, values)
    rows = []
    for stamp, place in enumerate(order):
        where, frame = with_depth[place]
        color = _file(folder, where, frame.get("file_path") or "")
        rows.append(
            RecordedFrame(
                files[place].stem,
                float(stamp),  # nobody knows when: a second apart
                partial(_pose, where, frame, *scales),
                where,
                files[place],
                first_file([color]),
                camera=cameras[place],
            )
        )
    recorded = _of_depth(path, color_cameras[order[0]], size, turned)
    factor = values.get("depth_unit_scale_factor")
    steps = STEPS_PER_METRE if factor is None else 1 / _positive(path, "depth_unit_scale_factor", factor)
    (lens,) = lenses
    return recording(
        folder,
        options,
        options.camera or recorded,
        rows,
        steps,
        str(path) if factor is not None else NAME,
        [],
        len(frames),
        f"{TRANSFORMS} names no depth image for them",
        scale_stated=factor is not None,
        distortion=lens if any(lens) else (),
    )


def _read(path: Path) -> dict[str, Any]:
    values: dict[str, Any] = json_values(read_text(path, DatasetError, most_bytes=_MOST_BYTES), path)
    try:
        if not all(isinstance(frame, dict) for frame in values["frames"]):
            raise TypeError
    except (KeyError, TypeError):
        raise DatasetError(f"{path}: no list of frames") from None
    if not any(frame.get("depth_file_path") for frame in values["frames"]):
        raise DatasetError(f"{path}: none of its frames has a depth_file_path")
    return values


def _file(folder: Path, where: str, name: Any) -> Path:
    """A file that a frame names, on whatever computer. Raises DatasetError."""
    if not isinstance(name, str) or len(name) > 4096 or "\0" in name:
        raise DatasetError(f"{where}: a path must be text, not {str(name)[:40]}")
    return beside(folder, name)


def _camera(where: str, values: Entry) -> PinholeCamera:
    """The camera of a frame's colour image."""
    model = str(values.get("camera_model", "OPENCV"))
    if model not in _MODELS:
        raise DatasetError(f"{where}: camera_model {model[:40]} is not supported; {', '.join(_MODELS)} are")
    w, h = (_positive(where, name, values.get(name)) for name in ("w", "h"))
    if "fl_x" in values:
        fl_x = _positive(where, "fl_x", values["fl_x"])
    elif "camera_angle_x" in values:
        fl_x = w / 2 / math.tan(_positive(where, "camera_angle_x", values["camera_angle_x"]) / 2)
    else:
        raise DatasetError(f"{where}: has neither fl_x nor camera_angle_x; --camera fx,fy,cx,cy sets them")
    fl_y = _positive(where, "fl_y", values.get("fl_y", fl_x))
    cx, cy = (_number(where, name, values.get(name, half / 2)) for name, half in (("cx", w), ("cy", h)))
    with naming(where, ConfigError):
        return PinholeCamera(int(w), int(h), fl_x, fl_y, cx, cy)


def _of_depth(path: Path, camera: PinholeCamera, size: tuple[int, int] | None, turned: str) -> PinholeCamera:
    """The camera of depth images of this (width, height), which show what colour images show."""
    if size is None:
        return camera
    camera = of_image_size(camera, size, turned)
    scaled = camera.scaled(size[0] / camera.width)
    if (scaled.width, scaled.height) != size:
        raise DatasetError(
            f"{path}: depth of {size[0]} x {size[1]} pixels has other proportions than w and h, "
            f"{camera.width} x {camera.height}{turn_hint(camera, size)}"
        )
    return scaled


def _pose(where: str, frame: Entry, scale: float, scale_of_positions: float) -> Pose:
    """T_world_camera (4, 4) with optical axes."""
    T = _matrix(where, "transform_matrix", frame.get("transform_matrix"))
    T[:3] /= scale
    T[:3, 3] /= scale_of_positions
    T[:3, :3] = T[:3, :3] @ T_AXES_OPTICAL["opengl"]
    with naming(f"{where}: transform_matrix", KeyframeError):
        return as_pose(T)


def _applied_scales(path: Path, values: Entry) -> tuple[float, float]:
    """The factors by which what was applied to the poses has scaled the matrices, and positions alone."""
    scale = _positive(path, "applied_scale", values.get("applied_scale", 1.0))
    applied = values.get("applied_transform")
    if applied is None:
        return 1.0, scale
    linear = _matrix(path, "applied_transform", applied)[:3, :3]
    factor = float(np.cbrt(np.linalg.det(linear)))
    if factor <= 0 or not np.allclose(linear.T @ linear, factor**2 * np.eye(3), atol=_RIGID * factor**2):
        raise DatasetError(f"{path}: applied_transform is not a scaled rotation; the poses are deformed")
    return factor, scale


def _matrix(where: str | Path, name: str, found: Any) -> NDArray[np.float64]:
    """A 4 x 4 or 3 x 4 matrix, (4, 4)."""
    try:
        matrix = np.array(found, np.float64)
    except (ValueError, TypeError, OverflowError):
        matrix = np.empty(0)
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise DatasetError(f"{where}: {name} is not a 4 x 4 matrix of numbers")
    return np.vstack([matrix[:3], [0.0, 0.0, 0.0, 1.0]])


def _number(where: str | Path, name: str, found: Any) -> float:
    is_number = isinstance(found, int | float) and not isinstance(found, bool) and abs(found) < 1e9
    if not is_number:
        raise DatasetError(f"{where}: {name} is {str(found)[:40]}, not a number")
    return float(found)


def _positive(where: str | Path, name: str, found: Any) -> float:
    number = _number(where, name, found)
    if number <= 0:
        raise DatasetError(f"{where}: {name} must be positive, not {number:g}")
    return number
