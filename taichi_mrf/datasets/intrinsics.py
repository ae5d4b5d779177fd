"""Finding a recording's camera: the caller's word, else a file in the folder, else the format's default."""

from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path

import numpy as np

from taichi_mrf.config.files import parse_yaml
from taichi_mrf.config.values import from_dict
from taichi_mrf.datasets.formats.open3d_json import read_intrinsics
from taichi_mrf.datasets.images import image_size
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.errors import ConfigError, DatasetError, said
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.files import read_text

PRIMESENSE = PinholeCamera(width=640, height=480, fx=525.0, fy=525.0, cx=319.5, cy=239.5)
"""What drivers of PrimeSense cameras (Kinect 1, Xtion) assume, and ROS with them."""

CAMERA_FILES = (
    "camera.txt",
    "camera.yaml",
    "camera-intrinsics.txt",
    "intrinsics.txt",
    "camera_intrinsic.json",
)
"""camera.txt: width height fx fy cx cy; camera.yaml: the same by name; camera_intrinsic.json: Open3D's; the
others: the 3 x 3 or 4 x 4 matrix."""


def find_camera(
    folder: Path,
    options: ReadOptions,
    default: PinholeCamera,
    default_name: str,
    depth_files: Iterable[Path],
) -> tuple[PinholeCamera, list[str]]:
    """The camera of the recording in ``folder``, and a note where it was assumed and not read.

    ``depth_files`` tell the image size where the intrinsics' file does not. Raises DatasetError,
    whose text names the file, if there is an intrinsics' file that makes no sense.
    """
    if options.camera is not None:
        return options.camera, []
    if options.intrinsics is not None:
        return PinholeCamera(*_image_size(default, depth_files), *options.intrinsics), []
    for name in CAMERA_FILES:
        path = folder / name
        if path.is_file():
            return read_camera(path, default, depth_files), []
    k = default
    note = (
        f"no {' or '.join(CAMERA_FILES)} in {folder}: assumed the camera of {default_name}, "
        f"{k.width} x {k.height}, fx {k.fx:g}, fy {k.fy:g}, cx {k.cx:g}, cy {k.cy:g}"
    )
    return default, [note]


def read_camera(path: Path, default: PinholeCamera, depth_files: Iterable[Path]) -> PinholeCamera:
    """The camera in a file of one of the layouts above; ``default`` gives the image size where neither the
    file nor ``depth_files`` do. Raises DatasetError, whose text names the file."""
    if path.suffix == ".json":
        return read_intrinsics(path)
    try:
        text = read_text(path, DatasetError)
        if path.suffix == ".yaml":
            return _camera_from_yaml(text, path)
        numbers = [float(word) for line in text.splitlines() for word in line.split("#")[0].split()]
        if len(numbers) == 6:
            return _camera_from_numbers(numbers)
        if len(numbers) in (9, 16):
            side = 3 if len(numbers) == 9 else 4
            K = np.reshape(numbers, (side, side))[:3, :3]
            return _camera_from_matrix(K, default, depth_files)
    except ConfigError as error:
        raise DatasetError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
    except ValueError as error:
        raise DatasetError(f"{path}: holds something that is not a number: {said(error)}") from error
    raise DatasetError(
        f"{path}: holds {len(numbers)} numbers; expected width height fx fy cx cy, or a 3 x 3 or 4 x 4 matrix"
    )


def _camera_from_numbers(numbers: list[float]) -> PinholeCamera:
    width, height, fx, fy, cx, cy = numbers
    if not (width.is_integer() and height.is_integer()):
        raise ConfigError(f"the image size {width} x {height} is not in whole pixels")
    return PinholeCamera(round(width), round(height), fx, fy, cx, cy)


def _camera_from_yaml(text: str, path: Path) -> PinholeCamera:
    try:
        values = parse_yaml(text)
    except ValueError as error:  # ValueError: the 31st of February
        raise DatasetError(f"{path}: not valid YAML: {said(error)}") from error
    wanted = [field.name for field in fields(PinholeCamera)]
    if isinstance(values, dict):
        for name in wanted:
            if name not in values:
                raise DatasetError(f"{path}: {name} is missing")
    return from_dict(PinholeCamera, values, str(path))


def _camera_from_matrix(K: np.ndarray, default: PinholeCamera, depth_files: Iterable[Path]) -> PinholeCamera:
    if K[0, 1] or K[1, 0] or tuple(K[2]) != (0.0, 0.0, 1.0):
        raise ConfigError("not the matrix of a pinhole camera without skew: fx 0 cx / 0 fy cy / 0 0 1")
    width, height = _image_size(default, depth_files)
    return PinholeCamera(
        width, height, fx=float(K[0, 0]), fy=float(K[1, 1]), cx=float(K[0, 2]), cy=float(K[1, 2])
    )


def _image_size(default: PinholeCamera, depth_files: Iterable[Path]) -> tuple[int, int]:
    """(width, height) of the first image that can be read, else the default camera's."""
    for depth_file in depth_files:
        try:
            return image_size(depth_file)
        except DatasetError:  # a broken image is reported when its frame is read
            continue
    return default.width, default.height
