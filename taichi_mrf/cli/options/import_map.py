"""``taichi-mrf import``: a file of OctoMap's in, a map of this program out."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Import:
    """Make a map of a file of OctoMap's (.bt or .ot), with its voxels and log-odds.

    The map is a LogOddsMap without keyframes: it can be asked, compared, exported and added to.
    Example: taichi-mrf import building.bt --out building.npz
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """A .bt or .ot."""

    out: Annotated[Path, tyro.conf.arg(metavar="MAP")]
    """The map to write, an .npz file."""

    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print what was read as JSON."""
