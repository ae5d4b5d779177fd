"""Finding a recording's camera: the caller's, else a file's in the folder, else the format's default; and
Open3D's JSON files.

Open3D writes matrices column by column. A PinholeCameraTrajectory has for each image its intrinsics and its
``extrinsic``, T_camera_world; a PoseGraph has for each node its ``pose``, T_world_camera.
"""

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from taichi_mrf.config.files import parse_yaml
from taichi_mrf.config.values import from_dict
from taichi_mrf.datasets.images import as_numbers, at_size, first_size
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.datasets.trajectories import RecordedPose, Trajectory
from taichi_mrf.errors import ConfigError, DatasetError, KeyframeError, naming, said
from taichi_mrf.geometry.poses import as_pose, inverse
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.files import read_text

_NAMED = re.compile(r"\b(fx|fy|cx|cy|width|height|skew|s)\b\s*[:=]\s*([-+.\w]+)", re.IGNORECASE)

_OTHER_SIZE, _SAME_PROPORTIONS = 0.75, 1.05
"""A principal point is off the middle of images of its own size by less, as a share of the size."""

CAMERA_FILES = (
    "camera.txt",
    "camera.yaml",
    "camera-intrinsics.txt",
    "camera_intrinsics.txt",
    "intrinsics.txt",
    "intrinsic.txt",
    "K.txt",
    "cam_K.txt",
    "camera_intrinsic.json",
    "intrinsic.json",
    "intrinsics.json",
)
"""camera.yaml: width, height, fx, fy, cx, cy by name; .json: Open3D's; the others: any layout of
:func:`read_camera`."""

SCENE_FILE = "camera-intrinsics.txt"
"""3DMatch keeps this one in the folder above the sequences."""


def find_camera(
    folder: Path, options: ReadOptions, default: PinholeCamera, default_name: str, depth_files: Iterable[Path]
) -> tuple[PinholeCamera, list[str]]:
    """The camera of the recording in ``folder``, and a note where it was assumed and not read.
    ``depth_files`` tell the image size where the intrinsics' file does not. Raises DatasetError, which names
    the file, for an intrinsics file that is not valid."""
    if options.camera is not None:
        return options.camera, []
    if options.intrinsics is not None:
        return PinholeCamera(*_image_size(default, depth_files), *options.intrinsics), []
    for path in (*(folder / name for name in CAMERA_FILES), folder.parent / SCENE_FILE):
        if path.is_file():
            return read_camera(path, default, depth_files), []
    k = default
    size = _image_size(default, depth_files)
    if size != (k.width, k.height):
        raise DatasetError(
            f"{folder}: the images have {size[0]} x {size[1]} pixels, the camera of {default_name} has "
            f"{k.width} x {k.height}, and there is no camera file: pass --camera fx,fy,cx,cy, or put K.txt "
            "(the 3 x 3 matrix) or camera.txt (width height fx fy cx cy) into the folder" + at_size(k, *size)
        )
    note = (
        f"no camera file such as K.txt in {folder}: assumed the camera of {default_name}, "
        f"{k.width} x {k.height}, fx {k.fx:g}, fy {k.fy:g}, cx {k.cx:g}, cy {k.cy:g}; --camera fx,fy,cx,cy "
        "sets another"
    )
    return default, [note]


def own_cameras(
    found: Sequence[PinholeCamera | None], options: ReadOptions
) -> Sequence[PinholeCamera | None]:
    """The cameras of frames that have their own: where one is not known, that of the frame before, or of the
    first that has one. None for all if the caller gives one, or none is known."""
    known = next((camera for camera in found if camera is not None), None)
    cameras: list[PinholeCamera | None] = []
    for camera in found:
        known = camera or known
        cameras.append(known if options.camera is None and options.intrinsics is None else None)
    return cameras


def read_camera(path: Path, default: PinholeCamera, depth_files: Iterable[Path]) -> PinholeCamera:
    """The camera in a file: ``width height fx fy cx cy``, ``fx fy cx cy``, a 3 x 3, 3 x 4 or 4 x 4 matrix,
    lines of ``fx: 525.0``, or YAML or JSON by the file's suffix. ``default`` gives the image size where
    neither the file nor ``depth_files`` do. Raises DatasetError, which names the file."""
    if path.suffix == ".json":
        return read_intrinsics(path)
    try:
        text = read_text(path, DatasetError)
        if path.suffix == ".yaml":
            return _camera_from_yaml(text, path)
        named = _NAMED.findall(text)
        if named:
            return _camera_from_names(
                {name.lower(): float(value) for name, value in named}, default, depth_files
            )
        numbers = [float(word) for line in text.splitlines() for word in _words(line)]
        if len(numbers) == 6:
            return _camera_from_numbers(numbers)
        if len(numbers) == 4:
            return of_this_size(PinholeCamera(*_image_size(default, depth_files), *numbers))
        if len(numbers) in (9, 12, 16):
            K = np.reshape(numbers, (3 if len(numbers) < 16 else 4, -1))[:3, :3]
            try:
                camera = PinholeCamera.from_matrix(*_image_size(default, depth_files), K)
            except ConfigError as error:
                first = next(n for n, line in enumerate(text.splitlines(), start=1) if _words(line))
                raise ConfigError(f"line {first}: {error}") from error
            return of_this_size(camera)
    except ConfigError as error:
        raise DatasetError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
    except ValueError as error:
        raise DatasetError(f"{path}: contains something that is not a number: {said(error)}") from error
    raise DatasetError(
        f"{path}: contains {len(numbers)} numbers; expected width height fx fy cx cy, fx fy cx cy, or a "
        "3 x 3 or 4 x 4 matrix"
    )


