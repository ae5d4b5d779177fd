"""A map in chunks that grows: it can be read at any moment, whatever interrupts the writing."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taichi_mrf.cluster.submaps.round_files import RoundResult, SubmapReport, read_layer, write_round
from taichi_mrf.config.schema import Config
from taichi_mrf.errors import MapFileError
from taichi_mrf.export.chunk_store import ChunkStore, StoreHeader, put_chunks
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.voxels.layers import LAYERS, LOG_ODDS, BrickValues, Chunk, Layer, Layers

pytest.importorskip("zarr", reason="maps in chunks need the extra store")

HEADER = StoreHeader.of(Config(), -2.0, -8.9, 0.05)
A, B, C = (0, 0, 0), (-7, 4000, 1), (2, 0, -1)


def put(path: Path, values: dict[Chunk, float]) -> None:
    """Put chunks of one value each, unknown in one half, into a store."""
    put_chunks(path, HEADER, np.array(list(values), np.int32), layers_of(LOG_ODDS, values))


def layers_of(name: str, values: dict[Chunk, float]) -> Layers:
    layer, bricks, dense = LAYERS[name], [np.zeros((0, 3), np.int32)], []
    for chunk, value in values.items():
        block = np.full(layer.chunk_shape, value, layer.dtype)
        block[:32] = layer.missing
        found = BrickValues.of_chunk(chunk, block)
        bricks, dense = [*bricks, found.bricks], [*dense, found.values]
    none = np.zeros((0, 512, *layer.shape), layer.dtype)
    return {name: BrickValues(np.concatenate(bricks), np.concatenate([none, *dense]))}


def values(path: Path) -> dict[tuple[int, ...], float]:
    """A reader's find: one value for each chunk."""
    store = ChunkedMap.open(path).store
    return {tuple(chunk): float(np.nanmax(store.read(LOG_ODDS, chunk))) for chunk in store.chunks.tolist()}


def test_chunks_are_added_and_replaced(tmp_path: Path) -> None:
    path = tmp_path / "map.zarr"
    put(path, {})
    assert values(path) == {}
    put(path, {A: 1, B: 2})
    assert values(path) == {A: 1, B: 2}
    put(path, {C: 3, A: 4})
    assert values(path) == {A: 4, B: 2, C: 3}
    m = ChunkedMap.open(path)
    np.testing.assert_array_equal(m.extent[0], np.array([-7, 0, -1]) * 64 * m.voxel_size)
    assert [p.name for p in tmp_path.iterdir()] == ["map.zarr"]


@pytest.mark.parametrize("moves", range(8))
def test_an_interrupted_write_leaves_the_old_chunk_or_the_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moves: int
) -> None:
    path = tmp_path / "map.zarr"
    put(path, {A: 1, B: 2})
    replace, left = os.replace, [moves]

    def move_or_be_interrupted(source: Any, target: Any) -> None:
        if Path(target).is_relative_to(path):
            if left[0] == 0:
                raise KeyboardInterrupt
            left[0] -= 1
        replace(source, target)

    monkeypatch.setattr(os, "replace", move_or_be_interrupted)
    try:
        put(path, {A: 10, C: 30})
        assert moves >= 4
    except KeyboardInterrupt:
        assert moves < 4
    found = values(path)
    assert found[A] == (10 if moves > 0 else 1)
    assert found[B] == 2
    assert found.get(C, 30) == 30
    assert (C in found) == (moves >= 4)
    assert [p.name for p in tmp_path.iterdir()] == ["map.zarr"]


def test_a_chunk_that_is_lost_is_told_from_one_of_which_nothing_is_known(tmp_path: Path) -> None:
    path = tmp_path / "map.zarr"
    put(path, {A: 1, B: 2})
    put_chunks(path, HEADER, np.array([A, C], np.int32), layers_of(LOG_ODDS, {}))
    store = ChunkStore.open(path)
    assert np.isnan(store.read(LOG_ODDS, A)).all()
    assert np.isnan(store.read(LOG_ODDS, C)).all()
    lost = path / store.file_of(LOG_ODDS, C)
    lost.unlink()
    with pytest.raises(MapFileError, match="there is no such file, which holds a part of the map") as told:
        store.read(LOG_ODDS, C)
    assert str(lost) in str(told.value)
    assert np.nanmax(store.read(LOG_ODDS, B)) == 2


def test_a_store_of_fixed_size_is_not_added_to(tmp_path: Path) -> None:
    path = tmp_path / "map.zarr"
    ChunkStore.create(path, HEADER, np.array([A], np.int32))
    with pytest.raises(MapFileError, match="no chunk can be added to it"):
        put(path, {B: 1})


def test_a_chunk_out_of_reach_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match="from the origin does not fit"):
        put(tmp_path / "map.zarr", {(1 << 17, 0, 0): 1})


def test_a_new_layer_is_one_entry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(LAYERS, "age", Layer("float32", 2, 0, "seconds, and their deviation"))
    grown, fixed, values = tmp_path / "grown.zarr", tmp_path / "fixed.zarr", {A: 3.0, C: 5.0}
    ages = layers_of("age", values)
    put_chunks(grown, HEADER, np.array(list(values), np.int32), {**layers_of(LOG_ODDS, values), **ages})
    ChunkStore.create(fixed, HEADER, np.array([A, C], np.int32), layers=["age"]).write(ages)
    for path in (grown, fixed):
        store = ChunkStore.open(path)
        assert store.layers == (LOG_ODDS, "age")
        assert {c: store.read("age", c)[63, 0, 0].tolist() for c in values} == {A: [3, 3], C: [5, 5]}
        assert not store.read("age", A)[:32].any()
    report = SubmapReport(0, 0, 1, 1, 1, 0, 0, 0.0, 0.0, 0.0, None)
    bricks = np.zeros((0, 3), np.int32)
    nothing = RoundResult(bricks, np.zeros((0, 512), np.float32), bricks, {}, report, ages)
    write_round(tmp_path / "round.npz", nothing)
    again = read_layer(tmp_path / "round.npz", "age")
    np.testing.assert_array_equal(again.bricks, ages["age"].bricks)
    np.testing.assert_array_equal(again.values, ages["age"].values)
