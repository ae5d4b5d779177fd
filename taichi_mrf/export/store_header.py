"""The metadata of a map in chunks, checked before zarr uses it.

zarr trusts these documents, which determine how much memory is allocated, which files are opened and how
they are unpacked. So only what this package writes is accepted.
"""

import json
import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import taichi_mrf
from taichi_mrf.config.schema import Config, to_yaml
from taichi_mrf.errors import MapFileError, said
from taichi_mrf.geometry.up import UP_NAMES, Up, up_name
from taichi_mrf.system.files import check_regular, exists, open_regular, read_text
from taichi_mrf.voxels.layers import LAYERS, LOG_ODDS
from taichi_mrf.voxels.layout import CHUNK_VOXELS

FORMAT = 1
FORMAT_KEY = "taichi_mrf_map"
CHUNKS = "chunks"
EVERY_CHUNK = "every_chunk_stored"

_MOST_BYTES = 1_000_000
_LARGEST_VOXEL_M = 1000.0
_LARGEST_LOG_ODDS = 1000.0
_MOST_CHUNKS_ACROSS = 1 << 24
_KEYS = {"name": "default", "configuration": {"separator": "/"}}


@dataclass(frozen=True)
class StoreHeader:
    """Properties of all voxels: ``voxel_size`` in metres, the log-odds of the prior and of space that was
    seen to be free without a surface near, the evidence from which a voxel counts as known, the configuration
    as YAML, the version of the package that made the map, and the name of the world axis that is up, empty if
    it is unknown."""

    voxel_size: float
    prior_log_odds: float
    seen_free_log_odds: float
    min_evidence: float
    config: str
    version: str
    up: str = ""

    @staticmethod
    def of(
        config: Config,
        prior_log_odds: float,
        seen_free_log_odds: float,
        min_evidence: float,
        up: Up | None = None,
    ) -> "StoreHeader":
        """The header of a map that this version has made with a configuration."""
        return StoreHeader(
            voxel_size=config.voxel_size,
            prior_log_odds=prior_log_odds,
            seen_free_log_odds=seen_free_log_odds,
            min_evidence=min_evidence,
            config=to_yaml(config),
            version=taichi_mrf.__version__,
            up=up_name(up) if up else "",
        )


@dataclass(frozen=True)
class StoreLayout:
    """The header, the first of the chunks that there is room for, (3,), how many there are along each axis,
    how many of them are listed, how many together in one file of the list, the ``layers`` beside log-odds
    that there are, and if ``every_chunk`` on the list has a file of log-odds: earlier versions left out those
    in which nothing is known."""

    header: StoreHeader
    lowest_chunk: tuple[int, int, int]
    chunks_across: tuple[int, int, int]
    listed: int
    listed_together: int
    layers: tuple[str, ...] = ()
    every_chunk: bool = False


