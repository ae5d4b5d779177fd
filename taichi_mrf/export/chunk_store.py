"""A map as a chunked array on disk, in zarr 3, for maps that are larger than memory.

The folder is a zarr group. Its array ``log_odds`` (x, y, z) float32 has a zarr chunk for each chunk of 64^3
voxels, NaN where nothing is known, and nothing on disk where a whole chunk is unknown. ``chunks`` (n, 3)
int32 lists the chunks that there are, in the world's coordinates: chunk c covers the voxels from 64 c up to,
but without, 64 (c + 1). The attributes say the rest: see :class:`StoreHeader`, and ``origin_m``, the outer
corner of the array's first voxel.
"""

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import taichi_mrf
from taichi_mrf.config.schema import Config, to_yaml
from taichi_mrf.errors import MapFileError, said
from taichi_mrf.system.atomic import temporary_name
from taichi_mrf.system.files import exists, is_file, is_folder
from taichi_mrf.system.libraries import library
from taichi_mrf.voxels.layout import CHUNK_VOXELS

FORMAT = 1
SUFFIX = ".zarr"
CHUNK_BYTES = 4 * CHUNK_VOXELS**3
LOG_ODDS, CHUNKS = "log_odds", "chunks"

Chunk = tuple[int, int, int]


@dataclass(frozen=True)
class StoreHeader:
    """What holds for all voxels: ``voxel_size`` in metres, the log-odds of the prior and of space that was
    seen to be free without a surface near, the evidence from which a voxel counts as known, the configuration
    as YAML and the version of the package that made the map."""

    voxel_size: float
    prior_log_odds: float
    seen_free_log_odds: float
    min_evidence: float
    config: str
    version: str

    @staticmethod
    def of(config: Config, prior_log_odds: float, min_evidence: float) -> "StoreHeader":
        """The header of a map that this version has made with a configuration."""
        return StoreHeader(
            voxel_size=config.voxel_size,
            prior_log_odds=prior_log_odds,
            seen_free_log_odds=prior_log_odds - config.inference.message_clamp,
            min_evidence=min_evidence,
            config=to_yaml(config),
            version=taichi_mrf.__version__,
        )


class ChunkStore:
    """The chunks of a map on disk. Each is read and written by itself; different chunks may be written by
    different processes at the same time."""

    def __init__(self, path: Path, group: Any, header: StoreHeader) -> None:
        """As :meth:`create` and :meth:`open` make it."""
        self.path, self.header, self._group = path, header, group
        self._array = group[LOG_ODDS]
        self._lowest = np.array(group.attrs["lowest_chunk"], np.int64)

    @classmethod
    def create(cls, path: str | Path, header: StoreHeader, chunks: NDArray[np.int32]) -> "ChunkStore":
        """An empty store with room for the box around some chunks, (n, 3); they are to be written next.

        Raises MapFileError if it cannot be written, TaichiMRFError without zarr.
        """
        zarr = library("zarr", "maps in chunks need", "store")
        path = Path(path)
        lowest, highest = (
            (chunks.min(axis=0), chunks.max(axis=0)) if len(chunks) else (np.zeros(3), np.zeros(3))
        )
        shape = (highest - lowest + 1).astype(int) * CHUNK_VOXELS
        origin_m = lowest * CHUNK_VOXELS * header.voxel_size
        place = {"lowest_chunk": lowest.astype(int).tolist(), "origin_m": origin_m.tolist()}
        try:
            group = zarr.create_group(
                store=str(path), attributes={"taichi_mrf_map": FORMAT, **asdict(header), **place}
            )
            group.create_array(
                LOG_ODDS, shape=tuple(shape.tolist()), chunks=(CHUNK_VOXELS,) * 3, dtype="float32",
                fill_value=float("nan"), dimension_names=("x", "y", "z"),
            )  # fmt: skip
            group.create_array(CHUNKS, data=np.ascontiguousarray(chunks, np.int32).reshape(-1, 3))
        except OSError as error:
            raise MapFileError(f"{path}: cannot be written: {error.strerror or error}") from error
        return cls(path, group, header)

    @classmethod
    def open(cls, path: str | Path) -> "ChunkStore":
        """A store that there is. Raises MapFileError, naming what is wrong, TaichiMRFError without zarr."""
        zarr = library("zarr", "maps in chunks need", "store")
        path = Path(path)
        if not is_folder(path):
            raise MapFileError(f"{path}: there is no such folder")
        try:
            group = zarr.open_group(store=str(path), mode="r+")
            found = group.attrs.get("taichi_mrf_map")
            if found is None:
                raise MapFileError(f"{path}: not a map of taichi_mrf in chunks")
            if found != FORMAT:
                raise MapFileError(f"{path}: written in format {found}; this version reads format {FORMAT}")
            header = StoreHeader(**{field.name: group.attrs[field.name] for field in fields(StoreHeader)})
            return cls(path, group, header)
        except KeyError as error:
            raise MapFileError(f"{path}: damaged: it lacks {error}") from error
        except (OSError, ValueError, TypeError) as error:
            raise MapFileError(f"{path}: not a readable map in chunks: {error}") from error

    @property
    def chunks(self) -> NDArray[np.int32]:
        """The chunks (n, 3) in which something is known. Raises MapFileError."""
        try:
            return np.asarray(self._group[CHUNKS][:], np.int32).reshape(-1, 3)
        except (KeyError, OSError, ValueError, TypeError, IndexError, RuntimeError) as error:
            raise MapFileError(
                f"{self.path}: damaged: its list of chunks cannot be read: {said(error)}"
            ) from error

    def write(self, chunk: Sequence[int], log_odds: NDArray[np.float32]) -> None:
        """Write one chunk, (64, 64, 64) log-odds, NaN for unknown. Raises MapFileError."""
        try:
            self._array.blocks[self._place(chunk)] = log_odds
        except OSError as error:
            raise MapFileError(f"{self.path}: cannot be written: {error.strerror or error}") from error

    def read(self, chunk: Sequence[int]) -> NDArray[np.float32]:
        """One of :attr:`chunks`, (64, 64, 64). Raises MapFileError."""
        try:
            return np.asarray(self._array.blocks[self._place(chunk)], np.float32)
        except (OSError, ValueError, RuntimeError, IndexError) as error:
            raise MapFileError(f"{self.path}: chunk {tuple(chunk)} cannot be read: {said(error)}") from error

    def _place(self, chunk: Sequence[int]) -> Chunk:
        x, y, z = (np.array(chunk, np.int64) - self._lowest).tolist()
        return x, y, z


@contextmanager
def new_store(path: str | Path) -> Iterator[Path]:
    """A folder beside ``path`` to make a store in, which takes its place when the block ends well.

    Raises MapFileError if something other than a map in chunks stands there, or if it cannot be written.
    """
    path = Path(path)
    if not is_folder(path.parent):  # zarr would make it, as no other format does
        raise MapFileError(f"{path}: cannot be written: No such file or directory")
    if exists(path) and not _is_store(path):
        raise MapFileError(f"{path}: exists, and is no map in chunks; it is left alone")
    temporary, old = temporary_name(path), temporary_name(path)
    try:
        yield temporary
        # A folder cannot take another one's place: for a moment there is none, but never half of one.
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
    finally:
        for folder in (temporary, old):
            shutil.rmtree(folder, ignore_errors=True)


def _is_store(path: Path) -> bool:
    header = path / "zarr.json"
    return is_file(header) and "taichi_mrf_map" in header.read_text("utf-8", "replace")
