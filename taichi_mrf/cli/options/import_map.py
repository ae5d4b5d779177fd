"""``taichi-mrf import``: a file of OctoMap's in, a map of this program out."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


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