def read_layout(folder: Path) -> StoreLayout:
    """The metadata in a store's folder. Raises MapFileError, which names folder and value."""
    attributes = _document(folder, "", "group").get("attributes")
    if not isinstance(attributes, dict) or FORMAT_KEY not in attributes:
        raise MapFileError(f"{folder}: not a map of taichi_mrf in chunks")
    if attributes[FORMAT_KEY] != FORMAT:
        found = str(attributes[FORMAT_KEY])[:20]
        raise MapFileError(f"{folder}: written in format {found}; this version reads format {FORMAT}")
    header = _header(folder, attributes)
    lowest = _whole_numbers(folder, "lowest_chunk", attributes.get("lowest_chunk"), 3, -_MOST_CHUNKS_ACROSS)
    shape, chunk_shape = _array(folder, LOG_ODDS, "float32", "NaN", 3)
    if chunk_shape != (CHUNK_VOXELS,) * 3 or any(n % CHUNK_VOXELS for n in shape):
        raise _damaged(folder, f"{LOG_ODDS} is not made of chunks of {CHUNK_VOXELS}^3 voxels")
    across = (shape[0] // CHUNK_VOXELS, shape[1] // CHUNK_VOXELS, shape[2] // CHUNK_VOXELS)
    (listed, three), together = _array(folder, CHUNKS, "int32", 0, 2)
    if (three, together[1]) != (3, 3) or listed > math.prod(across):
        raise _damaged(folder, f"{CHUNKS} has the shape ({listed}, {three})")
    layers = tuple(name for name in LAYERS if name != LOG_ODDS and exists(folder / name))
    for name in layers:
        layer = LAYERS[name]
        sides = _array(folder, name, layer.dtype, 0, 4)
        if sides != ((*shape, layer.width), (*chunk_shape, layer.width)):
            raise _damaged(folder, f"{name} is not made of the chunks of {LOG_ODDS}")
    every_chunk = attributes.get(EVERY_CHUNK, False)
    if not isinstance(every_chunk, bool):
        raise _damaged(folder, f"{EVERY_CHUNK} is not true or false")
    return StoreLayout(header, lowest, across, listed, together[0], layers, every_chunk)


def check_packed(path: Path, size: int) -> None:
    """Raise MapFileError unless a file, if it exists, is a regular one and holds ``size`` bytes, packed."""
    if not exists(path):
        return  # zarr leaves out what holds nothing
    check_regular(path, MapFileError)
    with open_regular(path, MapFileError) as file:
        claimed = _unpacked_size(file.read(18))
    if claimed != size:
        raise MapFileError(f"{path}: damaged: it does not hold {size:,} bytes in zstd's format")


def _unpacked_size(head: bytes) -> int | None:
    """The size that the header of a zstd frame states (RFC 8878, 3.1.1.1), None if it states none."""
    if len(head) < 6 or head[:4] != b"\x28\xb5\x2f\xfd":
        return None
    descriptor = head[4]
    single_segment = descriptor >> 5 & 1
    length = (single_segment, 2, 4, 8)[descriptor >> 6]
    begin = 5 + (1 - single_segment) + (0, 1, 2, 4)[descriptor & 3]
    field = head[begin : begin + length]
    if not length or len(field) < length:
        return None
    return int.from_bytes(field, "little") + (256 if length == 2 else 0)


def _header(folder: Path, attributes: dict[str, Any]) -> StoreHeader:
    attributes = {"up": "", **attributes}  # earlier versions did not save it
    for field in fields(StoreHeader):
        value = attributes.get(field.name)
        kinds = (int, float) if field.type in (float, "float") else str
        if not isinstance(value, kinds) or isinstance(value, bool):
            raise _damaged(folder, f"{field.name} is missing or of the wrong type")
        if isinstance(value, int | float) and not abs(value) <= _LARGEST_LOG_ODDS:
            raise _damaged(folder, f"{field.name} is {value:g}")
    header = StoreHeader(**{field.name: attributes[field.name] for field in fields(StoreHeader)})
    if not 0 < header.voxel_size <= _LARGEST_VOXEL_M:
        raise _damaged(folder, f"voxel_size is {header.voxel_size:g}")
    if header.up not in ("", *UP_NAMES):
        raise _damaged(folder, f"up is {header.up!r}")
    if header.min_evidence < 0:
        raise _damaged(folder, f"min_evidence is {header.min_evidence:g}")
    return header


def _array(folder: Path, name: str, data_type: str, missing: object, dimensions: int) -> tuple[Any, Any]:
    """The shape of an array and of its zarr chunks; nothing else in its document may differ."""
    document = _document(folder, name, "array")
    shape = _whole_numbers(folder, f"{name}: shape", document.get("shape"), dimensions, 0)
    codecs = document.get("codecs")
    names = (
        [c.get("name") if isinstance(c, dict) else None for c in codecs] if isinstance(codecs, list) else []
    )
    if (
        (document.get("data_type"), document.get("fill_value")) != (data_type, missing)
        or document.get("chunk_key_encoding") != _KEYS
        or names != ["bytes", "zstd"]
        or document.get("storage_transformers", [])
    ):
        raise _damaged(folder, f"{name} is not stored as {data_type} in zstd's format")
    grid = document.get("chunk_grid")
    settings = grid.get("configuration") if isinstance(grid, dict) and grid.get("name") == "regular" else None
    chunk_shape = settings.get("chunk_shape") if isinstance(settings, dict) else None
    return shape, _whole_numbers(folder, f"{name}: chunk_shape", chunk_shape, dimensions, 1)


def _document(folder: Path, name: str, kind: str) -> dict[str, Any]:
    path = folder / name / "zarr.json"
    missing = "damaged: there is no such file" if name else "not a readable map in chunks"
    text = read_text(path, MapFileError, missing, _MOST_BYTES)
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise MapFileError(f"{path}: damaged: {said(error)}") from error
    if not isinstance(document, dict) or (document.get("zarr_format"), document.get("node_type")) != (
        3,
        kind,
    ):
        raise MapFileError(f"{path}: damaged: it does not describe a zarr 3 {kind}")
    return document


def _whole_numbers(folder: Path, name: str, found: Any, count: int, least: int) -> Any:
    """``found`` as a tuple of ``count`` whole numbers."""
    fits = isinstance(found, list) and len(found) == count
    if not fits or not all(
        type(n) is int and least <= n <= _MOST_CHUNKS_ACROSS * CHUNK_VOXELS for n in found
    ):
        raise _damaged(folder, f"{name} must be {count} whole numbers within the limits")
    return tuple(found)


def _damaged(folder: Path, problem: str) -> MapFileError:
    return MapFileError(f"{folder}: damaged: {problem}")
