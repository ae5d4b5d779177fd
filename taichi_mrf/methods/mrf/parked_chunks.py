"""The folder of a map with a window: what is outside of the window, and the voxels of all for any reader.

The folder is a map in chunks (export/chunk_store.py), which ChunkedMap reads. Beside the voxels it holds,
in ``parked/``, a file for each chunk that is not in memory (parked_chunk.py). A saved map names those that
belong to it, and they are kept until it is saved again.
"""

import shutil
import tempfile
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import MapFileError
from taichi_mrf.export.chunk_store import SUFFIX, ChunkStore, new_store, put_chunks
from taichi_mrf.export.store_header import StoreHeader
from taichi_mrf.methods.mrf.parked_chunk import ParkedChunk, chunk_of, read_parked
from taichi_mrf.system.files import is_file
from taichi_mrf.voxels.layers import Chunk, Layers

PARKED = "parked"


def folder_beside(path: Path) -> Path:
    """The folder that goes with a saved map: ``map_window.zarr`` with ``map.npz``."""
    return path.with_name(f"{path.stem}_window{SUFFIX}")


class ParkedChunks:
    """The chunks that are not in memory, and the ``folder`` with their files, None before it is needed."""

    def __init__(self) -> None:
        self.folder: Path | None = None
        self._names: dict[Chunk, str] = {}
        self._saved: set[str] = set()  # files that a saved map names
        self._is_begun = False  # the folder is this map's; one of an earlier run is replaced
        self._temporary: tempfile.TemporaryDirectory[str] | None = None

    def __len__(self) -> int:
        return len(self._names)

    def __contains__(self, chunk: Chunk) -> bool:
        return chunk in self._names

    @property
    def chunks(self) -> NDArray[np.int32]:
        """The chunks, (n, 3)."""
        return np.array(list(self._names), np.int32).reshape(-1, 3)

    @property
    def names(self) -> list[str]:
        """The names of their files."""
        return list(self._names.values())

    def write_to(self, folder: Path) -> None:
        """Write chunks to a folder from now on; those that were written before are copied. Raises
        MapFileError."""
        if folder != self.folder:
            if self._is_begun:
                self._copy(folder)
            self.folder = folder

    def add(self, chunks: Mapping[Chunk, ParkedChunk], layers: Layers, header: StoreHeader) -> None:
        """Write chunks that are about to leave memory, and the layers of their voxels. Raises MapFileError;
        none of them counts as written then."""
        folder = self._begun(header)
        names = {chunk: parked.file_name(chunk) for chunk, parked in chunks.items()}
        for chunk, parked in chunks.items():
            parked.write(folder / PARKED / names[chunk])
        put_chunks(folder, header, np.array(list(chunks), np.int32), layers)
        self._names |= names

    def read(self, chunk: Chunk, voxel_size: float) -> ParkedChunk:
        """Contents of a chunk's file. Raises MapFileError."""
        assert self.folder is not None
        return read_parked(self.folder / PARKED / self._names[chunk], chunk, voxel_size)

    def drop(self, chunk: Chunk) -> None:
        """The chunk is in memory again. Its file is removed unless a saved map names it."""
        assert self.folder is not None
        name = self._names.pop(chunk)
        if name not in self._saved:
            (self.folder / PARKED / name).unlink(missing_ok=True)

    def resume(self, folder: Path, names: Iterable[str]) -> None:
        """Go on with the files in a folder that a saved map names. Raises MapFileError if one is missing."""
        for name in names:
            chunk = chunk_of(name)
            if chunk is None or not is_file(folder / PARKED / name):
                raise MapFileError(f"{folder / PARKED}: the map's file {name[:80]!r} is missing")
            self._names[chunk] = name
        if self._names:
            self.folder, self._is_begun, self._saved = folder, True, set(self.names)

    def complete(
        self,
        folder: Path,
        resident: Iterable[tuple[NDArray[np.int32], Layers]],
        header: StoreHeader,
    ) -> None:
        """Make a folder hold the whole map: all files, and the layers of the ``resident`` chunks too. Raises
        MapFileError."""
        self.folder = self.folder or folder
        self._begun(header)
        if folder != self.folder:
            self._copy(folder)
        for chunks, layers in resident:
            put_chunks(folder, header, chunks, layers)

    def tidy(self, folder: Path) -> None:
        """A map that names exactly these chunks was saved beside a folder: remove all other files."""
        keep = set(self._names.values())
        if folder == self.folder:
            self._saved = keep
        for file in (folder / PARKED).iterdir():
            if chunk_of(file.name) is not None and file.name not in keep:
                file.unlink(missing_ok=True)

    def _begun(self, header: StoreHeader) -> Path:
        """The folder, made if this map has not written to it yet."""
        if self.folder is None:
            self._temporary = tempfile.TemporaryDirectory(prefix="taichi_mrf_window_")
            self.folder = Path(self._temporary.name, f"map{SUFFIX}")
            warnings.warn(
                f"volume.window_m: the map outside the window is kept in {self.folder} until the map is "
                "dropped, because no folder was named (MRFMap.window.park_in)",
                stacklevel=2,
            )
        if not self._is_begun:
            with new_store(self.folder) as temporary:
                ChunkStore.create(temporary, header, np.zeros((0, 3), np.int32), grows=True)
                (temporary / PARKED).mkdir()
            self._is_begun = True
        return self.folder

    def _copy(self, folder: Path) -> None:
        assert self.folder is not None
        with new_store(folder) as temporary:
            shutil.copytree(self.folder, temporary)
