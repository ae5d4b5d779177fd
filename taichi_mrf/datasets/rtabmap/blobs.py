"""The blobs of a node in a database of RTAB-Map: its camera, and its depth image.

Of a camera, from version 0.18 on: 11 int32 (three of the version, 0 for a single camera or 1 for a stereo
pair, width, height, and how many numbers of K, D, R, P and the local transform follow), then those as
float64, the local transform as float32. Before: float32 fx, fy, cx, cy, perhaps width and height, and the
local transform. That is the pose of the camera's optical frame on the robot. A node of several cameras has
one after the other.

Depth images are PNGs of 16-bit millimetres, PNGs whose four 8-bit channels are the bytes of float32 metres,
RVL (rvl.py) behind a name of 8 bytes, or inverse depth in 16 bits, as a PNG or as RVL.
"""

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.image_header import PNG_SIGNATURE, claimed_size
from taichi_mrf.datasets.images import decode_16_bit, decode_unchanged, measured
from taichi_mrf.datasets.options import DISTORTION_COUNTS
from taichi_mrf.datasets.rvl import decode_rvl
from taichi_mrf.errors import ConfigError, DatasetError, KeyframeError, naming
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.sensor.camera import PinholeCamera

WITH_HEADER = (0, 18)
"""The version from which calibrations have a header."""

_HEADER = 11
_TRANSFORM = 12
_MOST = 1 << 20
"""Numbers of a matrix, at most."""


@dataclass(frozen=True)
class NodeCamera:
    """A node's camera: intrinsics (fx, fy, cx, cy) for images of ``size`` (width, height; 0, 0 if it is not
    stored), OpenCV's ``distortion``, and its pose on the robot."""

    intrinsics: tuple[float, float, float, float]
    size: tuple[int, int]
    distortion: tuple[float, ...]
    T_body_camera: Pose

    def of_images(self, width: int, height: int) -> PinholeCamera:
        """The camera of depth images of this size, which RTAB-Map makes by leaving out rows and columns of
        those that were calibrated. Raises ConfigError."""
        share = width / self.size[0] if self.size[0] else 1.0
        fx, fy, cx, cy = (value * share for value in self.intrinsics)
        return PinholeCamera(width, height, fx, fy, cx, cy)


def node_camera(blob: bytes, version: tuple[int, ...], where: str) -> NodeCamera:
    """A node's camera. Raises DatasetError, whose text begins with ``where``, for a damaged blob, a stereo
    pair and several cameras."""
    with naming(where, DatasetError, KeyframeError, ConfigError):
        return _with_header(blob) if version >= WITH_HEADER else _plain(blob)


def _with_header(blob: bytes) -> NodeCamera:
    header = np.frombuffer(blob[: 4 * _HEADER], "<i4").tolist() if len(blob) >= 4 * _HEADER else []
    if not header or not all(0 <= count <= _MOST for count in header[6:]):
        raise DatasetError("the calibration is damaged")
    _refuse(header[3] == 1, several=False)
    place, parts = 4 * _HEADER, []
    for count, kind in zip(header[6:], ("<f8",) * 4 + ("<f4",), strict=True):
        end = place + count * np.dtype(kind).itemsize
        if end > len(blob):
            raise DatasetError("the calibration is cut short")
        parts.append(np.frombuffer(blob[place:end], kind).astype(np.float64))
        place = end
    _refuse(stereo=False, several=place < len(blob))
    K, D, _, P, local = parts
    if len(P) == 12:  # images that are rectified already
        return _camera(P[[0, 5, 2, 6]], header[4], header[5], np.zeros(0), local)
    if len(K) != 9:
        raise DatasetError("the calibration has no matrix K")
    return _camera(K[[0, 4, 2, 5]], header[4], header[5], D, local)


def _plain(blob: bytes) -> NodeCamera:
    if len(blob) % 4:
        raise DatasetError("the calibration is damaged")
    numbers = np.frombuffer(blob, "<f4").astype(np.float64)
    count = len(numbers) - _TRANSFORM
    _refuse(stereo=count in (5, 7), several=count > 7)
    if count not in (4, 6):
        raise DatasetError("the calibration is damaged")
    size = numbers[4:6] if count == 6 else np.zeros(2)
    if not (np.isfinite(size).all() and (size >= 0).all() and (size < _MOST).all()):
        raise DatasetError("the calibration is damaged")
    return _camera(numbers[:4], int(size[0]), int(size[1]), np.zeros(0), numbers[count:])


def _refuse(stereo: bool, several: bool) -> None:
    if stereo:
        raise DatasetError("holds a stereo pair; only depth images are read")
    if several:
        raise DatasetError("holds images of several cameras side by side; only one camera is read")


def _camera(
    intrinsics: NDArray[np.float64],
    width: int,
    height: int,
    distortion: NDArray[np.float64],
    local: NDArray[np.float64],
) -> NodeCamera:
    if len(local) not in (0, _TRANSFORM):
        raise DatasetError("the calibration's local transform is damaged")
    T_body_camera = as_pose(local.reshape(3, 4)) if len(local) else np.eye(4)
    fx, fy, cx, cy = map(float, intrinsics)
    PinholeCamera(max(width, 1), max(height, 1), fx, fy, cx, cy)
    if len(distortion) and (len(distortion) not in DISTORTION_COUNTS or not np.isfinite(distortion).all()):
        raise DatasetError(
            f"the lens has {len(distortion)} coefficients, which is no model of OpenCV's pinhole"
        )
    lens = tuple(map(float, distortion)) if distortion.any() else ()
    return NodeCamera((fx, fy, cx, cy), (max(width, 0), max(height, 0)), lens, T_body_camera)


RVL, INVERSE = b"DEPTHRVL", b"DEPTHINV"
_RVL_HEADER = 16
_PNG_KIND = 25
"""The place of a PNG's type of colour: 6 is red, green, blue and opacity."""

_MOST_NIBBLES = 11
"""Of a whole number of 32 bits."""


def depth_size(data: bytes) -> tuple[int, int] | None:
    """(width, height) of a packed depth image, None for an unknown format or a damaged header."""
    if data.startswith(INVERSE):
        data = data[_RVL_HEADER:]
    if data.startswith(RVL) and len(data) >= _RVL_HEADER:
        width, height = struct.unpack_from("<2I", data, len(RVL))
        return width, height
    return claimed_size(data)


def decode_depth(data: bytes, where: str, steps_per_metre: float) -> NDArray[np.float32]:
    """Axial depth in metres, (H, W) float32, 0 for no measurement. ``steps_per_metre`` is for images of whole
    numbers. Raises DatasetError, whose text begins with ``where``, for a damaged image."""
    if data.startswith(INVERSE) and len(data) >= _RVL_HEADER:
        a, b = struct.unpack_from("<2f", data, len(INVERSE))
        steps = _whole(data[_RVL_HEADER:], where).astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            metres = np.where(steps > 0, np.float32(a) / (steps - np.float32(b)), np.float32(0))
    elif data.startswith(PNG_SIGNATURE) and data[_PNG_KIND : _PNG_KIND + 1] == b"\6":
        metres = np.ascontiguousarray(decode_unchanged(data, where)).view("<f4")[..., 0]
    else:
        metres = _whole(data, where).astype(np.float32) / np.float32(steps_per_metre)
    return np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(0)).astype(np.float32)


def _whole(data: bytes, where: str) -> NDArray[np.uint16]:
    """The whole numbers of an image, (H, W)."""
    if not data.startswith(RVL):
        return decode_16_bit(data, where)
    with naming(where):
        return measured(decode_rvl(data[len(RVL) :]))
