"""The geometry of an Ouster lidar, from its metadata (Ouster, "Sensor Data": coordinate frames).

A beam leaves from a point that turns with the sensor, 15 to 36 mm off its axis, so the direction of a point
from the centre depends a little on its range. Directions are those at NOMINAL_M, which moves points sideways
by less than that up to twice NOMINAL_M, and ranges are those from the centre.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.spherical import SphericalCamera

NOMINAL_M = 20.0


@dataclass(frozen=True)
class Beams:
    """``camera`` has a column for each azimuth, in the lidar's frame; row v of a measurement is shifted by
    ``shifts`` (H,) columns for that. ``T_sensor_lidar`` (4, 4)."""

    camera: SphericalCamera
    shifts: NDArray[np.int64]
    T_sensor_lidar: Pose
    _altitude: NDArray[np.float64]
    _azimuth: NDArray[np.float64]
    _origin_m: tuple[float, float]

    @staticmethod
    def of(info: Any) -> "Beams":
        """The geometry of a sensor's metadata (ouster.sdk's SensorInfo). Raises DatasetError for one that
        does not spin."""
        altitude, azimuth = np.radians(info.beam_altitude_angles), np.radians(info.beam_azimuth_angles)
        width = int(info.format.columns_per_frame)
        shifts = np.asarray(info.format.pixel_shift_by_row, np.int64)
        if not (altitude.ndim == 1 and len(altitude) == len(azimuth) == len(shifts)):
            raise DatasetError(f"has {altitude.size} beam angles for {len(shifts)} rows: it does not spin")
        T_lidar_beam = np.asarray(info.beam_to_lidar_transform, np.float64)
        origin_m = float(T_lidar_beam[0, 3]) / 1000, float(T_lidar_beam[2, 3]) / 1000
        T_sensor_lidar = np.array(info.lidar_to_sensor_transform, np.float64)
        T_sensor_lidar[:3, 3] /= 1000
        x, y, z = _from_column(np.full((len(shifts), 1), NOMINAL_M), altitude, azimuth, origin_m)
        turn = 2 * np.pi / width
        ahead = np.arctan2(y, x)[:, 0] + turn * shifts
        camera = SphericalCamera(
            np.arctan2(z, np.hypot(x, y))[:, 0],
            2 * np.pi - turn * np.arange(width),  # the encoder turns clockwise
            (ahead + np.pi) % (2 * np.pi) - np.pi,
        )
        return Beams(camera, shifts, T_sensor_lidar, altitude, azimuth, origin_m)

    def shifted(self, image: NDArray) -> NDArray:
        """An image (H, W) by measurement as one by azimuth."""
        columns = np.arange(image.shape[1])[None, :] - self.shifts[:, None]
        return image[np.arange(image.shape[0])[:, None], columns % image.shape[1]]

    def from_centre(self, range_m: NDArray[np.floating]) -> NDArray[np.float32]:
        """Distances (H, W) from the centre of points at ranges (H, W) along their beams; 0 stays 0."""
        x, y, z = _from_column(range_m, self._altitude, self._azimuth, self._origin_m)
        return np.where(range_m > 0, np.sqrt(x * x + y * y + z * z), 0.0).astype(np.float32)


def _from_column(
    range_m: NDArray[np.floating],
    altitude: NDArray[np.float64],
    azimuth: NDArray[np.float64],
    origin_m: tuple[float, float],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """x, y, z (H, W) of points in a frame whose x axis has the azimuth of their column's encoder."""
    along = np.asarray(range_m, np.float64) - np.hypot(*origin_m)
    altitude, azimuth = altitude[:, None], azimuth[:, None]
    level = along * np.cos(altitude)
    return (
        level * np.cos(azimuth) + origin_m[0],
        -level * np.sin(azimuth),
        along * np.sin(altitude) + origin_m[1],
    )
