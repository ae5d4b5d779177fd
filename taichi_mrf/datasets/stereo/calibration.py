"""The rig of a rectified stereo recording, from the projection matrices in KITTI's ``calib.txt``.

P0 and P1 are the 3 x 4 projections of the left and right camera, row by row: 12 numbers in lines that begin
with ``P0:`` and ``P1:``, else in the first two lines. P1 is K [I | (-b, 0, 0)] for the baseline b.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.stereo.matching import StereoRig
from taichi_mrf.errors import ConfigError, DatasetError
from taichi_mrf.sensor.camera import PinholeCamera

_SAME = 1e-6
"""Largest difference, relative to the focal length, of matrix entries that count as equal."""


def read_rig(path: Path, width: int, height: int) -> StereoRig:
    """The rig of images of ``width`` x ``height`` pixels.

    Raises DatasetError, whose text names the file, if it cannot be read, lacks P0 or P1, or if these are
    not two equal pinhole cameras, the first at the origin and the second to its right.
    """
    P_left, P_right = _read_projections(path)
    K = P_left[:, :3]
    fx = K[0, 0]
    if fx <= 0 or K[0, 1] or K[1, 0] or tuple(K[2]) != (0.0, 0.0, 1.0):
        raise DatasetError(f"{path}: P0 is no pinhole camera without skew: fx 0 cx 0 / 0 fy cy 0 / 0 0 1 0")
    if np.abs(K - P_right[:, :3]).max() > _SAME * fx:
        raise DatasetError(f"{path}: P0 and P1 differ in focal length or principal point: no rectified pair")
    if np.abs(P_left[:, 3]).max() > _SAME * fx or np.abs(P_right[1:, 3]).max() > _SAME * fx:
        raise DatasetError(f"{path}: P0 must be at the origin, and P1 moved along x alone")
    try:
        camera = PinholeCamera(width, height, float(fx), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
        return StereoRig(camera, baseline_m=-float(P_right[0, 3] / fx))
    except ConfigError as error:
        raise DatasetError(f"{path}: {error}") from error


def _read_projections(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """P0 and P1, (3, 4) each."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    lines = [words for line in text.splitlines() if (words := line.split())]
    labelled = {words[0]: words[1:] for words in lines if words[0].endswith(":")}
    rows = labelled or {f"P{i}:": words for i, words in enumerate(lines)}
    return _projection(path, "P0", rows), _projection(path, "P1", rows)


def _projection(path: Path, name: str, rows: dict[str, list[str]]) -> NDArray[np.float64]:
    words = rows.get(f"{name}:")
    if words is None:
        raise DatasetError(f"{path}: {name} is missing")
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        raise DatasetError(f"{path}: {name} holds something that is not a number") from None
    if len(numbers) != 12 or not np.isfinite(numbers).all():
        raise DatasetError(
            f"{path}: {name} must be 12 finite numbers (a 3 x 4 matrix), it has {len(numbers)}"
        )
    return numbers.reshape(3, 4)
