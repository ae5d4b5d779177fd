"""A map in chunks that grows during a run, and can be read at any moment.

Each file is written in a folder beside the store and moved into place: a chunk's file first, then the list
that names it. A run that is killed in between leaves the old chunk or the new one, and no chunk on the list
without its file.
"""

import os
import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import MapFileError
from taichi_mrf.export.chunk_store import FARTHEST, Chunk, ChunkStore
from taichi_mrf.export.store_header import CHUNKS, StoreHeader
from taichi_mrf.system.atomic import temporary_name
from taichi_mrf.system.files import exists

_DOCUMENT = "zarr.json"


Extras = Mapping[str, Mapping[Chunk, NDArray]]
"""By the names of EXTRAS and by chunks: (64, 64, 64, values) each."""


def put_chunks(
    path: Path, header: StoreHeader, blocks: Mapping[Chunk, NDArray[np.float32]], extras: Extras | None = None
) -> None:
    """Write some chunks, (64, 64, 64) log-odds each, NaN for unknown, into the store ``path``, which is made
    if it does not exist; chunks that are there already are replaced, as are those of their ``extras`` that
    are named. Raises MapFileError, also for a store that was not made here, and TaichiMRFError without zarr.
    """
    extras = extras or {}
    new = np.array(list(blocks), np.int32).reshape(-1, 3)
    if len(new) and max(-int(new.min()), int(new.max()) + 1) > FARTHEST:
        raise MapFileError(f"{path}: a chunk further than {FARTHEST} chunks from the origin has no place")
    grown = exists(path)
    listed = _listed(path) if grown else new[:0]
    known = set(map(tuple, listed.tolist()))
    added = [chunk for chunk in blocks if chunk not in known]
    chunks = np.concatenate([listed, np.array(added, np.int32).reshape(-1, 3)])
    staging = temporary_name(path)
    try:
        stage = ChunkStore.create(staging, header, chunks, grows=True, extras=tuple(extras))
        for chunk, block in blocks.items():
            stage.write(chunk, block)
        for name, found in extras.items():
            for chunk, values in found.items():
                stage.write_extra(name, chunk, values)
        if not grown:
            os.replace(staging, path)
            return
        for name in extras:
            _move(staging, path, Path(name, _DOCUMENT))
            for chunk in blocks:
                _move(staging, path, stage.file_of(chunk, name))
        for chunk in blocks:
            _move(staging, path, stage.file_of(chunk))
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
    """Move a file of the staged store to its place. zarr writes none for a chunk without known voxels."""
    if (staging / file).exists():
        (path / file).parent.mkdir(parents=True, exist_ok=True)
        os.replace(staging / file, path / file)
    else:
        (path / file).unlink(missing_ok=True)
