"""Decoding a sensor_msgs/PointCloud2: its fields are found by their names, whatever the driver."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import DatasetError

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
RINGS = ("ring", "channel", "laser_id", "line", "row")
TIMES = ("t", "time", "timestamp", "offset_time", "time_stamp", "point_time_offset")

_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_MOST_POINTS = 1 << 26
_LONGEST_SCAN_S = 2.0


@dataclass(frozen=True)
class Cloud:
    """The points of a message, (H, W, 3) metres in its frame, as it has them, NaN included; of each, (H, W):
    the ``ring``, and ``seconds`` from the header's stamp, if the message has them."""

    points_m: NDArray[np.float64]
    ring: NDArray[np.int64] | None
    seconds: NDArray[np.float64] | None


def decode(message: Any, stamp: float) -> Cloud:
    """Decode a message whose header has this stamp. Raises DatasetError, which does not name the topic, if it
    has no points or its data do not fit its fields."""
    points = _records(message)
    names = points.dtype.names or ()
    missing = [axis for axis in "xyz" if axis not in names]
    if missing:
        raise DatasetError(f"has no field {', '.join(missing)}, only {', '.join(names) or 'none'}")
    with np.errstate(invalid="ignore", over="ignore"):
        points_m = np.stack([points[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    ring = next((points[name] for name in RINGS if name in names and points[name].dtype.kind in "iu"), None)
    time = next((points[name] for name in TIMES if name in names), None)
    return Cloud(
        points_m,
        None if ring is None else ring.astype(np.int64),
        None if time is None else _seconds(time, stamp),
    )


def _records(message: Any) -> NDArray:
    """The points as a structured array (H, W)."""
    height, width = int(message.height), int(message.width)
    step, row_step = int(message.point_step), int(message.row_step)
    if not 0 < height * width <= _MOST_POINTS or step <= 0:
        raise DatasetError(f"{width} x {height} points of {step} bytes; 1 to {_MOST_POINTS:,} are read")
    formats: dict[str, tuple[str, int]] = {}
    order = ">" if message.is_bigendian else "<"
    for field in message.fields:
        kind = _KINDS.get(int(field.datatype))
        if kind is None or not 0 <= int(field.offset) <= step - int(kind[1]):
            raise DatasetError(f"field {field.name[:40]!r} of type {field.datatype} lies outside a point")
        formats.setdefault(str(field.name), (order + kind, int(field.offset)))
    dtype = np.dtype(
        {
            "names": list(formats),
            "formats": [kind for kind, _ in formats.values()],
            "offsets": [offset for _, offset in formats.values()],
            "itemsize": step,
        }
    )
    data = np.asarray(message.data, np.uint8)
    if height == 1:  # some drivers leave row_step at 0
        row_step = max(row_step, width * step)
    if row_step < width * step or len(data) < height * row_step:
        raise DatasetError(f"{len(data)} bytes are too few for {width} x {height} points of {step} bytes")
    rows = data[: height * row_step].reshape(height, row_step)[:, : width * step]
    return np.ascontiguousarray(rows).view(dtype)


def _seconds(time: NDArray, stamp: float) -> NDArray[np.float64] | None:
    """Times of points as seconds from the header's stamp: drivers write seconds as floating-point numbers,
    and nanoseconds as integers or since 1970. None if they do not lie around the stamp."""
    seconds = time.astype(np.float64)
    finite = seconds[np.isfinite(seconds)]
    if finite.size == 0:
        return None
    largest = float(np.abs(finite).max())
    if time.dtype.kind in "iu" or largest > 1e12:
        seconds = seconds * 1e-9
        largest *= 1e-9
    if largest > 1e6:  # since 1970
        seconds = seconds - stamp
    inside = np.abs(seconds[np.isfinite(seconds)]) <= _LONGEST_SCAN_S
    return seconds if inside.all() else None
