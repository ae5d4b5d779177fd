"""The file of a chunk that lies outside the window: all that frozen keyframes have left in it.

Its name holds the chunk and a hash of the content, so a file never changes: a chunk that comes back into
memory and leaves it again with other evidence has another file.
"""

import hashlib
import re
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import MapFileError
from taichi_mrf.export.chunk_store import Chunk
from taichi_mrf.system.atomic import write_npz
from taichi_mrf.system.files import exists
from taichi_mrf.system.npz_file import open_npz
from taichi_mrf.voxels.layout import CHUNK, VOXELS

_NAME = re.compile(r"(-?\d{1,7})_(-?\d{1,7})_(-?\d{1,7})-[0-9a-f]{16}\.npz")


@dataclass(frozen=True)
class ParkedChunk:
    """``belief`` and ``evidence`` are (n, 512) log-odds of the ``bricks`` (n, 3) that have voxels; ``owners``
    (n,) counts the frozen keyframes that own each; ``crossed`` (m, 3) are the bricks that they crossed."""

    bricks: NDArray[np.int32]
    belief: NDArray[np.float32]
    evidence: NDArray[np.float32]
    owners: NDArray[np.int32]
    crossed: NDArray[np.int32]

    def file_name(self, chunk: Chunk) -> str:
        """The name of its file."""
        digest = hashlib.blake2b(digest_size=8)
        for field in fields(self):
            digest.update(np.ascontiguousarray(getattr(self, field.name)).tobytes())
        x, y, z = chunk
        return f"{x}_{y}_{z}-{digest.hexdigest()}.npz"

    def write(self, path: Path) -> None:
        """Write the file, under a temporary name first. Raises MapFileError."""
        if not exists(path):
            write_npz(path, {field.name: getattr(self, field.name) for field in fields(self)}, manifest=True)


def chunk_of(name: str) -> Chunk | None:
    """The chunk that a file's name holds; None for any other name."""
    match = _NAME.fullmatch(name)
    return None if match is None else (int(match[1]), int(match[2]), int(match[3]))


def read_parked(path: Path, chunk: Chunk) -> ParkedChunk:
    """Read a chunk's file back. Raises MapFileError, which names the file and what is wrong."""
    with open_npz(path, MapFileError, "a readable chunk of a map") as file:
        file.check_manifest()
        bricks = file.array("bricks", "i", (None, 3)).astype(np.int32)
        n = len(bricks)
        belief, evidence = (
            file.array(name, "f", (n, VOXELS)).astype(np.float32) for name in ("belief", "evidence")
        )
        found = ParkedChunk(
            bricks,
            belief,
            evidence,
            file.array("owners", "i", (n,)).astype(np.int32),
            file.array("crossed", "i", (None, 3)).astype(np.int32),
        )
    for places in (found.bricks, found.crossed):
        if (places // CHUNK != chunk).any() or len(np.unique(places, axis=0)) < len(places):
            raise MapFileError(f"{path}: damaged: it names a brick twice, or one of another chunk")
    if (found.owners < 1).any():
        raise MapFileError(f"{path}: damaged: a brick has no owner")
    return found
