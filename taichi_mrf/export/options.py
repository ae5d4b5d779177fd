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
    """Voxels of at least this probability are points or cubes; a mesh lies where the probability is this."""

    cubes: bool = False
    """Write the outsides of the voxels, as cubes: .ply, and .glb, .obj, .stl in place of marching cubes."""

    mesh: bool = False
    """Write a .ply as a mesh by marching cubes, like .glb, .obj and .stl, not as points."""

    surface: Literal["auto", "rays", "marginal"] = "auto"
    """Surface of a mesh: rays is the one that the keyframes' rays measured, below the size of voxels, and
    marginal lies where the marginal is the threshold. auto is rays for a map that has keyframes, none frozen,
    and for a .zarr that holds it. rays also puts it into a .zarr, as auto does after --keep-surface."""

    cells: bool = True
    """Show a cell of 2, 4 or 8 voxels where it is likely enough and no voxel is: in a .ply as a point with
    the property size, in cubes and .html as all its voxels, in .bt and .ot as a larger leaf."""

    color_by: Literal["auto", "marginal", "photo"] = "auto"
    """Source of the colours of .ply, .glb, .obj, .ot, .html and .zarr: the marginals, or what cameras saw
    (photo), if the map was made with colour images; auto is photo for such a map. .ot and .zarr have no
    colours of marginals."""

    z_min: float | None = None
    """Lower end in metres of the band of heights that a .pgm shows; heights count along up."""

    z_max: float | None = None
    """Upper end in metres of the band of heights that a .pgm shows."""

    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = "auto"
    """The world axis that is up in .pgm, .glb, .html and .zarr. auto takes the map's own, that of its first
    keyframe's image, or z if the map does not hold it."""

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
