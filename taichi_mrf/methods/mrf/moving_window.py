"""A window that follows the camera: what lies outside of it is frozen, written to disk and released.

With ``volume.window_m`` the memory of a map is bounded by what is near the newest keyframe:

    before a keyframe is placed    chunks that its rays cross come back into memory
    after it                       keyframes whose camera is outside of the window are frozen;
                                   chunks that are further than LEAVE windows, and that no other keyframe's
                                   rays cross, are written to disk and released;
                                   chunks in the window come back

A chunk comes back with its evidence, so inference goes on as if it had never been away. The rays of the
keyframes in the window reach further than the window, hence what is in memory does too.
"""

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import CapacityError, MapFileError
from taichi_mrf.export.chunk_blocks import header_of
from taichi_mrf.export.store_header import StoreHeader
from taichi_mrf.inference.schedule import driven
from taichi_mrf.methods.brick_registry import Bricks
from taichi_mrf.methods.mrf.inferring import freeze_keyframe, infer_steps
from taichi_mrf.methods.mrf.parked_chunk import ParkedChunk
from taichi_mrf.methods.mrf.parked_chunks import ParkedChunks, folder_beside
from taichi_mrf.methods.mrf.parts import MapParts
from taichi_mrf.methods.mrf.surfacing import measured_bricks, surface_field
from taichi_mrf.queries.known_bricks import bricks_between
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.system.libraries import library
from taichi_mrf.voxels.distance_field import DistanceField
from taichi_mrf.voxels.layers import (
    FIRST,
    LOG_ODDS,
    SURFACE,
    BrickValues,
    Chunk,
    known_log_odds,
)
from taichi_mrf.voxels.layout import BRICK, CHUNK, CHUNK_BRICKS, CHUNK_VOXELS, VOXELS, by_chunk, grid_keys

LEAVE = 1.25
"""Chunks leave memory at this many times the distance at which they come back, so that a camera that stays
about one place does not move them to and fro."""

STEP = 0.1
"""Chunks that may leave are looked for whenever the camera has moved by this share of the window."""


_AT_ONCE = 32
"""Chunks whose voxels are assembled at once, a MB each."""

_NONE = np.zeros(0, np.int64)


