"""A map as a chunked array on disk, in zarr 3, for maps that are larger than memory.

The folder is a zarr group. Its array ``log_odds`` (x, y, z) float32 has a zarr chunk for each chunk of 64^3
voxels; unknown voxels are NaN. ``chunks`` (n, 3) int32 lists the stored chunks in the world's coordinates:
chunk c covers the voxels 64 c to 64 (c + 1) - 1. The other layers that the map has (voxels/layers.py) are
arrays (x, y, z, width) of their own, 0 for nothing. The attributes hold the rest: see :class:`StoreHeader`,
``origin_m``, the outer corner of the array's first voxel, and ``every_chunk_stored``, true where each chunk
on the list has a file of log-odds, so that a lost file is told from unknown space. zstd's checksums tell
changed bits.

A store can grow during a run, and be read at any moment. Each file is written in a folder beside the store
and moved into place: a chunk's file first, then the list that names it. A run that is killed in between
leaves the old chunk or the new one, and no chunk on the list without its file.
"""

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import MapFileError, said
from taichi_mrf.export.store_header import (
    CHUNKS,
    EVERY_CHUNK,
    FORMAT,
    FORMAT_KEY,
    StoreHeader,
    StoreLayout,
    check_packed,
    read_layout,
)
from taichi_mrf.system.atomic import temporary_name
from taichi_mrf.system.files import exists, is_file, is_folder, read_text
from taichi_mrf.system.libraries import library
from taichi_mrf.system.memory import check_memory
from taichi_mrf.voxels.layers import LAYERS, LOG_ODDS, Chunk, Layers, chunk_blocks
from taichi_mrf.voxels.layout import CHUNK_VOXELS

SUFFIX = ".zarr"
CHUNK_BYTES = 4 * CHUNK_VOXELS**3
_LISTED_BYTES = 12

FARTHEST = 1 << 17
"""A store that grows has room for chunks up to this far from the origin: all that have keys
(voxels.layout.grid_keys)."""

LISTED_TOGETHER = 1 << 16
"""Chunks in one file of the list of a store that grows."""


