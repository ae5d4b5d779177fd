"""The file of a chunk that lies outside the window: all that frozen keyframes have left in it.

Its name holds the chunk and a hash of the content, so a file never changes: a chunk that comes back into
memory and leaves it again with other evidence has another file.
"""

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.surfels import Surfels
from taichi_mrf.errors import MapFileError
from taichi_mrf.inference.voxel_share import VoxelShare
from taichi_mrf.methods.map_file import read_places
from taichi_mrf.methods.mrf.frozen_arrays import (
    dated_arrays,
    ray_arrays,
    read_dated,
    read_rays,
    read_shares,
    share_arrays,
)
from taichi_mrf.methods.mrf.kept_rays import RayShare
from taichi_mrf.system.atomic import write_npz
from taichi_mrf.system.files import exists
from taichi_mrf.system.npz_file import open_npz
from taichi_mrf.voxels.layers import Chunk
from taichi_mrf.voxels.layout import CHUNK, CHUNK_VOXELS, VOXELS

_NAME = re.compile(r"(-?\d{1,7})_(-?\d{1,7})_(-?\d{1,7})-[0-9a-f]{16}\.npz")

_MEMBERS = ("bricks", "total", "evidence", "owners", "crossed")


@dataclass(frozen=True)
class ParkedChunk:
    """``total`` and ``evidence`` are (n, 512) log-odds of the ``bricks`` (n, 3) that have voxels; ``owners``
    (n,) counts the frozen keyframes that own each; ``crossed`` (m, 3) are the bricks that they crossed.
    ``dated`` is, in a dated map, what they say of the voxels (n, 512), and as of when (n); ``surfels`` is the
    surface that they have measured, if keyframes are aligned; ``shares`` are what they gave to layers that
    pixels feed, and ``rays`` what they measured, if that is kept."""

    bricks: NDArray[np.int32]
    total: NDArray[np.float32]
    evidence: NDArray[np.float32]
    owners: NDArray[np.int32]
    crossed: NDArray[np.int32]
    dated: tuple[NDArray[np.float32], NDArray[np.float64]] | None
    surfels: Surfels
    shares: Mapping[str, VoxelShare]
    rays: RayShare

    @cached_property
    def _arrays(self) -> dict[str, NDArray]:
        arrays: dict[str, NDArray] = {name: getattr(self, name) for name in _MEMBERS}
        arrays |= {"surfel_keys": self.surfels.keys, "surfel_sums": self.surfels.sums}
        arrays |= share_arrays(self.shares) | ray_arrays(self.rays)
        return arrays if self.dated is None else arrays | dated_arrays(*self.dated)

    def file_name(self, chunk: Chunk) -> str:
        """The name of its file."""
        digest = hashlib.blake2b(digest_size=8)
        for array in self._arrays.values():
            digest.update(np.ascontiguousarray(array).tobytes())
        x, y, z = chunk
        return f"{x}_{y}_{z}-{digest.hexdigest()}.npz"

    def write(self, path: Path) -> None:
        """Write the file, under a temporary name first. Raises MapFileError."""
        if not exists(path):
            write_npz(path, self._arrays, manifest=True)


def chunk_of(name: str) -> Chunk | None:
    """The chunk that a file's name holds; None for any other name."""
    match = _NAME.fullmatch(name)
    return None if match is None else (int(match[1]), int(match[2]), int(match[3]))


def read_parked(path: Path, chunk: Chunk, voxel_size: float) -> ParkedChunk:
    """Read a chunk's file back. Raises MapFileError, which names the file and what is wrong."""
    with open_npz(path, MapFileError, "a readable chunk of a map") as file:
        file.check_manifest()
        bricks = read_places(path, file, "bricks")
        n = len(bricks)
        total, evidence = (
            file.array(name, "f", (n, VOXELS)).astype(np.float32) for name in ("total", "evidence")
        )
        keys = file.array("surfel_keys", "i", (None,)).astype(np.int64)
        found = ParkedChunk(
            bricks,
            total,
            evidence,
            file.integers("owners", (n,), 1, np.iinfo(np.int32).max).astype(np.int32),
            read_places(path, file, "crossed"),
            read_dated(file, n),
            Surfels(keys, file.array("surfel_sums", "f", (len(keys), 7)).astype(np.float64), voxel_size),
            read_shares(path, file, bricks),
            read_rays(path, file),
        )
    for places in (found.bricks, found.crossed, found.rays.distances.bricks, found.rays.votes.bricks):
        if (places // CHUNK != chunk).any():
            raise MapFileError(f"{path}: damaged: it names a brick of another chunk")
    if (np.diff(found.surfels.keys) <= 0).any() or (found.surfels.cells // CHUNK_VOXELS != chunk).any():
        raise MapFileError(f"{path}: damaged: its surfels are not in order, or of another chunk")
    return found
