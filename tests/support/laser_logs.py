"""Small CARMEN logs and npz files of scans, written the way the formats are described."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

ODOMETRY = "ODOM 0.1 0.2 0.3 0 0 0 1.5 host 1.5"
TAIL = "12.5 host 12.5"


def flaser(ranges: Sequence[float], pose: Sequence[float], name: str = "FLASER") -> str:
    """A line of a scan with its pose, twice as in corrected logs, and its stamps."""
    numbers = " ".join(repr(float(r)) for r in ranges)
    place = " ".join(repr(float(v)) for v in pose)
    return f"{name} {len(ranges)} {numbers} {place} {place} {TAIL}"


def robotlaser(
    ranges: Sequence[float],
    pose: Sequence[float],
    start: float,
    step: float,
    max_range: float,
    remissions: Sequence[int] = (),
) -> str:
    """A line in the newer format, with the robot's pose other than the scanner's."""
    numbers = " ".join(repr(float(r)) for r in ranges)
    place = " ".join(repr(float(v)) for v in pose)
    shine = " ".join(map(str, [len(remissions), *remissions]))
    return (
        f"ROBOTLASER1 0 {start!r} {step * len(ranges)!r} {step!r} {max_range!r} 0.01 0 "
        f"{len(ranges)} {numbers} {shine} {place} 9 9 9 0 0 0.5 0.5 0 {TAIL}"
    )


def write_npz(path: Path, **changes: ArrayLike | None) -> Path:
    """A file of two scans of three beams, of which arrays may be changed or (None) left out."""
    arrays: dict[str, ArrayLike | None] = {
        "range_m": np.array([[1.0, 2.0, 3.0], [1.5, 2.5, 8.0]], dtype=np.float32),
        "angle_rad": np.array([-0.5, 0.0, 0.5]),
        "pose_x_y_theta": np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]),
        "hit": np.array([[1, 1, 1], [1, 1, 0]], dtype=np.uint8),
    }
    arrays |= changes
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path
