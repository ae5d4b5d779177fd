"""Maps in chunks whose documents or chunks are not what this package writes: each is refused in one line."""

import copy
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taichi_mrf.config.schema import Config
from taichi_mrf.errors import MapFileError, TaichiMRFError
from taichi_mrf.export.chunk_store import ChunkStore
from taichi_mrf.export.store_header import StoreHeader
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.voxels.layers import LOG_ODDS, BrickValues

zarr = pytest.importorskip("zarr", reason="maps in chunks need the extra store")

ODD_VALUES: list[Any] = [
    None,
    True,
    "",
    "text",
    -1,
    0,
    1e300,
    float("nan"),
    float("inf"),
    10**30,
    [],
    {},
    [[1]],
]
CHUNK = (0, 0, 0)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("store") / "map.zarr"
    store = ChunkStore.create(
        path, StoreHeader.of(Config(), -2.0, -8.9, 0.05), np.array([CHUNK, (0, 1, 0)], np.int32)
    )
    for chunk in store.chunks.tolist():
        block = np.random.default_rng(0).normal(size=(64, 64, 64)).astype(np.float32)
        store.write({LOG_ODDS: BrickValues.of_chunk(tuple(chunk), block)})
    return path


@pytest.fixture
def store(good: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "map.zarr"))


def refusal(path: Path) -> str | None:
    try:
        ChunkedMap.open(path).log_odds(np.zeros((1, 3)))
    except TaichiMRFError as error:
        return str(error)
    return None


def everything(path: Path) -> None:
    ChunkedMap.open(path).voxels()


def places_in(document: Any) -> list[tuple[Any, ...]]:
    """The path of every value in a document."""
    items = document.items() if isinstance(document, dict) else enumerate(document)
    found: list[tuple[Any, ...]] = []
    for key, value in items:
        found.append((key,))
        if isinstance(value, dict | list):
            found += [(key, *below) for below in places_in(value)]
    return found


@pytest.mark.parametrize("name", ["", "log_odds", "chunks"])
def test_no_value_of_a_document_can_do_harm(store: Path, name: str) -> None:
    """Every value is replaced by each odd one: what is read is sound, or one line says what is wrong."""
    everything(store)
    file = store / name / "zarr.json"
    document = json.loads(file.read_text())
    refused = 0
    for place in places_in(document):
        for odd in ODD_VALUES:
            changed = copy.deepcopy(document)
            parent = changed
            for key in place[:-1]:
                parent = parent[key]
            parent[place[-1]] = odd
            file.write_text(json.dumps(changed))
            said = refusal(store)
            if said is not None:
                assert str(store) in said
                assert "\n" not in said
                refused += 1
    assert refused > 50


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d["attributes"].update(voxel_size=1e300), "voxel_size is 1e"),
        (lambda d: d["attributes"].update(voxel_size=0.06), "voxel_size is 0.06, in its configuration 0.05"),
        (lambda d: d["attributes"].update(min_evidence=-1), "min_evidence is -1"),
        (lambda d: d["attributes"].pop("prior_log_odds"), "prior_log_odds is missing"),
        (lambda d: d["attributes"].update(lowest_chunk=[0, 0.5, 0]), "lowest_chunk must be 3 whole numbers"),
        (lambda d: d["attributes"].update(lowest_chunk=[9, 0, 0]), "or one outside of the array"),
        (lambda d: d.update(zarr_format=2), "does not describe a zarr 3 group"),
    ],
)
def test_what_is_wrong_is_named(store: Path, change: Callable[[dict[str, Any]], object], said: str) -> None:
    document = json.loads((store / "zarr.json").read_text())
    change(document)
    (store / "zarr.json").write_text(json.dumps(document))
    with pytest.raises(MapFileError, match=said):
        everything(store)


def test_a_lost_chunk_is_named_and_is_unknown_in_stores_of_earlier_versions(store: Path) -> None:
    (store / "log_odds/c/0/1/0").unlink()
    with pytest.raises(MapFileError, match=r"log_odds/c/0/1/0: damaged: there is no such file"):
        everything(store)
    document = json.loads((store / "zarr.json").read_text())
    del document["attributes"]["every_chunk_stored"]
    (store / "zarr.json").write_text(json.dumps(document))
    assert np.isfinite(ChunkStore.open(store).read(LOG_ODDS, CHUNK)).all()
    assert np.isnan(ChunkStore.open(store).read(LOG_ODDS, (0, 1, 0))).all()


@pytest.mark.parametrize(("file", "said"), [("log_odds/c/0/0/0", "log_odds of chunk"), ("chunks/c/0/0", "")])
def test_a_changed_bit_is_told_or_changes_nothing(store: Path, file: str, said: str) -> None:
    def contents() -> list[np.ndarray]:
        again = ChunkStore.open(store)
        return [again.chunks, *(again.read(LOG_ODDS, chunk) for chunk in again.chunks)]

    whole, expected, told = (store / file).read_bytes(), contents(), []
    bits = {*range(8 * 18), *np.random.default_rng(0).integers(0, 8 * len(whole), 100).tolist()}
    for bit in (bit for bit in bits if bit < 8 * len(whole)):
        changed = bytearray(whole)
        changed[bit // 8] ^= 1 << bit % 8
        (store / file).write_bytes(changed)
        try:
            found = contents()
        except MapFileError as error:
            told.append(str(error))
        else:  # a bit of the header that has no meaning
            for one, other in zip(found, expected, strict=True):
                np.testing.assert_array_equal(one, other)
    assert all(said in text or file in text for text in told)
    assert len(told) > min(len(bits), 8 * len(whole)) // 2


@pytest.mark.skipif(os.name == "nt", reason="FIFOs are a POSIX feature")
@pytest.mark.parametrize(
    "file", ["zarr.json", "log_odds/zarr.json", "chunks/zarr.json", "log_odds/c/0/0/0", "chunks/c/0/0"]
)
def test_a_fifo_in_a_store_is_refused(store: Path, file: str) -> None:
    (store / file).unlink()
    os.mkfifo(store / file)
    with pytest.raises(MapFileError, match=f"{file}: cannot be read: it is a FIFO"):
        everything(store)


@pytest.mark.parametrize("file", ["log_odds/c/0/0/0", "chunks/c/0/0"])
def test_a_packed_chunk_that_holds_more_than_a_chunk_is_not_unpacked(store: Path, file: str) -> None:
    codec = pytest.importorskip("numcodecs.zstd").Zstd()
    (store / file).write_bytes(codec.encode(bytes(100_000_000)))
    with pytest.raises(MapFileError, match=rf"{file}: damaged: it does not hold [\d,]+ bytes"):
        everything(store)
    (store / file).write_bytes(b"not packed at all")
    with pytest.raises(MapFileError, match=f"{file}: damaged"):
        everything(store)
