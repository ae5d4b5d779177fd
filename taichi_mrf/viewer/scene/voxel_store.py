"""The viewer's copy of the map, by chunk.

A chunk of 64^3 voxels is the unit that is sent to browsers. It holds its bricks and selects the voxels to
show, without the mapping process.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.viewer.messages import LOG_ODDS_STEP
from taichi_mrf.voxels.colors import NO_COLOR
from taichi_mrf.voxels.layers import COLORS, LOG_ODDS, Layer
from taichi_mrf.voxels.layout import BRICK, CHUNK, CHUNK_VOXELS, VOXELS, offsets_in_brick

ChunkKey = tuple[int, int, int]

_IN_BRICK = offsets_in_brick().astype(np.uint8)
_NOWHERE = -1
_SAMPLED_CHUNKS, _SAMPLED_BRICKS, _SAMPLED = 256, 64, 256
"""A sample of a map is of so many chunks at most, of so many bricks and then voxels of each."""
_BITS = VOXELS.bit_length() - 1

_LAYERS = {
    LOG_ODDS: Layer("int16", 1, -32768, "log-odds in LOG_ODDS_STEP; where they are missing nothing is shown"),
    "seen": Layer("uint8", 1, 0, "keyframes whose rays cross the voxel"),
    COLORS: Layer("uint8", 3, NO_COLOR, "red, green, blue that cameras saw"),
    "earlier": Layer("int16", 1, -32768, "log-odds before today's first keyframe, in an earlier map"),
}
"""The layers of a map as they are sent to the page; others that pixels feed are sent in colours."""

_CODES = np.stack(np.unravel_index(np.arange(CHUNK**3), (CHUNK,) * 3), axis=1).astype(np.uint8)
_CELLS = (_CODES[:, None] * BRICK + _IN_BRICK).reshape(-1, 3)
"""Coordinates in the chunk, 0..63, of each voxel of each brick: (512 * 512, 3)."""


@dataclass(frozen=True)
class Shown:
    """Voxels of one chunk: ``cells`` (n, 3) uint8 in 0..63, ``log_odds`` (n,) int16 in LOG_ODDS_STEP,
    ``seen`` (n,) uint8 keyframes, ``colors`` (n, 3) RGB that cameras saw, None if the chunk has none;
    ``earlier`` (n,) int16 log-odds of the map that a recording has joined, None if it joined none;
    ``layers`` colours (n, 3) of other layers that pixels feed."""

    cells: NDArray[np.uint8]
    log_odds: NDArray[np.int16]
    seen: NDArray[np.uint8]
    colors: NDArray[np.uint8] | None = None
    earlier: NDArray[np.int16] | None = None
    layers: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)

    @classmethod
    def of(cls, cells: NDArray[np.uint8], values: Mapping[str, NDArray]) -> "Shown":
        """Voxels with the values of layers by their names."""
        own: Any = {name: each for name, each in values.items() if name in _LAYERS}
        return cls(cells, **own, layers={name: each for name, each in values.items() if name not in _LAYERS})

    @property
    def values(self) -> dict[str, NDArray]:
        """The values of all layers that are known, by their names."""
        own = {name: getattr(self, name) for name in _LAYERS}
        return {name: each for name, each in {**own, **self.layers}.items() if each is not None}

    @property
    def is_earlier(self) -> NDArray[np.bool_]:
        """The voxels of an earlier map of which today's keyframes have said nothing, (n,)."""
        return np.zeros(len(self.cells), bool) if self.earlier is None else self.log_odds == self.earlier

    def __getitem__(self, which: slice) -> "Shown":
        """Some of the voxels."""
        return Shown.of(self.cells[which], {name: each[which] for name, each in self.values.items()})


@dataclass(frozen=True)
class Cut:
    """A plane across ``axis``: voxels beyond ``voxel`` there are hidden; if ``flipped``, those before it."""

    axis: int
    voxel: int
    flipped: bool = False

    @property
    def plane(self) -> int:
        """The open side of the voxels at the cut, in voxels."""
        return self.voxel + (not self.flipped)

    @property
    def other_side(self) -> "Cut":
        """The cut that hides what this one keeps."""
        return Cut(self.axis, self.voxel + (-1 if self.flipped else 1), not self.flipped)

    def keeps(self, coordinates: NDArray) -> NDArray[np.bool_]:
        """Which coordinates (n,) of points on the axis, in voxels, are not cut away."""
        return coordinates >= self.plane if self.flipped else coordinates <= self.plane


