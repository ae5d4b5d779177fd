"""The cameras of keyframes in a map file: a row for each keyframe if all are pinholes, as earlier versions
have it, otherwise each camera once, and its number for each keyframe."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import MapFileError
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.distortion import DistortedCamera
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.sensor.spherical import SphericalCamera
from taichi_mrf.system.npz_file import NpzFile

NUMBERS = "keyframe_camera_numbers"
"""Files with cameras that are no pinholes have this member."""

_ROWS = "keyframe_cameras"
_ROW = 6


def camera_arrays(cameras: Sequence[Camera]) -> dict[str, NDArray]:
    """The cameras of keyframes as arrays by name. Raises MapFileError for one that cannot be saved."""
    if all(isinstance(camera, PinholeCamera) for camera in cameras):
        rows = [_row(camera) for camera in cameras if isinstance(camera, PinholeCamera)]
        return {_ROWS: np.array(rows, np.float64).reshape(-1, _ROW)}
    distinct = {camera: number for number, camera in enumerate(dict.fromkeys(cameras))}
    arrays: dict[str, NDArray] = {NUMBERS: np.array([distinct[camera] for camera in cameras], np.int64)}
    for camera, number in distinct.items():
        arrays |= {f"camera_{number}_{name}": values for name, values in _arrays(camera).items()}
    return arrays


def read_cameras(file: NpzFile, keyframes: int) -> list[Camera]:
    """The cameras that :func:`camera_arrays` has saved, one for each keyframe. Raises the file's error, and
    ConfigError for values that are no camera's."""
    if NUMBERS not in file:
        return [_pinhole(row) for row in file.array(_ROWS, "fi", (keyframes, _ROW))]
    numbers = file.array(NUMBERS, "i", (keyframes,)).tolist()
    distinct = {number: _read(file, f"camera_{number}_") for number in dict.fromkeys(numbers)}
    return [distinct[number] for number in numbers]


def _arrays(camera: Camera) -> dict[str, NDArray]:
    if isinstance(camera, PinholeCamera):
        return {"pinhole": np.array(_row(camera))}
    if isinstance(camera, SphericalCamera):
        return {
            "elevations_rad": camera.elevations_rad,
            "azimuths_rad": camera.azimuths_rad,
            "azimuth_offsets_rad": camera.azimuth_offsets_rad,
        }
    if isinstance(camera, DistortedCamera):
        return {"pinhole": np.array(_row(camera.pinhole)), "distortion": camera.coefficients}
    if isinstance(camera, RayTable):
        name = "directions" if camera.has_pattern else "free_directions"
        if camera.origins_m is None:
            return {name: camera.table}
        # Another name, so that versions without origins do not read the directions alone.
        return {f"moving_{name}": camera.table, "origins_m": camera.origins_m}
    raise MapFileError(f"a keyframe's camera of type {type(camera).__name__} cannot be saved")


def _read(file: NpzFile, prefix: str) -> Camera:
    if f"{prefix}pinhole" in file:
        pinhole = _pinhole(file.array(f"{prefix}pinhole", "f", (_ROW,)))
        if f"{prefix}distortion" in file:
            return DistortedCamera(pinhole, file.array(f"{prefix}distortion", "f", (None,)))
        return pinhole
    if f"{prefix}elevations_rad" in file:
        names = ("elevations_rad", "azimuths_rad", "azimuth_offsets_rad")
        return SphericalCamera(*(file.array(prefix + name, "f", (None,)) for name in names))
    if f"{prefix}directions" in file:
        return RayTable(file.array(f"{prefix}directions", "f", (None, None, 3)))
    if f"{prefix}origins_m" not in file:
        return RayTable(file.array(f"{prefix}free_directions", "f", (1, None, 3))[0])
    if f"{prefix}moving_free_directions" in file:
        free = (f"{prefix}moving_free_directions", f"{prefix}origins_m")
        return RayTable(*(file.array(name, "f", (1, None, 3))[0] for name in free))
    directions = file.array(f"{prefix}moving_directions", "f", (None, None, 3))
    origins_m = file.array(f"{prefix}origins_m", "f", (None, None, 3))
    return RayTable(directions, origins_m[0] if len(origins_m) == 1 else origins_m)


def _row(camera: PinholeCamera) -> list[float]:
    return [float(camera.width), camera.height, camera.fx, camera.fy, camera.cx, camera.cy]


def _pinhole(row: NDArray[np.float64]) -> PinholeCamera:
    width, height, *rest = row.tolist()
    return PinholeCamera(int(width), int(height), *rest)
