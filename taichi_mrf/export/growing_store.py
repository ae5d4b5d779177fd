"""A map in chunks that grows during a run, and can be read at any moment.

Each file is written in a folder beside the store and moved into place: a chunk's file first, then the list
that names it. A run that is killed in between leaves the old chunk or the new one, and no chunk on the list
without its file.
"""

import os
import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import MapFileError
from taichi_mrf.export.chunk_store import FARTHEST, ChunkStore
from taichi_mrf.export.store_header import CHUNKS, StoreHeader
from taichi_mrf.system.atomic import temporary_name
from taichi_mrf.system.files import exists
from taichi_mrf.voxels.layers import LOG_ODDS, Layers

_DOCUMENT = "zarr.json"


def put_chunks(path: Path, header: StoreHeader, put: NDArray[np.int32], layers: Layers) -> None:
    """Write the layers of some chunks ``put`` (n, 3) into the store ``path``, which is made if it does not
    exist; of chunks that are there already the named layers are replaced. Raises MapFileError, also for a
    store that was not made here, and TaichiMRFError without zarr."""
    new = put.reshape(-1, 3)
    if len(new) and max(-int(new.min()), int(new.max()) + 1) > FARTHEST:
        raise MapFileError(f"{path}: a chunk further than {FARTHEST} chunks from the origin has no place")
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
    """Move a file of the staged store to its place. zarr writes none for a chunk without known voxels."""
    if (staging / file).exists():
        (path / file).parent.mkdir(parents=True, exist_ok=True)
        os.replace(staging / file, path / file)
    else:
        (path / file).unlink(missing_ok=True)