def facing(cells: NDArray[np.uint8], across: int = CHUNK_VOXELS) -> NDArray[np.uint8]:
    """The direction of the surface at each shown voxel (n, 3) of a chunk, from its missing neighbours:
    (a * 3 + b) * 3 + c, (n,), where a, b, c = 0..2 neighbours are missing along x, y, z. Neighbours in other
    chunks count as present. A chunk is ``across`` voxels wide, or cells, if it is they that are shown."""
    side = across + 2
    grid = np.ones((side,) * 3, np.uint8)
    grid[1:-1, 1:-1, 1:-1] = 0
    here = (cells + 1).astype(np.int32) @ np.array([side * side, side, 1], np.int32)
    there = grid.reshape(-1)
    there[here] = 1
    number = np.zeros(len(cells), np.uint8)
    for step in (side * side, side, 1):
        number *= 3
        number += 2 - there[here - step] - there[here + step]
    return number


class Chunk:
    """The bricks of one chunk, in no particular order."""

    def __init__(self) -> None:
        self._row = np.full(CHUNK**3, _NOWHERE, np.int16)
        self._codes = np.zeros(0, np.int16)
        self.values = {name: _missing(name, 0) for name in (LOG_ODDS, "seen")}
        """Values of the voxels by layer, (n, 512); colours once some are known, (n, 512, 3)."""

    def __len__(self) -> int:
        return len(self._codes)

    @property
    def bricks(self) -> NDArray[np.int32]:
        """Coordinates (n, 3) of the bricks in this chunk, 0..7."""
        return _CODES[self._codes].astype(np.int32)

    def put(self, codes: NDArray[np.int16], **values: NDArray) -> None:
        """Set some layers of the voxels of some bricks, given by their numbers in the chunk. A brick that is
        new is hidden until it has log-odds."""
        new = codes[self._row[codes] == _NOWHERE]
        self._row[new] = np.arange(len(self), len(self) + len(new))
        self._codes = np.concatenate([self._codes, new])
        for name in self.values | values:
            before = self.values.get(name, _missing(name, len(self) - len(new)))
            if len(new):
                before = np.concatenate([before, _missing(name, len(new))])
            if name in values:
                before[self._row[codes]] = values[name]
            self.values[name] = before

    def remove(self, codes: NDArray[np.int16]) -> None:
        """Remove some bricks; numbers of other bricks are ignored."""
        keep = ~np.isin(self._codes, codes)
        self._codes = self._codes[keep]
        self.values = {name: values[keep] for name, values in self.values.items()}
        self._row[:] = _NOWHERE
        self._row[self._codes] = np.arange(len(self))

    def at_least(
        self, log_odds: float, cut: Cut | None = None, rows: slice | NDArray[np.intp] = slice(None)
    ) -> Shown:
        """The voxels of at least these log-odds that are not cut away, of all bricks or those in ``rows``;
        the ``cut`` counts from the chunk."""
        every = {name: each[rows].reshape(-1, *each.shape[2:]) for name, each in self.values.items()}
        voxels = np.flatnonzero(every[LOG_ODDS] >= np.ceil(log_odds / LOG_ODDS_STEP))
        codes = self._codes[rows].astype(np.int32)
        cells = _CELLS[codes[voxels >> _BITS] << _BITS | voxels & VOXELS - 1]
        if cut is not None:
            kept = cut.keeps(cells[:, cut.axis] + 0.5)
            voxels, cells = voxels[kept], cells[kept]
        return Shown.of(cells, {name: values[voxels] for name, values in every.items()})

    def voxels(self, cells: NDArray[np.integer]) -> Shown:
        """The voxels with coordinates (n, 3), 0 to 63; those that are not here have missing values."""
        row = self._row[np.ravel_multi_index(tuple((cells // BRICK).T), (CHUNK,) * 3)]
        number, here = np.ravel_multi_index(tuple((cells % BRICK).T), (BRICK,) * 3), row != _NOWHERE
        found = {}
        for name, values in self.values.items():
            found[name] = _filled(name, len(cells))
            found[name][here] = values[row[here], number[here]]
        return Shown.of(cells.astype(np.uint8), found)

    def sample(self, log_odds: float) -> Shown:
        """Some voxels of at least these log-odds, from all over the chunk; the same in whatever order its
        bricks came."""
        shown = self.at_least(log_odds, rows=np.argsort(self._codes)[:: _step(len(self), _SAMPLED_BRICKS)])
        return shown[:: _step(len(shown.cells), _SAMPLED)]

    def voxel(self, cell: NDArray[np.integer]) -> tuple[int, NDArray[np.uint8] | None] | None:
        """The log-odds of a voxel with coordinates (3,), 0 to 63, and the colour that cameras saw, None if it
        has none; None if it is not here."""
        row = self._row[np.ravel_multi_index(tuple(cell // BRICK), (CHUNK,) * 3)]
        if row == _NOWHERE:
            return None
        number = np.ravel_multi_index(tuple(cell % BRICK), (BRICK,) * 3)
        color = self.values[COLORS][row, number] if COLORS in self.values else None
        seen = color is not None and (color != NO_COLOR).any()
        return int(self.values[LOG_ODDS][row, number]), color if seen else None

    def slab(self, axis: int, cell: int) -> tuple[NDArray[np.int32], NDArray[np.int16]]:
        """The voxels of one layer of the chunk: cells (n, 2) along the other two axes, log-odds (n,)."""
        rows = np.flatnonzero(self.bricks[:, axis] == cell // BRICK)
        voxels = np.flatnonzero(_IN_BRICK[:, axis] == cell % BRICK)
        others = [other for other in range(3) if other != axis]
        cells = _CELLS.reshape(CHUNK**3, VOXELS, 3)[np.ix_(self._codes[rows], voxels)]
        log_odds = self.values[LOG_ODDS][np.ix_(rows, voxels)]
        return cells[..., others].reshape(-1, 2).astype(np.int32), log_odds.reshape(-1)


class VoxelStore:
    """All chunks of a map."""

    def __init__(self) -> None:
        self.chunks: dict[ChunkKey, Chunk] = {}
        self._bounds: dict[ChunkKey, tuple[NDArray[np.int64], NDArray[np.int64]]] = {}
        self._samples: dict[ChunkKey, tuple[float, Shown]] = {}

    def put(self, bricks: NDArray[np.int32], **values: NDArray) -> set[ChunkKey]:
        """Take in layers of bricks (n, 3) as :class:`messages.Bricks` and :class:`messages.BrickColors` bring
        them; returns the chunks that have changed."""
        changed = set()
        for key, codes, rows in _by_chunk(bricks):
            found = {name: each[rows] for name, each in values.items()}
            self.chunks.setdefault(key, Chunk()).put(codes, **found)
            changed.add(key)
        self._forget_bounds(changed)
        return changed

    def note_earlier(self) -> None:
        """All that is here now is of an earlier map, which a recording joins."""
        for chunk in self.chunks.values():
            chunk.values["earlier"] = chunk.values[LOG_ODDS].copy()

    def voxel(self, cell: NDArray[np.integer]) -> tuple[int, NDArray[np.uint8] | None] | None:
        """The voxel (3,) of the map, as :meth:`.Chunk.voxel` has it."""
        x, y, z = (cell // CHUNK_VOXELS).tolist()
        chunk = self.chunks.get((x, y, z))
        return None if chunk is None else chunk.voxel(cell % CHUNK_VOXELS)

    def remove(self, bricks: NDArray[np.int32]) -> set[ChunkKey]:
        """Remove bricks (n, 3); returns the chunks that have changed. A chunk without bricks is removed."""
        changed = set()
        for key, codes, _ in _by_chunk(bricks):
            if key in self.chunks:
                self.chunks[key].remove(codes)
                changed.add(key)
                if not len(self.chunks[key]):
                    del self.chunks[key]
        self._forget_bounds(changed)
        return changed

    def bounds(self) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
        """Lowest and highest brick coordinates, (3,) each; None for an empty map."""
        if not self.chunks:
            return None
        for key in self.chunks.keys() - self._bounds.keys():
            bricks = self.chunks[key].bricks + np.array(key, np.int64) * CHUNK
            self._bounds[key] = bricks.min(axis=0), bricks.max(axis=0)
        lows, highs = zip(*self._bounds.values(), strict=True)
        return np.min(lows, axis=0), np.max(highs, axis=0)

    def _forget_bounds(self, changed: set[ChunkKey]) -> None:
        for key in changed:
            self._bounds.pop(key, None)
            self._samples.pop(key, None)

    def bricks(self) -> NDArray[np.int64]:
        """World coordinates (n, 3) of all bricks."""
        return np.concatenate(
            [np.zeros((0, 3), np.int64)]
            + [chunk.bricks + np.array(key, np.int64) * CHUNK for key, chunk in self.chunks.items()]
        )

    def sample(self, log_odds: float) -> tuple[Shown, NDArray[np.float64]]:
        """Some voxels of at least these log-odds, from all over the map; their centres (n, 3) in voxels."""
        keys = sorted(self.chunks)[:: _step(len(self.chunks), _SAMPLED_CHUNKS)]
        for key in keys:
            if self._samples.get(key, (None,))[0] != log_odds:
                self._samples[key] = log_odds, self.chunks[key].sample(log_odds)
        found = [self._samples[key][1] for key in keys] or [Chunk().at_least(log_odds)]
        values = {}
        known = [shown.values for shown in found]
        for name in set().union(*known):
            filled = (_filled(name, len(shown.cells)) for shown in found)
            values[name] = np.concatenate(
                [each.get(name, one) for each, one in zip(known, filled, strict=True)]
            )
        corners = np.array(keys, np.float64).reshape(-1, 3) * CHUNK_VOXELS
        many = [len(shown.cells) for shown in found]
        cells = np.concatenate([shown.cells for shown in found])
        return Shown.of(cells, values), cells + 0.5 + (np.repeat(corners, many, axis=0) if keys else 0.0)

    def shown(self, key: ChunkKey, log_odds: float, cut: Cut | None) -> Shown:
        """The voxels of a chunk with at least these log-odds that are not cut away; none if there is no such
        chunk."""
        chunk = self.chunks.get(key)
        if chunk is None:
            return Chunk().at_least(log_odds)
        if cut is not None:
            cut = replace(cut, voxel=cut.voxel - key[cut.axis] * CHUNK_VOXELS)
        return chunk.at_least(log_odds, cut)


def _step(many: int, most: int) -> int:
    """The step of a sample of ``many``. It is odd: even ones would skip planes of a brick."""
    return -(-many // most) | 1


def _missing(name: str, bricks: int) -> NDArray:
    """Values of a layer of so many bricks of which nothing is known."""
    return _filled(name, bricks, VOXELS)


def _filled(name: str, *shape: int) -> NDArray:
    layer = _LAYERS.get(name, _LAYERS[COLORS])
    return np.full((*shape, *layer.shape), layer.missing, layer.dtype)


def _by_chunk(
    bricks: NDArray[np.int32],
) -> list[tuple[ChunkKey, NDArray[np.int16], NDArray[np.intp]]]:
    """Bricks (n, 3) by chunk: its key, the bricks' numbers in it, and their rows."""
    if not len(bricks):
        return []
    keys, inverse = np.unique(bricks // CHUNK, axis=0, return_inverse=True)
    order = np.argsort(inverse.reshape(-1), kind="stable")
    ends = np.cumsum(np.bincount(inverse.reshape(-1), minlength=len(keys)))
    local = bricks % CHUNK
    codes = ((local[:, 0] * CHUNK + local[:, 1]) * CHUNK + local[:, 2]).astype(np.int16)
    return [
        ((int(key[0]), int(key[1]), int(key[2])), codes[rows], rows)
        for key, rows in zip(keys, np.split(order, ends[:-1]), strict=True)
    ]
