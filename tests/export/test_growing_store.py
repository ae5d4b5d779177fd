"""A map in chunks that grows: it can be read at any moment, whatever interrupts the writing."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taichi_mrf.config.schema import Config
from taichi_mrf.errors import MapFileError
from taichi_mrf.export.chunk_store import ChunkStore, StoreHeader
from taichi_mrf.export.growing_store import put_chunks
from taichi_mrf.methods.chunked import ChunkedMap

pytest.importorskip("zarr", reason="maps in chunks need the extra store")

HEADER = StoreHeader.of(Config(), -2.0, -8.9, 0.05)
A, B, C = (0, 0, 0), (-7, 4000, 1), (2, 0, -1)


def block(value: float) -> np.ndarray:
    found = np.full((64, 64, 64), value, np.float32)
    found[:32] = np.nan
    return found


def values(path: Path) -> dict[tuple[int, ...], float]:
    """What a reader finds: one value for each chunk."""
    store = ChunkedMap.open(path).store
    return {tuple(chunk): float(np.nanmax(store.read(chunk))) for chunk in store.chunks.tolist()}


def test_chunks_are_added_and_replaced(tmp_path: Path) -> None:
    path = tmp_path / "map.zarr"
    put_chunks(path, HEADER, {})
    assert values(path) == {}
    put_chunks(path, HEADER, {A: block(1), B: block(2)})
    assert values(path) == {A: 1, B: 2}
    put_chunks(path, HEADER, {C: block(3), A: block(4)})
    assert values(path) == {A: 4, B: 2, C: 3}
    m = ChunkedMap.open(path)
    np.testing.assert_array_equal(m.extent[0], np.array([-7, 0, -1]) * 64 * m.voxel_size)
    assert [p.name for p in tmp_path.iterdir()] == ["map.zarr"]


@pytest.mark.parametrize("moves", range(8))
def test_an_interrupted_write_leaves_the_old_chunk_or_the_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moves: int
) -> None:
    path = tmp_path / "map.zarr"
    put_chunks(path, HEADER, {A: block(1), B: block(2)})
    replace, left = os.replace, [moves]

    def move_or_be_interrupted(source: Any, target: Any) -> None:
        if Path(target).is_relative_to(path):
            if left[0] == 0:
                raise KeyboardInterrupt
            left[0] -= 1
        replace(source, target)

    monkeypatch.setattr(os, "replace", move_or_be_interrupted)
    try:
        put_chunks(path, HEADER, {A: block(10), C: block(30)})
        assert moves >= 4
    except KeyboardInterrupt:
        assert moves < 4
    found = values(path)
    assert found[A] == (10 if moves > 0 else 1)
    assert found[B] == 2
    assert found.get(C, 30) == 30
    assert (C in found) == (moves >= 4)
    assert [p.name for p in tmp_path.iterdir()] == ["map.zarr"]


def test_a_store_of_fixed_size_is_not_added_to(tmp_path: Path) -> None:
    path = tmp_path / "map.zarr"
    ChunkStore.create(path, HEADER, np.array([A], np.int32))
    with pytest.raises(MapFileError, match="no chunk can be added to it"):
        put_chunks(path, HEADER, {B: block(1)})


def test_a_chunk_out_of_reach_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match="has no place"):
        put_chunks(tmp_path / "map.zarr", HEADER, {(1 << 17, 0, 0): block(1)})
