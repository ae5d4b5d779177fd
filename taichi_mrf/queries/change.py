"""Difference between two maps, voxel by voxel."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.queries.known_bricks import BrickReader, Bricks, known_bricks, sorted_bricks
from taichi_mrf.queries.points import FREE, OCCUPIED, UNKNOWN, probability
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.voxels.layout import BRICK, offsets_in_brick

STATES = ("unknown", "free", "occupied")
"""Names of UNKNOWN, FREE and OCCUPIED."""


@dataclass(frozen=True)
class MapChange:
    """Differences of map b from map a.

    ``counts`` (3, 3) int64 is the number of voxels by state in a (row) and in b (column): UNKNOWN, FREE,
    OCCUPIED, without those that are unknown in both. ``mean_difference`` is the mean of |p_b - p_a| over the
    voxels known in both maps, ``mean_difference_known`` over those known in either; 0 without any.
    ``points`` (n, 3) are the centres, in metres, of the voxels whose state has changed, ``before`` and
    ``after`` (n,) int8 their states, ``difference`` (n,) float32 p_b - p_a.
    """

    counts: NDArray[np.int64]
    mean_difference: float
    mean_difference_known: float
    points: NDArray[np.float64]
    before: NDArray[np.int8]
    after: NDArray[np.int8]
    difference: NDArray[np.float32]

    @property
    def only_in_a(self) -> int:
        """Voxels that are known in a and unknown in b."""
        return int(self.counts[UNKNOWN + 1 :, UNKNOWN].sum())

    @property
    def only_in_b(self) -> int:
        """Voxels that are known in b and unknown in a."""
        return int(self.counts[UNKNOWN, UNKNOWN + 1 :].sum())

    @property
    def in_both(self) -> int:
        """Voxels that are known in both maps."""
        return int(self.counts[1:, 1:].sum())

    @property
    def changed(self) -> int:
        """Voxels that are known in both maps and differ in state."""
        return int(self.counts[1, 2] + self.counts[2, 1])

    @property
    def appeared(self) -> NDArray[np.float64]:
        """Centres, (k, 3) in metres, of the voxels that are free in a and occupied in b."""
        return self.points[(self.before == FREE) & (self.after == OCCUPIED)]

    @property
    def vanished(self) -> NDArray[np.float64]:
        """Centres, (k, 3) in metres, of the voxels that are occupied in a and free in b."""
        return self.points[(self.before == OCCUPIED) & (self.after == FREE)]


def compare_maps(a: VoxelMap, b: VoxelMap, bricks: Bricks | None = None) -> MapChange:
    """Compare two maps over all space known in either, including free space without voxels; or only in
    ``bricks``, (n, 3) coordinates.

    States and probabilities are those of each map's ``decided``; pass ``m.marginals`` to compare marginals.
    The maps may be of different methods. Raises ConfigError if their voxels are of different sizes.
    """
    a, b = a.decided, b.decided
    if a.config.volume.origin != b.config.volume.origin:
        raise ConfigError(
            "maps with different origins in the recorded world cannot be compared: "
            "{:.0f} {:.0f} {:.0f} and {:.0f} {:.0f} {:.0f}".format(
                *a.config.volume.origin, *b.config.volume.origin
            )
        )
    if not np.isclose(a.voxel_size, b.voxel_size, rtol=1e-6):
        raise ConfigError(
            f"maps of different voxel sizes cannot be compared: {a.voxel_size:g} m and {b.voxel_size:g} m"
        )
    counts = np.zeros((3, 3), np.int64)
    sums = np.zeros(2)
    parts = []
    readers = BrickReader(a), BrickReader(b)
    if bricks is None:
        bricks = np.concatenate([known_bricks(a), known_bricks(b)])
    bricks = sorted_bricks(bricks)
    for piece, log_odds_a, before in readers[0].batches(bricks):
        log_odds_b = readers[1].log_odds(piece)
        after = readers[1].state(log_odds_b)
        pairs = np.bincount((3 * before + after).reshape(-1), minlength=9)
        counts += pairs.reshape(3, 3)
        difference = probability(log_odds_b) - probability(log_odds_a)
        known_a, known_b = before != UNKNOWN, after != UNKNOWN
        size = np.abs(difference)
        sums += size[known_a & known_b].sum(dtype=np.float64), size[known_a | known_b].sum(dtype=np.float64)
        row, number = np.nonzero(before != after)
        voxels = piece[row].astype(np.float64) * BRICK + offsets_in_brick()[number] + 0.5
        parts.append(
            (voxels * a.voxel_size, before[row, number], after[row, number], difference[row, number])
        )
    counts[UNKNOWN, UNKNOWN] = 0
    parts.append((np.zeros((0, 3)), np.zeros(0, np.int8), np.zeros(0, np.int8), np.zeros(0, np.float32)))
    points, before_, after_, differences = (np.concatenate(part) for part in zip(*parts, strict=True))
    both, either = counts[1:, 1:].sum(), counts.sum()
    means = sums / np.maximum([both, either], 1)
    return MapChange(counts, float(means[0]), float(means[1]), points, before_, after_, differences)