class ChunkStore:
    """The chunks of a map on disk. Each is read and written by itself; different chunks may be written by
    different processes at the same time."""

    def __init__(self, path: Path, group: Any, layout: StoreLayout) -> None:
        """As :meth:`create` and :meth:`open` make it."""
        self.path, self.header, self._layout, self._group = path, layout.header, layout, group
        self.layers = (LOG_ODDS, *layout.layers)

    @classmethod
    def create(
        cls,
        path: str | Path,
        header: StoreHeader,
        chunks: NDArray[np.int32],
        grows: bool = False,
        layers: Sequence[str] = (),
    ) -> "ChunkStore":
        """An empty store for some chunks, (n, 3), which the caller then writes. Its array covers their
        bounding box; if it ``grows``, all chunks within ``FARTHEST``. ``layers`` beside
        log-odds get arrays too.

        Raises MapFileError if it cannot be written, TaichiMRFError without zarr.
        """
        zarr = _zarr()
        path = Path(path)
        lowest, highest = (
            (chunks.min(axis=0), chunks.max(axis=0)) if len(chunks) else (np.zeros(3), np.zeros(3))
        )
        if grows:
            lowest, highest = np.full(3, -FARTHEST), np.full(3, FARTHEST - 1)
        shape = (highest - lowest + 1).astype(int) * CHUNK_VOXELS
        origin_m = lowest * CHUNK_VOXELS * header.voxel_size
        place = {
            "lowest_chunk": lowest.astype(int).tolist(),
            "origin_m": origin_m.tolist(),
            EVERY_CHUNK: True,
        }
        packed = zarr.codecs.ZstdCodec(checksum=True)
        try:
            group = zarr.create_group(
                store=str(path), attributes={FORMAT_KEY: FORMAT, **asdict(header), **place, EVERY_CHUNK: True}
            )
            for name in (LOG_ODDS, *layers):
                layer, last = LAYERS[name], _last_axis(name)
                group.create_array(
                    name, shape=(*shape.tolist(), *last), chunks=(*(CHUNK_VOXELS,) * 3, *last),
                    dtype=layer.dtype, fill_value=layer.missing, compressors=packed,
                    dimension_names=("x", "y", "z", "value")[: 3 + len(last)],
                )  # fmt: skip
            listed = np.ascontiguousarray(chunks, np.int32).reshape(-1, 3)
            in_one_file = (LISTED_TOGETHER if grows else max(1, len(listed)), 3)
            group.create_array(
                CHUNKS, shape=listed.shape, chunks=in_one_file,
                dtype="int32", fill_value=0, compressors=packed,
            )[:] = listed  # fmt: skip
        except OSError as error:
            raise MapFileError(f"{path}: cannot be written: {error.strerror or error}") from error
        return cls(path, group, read_layout(path))

    @classmethod
    def open(cls, path: str | Path) -> "ChunkStore":
        """A store that exists. Raises MapFileError, naming what is wrong, TaichiMRFError without zarr."""
        zarr = _zarr()
        path = Path(path)
        if not is_folder(path):
            raise MapFileError(f"{path}: there is no such folder")
        layout = read_layout(path)
        try:
            group = zarr.open_group(store=str(path), mode="r+", zarr_format=3, use_consolidated=False)
            return cls(path, group, layout)
        except Exception as error:  # zarr's parsers raise many kinds of exceptions
            raise MapFileError(f"{path}: not a readable map in chunks: {said(error)}") from error

    @property
    def chunks(self) -> NDArray[np.int32]:
        """The chunks (n, 3) in which something is known. Raises MapFileError."""
        layout = self._layout
        check_memory(_LISTED_BYTES * layout.listed, f"{self.path}: its list of chunks")
        for file in (self.path / CHUNKS).glob("c/*/0"):
            check_packed(file, _LISTED_BYTES * layout.listed_together)
        try:
            found = np.asarray(self._group[CHUNKS][:], np.int32).reshape(-1, 3)
        except Exception as error:  # as above
            raise MapFileError(
                f"{self.path}: damaged: its list of chunks cannot be read: {said(error)}"
            ) from error
        place = found - np.array(layout.lowest_chunk, np.int64)
        if ((place < 0) | (place >= layout.chunks_across)).any() or len(np.unique(found, axis=0)) < len(
            found
        ):
            raise MapFileError(
                f"{self.path}: damaged: its list names a chunk twice, or one outside of the array"
            )
        return found

    @property
    def grows(self) -> bool:
        """True if chunks can be added to it."""
        return self._layout.lowest_chunk == (-FARTHEST,) * 3

    def file_of(self, name: str, chunk: Sequence[int]) -> Path:
        """File of a chunk's layer, from the store's folder."""
        return Path(name, "c", *map(str, (*self._place(chunk), *(0 for _ in _last_axis(name)))))

    def write(self, layers: Layers) -> None:
        """Write some bricks of layers, chunk by chunk: those of a chunk together. Raises MapFileError."""
        for name, found in layers.items():
            last = _last_axis(name)
            for chunk, block in chunk_blocks(LAYERS[name], found):
                self._put(name, chunk, block.reshape(*(CHUNK_VOXELS,) * 3, *last))

    def fill(self, chunks: NDArray[np.int32]) -> None:
        """Write that nothing is known in those of some chunks, (n, 3), that have not been written. Raises
        MapFileError."""
        for x, y, z in chunks.tolist():
            if not exists(self.path / self.file_of(LOG_ODDS, (x, y, z))):
                self._put(LOG_ODDS, (x, y, z), LAYERS[LOG_ODDS].missing)

    def read(self, name: str, chunk: Sequence[int]) -> NDArray:
        """One of :attr:`layers` of one of :attr:`chunks`, (64, 64, 64), with a last axis for one of more than
        one value. Raises MapFileError."""
        layer, last = LAYERS[name], _last_axis(name)
        size = CHUNK_VOXELS**3 * layer.nbytes
        file = self.path / self.file_of(name, chunk)
        if name == LOG_ODDS and self._layout.every_chunk and not exists(file):
            raise MapFileError(f"{file}: damaged: there is no such file, which holds a part of the map")
        check_packed(file, size)
        what = f"{name} of chunk {tuple(chunk)}"
        try:
            place = (*self._place(chunk), *(0 for _ in last))
            found = np.asarray(self._group[name].blocks[place], layer.dtype)
        except Exception as error:  # as above
            raise MapFileError(f"{self.path}: {what} cannot be read: {said(error)}") from error
        unfit = np.isinf(found) if np.isnan(layer.missing) else ~np.isfinite(found)
        if found.shape != (*(CHUNK_VOXELS,) * 3, *last) or unfit.any():
            raise MapFileError(f"{self.path}: damaged: {what} holds a value that is not finite")
        return found.reshape(layer.chunk_shape)

    def _put(self, name: str, chunk: Chunk, values: NDArray | float) -> None:
        """Write a layer of a chunk, log-odds also where nothing is known."""
        try:
            with _zarr().config.set({"array.write_empty_chunks": name == LOG_ODDS}):
                self._group[name].blocks[(*self._place(chunk), *(0 for _ in _last_axis(name)))] = values
        except OSError as error:
            raise MapFileError(f"{self.path}: cannot be written: {error.strerror or error}") from error

    def _place(self, chunk: Sequence[int]) -> Chunk:
        x, y, z = (np.array(chunk, np.int64) - self._layout.lowest_chunk).tolist()
        return x, y, z


