"""Evidence of frozen keyframes, moved from one map into another by interpolation between its voxels.

Their images are gone, so nothing can be inferred anew. The evidence of a voxel is log-odds, a sum over
keyframes. To it is added the other map's evidence at its centre, interpolated between the eight voxels
around. Signed square roots are interpolated: free space has been seen by many keyframes, and its sums would
outweigh a wall of one voxel next to it. Where too little is known, nothing is added.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.schema import Config
from taichi_mrf.errors import ConfigError
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.methods.brick_registry import Bricks
from taichi_mrf.methods.mrf.kept_rays import RayShare
from taichi_mrf.methods.mrf.moving_window import MovingWindow
from taichi_mrf.methods.mrf.parts import MapParts
from taichi_mrf.voxels.layout import BRICK, VOXELS, grid_keys, offsets_in_brick

MOST = 20.0
"""Log-odds that moved evidence has at most, those of three keyframes: its place is not known exactly."""

_KNOWN = 0.4
"""Share of what lies around a place that has to be known: a wall between two voxels is in one of them."""

_ROUNDING = 1e-4
"""Log-odds within which evidence is that of free space alone."""

_AT_ONCE = 256
"""Bricks that are read in one piece."""


@dataclass(frozen=True)
class FrozenEvidence:
    """Log-odds beyond the prior that frozen keyframes give the voxels of ``bricks`` (n, 3), which ascend:
    ``roots`` (rows, 512) are their square roots, with the sign, and ``rows`` (n,) those of the bricks. The
    last row is nothing, and stands for all other bricks."""

    bricks: Bricks
    rows: NDArray[np.intp]
    roots: NDArray[np.float32]

    @staticmethod
    def of(parts: MapParts, free: float) -> "FrozenEvidence":
        """That of a map, in which bricks that were crossed and have no voxels have the log-odds ``free``."""
        pool, crossed = parts.pool, parts.registry.frozen_crossed
        pool.keep_evidence()
        slots = pool.in_order
        said = pool.read("evidence", slots) - np.float32(pool.prior_log_odds)
        empty = crossed[~np.isin(grid_keys(crossed), grid_keys(pool.bricks[slots]))]
        bricks = np.concatenate([pool.bricks[slots], empty])
        rows = np.minimum(np.arange(len(bricks)), len(slots))
        order = np.argsort(grid_keys(bricks))
        log_odds = np.concatenate([said, np.full((1, VOXELS), free), np.zeros((1, VOXELS))])
        roots = np.sign(log_odds) * np.sqrt(np.minimum(np.abs(log_odds), MOST))
        return FrozenEvidence(bricks[order], rows[order], roots.astype(np.float32))

    def moved(self, T: Pose) -> Iterator[tuple[Bricks, NDArray[np.float32]]]:
        """The evidence after a motion (4, 4), whose translation is in voxels: bricks (n, 3), each once, and
        the log-odds (n, 512) that they get, some at a time."""
        centres, T_back = offsets_in_brick() + 0.5, inverse(T)
        reached: dict[int, tuple[int, ...]] = {}
        for begin in range(0, len(self.bricks), _AT_ONCE):
            places = (self.bricks[begin : begin + _AT_ONCE, None] * BRICK + centres).reshape(-1, 3)
            there = np.floor((places @ T[:3, :3].T + T[:3, 3]) / BRICK).astype(np.int32)
            keys, first = np.unique(grid_keys(there), return_index=True)
            reached.update(zip(keys.tolist(), map(tuple, there[first].tolist()), strict=True))
        bricks = np.array([reached[key] for key in sorted(reached)], np.int32).reshape(-1, 3)
        for begin in range(0, len(bricks), _AT_ONCE):
            some = bricks[begin : begin + _AT_ONCE]
            places = (some[:, None] * BRICK + centres).reshape(-1, 3)
            found = self._between(places @ T_back[:3, :3].T + T_back[:3, 3]).reshape(-1, VOXELS)
            told = (found != 0).any(axis=1)
            yield some[told], found[told]

    def _between(self, places: NDArray[np.float64]) -> NDArray[np.float32]:
        """The log-odds at places (N, 3), in voxels, (N,)."""
        lowest = np.floor(places - 0.5).astype(np.int32)
        share = (places - 0.5 - lowest).astype(np.float32)
        root, known = np.zeros((2, len(places)), np.float32)
        for corner in product((0, 1), repeat=3):
            weight = np.prod(np.where(corner, share, 1 - share), axis=1)
            here = self._in_voxels(lowest + np.array(corner, np.int32))
            root += weight * here
            known += weight * (here != 0)
        root /= np.maximum(known, _KNOWN)
        return np.where(known >= _KNOWN, np.sign(root) * root**2, np.float32(0))

    def _in_voxels(self, voxels: NDArray[np.int32]) -> NDArray[np.float32]:
        """The roots of voxels (N, 3), (N,)."""
        bricks = voxels // BRICK
        wanted = grid_keys(bricks)
        place = np.minimum(np.searchsorted(self._keys, wanted), len(self._keys) - 1)
        rows = np.where(self._keys[place] == wanted, self.rows[place], len(self.roots) - 1)
        x, y, z = (voxels - BRICK * bricks).T
        return self.roots[rows, (x * BRICK + y) * BRICK + z]

    @cached_property
    def _keys(self) -> NDArray[np.int64]:
        return grid_keys(self.bricks)


def add_moved(parts: MapParts, other: MapParts, free: float, T: Pose, first_id: int) -> None:
    """MRFMap.take_in: bricks of which nothing more is said than that they are ``free``, which are log-odds
    beyond the prior, get no voxels; frozen keyframes have ids from ``first_id`` on."""
    registry, pool = parts.registry, parts.pool
    pool.keep_evidence()
    in_voxels = T.copy()
    in_voxels[:3, 3] /= registry.voxel_size
    for bricks, found in FrozenEvidence.of(other, free).moved(in_voxels):
        if not len(bricks):
            continue
        registry.topology.anchor(bricks[len(bricks) // 2])
        registry.topology.check(bricks, registry.voxel_size)
        if registry.before_claim is not None:
            registry.before_claim(bricks)
        slots = registry.topology.slots(bricks)
        new = (slots < 0) & (found > free + _ROUNDING).any(axis=1)
        if new.any():
            seen = np.isin(grid_keys(bricks[new]), grid_keys(registry.frozen_crossed))
            slots[new] = registry.create(bricks[new])
            found[new] += np.where(seen, np.float32(free), np.float32(0))[:, None]
        registry.see_for_good(bricks)
        held = slots >= 0
        pool.owners[slots[held]] += 1
        pool.write("evidence", slots[held], pool.read("evidence", slots[held]) + found[held])
    parts.frozen.update(enumerate(other.frozen.values(), first_id))
    parts.kept.wanted, parts.kept.share = False, RayShare.nothing()
    parts.settled = False


def check(first: Config, other: Config, window: MovingWindow | None, name: str) -> None:
    """Raise ConfigError, which begins with the ``name`` of the other map, if its frozen evidence cannot be
    moved into the first; these are their parameters, and ``window`` is the other's."""
    mine, its = first.voxel_size, other.voxel_size
    if mine != its:
        raise ConfigError(
            f"{name}: has voxels of {its:g} m, and the first map of {mine:g} m: frozen evidence keeps the "
            f"size of its voxels, so map its recording again with --voxel-size {mine:g}"
        )
    if first.time.half_life_s > 0 or other.time.half_life_s > 0:
        raise ConfigError(
            f"{name}: frozen evidence cannot be moved where time.half_life_s is above 0, because it has one "
            "date: map its recording with --onto the first map"
        )
    if window is not None and len(window.parked):
        raise ConfigError(f"{name}: parts of it are not in memory: pass {window.folder}, which holds all")