class MovingWindow:
    """The window of one map, ``size_m`` metres around the newest keyframe's camera."""

    def __init__(self, size_m: float, parts: MapParts) -> None:
        """Raises TaichiMRFError without zarr."""
        library("zarr", "volume.window_m needs", "store")  # fails before the run, not in the middle
        self.size_m, self._parts = size_m, parts
        self.parked = ParkedChunks()
        self._registry = parts.registry
        self._position_m: NDArray[np.float64] | None = None  # where chunks were last looked for
        self._chunks = self.parked.chunks
        self._registry.before_claim = self._fetch_crossed

    @property
    def folder(self) -> Path | None:
        """The map in chunks that holds what is outside of the window; None while nothing is."""
        return self.parked.folder

    def park_in(self, folder: str | Path) -> None:
        """Write what leaves the window to a folder, such as ``map_window.zarr``; without one it goes to a
        temporary folder. An earlier run's is replaced. Raises MapFileError."""
        self.parked.write_to(Path(folder))

    def park_beside(self, path: Path) -> None:
        """:meth:`park_in` the folder that goes with a map's file, in which the map is saved."""
        self.park_in(folder_beside(path))

    def follow(self, m: VoxelMap, position_m: NDArray[np.float64]) -> None:
        """Move the window to a position (3,): freeze the keyframes outside of it, write and release chunks,
        and bring back those that are in it. Disk errors are warnings: the map in memory is whole."""
        keyframes = self._parts.keyframes
        far = [
            id
            for id, keyframe in keyframes.items()
            if np.linalg.norm(keyframe.T_world_camera[:3, 3] - position_m) > self.size_m
        ]
        if any(keyframes[id].messages is None for id in far):
            driven(
                infer_steps(self._parts, keyframes=list(keyframes))
            )  # what is frozen cannot be swept again
        for id in far:
            freeze_keyframe(self._parts, id)
        moved = self._position_m is None or np.linalg.norm(position_m - self._position_m) > STEP * self.size_m
        if moved or far:
            self._position_m = position_m.copy()
            self._leave(m, position_m)
        near = self._chunks[self._distances(self._chunks, position_m) <= self.size_m]
        try:
            self._fetch(near)
        except (MapFileError, CapacityError) as error:
            warnings.warn(f"a chunk near the camera stays on disk: {error}", stacklevel=2)

    def save_beside(self, path: Path, m: VoxelMap) -> list[str]:
        """Make the folder beside a map's file hold the whole map; returns the names of the files of the
        chunks that are not in memory. Raises MapFileError."""
        header, parts = header_of(m), self._parts
        surface = first = None
        if parts.kept.wanted:
            self._fetch_crossed(measured_bricks(parts))
            surface = surface_field(parts) if parts.settled else parts.kept.share.field
            first = parts.decisions.calls(settled=True) if parts.settled else None
        resident = self._resident(header, surface, first)
        self.parked.complete(folder_beside(path), resident, header)
        return self.parked.names

    def saved(self, path: Path) -> None:
        """The map's file was written."""
        self.parked.tidy(folder_beside(path))

    def resume(self, path: Path, names: list[str]) -> None:
        """Go on with the chunks that a map's file names. Raises MapFileError."""
        self.parked.resume(folder_beside(path), names)
        self._chunks = self.parked.chunks

    def _fetch_crossed(self, bricks: Bricks) -> None:
        """Bring back the chunks of bricks (n, 3) that a keyframe's rays cross."""
        if len(self._chunks):
            keys = grid_keys(self._chunks)
            self._fetch(self._chunks[np.isin(keys, grid_keys(bricks // CHUNK))])

    def _fetch(self, chunks: NDArray[np.int32]) -> None:
        """Bring chunks (n, 3) back into memory."""
        try:
            for x, y, z in chunks.tolist():
                self._restore(self.parked.read((x, y, z), self._registry.voxel_size))
                self.parked.drop((x, y, z))
        finally:
            if len(chunks):
                self._chunks = self.parked.chunks

    def _restore(self, found: ParkedChunk) -> None:
        """Put what a chunk's file held back into memory."""
        registry = self._registry
        if len(found.bricks):
            slots = registry.restore(found.bricks, found.owners)
            registry.pool.write("total", slots, found.total)
            registry.pool.write("evidence", slots, found.evidence)
            if self._parts.dated is not None and found.dated is not None:
                self._parts.dated.restore_frozen(slots, *found.dated)
        registry.see_for_good(found.crossed)
        self._parts.surfels.restore(found.surfels)
        for name, share in found.shares.items():
            self._parts.layers[name].restore(share)
        self._parts.kept.restore(found.rays)

    def _leave(self, m: VoxelMap, position_m: NDArray[np.float64]) -> None:
        """Write the chunks that are outside of the window, and release them. What cannot be written stays in
        memory."""
        chunks = self._chunks_in_memory()
        chunks = chunks[self._distances(chunks, position_m) > LEAVE * self.size_m]
        chunks = chunks[~self._seen_by_keyframes(chunks)]
        if not len(chunks):
            return
        header = header_of(m)
        try:
            for first in range(0, len(chunks), _AT_ONCE):
                self._release(chunks[first : first + _AT_ONCE], header)
        except MapFileError as error:
            warnings.warn(f"the map outside the window stays in memory: {error}", stacklevel=2)

    def _release(self, chunks: NDArray[np.int32], header: StoreHeader) -> None:
        """Write chunks (n, 3) that only frozen keyframes have seen, and release them."""
        slots = self._slots_in(chunks)
        contents = self._contents(chunks, slots)
        layers = {LOG_ODDS: self._voxels(chunks, header)}
        layers |= {name: each.frozen_values(chunks) for name, each in self._parts.layers.items() if each}
        if self._parts.kept.wanted:
            layers |= self._parts.kept.share.in_chunks(chunks).layers
        self.parked.add(contents, layers, header)
        self._registry.leave(slots, chunks)
        self._parts.surfels.release(chunks)
        for layer in self._parts.layers.values():
            layer.release(chunks)
        self._parts.kept.release(chunks)
        self._chunks = self.parked.chunks

    def _contents(self, chunks: NDArray[np.int32], slots: NDArray[np.int32]) -> dict[Chunk, ParkedChunk]:
        """Contents that frozen keyframes have left in some chunks (n, 3), whose bricks are in ``slots``."""
        pool, frozen_crossed = self._registry.pool, self._registry.frozen_crossed
        pool.keep_evidence()
        if self._parts.dated is not None:  # no keyframe that is not frozen sees these chunks
            self._parts.dated.fold_for_good(slots)
        surfels = self._parts.surfels.frozen_in(chunks)
        slots_of, crossed_of = dict(by_chunk(pool.bricks[slots])), dict(by_chunk(frozen_crossed))
        surfels_of = dict(by_chunk(surfels.cells // BRICK))
        frozen = {name: layer.frozen.in_chunks(chunks) for name, layer in self._parts.layers.items()}
        rays = self._parts.kept.share.in_chunks(chunks)
        contents = {}
        for x, y, z in chunks.tolist():
            inside, chunk = slots[slots_of.get((x, y, z), _NONE)], np.array([[x, y, z]], np.int32)
            contents[x, y, z] = ParkedChunk(
                pool.bricks[inside],
                pool.read("total", inside),
                pool.read("evidence", inside),
                pool.owners[inside],
                frozen_crossed[crossed_of.get((x, y, z), _NONE)],
                None if self._parts.dated is None else self._parts.dated.read_frozen(inside),
                surfels.chosen(surfels_of.get((x, y, z), _NONE)),
                {name: share.in_chunks(chunk) for name, share in frozen.items()},
                rays.in_chunks(chunk),
            )
        return contents

    def _resident(
        self, header: StoreHeader, surface: DistanceField | None, first: NDArray[np.uint8] | None
    ) -> Iterator[tuple[NDArray[np.int32], dict[str, BrickValues]]]:
        """All chunks in memory with their layers, some at a time: those of pixels if they are known, the
        distances of ``surface``, and what rays say of voxels (slots, 512) beyond marginals, ``first``."""
        measured = np.zeros((0, 3), np.int32) if surface is None else surface.chunks
        footprints = [k.footprint for k in self._parts.keyframes.values()]
        crossed = [_distinct(each.window.bricks_of(each.crossed) // CHUNK) for each in footprints]
        chunks = _distinct(np.concatenate([self._chunks_in_memory(), measured, *crossed]))
        for begin in range(0, len(chunks), _AT_ONCE):
            some = chunks[begin : begin + _AT_ONCE]
            slots = self._slots_in(some)
            bricks, layers = self._registry.pool.bricks[slots], {}
            for name, layer in self._parts.layers.items():
                if (values := layer.stored(slots, self._parts.settled)) is not None:
                    layers[name] = BrickValues(bricks, values)
            if first is not None:
                layers[FIRST] = BrickValues(bricks, first[slots])
            if surface is not None:
                layers[SURFACE] = surface.values.in_chunks(some)
            yield some, {LOG_ODDS: self._voxels(some, header), **layers}

    def _voxels(self, chunks: NDArray[np.int32], header: StoreHeader) -> BrickValues:
        """Log-odds of the bricks in some chunks (n, 3)."""
        topology, pool = self._registry.topology, self._registry.pool
        all_bricks = _bricks_of(chunks)
        slots = topology.slots(all_bricks)
        has_voxels, is_free = slots >= 0, (slots < 0) & (topology.crossings(all_bricks) > 0)
        bricks = np.concatenate([all_bricks[has_voxels], all_bricks[is_free]])
        empty = np.full((int(is_free.sum()), VOXELS), header.seen_free_log_odds, np.float32)
        log_odds = np.concatenate([pool.read("belief", slots[has_voxels]), empty])
        return BrickValues(bricks, known_log_odds(log_odds, header.prior_log_odds))

    def _slots_in(self, chunks: NDArray[np.int32]) -> NDArray[np.int32]:
        """The slots of the bricks in some chunks (n, 3), by their coordinates."""
        pool = self._registry.pool
        slots = pool.in_order
        return slots[np.isin(grid_keys(pool.bricks[slots] // CHUNK), grid_keys(chunks))]

    def _chunks_in_memory(self) -> NDArray[np.int32]:
        """The chunks (n, 3) with voxels, or that frozen keyframes' rays cross or have measured."""
        pool, registry = self._registry.pool, self._registry
        measured = self._parts.kept.share.distances.bricks
        return _distinct(
            np.concatenate([pool.bricks[pool.in_use], registry.frozen_crossed, measured]) // CHUNK
        )

    def _seen_by_keyframes(self, chunks: NDArray[np.int32]) -> NDArray[np.bool_]:
        """True for chunks (n, 3) that rays of keyframes that are not frozen cross, (n,)."""
        registry, bricks = self._registry, _bricks_of(chunks)
        by_frozen = np.isin(grid_keys(bricks), grid_keys(registry.frozen_crossed))
        others = (registry.topology.crossings(bricks) > by_frozen).reshape(-1, CHUNK_BRICKS)
        return np.asarray(others.any(axis=1))

    def _distances(self, chunks: NDArray[np.int32], position_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Metres from a position (3,) to the nearest point of each chunk (n, 3)."""
        side_m = CHUNK_VOXELS * self._registry.voxel_size
        lower = chunks * side_m
        beside = np.maximum(np.maximum(lower - position_m, position_m - (lower + side_m)), 0.0)
        distances: NDArray[np.float64] = np.linalg.norm(beside, axis=1)
        return distances


def _distinct(chunks: NDArray[np.int32]) -> NDArray[np.int32]:
    """Each chunk (n, 3) once, ascending."""
    return chunks[np.unique(grid_keys(chunks), return_index=True)[1]]


def _bricks_of(chunks: NDArray[np.int32]) -> Bricks:
    """All bricks of some chunks, (n, 3) -> (512 n, 3), chunk after chunk."""
    offsets = bricks_between(np.zeros(3, np.int32), np.full(3, CHUNK - 1))
    return (chunks[:, None] * CHUNK + offsets).reshape(-1, 3).astype(np.int32)
