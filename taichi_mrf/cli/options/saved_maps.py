"""The options of the commands on files of maps: export, import, info, diff and merge."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from taichi_mrf.cli.options.shared import Reading
from taichi_mrf.config.schema import Arch
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.export.options import ExportOptions


@dataclass(frozen=True)
class Export:
    """Write a saved map in other formats, chosen by the files' extensions.

    .ply points, cubes or a mesh; .glb, .obj, .stl a mesh; .bt, .ot OctoMap; .pgm with .yaml a 2D map for
    ROS's map_server; .mcap Foxglove; .rrd Rerun; .npz arrays; .html a page; .zarr chunks of voxels. Example:
    taichi-mrf export out/map.npz --to room.ply room.bt floor.pgm --z-min 0.1 --z-max 1.5
    """

    map: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MAP")]
    """A saved map: the map.npz of a run, or a map in chunks, such as the map.zarr of a run in submaps."""

    to: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE [FILE ...]")]
    """The files to write."""

    layer: Literal["static", "dynamic", "both"] = "both"
    """Layer to write of a map of a changing world: voxels that were always occupied (static), voxels that are
    occupied now but were free before (dynamic), or both."""

    at: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None
    """Write the map as of this time: a stamp as ``info`` shows them or, if negative, seconds before the
    newest keyframe."""

    lower: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None
    """Lower corner (metres) of the box to export from a map in chunks. By default, the box starts where the
    map does."""

    upper: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None
    """Upper corner (metres) of the box to export."""

    options: Annotated[ExportOptions, tyro.conf.arg(name=""), tyro.conf.FlagCreatePairsOff] = field(
        default_factory=ExportOptions
    )
    """Contents of the files."""

    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print what was written as JSON."""

    arch: Arch = "auto"
    """Backend to read the map on."""


@dataclass(frozen=True)
class Import:
    """Convert an OctoMap file (.bt or .ot) into a map with the same voxels and log-odds.

    The map is a LogOddsMap without keyframes: it can be queried, compared, exported and extended.
    Example: taichi-mrf import building.bt --out building.npz
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """A .bt or .ot."""

    out: Annotated[Path, tyro.conf.arg(metavar="MAP")]
    """The map to write, an .npz file."""

    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print what was read as JSON."""


@dataclass(frozen=True)
class Info:
    """Show this machine's backends and all versions; or, with SOURCE, the contents of a saved map, or of a
    recording and how to map it.

    The exit status is 0 only if map accepts the recording. Example: taichi-mrf info walk.bag
    """

    source: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")] = None
    """A recording, as map takes it, or a saved map (map.npz, map.zarr, .bt, .ot). For a bag, all topics are
    listed."""

    arch: Arch = "auto"
    """Backend to start."""

    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the facts as JSON instead of tables."""

    reading: Reading = field(default_factory=SourceFlags)
    """Options for reading SOURCE."""


@dataclass(frozen=True)
class Diff:
    """Compare two saved maps voxel by voxel: which states have changed, and by how much probabilities differ.

    If B has another world frame, it is first located in A. The result lists what appeared and what left. The
    maps may come from different methods, but must have the same voxel size. The exit status is 0 whether they
    differ or not. Example: taichi-mrf diff monday.npz tuesday.npz --out changes.ply
    """

    a: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="A")]
    """The map before."""

    b: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="B")]
    """The map after."""

    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A .ply for the changes: the voxels that are occupied in one map only, coloured by map."""

    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the comparison as JSON."""

    arch: Arch = "auto"
    """Backend to read the maps on."""


@dataclass(frozen=True)
class Merge:
    """Merge saved maps of one place, each in its own world frame, into one map.

    Each map is located in the others, and keyframes that see the same surfaces are aligned with each other;
    the first map stays in place, and its parameters apply. A map that cannot be located in any other is
    refused. Example: taichi-mrf merge monday/map.npz tuesday/map.npz --out both.npz
    """

    maps: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="MAP MAP...", help_behavior_hint="(required)"),
    ]
    """The saved maps, with their keyframes: the map.npz of runs. The first may be in chunks (map.zarr)."""

    out: Annotated[Path, tyro.conf.arg(metavar="MAP")]
    """The map to write, an .npz file."""

    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print where the maps were located as JSON."""

    arch: Arch = "auto"
    """Backend to merge the maps on."""
