"""``taichi-mrf export``: a saved map in, files for other programs out."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from taichi_mrf.config.schema import Arch
from taichi_mrf.export.options import ExportOptions


@dataclass(frozen=True)
class Export:
    """Write a saved map in other formats, chosen by the files' extensions.

    .ply points, cubes or a mesh; .glb, .obj, .stl a mesh; .bt, .ot OctoMap; .pgm with .yaml a 2D map for
    ROS's map_server; .npz arrays; .html a page that any browser opens; .zarr chunks of 64^3 voxels. Example:
    taichi-mrf export out/map.npz --to room.ply room.bt floor.pgm --z-min 0.1 --z-max 1.5
    """

    map: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MAP")]
    """A saved map: the map.npz of a run, or a map in chunks, such as the map.zarr of a run in submaps."""

    to: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE [FILE ...]")]
    """The files to write."""

    layer: Literal["static", "dynamic", "both"] = "both"
    """Part to write of a map whose world may change: what was there all along (static), what is there now
    although it was free (dynamic), or both."""

    at: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None
    """Write
    the map as it was believed then: a stamp as ``info`` shows them, or, below 0, seconds before the newest
    keyframe."""

    lower: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None
    """Lower corner (metres) of the box to export from a map in chunks; without it, the box starts where the
    map does."""

    upper: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None
    """Upper corner of that box."""

    options: Annotated[ExportOptions, tyro.conf.arg(name=""), tyro.conf.FlagCreatePairsOff] = field(
        default_factory=ExportOptions
    )
    """Contents of the files."""

    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print what was written as JSON."""

    arch: Arch = "auto"
    """Backend to read the map on."""
