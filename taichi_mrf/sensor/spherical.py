"""The camera of a spinning lidar: a table of beams, an elevation for each row, an azimuth for each column."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.arguments import array
from taichi_mrf.errors import ConfigError
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.sensor.stored import Arrays

_BEAMS = "elevations_rad", "azimuths_rad", "azimuth_offsets_rad"


class SphericalCamera(RayTable):
    """A spinning lidar, as Ouster, Velodyne and Hesai describe theirs (camera.Camera).

    Its frame has x forward, y to the left, z up. The ray of a pixel is (cos e cos a, cos e sin a, sin e) with
    the elevation e of its row and the azimuth a of its column plus its row's offset. Its length is 1, so
    depth is range. Otherwise it is a ray table, and equals the table with the same rays.
    """

    def __init__(
        self,
        elevations_rad: ArrayLike,
        azimuths_rad: ArrayLike,
        azimuth_offsets_rad: ArrayLike | None = None,
    ) -> None:
        """``elevations_rad`` (H,) of the rows from top to bottom, ``azimuths_rad`` (W,) of the columns,
        ``azimuth_offsets_rad`` (H,) of the rows, 0 if they are not given. Neighbouring columns and rows
        should be neighbours in space. Raises ConfigError for other shapes and values that are not finite."""
        elevations = _angles(elevations_rad, "elevations_rad")
        azimuths = _angles(azimuths_rad, "azimuths_rad")
        offsets = np.zeros(len(elevations))
        if azimuth_offsets_rad is not None:
            offsets = _angles(azimuth_offsets_rad, "azimuth_offsets_rad")
        if len(offsets) != len(elevations):
            raise ConfigError(
                f"azimuth_offsets_rad has {len(offsets)} values, but there are {len(elevations)} elevations"
            )
        if np.abs(elevations).max() > np.pi / 2 + 1e-6:
            raise ConfigError("elevations_rad has an angle beyond pi / 2: is it in degrees?")
        self._beams = elevations, azimuths, offsets
        e, a = elevations[:, None], azimuths[None, :] + offsets[:, None]
        super().__init__(
            np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.broadcast_to(np.sin(e), a.shape)], -1)
        )

    @property
    def elevations_rad(self) -> NDArray[np.float64]:
        """Elevation of each row, (H,)."""
        return self._beams[0].copy()

    @property
    def azimuths_rad(self) -> NDArray[np.float64]:
        """Azimuth of each column, (W,)."""
        return self._beams[1].copy()

    @property
    def azimuth_offsets_rad(self) -> NDArray[np.float64]:
        """Angle that each row adds to the azimuths, (H,)."""
        return self._beams[2].copy()

    def arrays(self) -> dict[str, NDArray[Any]]:
        return dict(zip(_BEAMS, self._beams, strict=True))

    @classmethod
    def of_arrays(cls, file: Arrays) -> "SphericalCamera":
        return cls(*(file.array(name, "f", (None,)) for name in _BEAMS))

    def __reduce__(self) -> tuple[Any, ...]:
        return SphericalCamera, self._beams


def _angles(value: ArrayLike, name: str) -> NDArray[np.float64]:
    angles = array(value, name)
    if angles.ndim != 1 or len(angles) == 0:
        raise ConfigError(f"{name} must be of shape (N,), not {angles.shape}")
    if not np.isfinite(angles).all():
        raise ConfigError(f"{name} holds a value that is not finite")
    return angles.copy()
