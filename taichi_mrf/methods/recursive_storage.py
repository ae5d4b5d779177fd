"""A map that integrates its scans one by one as one .npz file.

Beside the scans, the voxels are stored: a loaded map answers queries at once, and goes on from there
without integrating anything anew.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.methods.map_file import MapHeader, open_map_file, read_bricks, read_header
from taichi_mrf.system.atomic import write_npz


@dataclass(frozen=True)
class RecursiveContents:
    """All that makes such a map. ``belief`` (n, 512) are the log-odds of the ``bricks`` (n, 3); ``stale``
    says that they are no longer those of the keyframes."""

    header: MapHeader
    bricks: NDArray[np.int32]
    belief: NDArray[np.float32]
    stale: bool


def write_recursive(path: Path, contents: RecursiveContents) -> None:
    """Write a map beside its place first, then into it. Raises MapFileError."""
    arrays = {
        **contents.header.arrays(),
        "bricks": contents.bricks,
        "belief": contents.belief,
        "stale": np.asarray(contents.stale),
    }
    write_npz(path, arrays, manifest=True)


def read_recursive(path: Path, method: str) -> RecursiveContents:
    """Read a map of a method back. Raises MapFileError naming the file and what is wrong with it."""
    with open_map_file(path, method) as file:
        return RecursiveContents(
            read_header(path, file), *read_bricks(path, file), stale=file.scalar("stale", "b")
        )