def of_this_size(camera: PinholeCamera) -> PinholeCamera:
    """Camera whose intrinsics came without the size of their images. Raises ConfigError if that is
    another: the principal point is off the middle along both sides, in the same way."""
    c, size = camera, (2 * camera.cx + 1, 2 * camera.cy + 1)
    if min(size) < 1:
        return camera
    lower, upper = sorted((c.width / size[0], c.height / size[1]))
    if upper > _OTHER_SIZE and lower < 1 / _OTHER_SIZE:
        return camera
    remedy = "pass the intrinsics of these images: --camera fx,fy,cx,cy"
    if upper < _SAME_PROPORTIONS * lower:
        scale = c.width / size[0]
        scaled = replace(c, fx=c.fx * scale, fy=c.fy * scale, cx=(c.width - 1) / 2, cy=(c.height - 1) / 2)
        remedy = (
            f"scaled to these they are {as_numbers(scaled)}; --camera fx,fy,cx,cy sets those of depth images"
        )
    raise ConfigError(
        f"the intrinsics are those of images of about {size[0]:.0f} x {size[1]:.0f} pixels, by the principal "
        f"point {c.cx:g} {c.cy:g}, but images have {c.width} x {c.height}: {remedy}"
    )


def _words(line: str) -> list[str]:
    """The numbers of a line as text, without comment, brackets and separators."""
    return re.sub(r"[\[\],;]", " ", line.split("#")[0]).split()


def _camera_from_names(
    values: dict[str, float], default: PinholeCamera, depth_files: Iterable[Path]
) -> PinholeCamera:
    missing = [name for name in ("fx", "fy", "cx", "cy") if name not in values]
    if missing:
        raise ConfigError(f"{', '.join(missing)} missing")
    if values.get("skew", values.get("s", 0.0)) != 0.0:
        raise ConfigError("the camera has skew; only cameras without skew can be used")
    intrinsics = (values["fx"], values["fy"], values["cx"], values["cy"])
    if "width" in values and "height" in values:
        return _camera_from_numbers([values["width"], values["height"], *intrinsics])
    return of_this_size(PinholeCamera(*_image_size(default, depth_files), *intrinsics))


def _camera_from_numbers(numbers: list[float]) -> PinholeCamera:
    width, height, fx, fy, cx, cy = numbers
    if not (width.is_integer() and height.is_integer()):
        raise ConfigError(f"the image size {width} x {height} is not a whole number of pixels")
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


def _image_size(default: PinholeCamera, depth_files: Iterable[Path]) -> tuple[int, int]:
    """(width, height) of the first image that can be read, else the default camera's."""
    return first_size(depth_files) or (default.width, default.height)


_LISTS = {"PinholeCameraTrajectory": "parameters", "PoseGraph": "nodes"}


def read_intrinsics(path: Path) -> PinholeCamera:
    """The camera of a PinholeCameraIntrinsic file. Raises DatasetError, which names the file."""
    return _json_camera(path, _json_values(path))


def is_trajectory_json(path: Path) -> bool:
    """True if a file is JSON of one of the two kinds of trajectory."""
    try:
        return _json_values(path).get("class_name") in _LISTS
    except (DatasetError, AttributeError):
        return False


def read_trajectory_json(path: Path) -> Trajectory:
    """The poses of a trajectory, counted from 0, with the cameras of their images where it holds some. Raises
    DatasetError, which names the file and the entry, if there is none, or a matrix has not 16 numbers."""
    values = _json_values(path)
    entries = values.get(_LISTS[values["class_name"]])
    if not isinstance(entries, list) or not entries:
        raise DatasetError(f"{path}: contains no pose")
    return Trajectory(
        path, "log", tuple(_json_pose(path, index, entry) for index, entry in enumerate(entries))
    )


def _json_pose(path: Path, index: int, entry: Any) -> RecordedPose:
    source = f"{path} entry {index}"
    try:
        name = "pose" if "pose" in entry else "extrinsic"
        matrix = np.array(entry[name], np.float64).reshape(4, 4).T
    except (KeyError, TypeError, ValueError, OverflowError):
        raise DatasetError(f"{source}: needs the 16 numbers of a pose or an extrinsic") from None
    if name == "extrinsic":
        try:
            matrix = inverse(as_pose(matrix))
        except KeyframeError:
            matrix = np.full((4, 4), np.nan)  # reported when its frame is read
    intrinsic = entry.get("intrinsic")
    # A focal length of zero stands for a camera that is not known.
    unknown = intrinsic is None or (isinstance(intrinsic, dict) and _focal(intrinsic) == 0)
    return RecordedPose(index, matrix, source, None if unknown else _json_camera(source, intrinsic))


def _focal(intrinsic: dict[str, Any]) -> Any:
    matrix = intrinsic.get("intrinsic_matrix")
    return matrix[0] if isinstance(matrix, list) and matrix else None


def _json_camera(path: Path | str, values: Any) -> PinholeCamera:
    try:
        width, height = int(values["width"]), int(values["height"])
        matrix = np.array([float(value) for value in values["intrinsic_matrix"]]).reshape(3, 3)
        by_rows = matrix[2].tolist() == [0, 0, 1]  # as they are written by hand
        with naming(path, ConfigError):
            return PinholeCamera.from_matrix(width, height, matrix if by_rows else matrix.T)
    except (KeyError, TypeError, ValueError, OverflowError):
        raise DatasetError(
            f"{path}: an intrinsic needs width, height and the 9 numbers of intrinsic_matrix"
        ) from None


def _json_values(path: Path) -> Any:
    return json_values(read_text(path, DatasetError), path)


def json_values(text: str | bytes, where: str | Path) -> Any:
    """The content of a JSON file. Raises DatasetError, which begins with ``where``."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{where}: not valid JSON: {said(error)}") from error
