"""The metadata of a Record3D recording: JSON, checked before any of it is used.

``K`` are the 9 numbers of the colour camera's matrix, column by column; ``w`` and ``h`` the size that it is
for; ``dw`` and ``dh`` the size of depth, which old files lack; ``poses`` qx qy qz qw tx ty tz of each frame.
``fps``, ``frameTimestamps`` (seconds) and ``perFrameIntrinsicCoeffs`` (fx fy cx cy of each frame) may be
missing.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError, DatasetError, naming, said
from taichi_mrf.sensor.camera import PinholeCamera

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
        """When each of these frames was taken, in seconds, and notes. Raises DatasetError."""
        times, rate = self.values.get("frameTimestamps"), self.values.get("fps")
        if times:
            try:
                stamps = [float(times[number]) for number in numbers]
            except (ValueError, TypeError, IndexError, KeyError, OverflowError):
                stamps = []
            if len(stamps) < len(numbers) or not all(map(math.isfinite, stamps)):
                raise DatasetError(f"{self.where}: frameTimestamps is no list of a number for each frame")
            return stamps, []
        if isinstance(rate, int | float) and _LEAST_RATE <= rate <= _LARGEST_RATE:
            return [number / rate for number in numbers], []
        note = f"no stamps in {self.where}: assumed {FRAMES_PER_SECOND:g} frames a second"
        return [number / FRAMES_PER_SECOND for number in numbers], [note]


def read_metadata(where: str, data: bytes) -> Metadata:
    """The metadata in a file. Raises DatasetError, which begins with ``where`` and names the entry."""
    try:
        values = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{where}: not valid JSON: {said(error)}") from error
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
        raise DatasetError(f"{where}: K is no list of 9 numbers")
    with naming(f"{where}: K", ConfigError):
        return PinholeCamera.from_matrix(width, height, K.reshape(3, 3).T)


def _table(where: str, values: Mapping[str, Any], name: str, columns: int) -> NDArray[np.float64]:
    """A list of lists of as many numbers, (N, columns), without a row if it is missing."""
    found = values.get(name)
    table = _numbers(found) if found else np.empty((0, columns))
    if table.ndim != 2 or table.shape[1] != columns:
        raise DatasetError(f"{where}: {name} is no list of {columns} numbers for each frame")
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
        raise DatasetError(f"{where}: {name} is {str(found)[:40]}, which is no number of pixels")
    return found
