"""A finished map, read from disk in chunks of 64^3 voxels and never held in memory as a whole."""

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.arguments import real
from taichi_mrf.config.files import parse_yaml
from taichi_mrf.config.schema import Config
from taichi_mrf.config.values import from_dict
from taichi_mrf.errors import ConfigError, MapFileError, said
from taichi_mrf.export.chunk_store import CHUNK_BYTES, ChunkStore
from taichi_mrf.geometry.up import Up, up_from_name
from taichi_mrf.inference.surface_votes import called
from taichi_mrf.methods.map_file import check_registered
from taichi_mrf.methods.mrf.calibrated import calibrate, carry
from taichi_mrf.methods.stored_distances import StoredDistances
from taichi_mrf.queries.box import BoxOfVoxels, voxels_of_box
from taichi_mrf.queries.known_bricks import BRICKS_AT_ONCE
from taichi_mrf.queries.points import checked_points, classify, probability
from taichi_mrf.queries.voxel_map import PixelReader
from taichi_mrf.system import runtime, tensors
from taichi_mrf.system.memory import check_memory
from taichi_mrf.voxels.calls import WON, follow_calls
from taichi_mrf.voxels.layers import FIRST, LAYERS, LOG_ODDS, SURFACE, Chunk, pixel_layers
from taichi_mrf.voxels.layout import (
    BRICK,
    CHUNK,
    CHUNK_VOXELS,
    VOXELS,
    join_bricks,
    offsets_in_brick,
    split_bricks,
)

_BYTES_PER_VOXEL = 9
"""Log-odds, states, and temporary arrays."""

SAME_LOG_ODDS = 1e-3
"""Free space without voxels is stored by its probability, which is float32."""


def _config_of(store: ChunkStore) -> Config:
    try:
        values = parse_yaml(store.header.config)
        if isinstance(values, dict) and isinstance(values.get("method"), str):
            check_registered(store.path, values["method"])
        config = from_dict(Config, values, str(store.path), of_map=True)
    except ValueError as error:
        raise MapFileError(
            f"{store.path}: damaged: its configuration cannot be read: {said(error)}"
        ) from error
    except ConfigError as error:
        raise MapFileError(str(error)) from error
    if config.voxel_size != store.header.voxel_size:
        raise MapFileError(
            f"{store.path}: damaged: voxel_size is {store.header.voxel_size:g}, "
            f"in its configuration {config.voxel_size:g}"
        )
    return config


def _voxels_of(points: ArrayLike, voxel_size: float) -> NDArray[np.int64]:
    """The voxels that hold points (N, 3) in metres. Raises ConfigError."""
    return np.clip(np.floor(checked_points(points) / voxel_size), -(2**30), 2**30).astype(np.int64)


LogOdds = Literal["stored", "marginal", "decided", "calibrated"]
"""Kind of a chunked map's log-odds: the stored marginals', from which queries derive the decided states; the
marginals' alone; the decided ones; or the calibrated ones."""


