"""The options of exports, which are also the flags of ``taichi-mrf export``."""

import math
from dataclasses import dataclass
from typing import Literal

from taichi_mrf.errors import ConfigError


@dataclass(frozen=True)
class ExportOptions:
    """Options of :func:`export_map`; each format uses the fields that name it, and ignores the others.

    Raises ConfigError for values outside their ranges.
    """

    threshold: float = 0.5
    """Lowest probability of voxels written as points or cubes, and the level of a mesh."""

    cubes: bool = False
    """Write voxels as cubes: in .ply, and instead of marching cubes in .glb, .obj, .stl."""

    mesh: bool = False
    """Write a .ply as a mesh by marching cubes, like .glb, .obj and .stl, instead of points."""

    surface: Literal["auto", "rays", "marginal"] = "auto"
    """Surface of a mesh: rays is the measured surface, finer than voxels; marginal is where the marginal
    equals the threshold. auto is rays for a map with keyframes, none frozen, and for a .zarr that holds the
    measured surface. A .zarr gets it with rays, and with auto after --keep-surface."""

    cells: bool = True
    """Write cells of 2, 4 or 8 voxels that reach the threshold although none of their voxels does; --no-cells
    leaves them out. A cell is a point with the property size in .ply, all its voxels in cubes and .html, and
    a larger leaf in .bt and .ot."""

    color_by: Literal["auto", "marginal", "photo"] = "auto"
    """Colours in .ply, .glb, .obj, .ot, .html and .zarr: of the marginals (not in .ot and .zarr), or of the
    colour images (photo). auto is photo if the map was made with colour images."""

    z_min: float | None = None
    """Lower end of the heights in a .pgm, in metres along the axis up."""

    z_max: float | None = None
    """Upper end of the heights in a .pgm, in metres along the axis up."""

    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = "auto"
    """The world axis that is up in .pgm, .glb, .html and .zarr. auto is the up direction of the map's first
    keyframe, or z if unknown."""

    occupied_from: float = 0.5
    """A cell of a .pgm is occupied if a voxel in the band has at least this probability."""

    free_below: float = 0.5
    """A cell of a .pgm is free if all known voxels in the band, at least one, have less than this."""

    def __post_init__(self) -> None:
        for name in ("threshold", "occupied_from", "free_below"):
            value = getattr(self, name)
            if not 0 < value < 1:
                raise ConfigError(f"{name} must lie between 0 and 1, not {value}")
        if self.free_below > self.occupied_from:
            raise ConfigError("free_below must not be larger than occupied_from")
        if self.cubes and self.mesh:
            raise ConfigError("cubes and mesh are two different surfaces: choose one of them")
        for name in ("z_min", "z_max"):
            value = getattr(self, name)
            if value is not None and not math.isfinite(value):
                raise ConfigError(f"{name} must be a number, not {value}")
        if self.z_min is not None and self.z_max is not None and self.z_min >= self.z_max:
            raise ConfigError(f"z_min must lie below z_max, not {self.z_min} and {self.z_max}")
