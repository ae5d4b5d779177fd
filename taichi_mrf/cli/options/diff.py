"""``taichi-mrf diff``: what differs between two saved maps."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from taichi_mrf.config.schema import Arch


@dataclass(frozen=True)
class Diff:
    """Compare two saved maps voxel by voxel: which states have changed, and by how much probabilities differ.

    The maps can be of different methods, but their voxels must be of one size. The exit status is 0 whether
    they differ or not. Example: taichi-mrf diff monday.npz tuesday.npz --out changes.ply
    """

    a: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="A")]
    """The map before."""

    b: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="B")]
    """The map after."""

    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A .ply for the changes: the voxels that are occupied in one map only, coloured by which."""

    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the comparison as JSON."""

    arch: Arch = "auto"
    """Backend to read the maps on."""