class ChunkedMap(PixelReader):
    """Answers queries from a :class:`ChunkStore` on disk. It caches the most recently used chunks, up to
    ``cache_mb`` MB (10^6 bytes); beyond that, memory grows only with the answers."""

    def __init__(self, store: ChunkStore, cache_mb: float = 256.0, by: LogOdds = "stored") -> None:
        """Raises ConfigError for a cache smaller than one chunk."""
        self._by = by
        if not real(cache_mb, "cache_mb") * 1e6 >= CHUNK_BYTES:
            raise ConfigError(f"cache_mb must be at least {CHUNK_BYTES / 1e6:.3g}, not {cache_mb}")
        self.store, self.header = store, store.header
        self.voxel_size = store.header.voxel_size
        self.config = _config_of(store)
        self.prior = float(probability(np.array([store.header.prior_log_odds], np.float32))[0])
        self.chunks = store.chunks
        self._most = int(cache_mb * 1e6) // CHUNK_BYTES
        self._known = set(map(tuple, self.chunks.tolist()))
        self._cache: OrderedDict[Chunk, NDArray[np.float32]] = OrderedDict()
        self.read_layer = lru_cache(self._most)(store.read)

    @classmethod
    def open(cls, path: str | Path, cache_mb: float = 256.0) -> "ChunkedMap":
        """The map in a folder such as map.zarr. Raises MapFileError, TaichiMRFError without zarr."""
        return cls(ChunkStore.open(path), cache_mb)

    @property
    def holds_marginals(self) -> bool:
        """True if the log-odds are those of the marginals."""
        return self._by in ("stored", "marginal")

    @cached_property
    def decided(self) -> "ChunkedMap":
        """The map with decided states, as MRFMap.decided; itself if the store holds no votes of rays."""
        if self._by != "stored" or FIRST not in self.store.layers:
            return self
        return ChunkedMap(self.store, self._most * CHUNK_BYTES / 1e6, "decided")

    @cached_property
    def marginals(self) -> "ChunkedMap":
        """The map by its marginals alone, as MRFMap.marginals."""
        if self.decided is self:
            return self
        return ChunkedMap(self.store, self._most * CHUNK_BYTES / 1e6, "marginal")

    def calibrated(self) -> "ChunkedMap":
        """The map of calibrated probabilities, as MRFMap.calibrated. Raises ConfigError if the store does not
        hold the measurements of rays."""
        if not self.has_surface:
            raise ConfigError(
                f"{self.store.path}: holds no measurements of rays: map the recording again with "
                "--keep-surface, or export from the map.npz of a run"
            )
        return ChunkedMap(self.store, self._most * CHUNK_BYTES / 1e6, "calibrated")

    @property
    def up(self) -> Up | None:
        """The world axis that is up, None if the store does not hold it."""
        return up_from_name(self.header.up) if self.header.up else None

    @property
    def pixel_layers(self) -> "Mapping[str, StoredLayer]":
        """The layers computed from pixels that the store holds."""
        return {name: StoredLayer(self, name) for name in pixel_layers() if name in self.store.layers}

    @property
    def has_surface(self) -> bool:
        """True if the store holds the measured surface."""
        return SURFACE in self.store.layers

    @property
    def extent(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Two corners, (3,) in metres, of the box around all chunks. Raises ConfigError for an empty map."""
        if not len(self.chunks):
            raise ConfigError("the map is empty: no voxel was observed")
        side = CHUNK_VOXELS * self.voxel_size
        return self.chunks.min(axis=0) * side, (self.chunks.max(axis=0) + 1) * side

    def distances(self, first: NDArray[np.int64], after: NDArray[np.int64]) -> StoredDistances:
        """The signed distances that keyframes measured, from the voxel ``first`` to ``after`` (exclusive),
        (3,) each."""
        return StoredDistances(self.store, self.chunks, first, after)

    @tensors.in_kind("points")
    def log_odds(self, points: ArrayLike) -> NDArray[np.float32]:
        """Log-odds of occupied at (N, 3) points in metres, (N,), as in :attr:`decided`; the prior where
        nothing was observed.

        Raises ConfigError for points of another shape or that are not finite.
        """
        if self.decided is not self:
            return self.decided.log_odds(points)
        voxels = _voxels_of(points, self.voxel_size)
        out = np.full(len(voxels), self.header.prior_log_odds, np.float32)
        for chunk, rows in self.by_chunk(voxels):
            found = self._block(chunk)[tuple((voxels[rows] % CHUNK_VOXELS).T)]
            out[rows] = np.where(np.isnan(found), self.header.prior_log_odds, found)
        return out

    @tensors.in_kind("points")
    def occupancy(self, points: ArrayLike) -> NDArray[np.float32]:
        """Probability of occupied at (N, 3) points in metres, (N,) float32; the prior where nothing was
        observed."""
        return probability(self.log_odds(points))

    @tensors.in_kind("points")
    def state(self, points: ArrayLike) -> NDArray[np.int8]:
        """UNKNOWN, FREE or OCCUPIED at (N, 3) points in metres, (N,) int8."""
        return self._state(self.log_odds(points))

    def box(self, lower: ArrayLike, upper: ArrayLike) -> BoxOfVoxels:
        """The voxels that overlap a box, given by two corners, (3,) in metres each, as dense arrays, as in
        :attr:`decided`.

        Raises ConfigError for corners that make no box, CapacityError if there is not enough memory.
        """
        if self.decided is not self:
            return self.decided.box(lower, upper)
        first, after = voxels_of_box(lower, upper, self.voxel_size)
        shape = after - first
        voxels = float(np.prod(shape.astype(np.float64)))
        check_memory(_BYTES_PER_VOXEL * voxels, f"a box of {voxels / 1e6:.3g} million voxels")
        log_odds = np.full(shape, self.header.prior_log_odds, np.float32)
        for begin, block in self._cut(first, after):
            place = tuple(slice(b, b + n) for b, n in zip(begin - first, block.shape, strict=True))
            log_odds[place] = np.where(np.isnan(block), self.header.prior_log_odds, block)
        x, y, z = first.tolist()
        return BoxOfVoxels(log_odds, self._state(log_odds), (x, y, z), self.voxel_size)

    def voxels(
        self,
        lower: ArrayLike | None = None,
        upper: ArrayLike | None = None,
        min_probability: float = 0.5,
    ) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Observed voxels of at least this probability, as in :attr:`decided`, in a box (default: the whole
        map): centres (N, 3) in metres, and probabilities (N,).

        Raises ConfigError for a probability outside [0, 1] and for corners that make no box.
        """
        if not 0 <= min_probability <= 1:
            raise ConfigError(f"min_probability must lie between 0 and 1, not {min_probability}")
        if self.decided is not self:
            return self.decided.voxels(lower, upper, min_probability)
        centres: list[NDArray[np.float64]] = [np.zeros((0, 3))]
        found = [np.zeros(0, np.float32)]
        if len(self.chunks):
            low, high = self.extent
            first, after = voxels_of_box(
                low if lower is None else lower, high if upper is None else upper, self.voxel_size
            )
            for begin, block in self._cut(first, after):
                occupancy = probability(block)
                # Unknown voxels are NaN, for which the comparison is false.
                place = np.argwhere(occupancy >= min_probability)
                centres.append((place + begin + 0.5).astype(np.float64) * self.voxel_size)
                found.append(occupancy[tuple(place.T)])
        return np.concatenate(centres), np.concatenate(found)

    def blocks(self, lower: ArrayLike, upper: ArrayLike) -> Iterator[tuple[Chunk, NDArray[np.float32]]]:
        """The chunks that overlap a box in metres, each with (64, 64, 64) log-odds, NaN for unknown."""
        first, after = voxels_of_box(lower, upper, self.voxel_size)
        for chunk in self._chunks_between(first, after):
            yield chunk, self._block(chunk)

    def _state(self, log_odds: NDArray[np.float32]) -> NDArray[np.int8]:
        return classify(log_odds, self.header.prior_log_odds, self.header.min_evidence)

    def by_chunk(self, voxels: NDArray[np.int64]) -> Iterator[tuple[Chunk, NDArray[np.int64]]]:
        """The known chunks that hold some of the voxels (n, 3), each with the rows of these."""
        chunks, owner = np.unique(voxels // CHUNK_VOXELS, axis=0, return_inverse=True)
        for number, (x, y, z) in enumerate(chunks.tolist()):
            if (x, y, z) in self._known:
                yield (x, y, z), np.flatnonzero(owner.reshape(-1) == number)

    def _chunks_between(self, first: NDArray[np.int64], after: NDArray[np.int64]) -> list[Chunk]:
        inside = (self.chunks >= first // CHUNK_VOXELS) & (self.chunks <= (after - 1) // CHUNK_VOXELS)
        return [(x, y, z) for x, y, z in self.chunks[inside.all(axis=1)].tolist()]

    def _cut(
        self, first: NDArray[np.int64], after: NDArray[np.int64]
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float32]]]:
        """The parts of chunks inside a box of voxels, each with its lowest voxel."""
        for chunk in self._chunks_between(first, after):
            corner = np.array(chunk, np.int64) * CHUNK_VOXELS
            begin, end = np.maximum(first, corner), np.minimum(after, corner + CHUNK_VOXELS)
            cut = tuple(slice(b, e) for b, e in zip(begin - corner, end - corner, strict=True))
            yield begin, self._block(chunk)[cut]

    def _block(self, chunk: Chunk) -> NDArray[np.float32]:
        if chunk not in self._cache:
            block = self._read_by_rays(chunk, self.store.read(LOG_ODDS, chunk))
            self._cache[chunk] = block
            while len(self._cache) > self._most:
                self._cache.popitem(last=False)
        self._cache.move_to_end(chunk)
        return self._cache[chunk]

    def _read_by_rays(self, chunk: Chunk, block: NDArray[np.float32]) -> NDArray[np.float32]:
        """Log-odds of a chunk by the rule of the map, from the marginals'; NaN for unknown."""
        if self.holds_marginals:
            return block
        prior, min_evidence = self.header.prior_log_odds, self.header.min_evidence
        unknown = np.isnan(block)
        shown = np.where(unknown, np.float32(prior), block)
        likely = self._calibrated_chunk(chunk, shown) if self.has_surface else shown
        if self._by == "decided":
            least = called(prior, min_evidence)
            calls = np.where(unknown, np.uint8(0), self.store.read(FIRST, chunk).reshape(unknown.shape))
            shown[calls == WON] = np.maximum(shown[calls == WON], least)
            if self.has_surface:
                carry(likely.reshape(-1), shown.reshape(-1), prior, min_evidence, least)
            follow_calls(calls, shown, prior, least)
        else:
            shown = likely
        return np.where(unknown & (shown == np.float32(prior)), np.float32(np.nan), shown)

    def _calibrated_chunk(self, chunk: Chunk, block: NDArray[np.float32]) -> NDArray[np.float32]:
        """Calibrated log-odds of a chunk's voxels, from the marginals'."""
        runtime.init()
        first = np.array(chunk, np.int64) * CHUNK
        log_odds, places = split_bricks(block), np.indices((CHUNK,) * 3).reshape(3, -1).T
        # Free space away from surfaces has no voxels, and stays as it is, as does what is unknown.
        away = np.abs(log_odds - self.header.seen_free_log_odds) < SAME_LOG_ODDS
        away |= log_odds == np.float32(self.header.prior_log_odds)
        near = np.flatnonzero(~away.all(axis=1)).astype(np.int32)
        field = self.distances((first - 1) * BRICK, (first + CHUNK + 1) * BRICK).field()
        bricks = (places[near] + first).astype(np.int32)
        calibrate(field, bricks, near, log_odds.reshape(-1), self.header.prior_log_odds)
        return join_bricks(log_odds, block.shape)


class StoredLayer:
    """A layer of a store that pixels feed. ``bricks`` (slots, 3) are those of a part of the map."""

    def __init__(self, source: ChunkedMap, name: str, bricks: NDArray[np.int32] | None = None) -> None:
        self._source, self._name, self._bricks = source, name, bricks

    def __bool__(self) -> bool:
        """Always True: a store has the layers that it was made with."""
        return True

    def at(self, points: ArrayLike) -> NDArray:
        """Values (N, ...) of the voxels that hold points (N, 3) in metres; 0 for none. Raises ConfigError for
        points of another shape or that are not finite."""
        voxels, layer = _voxels_of(points, self._source.voxel_size), LAYERS[self._name]
        out = np.zeros((len(voxels), *layer.shape), layer.dtype)
        for chunk, rows in self._source.by_chunk(voxels):
            block = self._source.read_layer(self._name, chunk)
            out[rows] = block[tuple((voxels[rows] % CHUNK_VOXELS).T)]
        return out

    def within(self, slots: NDArray[np.int32]) -> NDArray:
        """Values of the voxels of some bricks of a part, (n,) slots -> (n, 512, ...); 0 where a slot is
        -1."""
        assert self._bricks is not None
        layer = LAYERS[self._name]
        out = np.zeros((len(slots), VOXELS, *layer.shape), layer.dtype)
        here = np.flatnonzero(slots >= 0)
        for begin in range(0, len(here), BRICKS_AT_ONCE):
            rows = here[begin : begin + BRICKS_AT_ONCE]
            voxels = self._bricks[slots[rows]].astype(np.float64)[:, None] * BRICK + offsets_in_brick() + 0.5
            found = self.at(voxels.reshape(-1, 3) * self._source.voxel_size)
            out[rows] = found.reshape(-1, *out.shape[1:])
        return out
