"""The file of a recursive map. It holds the scans and the voxels, so that a loaded map answers queries at
once and continues without integrating its scans again."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.methods.map_file import MapHeader, open_map_file, read_bricks, read_header
from taichi_mrf.system.atomic import write_npz


@dataclass(frozen=True)
class RecursiveContents:
    """The contents of such a file. ``belief`` (n, 512) are the log-odds of the ``bricks`` (n, 3); ``stale``
    says that keyframes were removed or moved since they were computed."""

    header: MapHeader
    bricks: NDArray[np.int32]
    belief: NDArray[np.float32]
    stale: bool


def write_recursive(path: Path, contents: RecursiveContents) -> None:
    """Write the file under a temporary name and rename it into place. Raises MapFileError."""
    arrays = {
        **contents.header.arrays(),
        "bricks": contents.bricks,
        "belief": contents.belief,
        "stale": np.asarray(contents.stale),
    }
    write_npz(path, arrays, manifest=True)


def read_recursive(path: Path, method: str) -> RecursiveContents:
    """Read a map of a method back. Raises MapFileError, which names the file and what is wrong."""
    with open_map_file(path, method) as file:
        return RecursiveContents(
            read_header(path, file), *read_bricks(path, file), stale=file.scalar("stale", "b")
        )
