"""Rules of a distance field: which voxels are obstacles, what unknown space is, and how far distances go."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.voxels.layout import BRICK

UnknownSpace = Literal["free", "occupied", "unknown"]
"""Role of unknown voxels: no obstacles, obstacles, or no obstacles but without a distance themselves."""

MOST_REACH = 1024
"""Voxels that distances may reach, at most."""


@dataclass(frozen=True)
class SpaceRules:
    """Rules in voxels: the role of unknown space, the ``reach`` in voxels, and the distance in metres of each
    square of voxels, ``metres`` ((reach + 1)^2 + 1)."""

    unknown: UnknownSpace
    reach: int
    metres: NDArray[np.float32]

    @staticmethod
    def of(unknown: UnknownSpace, max_distance_m: float, voxel_size: float) -> "SpaceRules":
        """Distances to the faces of obstacles: half a voxel less than to their centres. Raises
        ConfigError."""
        reach = max(1, int(np.ceil(max_distance_m / voxel_size - 0.5)))
        if reach > MOST_REACH:
            raise ConfigError(
                f"max_distance_m must be at most {MOST_REACH} voxels, {MOST_REACH * voxel_size:g} m, "
                f"not {max_distance_m:g}"
            )
        squares = np.arange((reach + 1) ** 2 + 1, dtype=np.float64)
        metres = np.minimum((np.sqrt(squares) - 0.5) * voxel_size, max_distance_m)
        metres[-1] = max_distance_m
        return SpaceRules(unknown, reach, metres.astype(np.float32))

    @property
    def beyond(self) -> int:
        """The square that stands for all that is further than distances go."""
        return (self.reach + 1) ** 2

    @property
    def reach_bricks(self) -> int:
        """Bricks up to which a state can change a distance."""
        return -(-self.reach // BRICK)

    @property
    def outside_class(self) -> int:
        """A column of unknown voxels (distance_grid.FieldGrid)."""
        return {"free": 0, "occupied": 0x00FF, "unknown": 0xFF00}[self.unknown]

    @property
    def outside_square(self) -> int:
        """The squared distance deep in unknown space."""
        return -self.beyond if self.unknown == "occupied" else self.beyond

    @property
    def outside_m(self) -> float:
        """The distance there, in metres."""
        return -float(self.metres[-1]) if self.unknown == "occupied" else float(self.metres[-1])