def _zarr() -> Any:
    return library("zarr", "maps in chunks need", "store")


def _last_axis(name: str) -> tuple[int, ...]:
    """The last axis of a layer's array: log-odds have none."""
    return () if name == LOG_ODDS else (LAYERS[name].width,)


@contextmanager
def new_store(path: str | Path) -> Iterator[Path]:
    """A temporary folder beside ``path`` to write a store to; it replaces ``path`` if the block succeeds.

    Raises MapFileError if ``path`` exists and is not a map in chunks, or if it cannot be written.
    """
    path = Path(path)
    if not is_folder(path.parent):  # zarr would make it, as no other format does
        raise MapFileError(f"{path}: cannot be written: No such file or directory")
    if exists(path) and not _is_store(path):
        raise MapFileError(f"{path}: exists and is not a map in chunks: it is not overwritten")
    temporary, old = temporary_name(path), temporary_name(path)
    try:
        yield temporary
        # A folder cannot replace another in one step: for a moment neither exists, but never half of one.
        if exists(path):
            os.replace(path, old)
        try:
            os.replace(temporary, path)
        except BaseException:
            if exists(old):
                os.replace(old, path)
            raise
    except OSError as error:
        raise MapFileError(f"{path}: cannot be written: {error.strerror or error}") from error
    except MapFileError as error:
        raise MapFileError(str(error).replace(str(temporary), str(path))) from error
    finally:
        for folder in (temporary, old, temporary):  # again: a thread of zarr's may have been writing
            shutil.rmtree(folder, ignore_errors=True)


def _is_store(path: Path) -> bool:
    header = path / "zarr.json"
    return is_file(header) and FORMAT_KEY in read_text(header, MapFileError)


_DOCUMENT = "zarr.json"


def put_chunks(path: Path, header: StoreHeader, put: NDArray[np.int32], layers: Layers) -> None:
    """Write the layers of some chunks ``put`` (n, 3) into the store ``path``, which is made if it does not
    exist; of chunks that are there already the named layers are replaced. Raises MapFileError, also for a
    store that was not made here, and TaichiMRFError without zarr."""
    new = put.reshape(-1, 3)
    if len(new) and max(-int(new.min()), int(new.max()) + 1) > FARTHEST:
        raise MapFileError(f"{path}: a chunk further than {FARTHEST} chunks from the origin does not fit")
    grown = exists(path)
    listed = _listed(path) if grown else new[:0]
    known = set(map(tuple, listed.tolist()))
    added = [chunk for chunk in new.tolist() if tuple(chunk) not in known]
    chunks = np.concatenate([listed, np.array(added, np.int32).reshape(-1, 3)])
    staging = temporary_name(path)
    try:
        others = tuple(name for name in layers if name != LOG_ODDS)
        stage = ChunkStore.create(staging, header, chunks, grows=True, layers=others)
        stage.write(layers)
        stage.fill(new)
        if not grown:
            os.replace(staging, path)
            return
        for name in (*others, LOG_ODDS):
            if name != LOG_ODDS:
                _move(staging, path, Path(name, _DOCUMENT))
            for chunk in new.tolist():
                _move(staging, path, stage.file_of(name, chunk))
        if added:
            for file in sorted((staging / CHUNKS / "c").glob("*/0")):
                _move(staging, path, file.relative_to(staging))
            _move(staging, path, Path(CHUNKS, _DOCUMENT))
    except OSError as error:
        raise MapFileError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _listed(path: Path) -> NDArray[np.int32]:
    store = ChunkStore.open(path)
    if not store.grows:
        raise MapFileError(f"{path}: its array is as large as its map: no chunk can be added to it")
    return store.chunks


def _move(staging: Path, path: Path, file: Path) -> None:
    """Move a file of the staged store to its place. zarr writes none for an extra layer without values."""
    if (staging / file).exists():
        (path / file).parent.mkdir(parents=True, exist_ok=True)
        os.replace(staging / file, path / file)
    else:
        (path / file).unlink(missing_ok=True)
