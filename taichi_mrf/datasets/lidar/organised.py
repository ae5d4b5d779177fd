"""Clouds whose points form an image of rows (beams) and columns: their rays, those without a return too.

A pixel that measured something has the direction of its point, exactly. The direction of one that did not
follows from the others: the elevation of its row, and the azimuth of its column plus what the row is ahead.
"""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.lidar.motion import Scan
from taichi_mrf.datasets.lidar.scans import measured_points
from taichi_mrf.sensor.ray_table import RayTable

_LEAST_MEASURED = 0.2
"""Share of pixels below which nothing is said of the others."""

_NEIGHBOURS = 1.5
"""How many columns nine tenths of the pixels may lie from where row and column say."""


def organised(points_m: NDArray[np.floating]) -> tuple[Scan, NDArray[np.intp]] | None:
    """The image of points (H, W, 3) in the sensor's frame, where pixels without a point got nothing back, and
    the number, row by row, of each pixel's point, (H, W). None if neighbours in the image are no neighbours
    in space.

    Rows that are ahead of others by whole columns, as some drivers write them, are shifted back.
    """
    height, width = points_m.shape[:2]
    measured = measured_points(points_m)
    if min(height, width) < 2 or measured.mean() < _LEAST_MEASURED:
        return None
    points = np.where(measured[..., None], points_m, 0.0).astype(np.float64)
    range_m = np.linalg.norm(points, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        directions = points / range_m[..., None]
    elevation = np.where(measured, np.arcsin(np.clip(directions[..., 2], -1, 1)), np.nan)
    azimuth = np.where(measured, np.arctan2(directions[..., 1], directions[..., 0]), np.nan)
    found = _azimuths(azimuth)
    if found is None:
        return None
    columns, ahead, step = found
    number = np.arange(height * width).reshape(height, width)
    shifts = np.rint(ahead / step).astype(int)
    if np.any(shifts != shifts[0]):
        if abs(abs(step) * width - 2 * np.pi) > 0.5 * abs(step) * np.abs(shifts).max() + 0.05:
            return None  # only a full turn can be shifted
        place = (np.arange(width)[None, :] - shifts[:, None]) % width
        picked = np.arange(height)[:, None], place
        measured, range_m, directions = measured[picked], range_m[picked], directions[picked]
        elevation, azimuth, number = elevation[picked], azimuth[picked], number[picked]
        found = _azimuths(azimuth)
        if found is None:
            return None
        columns, ahead, step = found
    rows = _filled(np.array([np.nanmedian(row) if np.isfinite(row).any() else np.nan for row in elevation]))
    guess = columns[None, :] + ahead[:, None]
    off = np.abs(_wrapped(azimuth - guess))[measured]
    if rows is None or np.quantile(off, 0.9) > _NEIGHBOURS * abs(step):
        return None
    level = np.cos(rows)[:, None]
    rays = np.stack(
        [level * np.cos(guess), level * np.sin(guess), np.broadcast_to(np.sin(rows)[:, None], guess.shape)],
        -1,
    )
    rays[measured] = directions[measured]
    return Scan(RayTable(rays), np.where(measured, range_m, 0.0).astype(np.float32), ~measured), number


def by_ring(points_m: NDArray[np.floating], ring: NDArray[np.integer]) -> NDArray[np.intp] | None:
    """The numbers of points (N, 3) as an image (H, W) with a row for each ring, the highest first; None if
    the rings have different numbers of points."""
    rings, counts = np.unique(ring, return_counts=True)
    if len(rings) < 2 or np.any(counts != counts[0]):
        return None
    numbers = np.argsort(ring, kind="stable").reshape(len(rings), counts[0])
    image = points_m[numbers]
    with np.errstate(invalid="ignore", divide="ignore"):
        height = np.nanmedian(image[..., 2] / np.linalg.norm(image, axis=-1), axis=1)
    return numbers[np.argsort(-height, kind="stable")]


def _azimuths(azimuth: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], float] | None:
    """From azimuths (H, W), NaN for none: the azimuth of each column (W,), by how much each row (H,) is ahead
    of it, and the step from column to column. None if columns do not follow each other."""
    width = azimuth.shape[1]
    steps = _wrapped(np.diff(azimuth, axis=1))
    steps = steps[np.isfinite(steps)]
    if steps.size == 0:
        return None
    step = float(np.median(steps))
    if step == 0.0:
        return None
    # Seen from the column, all azimuths of a row are nearly the same, and do not wrap.
    turned = np.arange(width) * step
    unrolled = azimuth - turned
    ahead = np.array([_circular_median(row) for row in unrolled])
    if not np.isfinite(ahead).any():
        return None
    ahead = np.where(np.isfinite(ahead), ahead, np.nanmedian(ahead))
    # One row's, not the middle between two, so that whole columns are whole.
    first = ahead[np.abs(_wrapped(ahead - _circular_median(ahead))).argmin()]
    rest = np.array([_circular_median(column) for column in (unrolled - ahead[:, None]).T])
    return first + turned + np.nan_to_num(rest), _wrapped(ahead - first), step


def _circular_median(angles: NDArray[np.float64]) -> float:
    """The median of angles around their mean direction, NaN if there is none."""
    angles = angles[np.isfinite(angles)]
    if angles.size == 0:
        return float("nan")
    mean = np.arctan2(np.sin(angles).mean(), np.cos(angles).mean())
    return float(mean + np.median(_wrapped(angles - mean)))


def _wrapped(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles taken to between -pi and pi."""
    return (angles + np.pi) % (2 * np.pi) - np.pi


def _filled(values: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Values (H,) with NaN replaced by what lies between their neighbours; None if all are NaN."""
    known = np.flatnonzero(np.isfinite(values))
    if known.size == 0:
        return None
    return np.interp(np.arange(len(values)), known, values[known])
